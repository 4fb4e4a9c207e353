"""What a calibration comes to: the report, the calibration to use, and how the fits ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.calibration import Calibration, Fit
from modcal_core.claim import Claim
from modcal_core.errors import BadRobot
from modcal_core.files import write_folder
from modcal_core.measurements import Samples
from modcal_core.report import Report
from modcal_core.robot import Robot
from modcal_core.robots import is_delta


@dataclass(frozen=True)
class Result:
    """The result of :func:`modcal_core.calibrate`; nothing in it can be written to.

    report: what was found, scored on held-out samples. calibration: fitted to all samples, for use. robot, samples:
    what it was made from. scored: the fit that the report is about, which has not seen the held-out samples.
    """

    report: Report
    calibration: Calibration
    robot: Robot
    samples: Samples
    scored: Fit = field(repr=False)

    @property
    def claim(self) -> Claim | None:
        """How far the tool may be from where the calibration says over the recorded ranges, and whether to use it."""
        return self.report.claim

    @property
    def converged(self) -> bool:
        """Whether every fit ended at its minimum."""
        return self.report.grounds.converged

    @property
    def iterations(self) -> int:
        """Steps of the last fit of the model that was scored."""
        return self.scored.iterations

    @property
    def message(self) -> str:
        """How the fits ended, in one sentence."""
        if self.converged:
            return f"All fits reached their minimum; the last one took {self.iterations} steps."
        return f"A fit ended before its minimum, the last one after {self.iterations} steps: see report.open_because."

    def with_distances(self, seed: int = 0) -> Result:
        """The result whose report also says what distances between points alone make of a Delta, without any frame.

        seed: of the annealing. Raises BadRobot for another robot, BadRecording where there are no such distances, and
        NotEnoughData for too few.
        """
        from modcal_core.calibration import by_distances  # what it needs of SciPy, others need not

        delta, report = self.robot.mechanism, self.report
        if not is_delta(delta):
            raise BadRobot(f"robot {self.robot.name}", "is no Delta", "leave --by-distances out")
        train = report.sets.train[~report.wrong[report.sets.train]]
        found = by_distances(delta, self.report.samples.select(train), report.scored, np.random.default_rng(seed))
        return replace(self, report=replace(report, by_distances=found))

    def _repr_html_(self) -> str:
        """The report, as notebooks show it."""
        return self.report._repr_html_()

    def files(self, factory: Mapping[str, Any] | None = None, page: bool = True) -> dict[str, str]:
        """Names and texts of the files of a calibration: report, corrected model, everything needed to predict.

        factory: the kinematics that the manufacturer's tool took from this arm, whose form and hash
        ``kinematics.yaml`` keeps. page: whether report.html is among them.
        """
        from modcal_core.report import calibration_files

        arm = self.robot.mechanism, self.robot.description
        return calibration_files(self.calibration, self.report, *arm, factory, page)

    def save(self, folder: str | Path, factory: Mapping[str, Any] | None = None, page: bool = True) -> Path:
        """Write the files of ``modcal calibrate`` into a folder, whole or not at all; returns the folder."""
        write_folder(Path(folder), self.files(factory, page))
        return Path(folder)
