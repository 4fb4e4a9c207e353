"""An executor for nodes that hear a thousand messages a second and need not answer within a millisecond.

Each look of rclpy's executor gathers every entity of the node anew, 0.1 to 0.25 ms of processor, and brings one message
a topic. While messages come, they are taken from their subscriptions without it, every few milliseconds, and timers
that are due are run without it. It is asked some thirty times a second for services and events, and waits once nothing
has come for a while.
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

from rclpy.executors import (
    ConditionReachedException,
    InvalidHandle,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.task import Task

from modcal_nodes.ros.guarded import GuardedNode

_SERVED = 0.03  # s between two looks at services and events while messages come
_PAUSE = 0.02  # s without a message, after which the executor waits for the next: it wakes at once, and costs nothing
_SIMULATED = 0.002  # s, the longest rest in simulated time, which is read when a message is taken


class RestingExecutor(SingleThreadedExecutor):
    """One node's executor. rest: seconds between two looks for messages; 0: as rclpy's."""

    def __init__(self, node: Node, rest: float = 0.0) -> None:
        super().__init__()
        self._node, self._rest = node, rest
        self._served = self._heard = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle what there is; without anything, wait for it."""
        node = self._node
        if not self._rest or not isinstance(node, GuardedNode) or node.hurried:
            super().spin_once(timeout_sec)
            return
        heard = node.take_waiting()
        ran = self._run_timers()
        now = time.monotonic()
        if heard:
            self._heard = now
        elif not ran and now - self._heard > _PAUSE:
            self._serve(timeout_sec)
            heard = node.take_waiting()
        if now - self._served > _SERVED:
            self._served = now
            while self._serve(0.0):
                pass
        if heard < node.most_at_once:  # else more waits
            longest = min(self._rest, _SIMULATED) if node.get_clock().ros_time_is_active else self._rest
            time.sleep(min(longest, _until_timer(node)))

    def _run_timers(self) -> bool:
        """Run what is due; whether something was."""
        ran = False
        for timer in list(self._node.timers):
            with contextlib.suppress(InvalidHandle):  # one before it may have taken it away
                if timer.is_ready():
                    ran = True
                    _run(self._make_handler(timer, self._node, self._take_timer))
        return ran

    def _serve(self, timeout: float | None) -> bool:
        """Run the next callback that is ready; whether there was one."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return False
        _run(handler)
        return True


def _run(handler: Task[Any]) -> None:
    """Run a callback, and raise what it raises."""
    handler()
    if (error := handler.exception()) is not None:
        raise error
    handler.result()


def _until_timer(node: Node) -> float:
    """Seconds until the next timer of a node is due; 0 where one is."""
    due = [timer.time_until_next_call() for timer in node.timers if not timer.is_canceled()]
    return max(1e-9 * min((ns for ns in due if ns is not None), default=1e9), 0.0)
