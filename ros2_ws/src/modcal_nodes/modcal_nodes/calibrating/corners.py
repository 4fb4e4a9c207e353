"""Corners of a printed target on their way into a calibration: whose joints they belong to, and what becomes of them.

One image a posture is kept, of an arm that stands; images that come while it moves say where it was to no better than
the clocks agree. With a calibration, each image that is kept is also held against it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from modcal_core.camera import (
    APPLY,
    BoardView,
    CameraFit,
    CameraImages,
    CameraProblem,
    CameraWatch,
    ImageMoments,
    Moved,
    beside,
    enough_corners,
    read_target,
    solve_camera,
)
from modcal_core.errors import BadRecording, ModcalError
from modcal_core.files import write_folder
from modcal_core.geometry import Array
from modcal_core.online import BETTER
from modcal_core.recalibrate import SampleMemory
from modcal_core.report import camera_report
from modcal_core.robot import Robot
from modcal_msgs_py import read_corners
from modcal_nodes.calibrating.intake import Buffer, KnownArm
from modcal_nodes.calibrating.state import KeptImages, forget_images, read_images, write_images
from modcal_nodes.calibrating.worker import Publishers, SolveWorker
from modcal_nodes.ros import OK, WARN, Status

MIN = 8  # images, from which a solve is tried
_JOINTS_S = 10.0  # s of joint states that are remembered
_STILL = 1e-3  # rad or m that a joint of an arm that stands moves around an image
_AROUND_S = 0.1  # s on either side of an image
_OTHER = 0.02  # rad or m by which a joint differs between two postures
_MAX = 400  # images; older ones go
_BEFORE = 5  # images of the calibration that those behind it are compared with
_WAITING = 50  # images whose joint states have not come yet


@dataclass(frozen=True)
class CameraSolved:
    """What a solve of corners brings back. apply: whether its advice is to use it."""

    files: dict[str, str]
    verdict: str
    apply: bool
    fit: CameraFit


@dataclass(frozen=True)
class CornerJob:
    """All that a calibration from corners needs, so that it can be done elsewhere. cameras: what each saw. heard: of
    other instruments.
    """

    cameras: tuple[CameraImages, ...]
    urdf: str
    base: str
    tip: str
    seed: int
    effects: bool
    heard: SampleMemory
    clock_limit: float


def solve_corners(job: CornerJob) -> CameraSolved:
    """Calibrate from corners, and from what other instruments have read meanwhile. Raises ModcalError."""
    robot = Robot.from_urdf(job.urdf, job.base or None, job.tip or None)
    try:
        samples, _, _ = job.heard.prepared(robot.chain, job.clock_limit)
        others = beside(robot.chain, samples, robot.inertias)
    except ModcalError:  # no other instrument, or too little of it
        others = None
    about = CameraProblem(
        robot.chain, job.cameras, inertias=robot.inertias, beside=others, look_for_effects=job.effects
    )
    solution = solve_camera(about, np.random.default_rng(job.seed))
    report = camera_report(solution, robot, len(job.cameras[0].views), {})
    apply = solution.claim.decision.word == APPLY
    return CameraSolved(dict(report.files), str(report.data["verdict"]), apply, solution.fit)


class CornerIntake:
    """Images' corners with their joints. name: of the topic of a further camera, "" of the first. further: those of
    further cameras that look at the same target. moved: what was since the calibration, as far as all images show.
    """

    def __init__(
        self, target: Path, further: Sequence[str] = (), name: str = "", first: CornerIntake | None = None
    ) -> None:
        """target: file of the printed target. further: topics. first: whose further one this is. Raises BadTable."""
        self.target = read_target(target)
        self.name = name
        self._first = first or self
        self.further = tuple(CornerIntake(target, name=topic, first=self) for topic in further)
        self.images: list[tuple[BoardView, Array]] = []
        self.size: tuple[int, int] | None = None
        self.verdict = ""
        self.passed_over = 0
        self._watch: CameraWatch | None = None  # of the first: all cameras' images are held against it
        self.moved: Moved | None = None
        self._joints: deque[tuple[float, Array]] = deque()
        self._waiting: deque[BoardView] = deque(maxlen=_WAITING)

    @classmethod
    def of(cls, chosen: Mapping[str, Any]) -> CornerIntake | None:
        """By a node's parameters; None if no target is stated. Raises BadTable."""
        if not chosen["target"]:
            return None
        return cls(Path(chosen["target"]), [topic for topic in chosen["also_corners"] if topic])

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics of all cameras."""
        return "corners", *(one.name for one in self.further)

    @property
    def every(self) -> tuple[CornerIntake, ...]:
        """This one and those of further cameras."""
        return self, *self.further

    def joint_state(self, stamp: float, q: Array) -> None:
        """Remember where the joints were, and take the images that waited for it."""
        for one in self.further:
            one.joint_state(stamp, q)
        if self._joints and stamp <= self._joints[-1][0]:
            if stamp < self._joints[-1][0] - _JOINTS_S:  # the clock was set back
                self._joints.clear()
                self._waiting.clear()
            else:
                return
        self._joints.append((stamp, q))
        while self._joints[0][0] < stamp - _JOINTS_S:
            self._joints.popleft()
        self._take_due()

    def corners(self, message: Any) -> None:
        """Take the corners of an image. Raises BadRecording for what are none of this target."""
        view, size = read_corners(message)
        if view.ids.max(initial=-1) >= len(self.target.points):
            said = f"number {int(view.ids.max())}, the target has {len(self.target.points)}"
            raise BadRecording("corners", said, "give board_detector and calibrator the same target")
        if self.size is not None and size != self.size:
            said = f"are of images of {size[0]} × {size[1]}, those before of {self.size[0]} × {self.size[1]}"
            raise BadRecording("corners", said, "keep the camera's resolution, or call ~/reset")
        self.size = size
        if enough_corners(self.target.points[view.ids]):
            self._waiting.append(view)
            self._take_due()

    def _take_due(self) -> None:
        while self._joints and self._waiting and self._waiting[0].stamp + _AROUND_S <= self._joints[-1][0]:
            self._take(self._waiting.popleft())

    def _take(self, view: BoardView) -> None:
        q = self._standing_at(view.stamp)
        if q is None:
            self.passed_over += 1
            return
        if self.images and np.abs(self.images[-1][1] - q).max() < _OTHER:
            return
        self.images.append((view, q))
        del self.images[:-_MAX]
        first = self._first
        if first._watch is not None:
            first.moved = first._watch.image(view, q, self.name)

    def _standing_at(self, stamp: float) -> Array | None:
        """Where the joints were, None where they moved or nobody says."""
        near = [q for t, q in self._joints if abs(t - stamp) <= _AROUND_S]
        before = any(t <= stamp for t, _ in self._joints)
        if len(near) < 2 or not before:
            return None
        at = np.array(near)
        return np.median(at, axis=0) if float(np.ptp(at, axis=0).max()) < _STILL else None

    def forget(self) -> None:
        """Start over with the images; the calibration stays."""
        for one in self.every:
            one.images.clear()
            one._waiting.clear()
            one.size = None
        self.moved = None
        if self._watch is not None:
            self._watch.forget()

    def cameras(self) -> tuple[CameraImages, ...]:
        """What a solve needs, of the first camera and of those others that have seen enough."""
        return tuple(one._seen() for one in self.every if one is self or len(one.images) >= MIN)

    def _seen(self) -> CameraImages:
        assert self.size is not None
        views = tuple(replace(view, name=f"{i}") for i, (view, _) in enumerate(self.images))
        moments = ImageMoments(np.array([view.stamp for view in views]))
        q = np.array([q for _, q in self.images])
        return CameraImages(q, views, self.target, self.size, moments=moments, name=self.name or "images")

    def solved(self, found: CameraSolved) -> None:
        """Hold what comes from now on against this calibration."""
        self.verdict = found.verdict
        self._watch, self.moved = CameraWatch(found.fit, self.target), None
        # a move shows most plainly against images from before it
        last = [(view, q, one.name) for one in self.every for view, q in one.images[-_BEFORE:]]
        for view, q, name in sorted(last, key=lambda each: each[0].stamp):
            self._watch.image(view, q, name)

    def status(self) -> Status:
        """How many images there are, what they led to, and whether anything was moved since."""
        facts: dict[str, object] = {"images": len(self.images), "passed over, the arm moved": self.passed_over}
        facts |= {f"images of {one.name}": len(one.images) for one in self.further}
        if self.verdict:
            facts["last result"] = self.verdict
        if self.moved is not None:
            return Status("camera", WARN, f"{self.moved.sentence}: solve again from images since", facts)
        if len(self.images) < MIN:
            said = f"{len(self.images)} of {MIN} images at different postures, 25 to 30 are better"
            return Status("camera", WARN if not self.verdict else OK, said, facts)
        return Status("camera", OK, self.verdict or f"{len(self.images)} images: call ~/solve", facts)


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
            cameras=self.intake.cameras(),
            urdf=arm.description,
            base=chosen["base"],
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
