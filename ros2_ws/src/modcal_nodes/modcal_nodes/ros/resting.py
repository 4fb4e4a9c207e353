"""An executor for nodes that hear a thousand messages a second and need not answer within a millisecond.

Each look of rclpy's executor gathers every entity of the node anew, 0.1 to 0.25 ms of processor, and brings one message
a topic. While messages come, they are taken from their subscriptions without it, every few milliseconds; it is asked
when a timer is due, a hundred times a second for services and events, and whenever nothing has come, to wait.
"""

from __future__ import annotations

import time

from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node

from modcal_nodes.ros.guarded import GuardedNode

_SERVED = 0.01  # s between two looks at services and events while messages come
_SOON = 2e-4  # s; a timer that is due this soon is not rested before
_SIMULATED = 0.002  # s, the longest rest in simulated time, which is read when a message is taken


class RestingExecutor(SingleThreadedExecutor):
    """One node's executor. rest: seconds between two looks for messages; 0: as rclpy's."""

    def __init__(self, node: Node, rest: float = 0.0) -> None:
        super().__init__()
        self._node, self._rest = node, rest
        self._served = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle what there is; without anything, wait for it."""
        node = self._node
        if not self._rest or not isinstance(node, GuardedNode) or node.hurried:
            super().spin_once(timeout_sec)
            return
        heard = node.take_waiting()
        if not heard:
            self._serve(timeout_sec)
            heard = node.take_waiting()
        due = _until_timer(node)
        if due < _SOON or time.monotonic() - self._served > _SERVED:
            self._served = time.monotonic()
            while self._serve(0.0):
                pass
            due = _until_timer(node)
        if heard < node.most_at_once:  # else more waits
            longest = min(self._rest, _SIMULATED) if node.get_clock().ros_time_is_active else self._rest
            time.sleep(min(longest, due))

    def _serve(self, timeout: float | None) -> bool:
        """Run the next callback that is ready; whether there was one."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return False
        handler()
        if (error := handler.exception()) is not None:
            raise error
        handler.result()
        return True


def _until_timer(node: Node) -> float:
    """Seconds until the next timer of a node is due; 0 where one is."""
    due = [timer.time_until_next_call() for timer in node.timers if not timer.is_canceled()]
    return max(1e-9 * min((ns for ns in due if ns is not None), default=1e9), 0.0)
