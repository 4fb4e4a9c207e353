"""The outcome of a calibration or an evaluation: errors before and after, effects, and what the data do not show."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from modcal_core.calibration import (
    Errors,
    ErrorSize,
    Identifiability,
    KnownDistance,
    Model,
    Readmitted,
    Split,
    block_length,
    units_of_stations,
)
from modcal_core.claim import Claim
from modcal_core.diagnosis import EffectChoice, EvidenceMap, Loads
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.outcome.entries import Finding
from modcal_core.outcome.joint_offsets import JointOffsets
from modcal_core.verdict import (
    Asked,
    AtTool,
    Grounds,
    Rejected,
    Status,
    Tolerance,
    Verdict,
    assess,
    interval_of_rms,
)
from modcal_core.version import __version__

if TYPE_CHECKING:
    from modcal_core.calibration import ByDistances


@dataclass(frozen=True)
class Trace:
    """date: the first stamp of the recording, ISO 8601 in UTC, so that two runs give the same bytes. bag_sha256: of the
    bag's file; of a folder, of the list that ``sha256sum`` prints of its files in order of their names. robot: the name
    in the description. instrument: kind of reading, topic and frame. None where not known.
    """

    version: str = __version__
    date: str | None = None
    bag_sha256: str | None = None
    robot: str | None = None
    instrument: str | None = None


def iso_date(stamp: float) -> str:
    """A stamp [s] as date and time, UTC."""
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


_MIN_BLOCK = 5  # stations; the shortest that the split makes of a dense recording


def independent_units(samples: Samples, rows: np.ndarray, blocks: bool) -> np.ndarray:
    """A number for each of these rows of the samples, (k,), the same for rows whose errors may be alike.

    A station is a unit of its own, with others in its posture where there are many of them. Where stations are dense,
    neighbours in time are neighbours in posture: there a unit is a run of neighbours, no longer than a block of the
    split. blocks: whether the split made blocks.
    """
    if not len(rows):
        return np.empty(0, int)
    _, first, station = np.unique(samples.station, return_index=True, return_inverse=True)
    order = np.argsort(samples.stamps[first], kind="stable")
    length = block_length(samples)
    if length == 1 and not blocks:
        return np.asarray(units_of_stations(samples)[1][station[rows]])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    taken = np.unique(rank[station[rows]])
    run = np.cumsum(np.r_[0, np.diff(taken) > 1])
    within = np.arange(len(taken)) - np.searchsorted(run, run)
    unit = np.zeros(len(order), int)
    unit[taken] = run * len(order) + within // max(length, _MIN_BLOCK)
    return np.asarray(unit[rank[station[rows]]])


STAGES = ("nominal", "geometric", "final")


@dataclass(frozen=True)
class Step:
    """What is left after one more thing was added to the model. added: its name. errors: of the scored samples."""

    added: str
    errors: Errors

    @property
    def rms_mm(self) -> float:
        """RMS of the position errors [mm]; 0 where nothing was scored."""
        size = self.errors.size_mm()
        return 0.0 if size is None else size.rms


@dataclass(frozen=True)
class Outcome:
    """The outcome of a calibration or an evaluation.

    - scored: held-out samples without outliers.
    - errors: errors of the scored samples by stage (nominal, geometric, final).
    - effects: what the diagnosis added and held-out stations prove. unproved: what they do not prove one by one.
    - left: the best candidate that is significant but does not predict, or None.
    - parameters: (name, value, standard deviation, unit). left_out: parameters that are not independent of others.
    - steps: what remains after geometry and after each added effect, in the order found.
    - evidence: the first and the last scan for effects; empty where none was sought.
    - model: the final model. residuals: distance of each sample from it [m], (N,). wrong: True for outliers, (N,).
    - rejection: number of outliers, and the error with and without them. readmitted: stations rejected at first only.
    - distances: known distances as fitted. loads: gravity and payloads that the data showed.
    - grounds: further input of the verdict. judged: the verdict, None until there is one.
    - offsets: joint offsets of the calibration that is written or judged; None where they do not apply.
    - by_distances: a Delta from distances alone, where that was asked for.
    - notes: sentences on the recording. claim: what may be said of the tool; None if nothing was calibrated.
    """

    samples: Samples
    sets: Split
    scored: Samples
    errors: dict[str, Errors]
    effects: tuple[Finding, ...] = ()
    unproved: tuple[Finding, ...] = ()
    left: EffectChoice | None = None
    identifiability: Identifiability | None = None
    parameters: tuple[tuple[str, float, float, str], ...] = ()
    offsets: JointOffsets | None = None
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    title: str = "recording"
    steps: tuple[Step, ...] = ()
    evidence: tuple[EvidenceMap, ...] = ()
    model: Model | None = None
    residuals: Array = field(default_factory=lambda: np.empty(0))
    wrong: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    rejection: Rejected | None = None
    distances: tuple[KnownDistance, ...] = ()
    grounds: Grounds = field(default_factory=Grounds)
    judged: Verdict | None = None
    loads: Loads | None = None
    searched: bool | None = None
    dropped: tuple[tuple[str, int], ...] = ()
    tolerance: Tolerance | None = None
    trace: Trace = field(default_factory=Trace)
    readmitted: Readmitted = field(default_factory=Readmitted)
    claim: Claim | None = None
    by_distances: ByDistances | None = None

    @property
    def measurement(self) -> str:
        """pose, point, same_point, or mixed."""
        kinds = {
            "same_point" if self.samples.is_same_point(f) else str(kind)
            for f in range(len(self.samples.frames))
            for kind in np.unique(self.samples.kind[self.samples.frame == f])
        }
        return kinds.pop() if len(kinds) == 1 else "mixed"

    def set_sizes(self) -> dict[str, int]:
        """Stations in each of the three sets."""
        rows = {"train": self.sets.train, "explain": self.sets.explain, "held_out": self.sets.held_out}
        return {name: len(np.unique(self.samples.station[r])) for name, r in rows.items()}

    def size_mm(self, stage: str) -> ErrorSize | None:
        """Sizes of the held-out position errors of a stage [mm]."""
        return self.errors[stage].size_mm() if stage in self.errors else None

    def size_deg(self, stage: str) -> ErrorSize | None:
        """Sizes of the held-out orientation errors of a stage [deg]."""
        return self.errors[stage].size_deg() if stage in self.errors else None

    @cached_property
    def units(self) -> np.ndarray:
        """Unit numbers of the scored samples, (N,): equal where errors may be correlated."""
        rows = self.sets.held_out
        unit = independent_units(self.samples, rows, self.sets.unit == "block")
        return unit if self.counts_rejected else unit[~self.wrong[rows]]

    @property
    def counts_rejected(self) -> bool:
        """Whether the score includes the rejected samples: too many to be single wrong readings, or none are."""
        return len(self.scored) == len(self.sets.held_out)

    def interval_mm(self, stage: str) -> tuple[float, float] | None:
        """95 % interval of the RMS position error of a stage [mm], by drawing held-out units again."""
        return self._intervals.get(stage)

    @cached_property
    def _intervals(self) -> dict[str, tuple[float, float] | None]:
        scored = self.errors if len(self.scored) else {}
        return {stage: interval_of_rms(1e3 * e.position_norm, self.units) for stage, e in scored.items()}

    def with_tolerance(self, asked: Asked | None) -> Self:
        """The report with the result for a tolerance; the same where none is asked for."""
        if asked is None:
            return self
        at_tool = None
        if (one := self.claim) is not None:
            found = one.mm[asked.statistic]
            size = self.size_mm("final")
            read = None if size is None else float(getattr(size, asked.statistic))
            at_tool = AtTool(found.value, found.ci95, one.over, one.unshown_mm, one.remedy, read)
        return replace(self, tolerance=assess(at_tool, asked, self.judged))

    def rejected_rows(self) -> np.ndarray:
        """Rows of the samples that were left out, the farthest first."""
        rows = np.flatnonzero(self.wrong)
        return rows[np.argsort(-self.residuals[rows], kind="stable")]

    def rejected_stations(self) -> int:
        """How many stations have a sample that was rejected."""
        return len(np.unique(self.samples.station[self.wrong])) if len(self.wrong) else 0

    @property
    def status(self) -> Status:
        """The verdict in a word; cannot_tell where none was made."""
        return "cannot_tell" if self.judged is None else self.judged.status

    @property
    def open_because(self) -> tuple[str, ...]:
        """The reasons of the verdict *open*, a sentence each; none for any other."""
        return () if self.judged is None else tuple(self.judged.open_because)

    @property
    def unexplained_mm(self) -> float | None:
        """RMS of what is left beyond the floor [mm]; None if nothing shows that there is any.

        The larger of what exceeds a known floor and what a regressor without physics predicts, where the verdict is
        open for it; else what one more effect would take away.
        """
        final = self.size_mm("final")
        if final is None:
            return None
        squares = [] if self.left is None else [final.rms**2 * self.left.share]
        judged = self.judged or Verdict("cannot_tell")
        kinds = {reason.kind for reason in judged.reasons}
        if judged.floor_mm is not None and "above_floor" in kinds:
            squares.append(final.rms**2 - judged.floor_mm**2)
        if "predictable" in kinds:
            squares += [row.value for row in judged.account_mm2 or () if row.what == "predictable"]
        most = max(squares, default=0.0)
        return float(np.sqrt(most)) if most > 0.0 else None

    @property
    def story(self) -> tuple[str, ...]:
        """A sentence for each effect, for a technician."""
        return tuple(finding.sentence for finding in self.effects)
