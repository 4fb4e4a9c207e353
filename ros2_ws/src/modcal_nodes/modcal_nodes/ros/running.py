"""Starting and stopping a node: the same for all of them.

Executor for nodes that receive a thousand messages a second and need not answer within a millisecond.

Each call of rclpy's executor collects every entity of the node again (subscriptions, services, events). That takes 0.5
to 1.5 ms of processor and yields one message a topic. While messages arrive, this executor takes them from their
subscriptions directly, every few milliseconds; it also runs timers that are due. rclpy's executor is called ten times a
second for the rest: requests, events of the middleware, and waiting coroutines. It waits when nothing has arrived for a
while.
"""

from __future__ import annotations

import contextlib
import gc
import inspect
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import (
    ConditionReachedException,
    ExternalShutdownException,
    InvalidHandle,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from modcal_core.errors import BadTable, ModcalError
from modcal_nodes.ros.guarded import GuardedNode, NodeEnds, described
from modcal_nodes.ros.parameters import NODES

_LOOKED = 0.1  # s between two looks of the executor while messages come
_IDLE = 0.02  # s without a message, after which the executor waits for the next: it wakes at once, and costs nothing
_SIMULATED = 0.002  # s, the longest rest in simulated time, which is read when a message is taken
_LONGEST = 1.0  # s until a timer of a node that has none


class RestingExecutor(SingleThreadedExecutor):
    """One node's executor. rest: seconds between two looks for messages; 0: as rclpy's."""

    def __init__(self, node: GuardedNode, rest: float = 0.0) -> None:
        super().__init__()
        self._node, self._rest = node, rest
        self._looked = self._heard = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle what there is; without anything, wait for it."""
        node = self._node
        if not self._rest or node.hurried:
            super().spin_once(timeout_sec)
            return
        heard = node.take_waiting()
        ran, due = self._run_timers()
        now = time.monotonic()
        if heard:
            self._heard = now
        elif not ran and now - self._heard > _IDLE:
            self._serve(timeout_sec)
            heard = node.take_waiting()
            due = 0.0  # of timers nothing is known after a wait
        if now - self._looked > _LOOKED:
            self._looked = now
            while self._serve(0.0):
                pass
        if heard < node.most_at_once:  # else more waits
            longest = min(self._rest, _SIMULATED) if node.get_clock().ros_time_is_active else self._rest
            time.sleep(min(longest, max(due - time.monotonic(), 0.0)))

    def _run_timers(self) -> tuple[bool, float]:
        """Run what is due; whether something was, and when the next will be, by the monotonic clock [s]."""
        ran, until = False, _LONGEST
        for timer in list(self._node.timers):
            with contextlib.suppress(InvalidHandle):  # one before it may have taken it away
                wait = timer.time_until_next_call()  # None of one that is cancelled
                if wait is not None and wait <= 0:
                    if not timer.callback_group.can_execute(timer):
                        continue
                    ran = True
                    with timer.handle:
                        timer.handle.call_timer()
                    timer.callback()
                    wait = timer.time_until_next_call()
                if wait is not None:
                    until = min(until, 1e-9 * wait)
        return ran, time.monotonic() + until

    def _serve(self, timeout: float | None) -> bool:
        """Run the next callback that is ready; whether there was one."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return False
        handler()
        handler.result()  # raises what the callback has raised
        return True


_PATIENCE = 10.0  # s after the first signal, from which another one interrupts what hangs


class SignalGuard:
    """SIGINT and SIGTERM set ``asked``, and nothing else, however often they come."""

    def __init__(self) -> None:
        self.asked = False
        self._since = 0.0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if not self.asked:
            self.asked, self._since = True, time.monotonic()
        elif time.monotonic() - self._since > _PATIENCE:
            raise KeyboardInterrupt

    def done(self) -> None:
        """Closed: what comes from now on must not end Python's own end, which would restore what signals do."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)

    def wake(self, wake: Callable[[], object]) -> None:
        """Have this called, from a thread, at every signal: a wait outside Python would not see it."""
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        self._ends = ours, theirs  # open as long as this is

        def listen() -> None:
            while ours.recv(64):
                wake()

        threading.Thread(target=listen, name="signals", daemon=True).start()


_WIDTH = 120
_ROS = (
    "  --ros-args -p NAME:=VALUE          a parameter",
    "  --ros-args --params-file FILE      parameters from a file",
    "  --ros-args -r FROM:=TO             another name for a topic or service; __ns:=/arm puts all in a namespace",
    "  --ros-args --log-level LEVEL       debug, info, warn, error or fatal",
)


def answered(make: Callable[[], Any], arguments: Sequence[str] | None = None) -> int | None:
    """The exit code, if the arguments ask for help or are none that a node has; None: the node is to be started."""
    words = list(sys.argv if arguments is None else arguments)
    name = Path(words[0]).name if words else ""
    if any(word in ("-h", "--help") for word in words[1:]):
        print(help_text(name, make), flush=True)
        return 0
    try:
        own = remove_ros_args(words)[1:]
    except RuntimeError as error:  # rcl's own errors have no public name
        print(f"modcal: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if own:
        print(f"modcal: {own[0]}: is not an argument of {name}: see {name} --help", file=sys.stderr)
        return 2
    return None


def help_text(name: str, make: Callable[[], Any]) -> str:
    """Usage, what the node does, and its parameters with defaults."""
    about = inspect.cleandoc(inspect.getdoc(make) or "").splitlines()[:1]
    lines = [f"usage: ros2 run modcal_nodes {name} [--ros-args ...]", "", *about, "", *_ROS]
    if parameters := NODES.get(name):
        lines += ["", "Parameters (those marked * may be changed while it runs):"]
        for key, parameter in parameters.items():
            default = parameter.default if parameter.default != "" else '""'
            bounds = "" if parameter.low is None else f", {parameter.low:g} to {parameter.high:g}"
            lines += [f" {'*' if parameter.live else ' '}{key} ({default}{bounds})"]
            lines += [f"      {parameter.description}"[:_WIDTH]]
    lines += [
        "",
        "Exit code 0: stopped on request. 2: unusable parameters, files or disk, one line on stderr. 1: a fault.",
    ]
    return "\n".join(lines)


RCLError = rclpy_implementation.RCLError
_PAUSE = 0.05  # s after a fault of the executor itself, so that one that lasts does not take the processor

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# nothing is lost where the publisher can repeat it; one that cannot is heard as it is, see subscriptions.py
SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
# what is acted on at once: a long queue would only make it old
FRESH = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def run(make: Callable[[], GuardedNode], rest: float = 0.0) -> None:
    """Spin the node until it is stopped (Ctrl-C, SIGTERM, shutdown), then close it, however often it is told.

    rest: seconds between two looks for messages, of a node that need not answer within a millisecond. A look of the
    executor costs as much as handling ten messages, so while messages come they are taken past it.

    ``--help`` is answered in place of starting. A ModcalError while it starts or closes, NodeEnds, a parameter outside
    its bounds, or a file that is not there, ends the process with exit code 2 and one line on stderr.
    """
    if (code := answered(make)) is not None:
        sys.exit(code)
    stopping = SignalGuard()
    code = 0
    node: GuardedNode | None = None
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = make()
        executor = RestingExecutor(node, rest)
        executor.add_node(node)
        stopping.wake(executor.wake)
        gc.collect()
        gc.freeze()  # looking through all modules for garbage would hold up messages for some 45 ms each time
        while rclpy.ok() and not stopping.asked:
            spin_once(executor, node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except NodeEnds as end:
        code = _refused(end.error)
    except (ModcalError, ParameterException, RCLError) as error:
        # RCLError: arguments that rcl cannot read, or the context has ended between two looks at it
        code = _refused(error) if node is None or rclpy.ok() else 0
    except OSError as error:  # of a file that a parameter names
        if node is not None or not error.filename:
            raise
        code = _refused(BadTable(str(error.filename), error.strerror or "cannot be read", "correct the parameter"))
    finally:
        code = max(code, _close(node))
        rclpy.try_shutdown()
        stopping.done()
    sys.exit(code)


def spin_once(executor: SingleThreadedExecutor, node: GuardedNode) -> None:
    """One look for messages. What fails outside of every guarded callback is noted as well, and the node goes on."""
    try:
        executor.spin_once()
    except (NodeEnds, ExternalShutdownException):
        raise
    except Exception as error:
        if not node.context.ok():
            raise
        node.faults.note("executor", error)
        time.sleep(_PAUSE)


def _refused(error: Exception) -> int:
    print(f"modcal: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def _close(node: GuardedNode | None) -> int:
    if node is None:
        return 0
    try:
        node.close()
    except NodeEnds as end:
        return _refused(end.error)
    except ModcalError as error:
        return _refused(error)
    except Exception as error:
        if not rclpy.ok():  # the context was ended by somebody else: nothing can be published any more
            return 0
        print(f"modcal: closing failed: {described(error)}", file=sys.stderr)
        return 1
    finally:
        node.destroy_node()
    return 0


def settle_in(yielding: int = 0) -> None:
    """Leave Ctrl-C to the parent, and end with it, however that ends. yielding: by how much nicer than it."""
    if yielding:
        os.nice(yielding)
    # Ctrl-C in a terminal reaches every process of the group; the parent decides when this one ends
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
