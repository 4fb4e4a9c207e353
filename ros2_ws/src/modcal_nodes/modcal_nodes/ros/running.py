"""Starting and stopping a node: the same for all of them."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from modcal_core.errors import ModcalError
from modcal_nodes.ros.guarded import GuardedNode, NodeEnds, described
from modcal_nodes.ros.resting import RestingExecutor
from modcal_nodes.ros.signals import SignalGuard
from modcal_nodes.ros.usage import answered

RCLError = rclpy_implementation.RCLError
_PAUSE = 0.05  # s after a fault of the executor itself, so that one that lasts does not take the processor

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# nothing is lost where the publisher can repeat it; one that cannot is heard as it is, see subscriptions.py
SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
# what is acted on at once: a long queue would only make it old
FRESH = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def run(make: Callable[[], Node], rest: float = 0.0) -> None:
    """Spin the node until it is stopped (Ctrl-C, SIGTERM, shutdown), then close it, however often it is told.

    rest: seconds between two looks for messages, of a node that need not answer within a millisecond. A look of the
    executor costs as much as handling ten messages, so while messages come they are taken past it (see resting.py).

    ``--help`` is answered in place of starting. A ModcalError while it starts or closes, NodeEnds, or a parameter
    outside its bounds, ends the process with exit code 2 and one line on stderr.
    """
    if (code := answered(make)) is not None:
        sys.exit(code)
    stopping = SignalGuard()
    code = 0
    node: Node | None = None
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
    finally:
        code = max(code, _close(node))
        rclpy.try_shutdown()
        stopping.done()
    sys.exit(code)


def spin_once(executor: SingleThreadedExecutor, node: Node) -> None:
    """One look for messages. What fails outside of every guarded callback is noted as well, and the node goes on."""
    try:
        executor.spin_once()
    except (NodeEnds, ExternalShutdownException):
        raise
    except Exception as error:
        if not node.context.ok() or not isinstance(node, GuardedNode):
            raise
        node.faults.note("executor", error)
        time.sleep(_PAUSE)


def _refused(error: Exception) -> int:
    print(f"modcal: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def _close(node: Node | None) -> int:
    if node is None:
        return 0
    try:
        if hasattr(node, "close"):
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
