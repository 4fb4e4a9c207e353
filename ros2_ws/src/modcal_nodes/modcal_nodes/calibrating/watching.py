"""The calibrator as a sentinel: pieces of what it hears of an arm at its work, beside the history of that arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from modcal_core.measurements import Recording
from modcal_core.robots import Chain, read_inertias
from modcal_core.sentinel import LEAST_SECONDS, ArmVerdict, BagHistory, MonitoredArm, cells_of
from modcal_nodes.calibrating.intake import Buffer, KnownArm
from modcal_nodes.calibrating.worker import SolveWorker
from modcal_nodes.ros import OK, WARN, Status

_BEGIN = "make one of ordinary recordings: modcal sentinel BAG --reference BAG … --history FOLDER"


def judge_piece(piece: Recording, chain: Chain, urdf: str, folder: Path) -> ArmVerdict:
    """What a piece says beside the history in a folder, which keeps it. Raises ModcalError where it says nothing."""
    arm = MonitoredArm(chain.names, chain, read_inertias(urdf, chain))
    return BagHistory(folder, arm).judged([(cells_of(piece, arm.names, "live"), False)], every=False)


def _ends(piece: Recording) -> tuple[float, float]:
    """First and last stamp of joint states [s]."""
    stamps = np.concatenate([track.stamps for track in piece.joints])
    return float(stamps.min()), float(stamps.max())


class SentinelWatch:
    """Has a piece judged now and then, and says what came of it. every: seconds from one piece to the next."""

    def __init__(self, folder: str, every: float, warn: Callable[[str], object]) -> None:
        self._folder, self._every, self._warn = Path(folder), every, warn
        self._last, self._count = -np.inf, 0
        self._found: ArmVerdict | None = None
        self._trouble = "" if self._folder.is_dir() else f"{folder}: is no folder with a history: {_BEGIN}"

    def begin(self, buffer: Buffer, arm: KnownArm, worker: SolveWorker) -> bool:
        """Give the newest finished piece to the worker, where one is due; returns whether it was."""
        pieces = buffer.finished().recordings
        if not any(piece.readings for piece in pieces):
            buffer.keep(0)  # an arm at its work, which nobody measures
        if not pieces or not pieces[-1].joints or arm.serial is None or not self._folder.is_dir():
            return False
        began, ended = _ends(pieces[-1])
        if ended - began < LEAST_SECONDS or abs(began - self._last) < self._every:
            return False
        self._last = began
        work = pieces[-1], arm.serial, arm.description, self._folder
        worker.give("watching", judge_piece, *work, finish=self._take, fail=self._fail)
        return True

    def _take(self, found: ArmVerdict) -> None:
        if found.changes and (self._found is None or found.sentence != self._found.sentence):
            self._warn(f"sentinel: {found.sentence}")
        self._found, self._trouble, self._count = found, "", self._count + 1

    def _fail(self, why: str) -> None:
        self._trouble = why

    def status(self) -> Iterable[Status]:
        """What the last piece said: OK where nothing has changed."""
        found, facts = self._found, dict[str, object]({"history": self._folder, "pieces judged": self._count})
        if found is not None:
            facts["evidence [nats]"] = f"{found.log_e:.1f} of {found.asked:.1f} that a change needs"
            facts |= {"not shown": ", ".join(found.unseen), "not judged": ", ".join(found.untold)}
            facts |= {f"would be noticed: {k}": f"{size:.3g} {unit}" for k, (size, unit) in found.noticed.items()}
        said = found.sentence if found is not None else f"waiting for {self._every:g} s of joint states"
        fine = found is not None and found.status == "unchanged" and not self._trouble
        yield Status("sentinel", OK if fine else WARN, self._trouble or said, facts)
