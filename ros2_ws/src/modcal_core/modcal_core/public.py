"""The public functions: what the library and the command both do, from a robot and samples to a report.

What goes on inside is :func:`modcal_core.loop.calibrate` and :func:`modcal_core.evaluation.evaluate`; here samples meet
the robot, what they state of themselves is put in, and the report says where they come from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core import evaluation, loop
from modcal_core.calibration import Calibration, Cell, Fit, Stated, fingerprint
from modcal_core.claim import Claim
from modcal_core.errors import BadRecording, BadRobot, BadTable, ModcalError, NotEnoughData
from modcal_core.files import write_folder
from modcal_core.geometry import sealed
from modcal_core.measurements import BETWEEN, Samples, as_recording, remedies_of, require_usable
from modcal_core.outcome import Outcome, Trace, iso_date
from modcal_core.report import Report
from modcal_core.robot import Robot
from modcal_core.robots import Mechanism, is_delta, is_serial_arm
from modcal_core.verdict import COMPUTED, STATISTICS, Asked

if TYPE_CHECKING:
    from modcal_core.articulation import Choice, Track
    from modcal_core.checkup import Checked
    from modcal_core.planning import Plan, Site


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


def quiet(stage: str) -> None:
    """The progress callback that is used where none is given: it does nothing."""


def calibrate(
    robot: Robot,
    samples: Samples,
    seed: int = 0,
    *,
    cell: Cell | None = None,
    fixed: tuple[str, ...] = (),
    geometry_only: bool = False,
    block: int | None = None,
    tolerance_mm: float | None = None,
    tolerance_of: str = "p95",
    progress: Callable[[str], None] = quiet,
) -> Result:
    """Calibrate a robot from samples: geometry, effects that the samples show, and a verdict.

    One part of the samples fits, another chooses effects, a held-out part scores. The seed draws what is held out for
    the score; the model and what is named do not depend on it.

    - cell: what is known of the surroundings, of arm and instrument.
    - fixed: parameters or places that stay nominal, such as ``tool``. geometry_only: look for no effects.
    - block: number of stations that the split keeps together; None: chosen from the data.
    - tolerance_mm: allowed error, of the statistic tolerance_of ("mean", "rms", "p95" or "max"); the report judges it.
    - progress: called with each stage.

    Raises BadRecording for samples of another robot or in other units, NotEnoughData for too few of them, and BadTable
    for invalid statements; all are ModcalError.
    """
    asked = tolerance_asked(tolerance_mm, tolerance_of)
    samples = _met(samples, robot.mechanism)
    around = _stated(replace(cell or Cell(), fixed=(*(cell or Cell()).fixed, *fixed)), samples)
    progress("fitting the geometry")
    try:
        with remedies_of(samples.origin.notes):
            found = loop.calibrate(
                samples,
                robot.mechanism,
                np.random.default_rng(seed),
                around,
                block,
                robot.inertias,
                progress=lambda effect: progress(f"trying {effect}"),
                look_for_effects=not geometry_only,
            )
    except NotEnoughData as error:
        raise _too_little(error, samples) from error
    _require_measured(found.report, samples)
    report = replace(found.report, notes=(*found.report.notes, *robot.notes))
    report = _traced(report, samples, robot.name).with_tolerance(asked)
    return sealed(Result(report, found.calibration, robot, samples, found.scored))


def evaluate(
    calibration: Calibration,
    samples: Samples,
    seed: int = 0,
    *,
    refit_base: bool = False,
    refit_tool: bool = False,
    cell: Cell | None = None,
    block: int | None = None,
    tolerance_mm: float | None = None,
    tolerance_of: str = "p95",
) -> Report:
    """Error of a frozen calibration on samples that it was not made from.

    refit_base, refit_tool: fit base or tool again on a part of the samples, where instrument, robot or tool were moved;
    the rest is scored. The other arguments and errors are those of :func:`calibrate`.
    """
    asked = tolerance_asked(tolerance_mm, tolerance_of)
    samples = _met(samples, calibration.nominal.chain)
    rng = np.random.default_rng(seed)
    around = _stated(cell or Cell(), samples)
    try:
        with remedies_of(samples.origin.notes):
            report = evaluation.evaluate(calibration, samples, rng, refit_base, refit_tool, around, block)
    except NotEnoughData as error:
        raise _too_little(error, samples) from error
    report = _traced(report, samples, _described(samples)).with_tolerance(asked)
    return sealed(replace(report, notes=(*report.notes, *_other_robot(calibration, samples))))


def check(
    calibration: Calibration,
    samples: Samples,
    seed: int = 0,
    *,
    cell: Cell | None = None,
    tolerance_mm: float | None = None,
    tolerance_of: str = "p95",
    pattern: float | None = None,
) -> Checked:
    """What has changed since a calibration was made, from as few as ten new stations, and what to do about it.

    The answer names base, tool, a joint's zero, a gear, a load, heat, or the tracker's scale or noise, with sizes and
    intervals and with what explains the stations as well, or says that nothing has changed. ``repaired`` is the
    calibration with only that corrected. pattern: share of the calibration's noise that neighbouring postures have in
    common, as ``predictable`` in its report; None: a quarter. The other arguments are those of :func:`calibrate`.
    Raises NotEnoughData for fewer than five stations, BadRecording for a recording of another robot, in other units or
    in another convention, BadTable for a frame that the calibration does not know.
    """
    from modcal_core.checkup import checkup
    from modcal_core.moves import PATTERN  # not for those who only calibrate

    asked = tolerance_asked(tolerance_mm, tolerance_of)
    samples = _met(samples, calibration.nominal.chain)
    around = _stated(cell or Cell(), samples)
    share = PATTERN if pattern is None else float(np.clip(pattern, 0.0, 1.0))
    with remedies_of(samples.origin.notes):
        found = checkup(calibration, samples, np.random.default_rng(seed), around, share)
    report = _traced(found.report, samples, _described(samples)).with_tolerance(asked)
    return sealed(replace(found, report=report, notes=(*found.notes, *_other_robot(calibration, samples))))


def articulate(track: Track, seed: int = 0) -> Choice:
    """How a handle moves: rigid, sliding, turning, or like a screw, with the probability of each and the best fit.

    ``kind`` is "none" where the best of them leaves more than furniture and tracking do; a pull of two motions is then
    cut into ``phases``. ``enough`` says whether to rely on the kind: it is probable, good enough, and predicts.

    track: positions or poses of the handle. seed: of the samples that first guesses are made from. Raises BadRecording
    where rotations would follow the handle in another convention (w x y z, inverse, a left-handed frame).
    """
    from modcal_core.articulation import choose, require_convention  # not for those who only calibrate

    rng = np.random.default_rng(seed)
    choice = choose(track, rng)
    require_convention(track, choice, rng)
    return sealed(choice)


def plan(
    robot: Robot,
    stations: int | None = None,
    seed: int = 0,
    *,
    accuracy_mm: float | None = None,
    reading: str = "point",
    site: Site | None = None,
    fixed: tuple[str, ...] = (),
) -> Plan:
    """Where to measure: the stations ``q`` (k, n), in an order free of collisions, and the accuracy to be expected.

    stations: how many; None: as many as accuracy_mm asks for [mm, 95 % of the workspace]. reading: "point" or "pose".
    site: instrument, obstacles and noise; None: an instrument that sees everything. fixed: as in :func:`calibrate`.
    seed: of candidates and starts. Raises NotPlannable where no set of stations will do.
    """
    from modcal_core.planning import PlanRequest, Site  # not for those who only calibrate
    from modcal_core.planning import plan as plan_stations

    request = PlanRequest(stations, None if accuracy_mm is None else 1e-3 * accuracy_mm, reading=reading, fixed=fixed)
    return sealed(plan_stations(robot.mechanism, site or Site(), request, np.random.default_rng(seed)))


def tolerance_asked(mm: float | None, of: str) -> Asked | None:
    """The tolerance that is asked for; None if none is. Raises BadTable."""
    if mm is None:
        return None
    if of not in STATISTICS:
        raise BadTable(f"tolerance of {of}", "is not a statistic of the error", f"ask for {', '.join(STATISTICS)}")
    return Asked(mm, of)


def _met(samples: Samples, mechanism: Mechanism) -> Samples:
    """The samples with the robot's joints in its order, and, where nobody has done that before, checked against it."""
    samples = samples.of_joints(mechanism.names)
    if not samples.origin.checked:
        require_usable(as_recording(samples, mechanism.names), mechanism)
    return samples


