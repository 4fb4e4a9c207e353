"""The calibrator's part that works from corners: when to solve, what becomes of a result, what was moved since."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger

from modcal_core.camera import BoardView, Moved
from modcal_core.files import write_folder
from modcal_core.geometry import Array
from modcal_core.online import BETTER
from modcal_nodes.calibrating.corners import MIN, CameraSolved, CornerIntake, CornerJob, solve_corners
from modcal_nodes.calibrating.intake import Buffer, KnownArm
from modcal_nodes.calibrating.state import KeptImages, forget_images, read_images, write_images
from modcal_nodes.calibrating.worker import Publishers, SolveWorker


class ByCamera:
    """Solves of corners. intake: the images so far. trusted: is called with files that are trusted from now on."""

    def __init__(
        self,
        intake: CornerIntake,
        chosen: dict[str, Any],
        outputs: Publishers,
        log: RcutilsLogger,
        trusted: Callable[[dict[str, str]], None],
    ) -> None:
        """chosen: the node's parameters."""
        self.intake = intake
        self._chosen, self._outputs, self._log, self._trusted = chosen, outputs, log, trusted
        self._candidate: CameraSolved | None = None
        self._said: Moved | None = None
        self._folder = Path(chosen["state"]) if chosen["state"] else None
        self._given: list[list[tuple[BoardView, Array]]] = []  # of each camera, what the last solve came from
        self._was_trusted = self._restoring = False
        kept = None if self._folder is None else read_images(self._folder, intake.target)
        if kept is not None:
            self._was_trusted = self._restoring = kept.trusted
            for one, images, size in zip(intake.every, kept.images, kept.sizes, strict=False):
                one.images, one.size = images, size if images else None

    def restore(self, arm: KnownArm, buffer: Buffer, worker: SolveWorker) -> None:
        """Go on with what was trusted before a restart: have its images solved again, once the arm is known."""
        if not self._restoring or worker.doing:
            return
        of_arm = arm.chain is not None and all(len(q) == arm.chain.n for _, q in self.intake.images)
        said = "its images are of another arm" if not of_arm else ""
        if of_arm:
            said = self.begin("restoring", arm, buffer, worker, self._restored)
        if said:
            self._restored(False, said)

    def _restored(self, success: bool, message: str) -> None:
        if not success:
            self._restoring = self._was_trusted = False
            self._log.warning(f"the model by camera that was trusted is not used: {message}")

    def keep(self) -> None:
        """Keep the images on disk, to go on from them after a restart; of a trusted model those that it came from."""
        every = self.intake.every
        given = self._given if self._was_trusted else [one.images for one in every]
        if self._folder is not None and any(given):
            sizes = [one.size or (0, 0) for one in every]
            write_images(self._folder, KeptImages(given, sizes, self._was_trusted), self.intake.target)

    def begin(
        self, name: str, arm: KnownArm, buffer: Buffer, worker: SolveWorker, answer: Callable[[bool, str], None]
    ) -> str:
        """Have the corners solved by the worker, under this name; returns why not, or nothing."""
        count = len(self.intake.images)
        if count < MIN:
            return f"{count} images of the target at different postures, at least {MIN} are needed"
        chosen = self._chosen
        self._given = [list(one.images) for one in self.intake.every]
        job = CornerJob(
            *(self.intake.cameras(), arm.description, chosen["base"]),
            tip=arm.chain.tip if arm.chain is not None else chosen["tip"],
            seed=chosen["seed"],
            effects=chosen["effects"],
            heard=buffer.collected(),
            clock_limit=chosen["clock_limit_s"],
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
        restored, self._restoring = self._restoring, False
        if solved.apply and (restored or self._chosen["accept"] == BETTER):
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
        self._was_trusted = True
        self.keep()
        return True

    def forget(self) -> None:
        """Start over with the images; the trusted model stays."""
        self.intake.forget()
        self._candidate = self._said = None
        self._was_trusted = self._restoring = False
        if self._folder is not None:
            forget_images(self._folder)

    def tell(self) -> bool:
        """Say what images show to have been moved, once; returns whether there was anything to say."""
        moved = self.intake.moved
        if moved is None or (self._said is not None and self._said.what == moved.what):
            return False
        self._said = moved
        if self._was_trusted:  # nor after a restart
            self._was_trusted = False
            self.keep()
        self._outputs.moved(moved)
        self._log.warning(f"{moved.sentence}; the last trusted model is still published")
        return True
