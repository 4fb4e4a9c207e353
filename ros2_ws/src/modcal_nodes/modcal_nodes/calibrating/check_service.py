"""The calibrator's ``~/check``: one check at a time, by the worker, its answer when it is known."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.task import Future

from modcal_nodes.calibrating.check import LiveCheck, live_check
from modcal_nodes.calibrating.worker import SolveWorker

_CHECK = "check"


class CheckService:
    """Checks of the trusted model. publish: takes the text of check.json."""

    def __init__(self, node: Node, worker: SolveWorker, publish: Callable[[str], None]) -> None:
        self._node, self._worker, self._publish = node, worker, publish
        self._waiting: Future | None = None

    @property
    def busy(self) -> str:
        """What the worker is doing; empty: nothing."""
        return self._worker.doing or (_CHECK if self._waiting is not None else "")

    async def answered(self, *work: Any) -> tuple[bool, str]:
        """Whether the check was done, and its sentence. work: the arguments of :func:`live_check`."""
        self._waiting = Future(executor=self._node.executor)
        self._worker.give(_CHECK, live_check, *work, finish=self._found, fail=partial(self._answer, False))
        success, message = await self._waiting
        return success, message

    def _found(self, check: LiveCheck) -> None:
        self._publish(check.data)
        if check.changed:
            self._node.get_logger().warning(f"check: {check.sentence}")
        else:
            self._node.get_logger().info(f"check: {check.sentence}")
        self._answer(True, check.sentence)

    def _answer(self, success: bool, message: str) -> None:
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.set_result((success, message))
