"""Real nodes spun in the test's own process, as their executables spin them, with a partner to talk to over DDS."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.processes import MUTUAL, SLOWER, fresh_domain
from rclpy.executors import SingleThreadedExecutor

from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import spin_once


class Pair:
    """A node under test, and a partner in the same domain; ``wait`` spins both."""

    def __init__(self, node: GuardedNode) -> None:
        self.node, self.partner = node, rclpy.create_node("test_partner", use_global_arguments=False)
        self._clients: dict[str, Any] = {}
        self._executors = []
        for each in (node, self.partner):
            executor = SingleThreadedExecutor()
            executor.add_node(each)
            executor.spin_once_ = executor.spin_once  # type: ignore[attr-defined]
            self._executors.append(executor)
        # spin_once of the node's executor waits; here it only looks
        node_executor = self._executors[0]
        node_executor.spin_once = lambda: node_executor.spin_once_(0.002)  # type: ignore[attr-defined,method-assign]

    def spin(self) -> None:
        """One look of each."""
        spin_once(self._executors[0], self.node)
        self._executors[1].spin_once(0.002)

    def wait(self, condition: Callable[[], Any], seconds: float) -> Any:
        """Spin until the condition is true."""
        end = time.monotonic() + SLOWER * seconds
        while time.monotonic() < end:
            self.spin()
            if value := condition():
                return value
        raise AssertionError(f"waited {SLOWER * seconds:g} s in vain")

    def meet(self, services: Iterable[tuple[Any, str]]) -> None:
        """Find these services (type, name), and be found by them."""
        for kind, name in services:
            self._clients.setdefault(name, self.partner.create_client(kind, name))
        for client in self._clients.values():
            self.wait(client.service_is_ready, 5.0)
        found = time.monotonic() + MUTUAL
        self.wait(lambda: time.monotonic() > found, 5.0)

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """The answer of a service."""
        if name not in self._clients:
            self.meet([(kind, name)])
        answer = self._clients[name].call_async(request or kind.Request())
        self.wait(answer.done, 5.0)
        return answer.result()

    def told(self) -> list[DiagnosticStatus]:
        """What is said on /diagnostics from now on."""
        heard: list[DiagnosticStatus] = []
        self.partner.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 50)
        return heard

    def close(self) -> None:
        """As running.py closes a node."""
        self.node.close()
        self.partner.destroy_node()
        self.node.destroy_node()


@contextlib.contextmanager
def spun(make: Callable[[], GuardedNode], **parameters: Any) -> Iterator[Pair]:
    """A node made by ``make`` with these parameters, in a domain of its own."""
    settings = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    rclpy.init(args=["--ros-args", *settings] if settings else [], domain_id=fresh_domain())
    pair: Pair | None = None
    try:
        pair = Pair(make())
        yield pair
    finally:
        if pair is not None:
            pair.close()
        rclpy.try_shutdown()
