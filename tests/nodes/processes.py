"""Real node processes for tests: started from the install tree, each test in a DDS domain of its own."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import itertools
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import rclpy
from nodes.forking import Forked, Forker
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = ROOT / "ros2_ws" / "install" / "modcal_nodes" / "lib" / "modcal_nodes"
Wait = Callable[[Callable[[], Any], float], Any]  # spins until a condition is true, so many seconds at most
_domains = itertools.count(1 + os.getpid() % 90)
_held: list[TextIO] = []


def fresh_domain() -> int:
    """A domain that no other test uses, of this run or one beside it, as long as this process lives.

    Above 101 ports would collide with those the system hands out. A run that has used them all begins again.
    """
    folder = Path(tempfile.gettempdir()) / "modcal_domains"
    folder.mkdir(exist_ok=True)
    for _ in range(2):
        for _ in range(100):
            domain = 1 + next(_domains) % 100
            lock = (folder / str(domain)).open("w")
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _held.append(lock)
                return domain
            lock.close()
        while _held:
            _held.pop().close()
    raise RuntimeError("all domains are taken by other test runs")


def environment(domain: int) -> dict[str, str]:
    install = ROOT / "ros2_ws" / "install"
    prefixes = [install / name for name in ("modcal_nodes", "modcal_msgs_py", "modcal_core")] + [ROOT / ".venv"]
    return {
        **os.environ,
        "AMENT_PREFIX_PATH": os.pathsep.join(map(str, prefixes)),
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "PYTHONUNBUFFERED": "1",
    }


# On a machine that does other things as well everything takes longer; what succeeds in time is not held up by it.
SLOWER = 4.0
MUTUAL = 0.5  # s, within which two sides of a service have found each other


@functools.cache
def _forker() -> Forker:
    return Forker(environment(0))


class Process:
    """One node process; its output is kept and shown when a test fails.

    from_nothing: in an interpreter of its own, not one that was forked with everything imported. command: another one in
    place of the node's executable, likewise from nothing.
    """

    popen: subprocess.Popen[bytes] | Forked

    def __init__(
        self,
        name: str,
        domain: int,
        folder: Path,
        *arguments: str,
        from_nothing: bool = False,
        command: Sequence[str] = (),
        **parameters: Any,
    ) -> None:
        settings = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
        ros = ["--ros-args", *arguments, *settings] if arguments or settings else []
        self.log = folder / f"{name}-{time.monotonic_ns()}.log"
        words, variables = [*(command or [str(EXECUTABLES / name)]), *ros], environment(domain)
        with self.log.open("wb") as stream:
            if from_nothing or command:
                self.popen = subprocess.Popen(words, env=variables, stdout=stream, stderr=subprocess.STDOUT, cwd=folder)
            else:
                self.popen = _forker().start(words, variables, folder, stream.fileno())

    def stop(self, number: int = signal.SIGTERM, patience: float = 15.0) -> int:
        """Signal the process and return its exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        try:
            return self.popen.wait(SLOWER * patience)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
            raise AssertionError(f"{self.log.name} did not stop:\n{self.output}") from None

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")


@contextlib.contextmanager
def running(*processes: Process) -> Iterator[None]:
    """Make sure that none of them outlives the test, and show what they said when it fails."""
    try:
        yield
    except BaseException:
        for process in processes:
            print(f"--- {process.log.name}\n{process.output[-4000:]}")
        raise
    finally:
        for process in processes:
            if process.popen.poll() is None:
                process.popen.kill()
                process.popen.wait()


def meet(wait: Wait, client: Any) -> None:
    """Wait for a server, and a moment more: one that was just found may not have found the caller, and its answer is lost."""
    if not client.service_is_ready():
        wait(client.service_is_ready, 60.0)
        found = time.monotonic() + MUTUAL
        wait(lambda: time.monotonic() > found, 10.0)


def ask(node: Node, wait: Wait, kind: type, name: str, request: Any = None, patience: float = 30.0) -> Any:
    """The answer of a service; asked again where the question was lost."""
    clients = node.__dict__.setdefault("asked_by_tests", {})
    client = clients.setdefault(name, clients.get(name) or node.create_client(kind, name))
    meet(wait, client)
    for _ in range(3):
        answer = client.call_async(request or kind.Request())
        with contextlib.suppress(AssertionError):
            wait(answer.done, 0.5 * patience)
            return answer.result()
    raise AssertionError(f"{name} does not answer")


class Goal:
    """A goal of an action, sent to a server that is there. ``heard``: its feedback so far."""

    def __init__(self, node: Node, wait: Wait, kind: Any, name: str) -> None:
        clients = node.__dict__.setdefault("actions_by_tests", {})
        client = clients.setdefault(name, clients.get(name) or ActionClient(node, kind, name))
        self._wait, self.heard = wait, list[Any]()
        wait(client.server_is_ready, 30.0)
        found = time.monotonic() + MUTUAL
        wait(lambda: time.monotonic() > found, 10.0)
        sent = client.send_goal_async(kind.Goal(), feedback_callback=lambda m: self.heard.append(m.feedback))
        wait(sent.done, 30.0)
        self._handle = sent.result()
        self._result = self._handle.get_result_async()

    @property
    def done(self) -> bool:
        """Whether its result has come."""
        return bool(self._result.done())

    def cancel(self) -> bool:
        """Ask for an early end; whether that was accepted."""
        asked = self._handle.cancel_goal_async()
        self._wait(asked.done, 30.0)
        return bool(asked.result().goals_canceling)

    def result(self, patience: float = 60.0) -> tuple[int, Any]:
        """The status of action_msgs and the result, once it has ended."""
        self._wait(self._result.done, patience)
        return self._result.result().status, self._result.result().result


def put(node: Node, wait: Wait, who: str, **values: Any) -> str:
    """Set parameters of a node as `ros2 param set` does; why one was refused, or nothing."""
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParameters.Request(parameters=parameters)
    results = ask(node, wait, SetParameters, f"{who}/set_parameters", request).results
    assert all(result.successful or result.reason for result in results)
    return "; ".join(result.reason for result in results if not result.successful)


@contextlib.contextmanager
def listener(domain: int, kind: type[Node] = Node) -> Iterator[tuple[Node, Wait]]:
    """A node of the test's own, and ``wait(condition, seconds)`` that spins it until the condition is true."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = kind("test_listener", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def wait(condition: Callable[[], Any], seconds: float) -> Any:
        end = time.monotonic() + SLOWER * seconds
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
            if value := condition():
                return value
        raise AssertionError(f"waited {SLOWER * seconds:g} s in vain")

    try:
        yield node, wait
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@contextlib.contextmanager
def beside(folder: Path, name: str, *arguments: str, **parameters: Any) -> Iterator[tuple[Process, Node, Wait]]:
    """A node process in a domain of its own, and a node of the test's own beside it, with its ``wait``."""
    domain = fresh_domain()
    process = Process(name, domain, folder, *arguments, **parameters)
    with running(process), listener(domain) as (node, wait):
        yield process, node, wait
