"""Executor for nodes that receive a thousand messages a second and need not answer within a millisecond.

Each call of rclpy's executor collects every entity of the node again (subscriptions, services, events). That takes 0.5
to 1.5 ms of processor and yields one message a topic. While messages arrive, this executor takes them from their
subscriptions directly, every few milliseconds; it also runs timers that are due and answers requests. rclpy's executor
is called four times a second for the rest: events of the middleware, and waiting coroutines. It waits when nothing has
arrived for a while.
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
    await_or_execute,
)
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task

from modcal_nodes.ros.guarded import GuardedNode

_ANSWERED = 0.03  # s between two looks at requests while messages come
_LOOKED = 0.25  # s between two looks of the executor while messages come
_PAUSE = 0.02  # s without a message, after which the executor waits for the next: it wakes at once, and costs nothing
_SIMULATED = 0.002  # s, the longest rest in simulated time, which is read when a message is taken
_LONGEST = 1.0  # s until a timer of a node that has none


class RestingExecutor(SingleThreadedExecutor):
    """One node's executor. rest: seconds between two looks for messages; 0: as rclpy's."""

    def __init__(self, node: Node, rest: float = 0.0) -> None:
        super().__init__()
        self._node, self._rest = node, rest
        self._answered = self._looked = self._heard = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Handle what there is; without anything, wait for it."""
        node = self._node
        if not self._rest or not isinstance(node, GuardedNode) or node.hurried:
            super().spin_once(timeout_sec)
            return
        heard = node.take_waiting()
        ran, due = self._run_timers()
        now = time.monotonic()
        if heard:
            self._heard = now
        elif not ran and now - self._heard > _PAUSE:
            self._serve(timeout_sec)
            heard = node.take_waiting()
            due = 0.0  # of timers nothing is known after a wait
        if now - self._answered > _ANSWERED:
            self._answered = now
            self._answer()
        if now - self._looked > (_ANSWERED if node.heard_by_executor else _LOOKED):
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

    def _answer(self) -> None:
        for service in list(self._node.services):
            if not service.callback_group.can_execute(service):
                continue
            with contextlib.suppress(InvalidHandle):
                with service.handle:
                    request, header = service.handle.service_take_request(service.srv_type.Request)
                if header is not None:
                    _run(self._make_handler(service, self._node, _answering(request, header)))

    def _serve(self, timeout: float | None) -> bool:
        """Run the next callback that is ready; whether there was one."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return False
        _run(handler)
        return True


def _answering(request: Any, header: Any) -> Any:
    """What rclpy makes of a request that was taken: from its service a coroutine function that answers it."""

    def take(service: Service) -> Any:
        async def answer() -> None:
            response = await await_or_execute(service.callback, request, service.srv_type.Response())
            service.send_response(response, header)

        return answer

    return take


def _run(handler: Task[Any]) -> None:
    handler()
    if (error := handler.exception()) is not None:
        raise error
    handler.result()
