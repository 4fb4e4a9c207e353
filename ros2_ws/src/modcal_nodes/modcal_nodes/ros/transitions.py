"""Transitions of a lifecycle node whose exceptions are said and counted; rclpy would keep them to itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn


def noted(transition: Callable[[Any, LifecycleState], TransitionCallbackReturn]) -> Callable[..., Any]:
    """A transition of a GuardedNode that notes what it raises among the node's faults, and then has failed."""

    @wraps(transition)
    def noting(self: Any, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(self, state)
        except Exception as error:
            self.faults.note(transition.__name__, error)
            return TransitionCallbackReturn.ERROR

    return noting
