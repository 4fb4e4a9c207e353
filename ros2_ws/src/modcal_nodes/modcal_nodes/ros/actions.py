"""Types of modcal_interfaces, and actions of a node that does one thing at a time.

rclpy looks at a waiting coroutine in every turn of its executor, so no coroutine waits here: an accepted goal is kept
until the node says how its work has ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import GoalEvent, ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from modcal_core.errors import BadTable, ModcalError
from modcal_msgs_py import require_version
from modcal_nodes.ros.guarded import GuardedNode

DONE, REFUSED, FAILED, CANCELLED = 1, 2, 3, 4  # outcomes of every action, whatever their names there
_FEEDBACK = 0.2  # s


def interface(name: str) -> Any:
    """The message, action or service of that name. Raises BadTable where modcal_interfaces is not built."""
    for kind in ("msg", "action", "srv"):
        try:
            found = getattr(import_module(f"modcal_interfaces.{kind}"), name, None)
        except ImportError as error:
            remedy = "run make build; where ROS is from apt, build the workspace with colcon and source it"
            raise BadTable("package modcal_interfaces", "is not built", remedy) from error
        if found is not None:
            return found
    raise AttributeError(f"modcal_interfaces has no {name}")


class Action:
    """One action: at most one goal at a time, with feedback while it is active."""

    def __init__(
        self,
        node: GuardedNode,
        kind: str,
        begin: Callable[[], str],
        cancel: Callable[[], None],
        progress: Callable[[Any], None],
        trigger: bool = False,
    ) -> None:
        """kind: such as Solve, whose name below the node's is ~/solve. begin: returns why it cannot, or nothing; what
        has begun ends with a call of :meth:`end`. cancel: makes it end soon. progress: fills the feedback. trigger:
        whether a Trigger of the same name is answered with the end of what it begins.
        """
        self._node, self._type, self.name = node, interface(kind), f"~/{kind.lower()}"
        self._begin, self._cancel, self._progress = begin, cancel, progress
        self._goal: ServerGoalHandle | None = None
        self._waiting: Future | None = None
        self._timer: Timer | None = None
        self._begun = 0.0
        self._server = ActionServer(
            node, self._type, self.name, lambda _: None,
            handle_accepted_callback=self._accept, cancel_callback=self._ask_to_cancel,
        )  # fmt: skip
        if trigger:
            # a group of its own: while an end is awaited, its group takes no other callback
            node.create_service(Trigger, self.name, self._await, callback_group=ReentrantCallbackGroup())

    @property
    def active(self) -> bool:
        """Whether a goal is pursued."""
        return self._goal is not None

    @property
    def elapsed(self) -> float:
        """Seconds since something was begun by it."""
        return time.monotonic() - self._begun

    async def _await(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begun = time.monotonic()
        if refusal := self._node.idle or self._begin():
            response.success, response.message = False, refusal
            return response
        self._waiting = Future(executor=self._node.executor)
        result = await self._waiting
        response.success, response.message = result.outcome == DONE, result.message
        return response

    def end(self, outcome: int, message: str, **fields: Any) -> None:
        """What was going on has ended so. fields: of the result, beside outcome and message."""
        result = self._type.Result(outcome=outcome, message=message, **fields)
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.set_result(result)
        if self._goal is not None:
            goal, self._goal = self._goal, None
            self._close(goal, result)

    def _accept(self, goal: ServerGoalHandle) -> None:
        goal._update_state(GoalEvent.EXECUTE)  # execute() would call a function, which had to wait
        if self._goal is not None:
            self._close(goal, self._type.Result(outcome=REFUSED, message=f"{self.name}: another goal is active"))
            return
        self._goal, self._begun = goal, time.monotonic()
        try:
            require_version(goal.request, self.name)
            if refusal := self._node.idle or self._begin():
                self.end(REFUSED, refusal)
        except ModcalError as error:
            self.end(REFUSED, str(error))
        except Exception as error:
            self.end(FAILED, self._node.faults.note(f"action {self.name}", error))
        if self._goal is goal:
            self._timer = self._node.create_timer(_FEEDBACK, self._tell, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _tell(self) -> None:
        if self._goal is not None:
            feedback = self._type.Feedback()
            self._progress(feedback)
            self._goal.publish_feedback(feedback)

    def _ask_to_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal is not self._goal:
            return CancelResponse.REJECT
        try:
            self._cancel()
        except Exception as error:
            self._node.faults.note(f"cancelling {self.name}", error)
        return CancelResponse.ACCEPT

    def _close(self, goal: ServerGoalHandle, result: Any) -> None:
        """Give the goal its result, once it is known whether it was cancelled."""
        self._server.notify_execute(goal, partial(_closed, result))


def _closed(result: Any, goal: ServerGoalHandle) -> Any:
    if result.outcome == DONE:
        goal.succeed()
    elif goal.is_cancel_requested:
        result.outcome = CANCELLED
        goal.canceled()
    else:
        goal.abort()
    return result