def _stated(cell: Cell, samples: Samples) -> Cell:
    """The cell, with what the instruments state of themselves where it states nothing."""
    own = Stated(instrument_mm=samples.origin.instrument_mm, instrument_deg=samples.origin.instrument_deg)
    return replace(cell, stated=cell.stated.over(own))


def _traced(report: Outcome, samples: Samples, robot: str | None) -> Report:
    """The report with what there is to know of where its samples come from."""
    origin = samples.origin
    date = None if origin.began is None else iso_date(origin.began)
    trace = Trace(date=date, bag_sha256=origin.sha256, robot=robot, instrument=origin.instrument)
    notes = (*report.notes, *origin.notes)
    return Report.of(replace(report, title=origin.title, notes=notes, dropped=origin.dropped, trace=trace))


def _too_little(error: NotEnoughData, samples: Samples) -> NotEnoughData:
    """The refusal, with what was left out before."""
    left_out = ", ".join(f"{n} {reason}" for reason, n in samples.origin.dropped if reason != BETWEEN)
    limit = f"{error.limit}; left out: {left_out}" if left_out else error.limit
    return NotEnoughData(error.offender, limit, error.remedy)


def _require_measured(report: Outcome, samples: Samples) -> None:
    """Raises BadRecording where a topic that nobody named turns out to hold what was computed from the joints."""
    computed = [reason for reason in report.open_because if COMPUTED in reason]
    by_type = samples.origin.by_type
    if computed and by_type:
        said = f"was taken as the tracker's topic, as the only candidate; but {computed[0].rstrip('.')}"
        remedy = f"record a tracker, or state --topic tracker/pose={by_type[0]} if it is one"
        raise BadRecording(f"topic {by_type[0]}", said, remedy)


def _described(samples: Samples) -> str | None:
    """The name of the robot in the recorded description; None where there is none that can be read."""
    if samples.origin.description is None:
        return None
    from modcal_core.robots import parse

    try:
        return parse(samples.origin.description).name
    except BadRobot:  # evaluate does not need the description, and says elsewhere that it cannot be read
        return None


def _other_robot(calibration: Calibration, samples: Samples) -> tuple[str, ...]:
    """A sentence when the recording describes a robot other than the one that was calibrated."""
    nominal, calibrated = calibration.nominal.chain, calibration.calibrated.chain
    if samples.origin.description is None or not is_serial_arm(calibrated):
        return ()
    from modcal_core.robots import read_chain

    try:
        described = fingerprint(read_chain(samples.origin.description, nominal.base, nominal.tip))
    except ModcalError as error:
        return (f"The recording's robot description was not compared: {error}.",)
    if described in (calibration.robot, fingerprint(calibrated)):
        return ()
    return ("The recording's robot description has different kinematics than the one that was calibrated.",)
