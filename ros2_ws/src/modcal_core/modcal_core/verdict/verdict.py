"""The verdict: one of three words, why it is that one, and the account of squared error that it rests on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["at_floor", "open", "cannot_tell"]
ReasonKind = Literal[
    "not_converged", "rejected", "not_applied", "convention", "contradiction", "predictable", "above_floor", "cut_off"
]
Interval = tuple[float, float]
MAX_PREDICTABLE = 0.05  # lower end (99 %) of the share of E² that is predictable: 2.5 % in RMS (sweep)


@dataclass(frozen=True)
class Reason:
    """Why a verdict is open: a sentence for a person, and the test that failed, for programs.

    not_converged: a fit did not reach its minimum. rejected: too many stations were left out. not_applied: an effect
    lacks its driver. convention: another convention fits better. contradiction: the data contradict a statement, or
    each other. predictable: a regressor predicts the rest. above_floor: the error exceeds a known floor.
    cut_off: something scatters, and the largest of it was rejected.
    """

    kind: ReasonKind
    sentence: str


@dataclass(frozen=True)
class Row:
    """One row of the account: a name as in ``report.json``, its value [mm² or deg²], and its 95 % interval if known."""

    what: str
    value: float
    ci95: Interval | None = None


@dataclass(frozen=True)
class Share:
    """A share of the squared error, 0 … 1, with its 95 % interval. lower99: the lower end of its 99 % interval."""

    share: float
    ci95: Interval
    lower99: float

    @property
    def sure(self) -> bool:
        """Whether it is surely more than what may be left."""
        return self.lower99 > MAX_PREDICTABLE


@dataclass(frozen=True)
class NotAsked:
    """A question that so few stations do not answer, and what it needs."""

    what: str
    needs: str


@dataclass(frozen=True)
class Repeatability:
    """What the arm does not repeat, RMS over space [mm or deg]. source: "revisits", "stated", or None if unknown."""

    value: float | None
    source: Literal["revisits", "stated"] | None


@dataclass(frozen=True)
class Verdict:
    """Status and its grounds.

    reasons: why the status is open; empty unless it is. remedy: what would tell, for a status of cannot_tell. floor_mm,
    floor_deg: RMS of what cannot be modelled, None where it is not known. account_mm2, account_deg2: rows that sum to
    the squared error of the nominal model; None where readings have no length or no angle. predictable,
    predictable_deg: share of the held-out squared error that a regressor without physics predicts. source: from what,
    where that is sure. unproven: why it is not certain that the readings were measured: then they prove no floor and no
    tolerance. not_asked: see there.
    """

    status: Status
    reasons: tuple[Reason, ...] = ()
    remedy: str = ""
    floor_mm: float | None = None
    floor_deg: float | None = None
    account_mm2: tuple[Row, ...] | None = None
    account_deg2: tuple[Row, ...] | None = None
    predictable: Share | None = None
    predictable_deg: Share | None = None
    predictable_both: Share | None = None
    repeatability_mm: Repeatability = Repeatability(None, None)
    repeatability_deg: Repeatability = Repeatability(None, None)
    returns: int = 0
    source: str = ""
    unproven: str = ""
    not_asked: tuple[NotAsked, ...] = ()

    @property
    def floor_known(self) -> bool:
        """Whether it is known for all that the readings tell: positions, and orientations where there are any."""
        known = self.floor_mm is not None or self.account_mm2 is None
        return (
            known
            and (self.floor_deg is not None or self.account_deg2 is None)
            and (self.floor_mm, self.floor_deg) != (None, None)
        )

    @property
    def predicted(self) -> bool:
        """Whether a part of the rest is surely predictable."""
        return self.predictable_both is not None and self.predictable_both.sure

    @property
    def may_depend(self) -> bool:
        """Whether an open rest is surely predictable in part, or of too few stations to be asked."""
        return self.status == "open" and (self.predicted or self.predictable_both is None)

    @property
    def open_because(self) -> tuple[str, ...]:
        """A sentence for each reason; empty unless the status is open."""
        return tuple(reason.sentence for reason in self.reasons)
