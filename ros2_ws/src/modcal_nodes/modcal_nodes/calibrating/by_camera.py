"""The calibrator's part that works from corners: when to solve, what becomes of a result, what was moved since."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from modcal_core.camera.watching import Moved
from modcal_core.files import write_folder
from modcal_core.online.supervisor import BETTER
from modcal_nodes.calibrating.arm import KnownArm
from modcal_nodes.calibrating.buffer import Buffer
from modcal_nodes.calibrating.corners import LEAST, CameraSolved, CornerIntake, solve_corners
from modcal_nodes.calibrating.publishers import Publishers
from modcal_nodes.calibrating.worker import SolveWorker


class _Log(Protocol):
    def info(self, message: str) -> Any: ...

    def warning(self, message: str) -> Any: ...


class ByCamera:
    """Solves of corners. intake: the images so far. trusted: is called with files that are trusted from now on."""

    def __init__(
        self,
        intake: CornerIntake,
        chosen: dict[str, Any],
        outputs: Publishers,
        log: _Log,
        trusted: Callable[[dict[str, str]], None],
    ) -> None:
        """chosen: the node's parameters."""
        self.intake = intake
        self._chosen, self._outputs, self._log, self._trusted = chosen, outputs, log, trusted
        self._candidate: CameraSolved | None = None
        self._said: Moved | None = None

    def begin(
        self, name: str, arm: KnownArm, buffer: Buffer, worker: SolveWorker, answer: Callable[[bool, str], None]
    ) -> str:
        """Have the corners solved by the worker, under this name; returns why not, or nothing."""
        count = len(self.intake.images)
        if count < LEAST:
            return f"{count} images of the target at different postures, at least {LEAST} are needed"
        chosen = self._chosen
        job = self.intake.job(
            urdf=arm.description,
            base=chosen["base"],
            tip=arm.chain.tip if arm.chain is not None else chosen["tip"],
            seed=chosen["seed"],
            effects=chosen["effects"],
            heard=buffer.collected(),
            clock_limit=chosen["clock_limit_s"],
            page=bool(chosen["out"]),
        )
        done = partial(self._solved, buffer, buffer.forgotten, answer)
        worker.give(name, solve_corners, job, finish=done, fail=partial(answer, False))
        return ""

    def _solved(self, buffer: Buffer, then: int, answer: Callable[[bool, str], None], solved: CameraSolved) -> None:
        """Publish what corners have led to; trust it where that is its advice and the policy."""
        if then != buffer.forgotten:
            answer(False, "the data it was solved from have been cleared since")
            return
        if self._chosen["out"]:
            write_folder(Path(self._chosen["out"]), solved.files)
        self.intake.solved(solved)
        self._candidate, self._said = solved, None
        if solved.apply and self._chosen["accept"] == BETTER:
            self.accept()
        self._log.info(solved.verdict)
        answer(True, solved.verdict)

    def accept(self) -> bool:
        """Trust the last result; returns whether there was one that is not trusted yet."""
        if self._candidate is None:
            return False
        files, self._candidate = self._candidate.files, None
        self._trusted(files)
        self._outputs.model(files)
        self._outputs.no_change()
        return True

    def forget(self) -> None:
        """Begin anew with the images; the trusted model stays."""
        self.intake.forget()
        self._candidate = self._said = None

    def tell(self) -> bool:
        """Say what images show to have been moved, once; returns whether there was anything to say."""
        moved = self.intake.moved
        if moved is None or (self._said is not None and self._said.what == moved.what):
            return False
        self._said = moved
        self._outputs.moved(moved)
        self._log.warning(f"{moved.sentence}; the last trusted model is still published")
        return True
