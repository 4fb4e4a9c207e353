"""What changed, in words and numbers for people, of a check and of a stream alike, and what it may as well be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modcal_core.geometry import Array
from modcal_core.moves.rows import COMPLIANCE, GEAR, KINDS, NOISE, PAYLOAD, ZERO
from modcal_core.moves.searching import FittedChange

# how alike two changes are at every recorded posture: not, in the positions that are read, or in poses
Alike = Literal["", "positions", "poses"]
UNTRIED = "the calibration, beyond the joint ranges that it was made from"
# RMS, rad: six degrees, some teeth of a gear at an arm's joint. Angles that differ by more, by another amount at every
# station, are another joint's or no angles of the arm, and a model with them repaired would be nobody's
OF_A_GEAR = 0.1
_95 = 1.959964  # standard deviations
_LISTED = 3  # others that a sentence has room for; check.json and the page have them all
_WHY = {
    "poses": "the same motion at every posture, so the repaired poses are the same",
    "positions": "the same positions at every posture, so these are repaired, but not the same orientations, which "
    "poses would tell",
    "": "these stations cannot tell",
}


@dataclass(frozen=True)
class SizeFound:
    """One size of a change, with its 95 % interval, in the unit that people read."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:+.3g} {self.unit} ({self.low:.3g} … {self.high:.3g})"


@dataclass(frozen=True)
class NamedChange:
    """One change. kind, place: as in :mod:`modcal_core.moves.rows`. label: for people. sizes: of it.

    moved_mm: how far it moves the tool over these stations, RMS, with its 95 % interval. turned_deg: how far it turns
    it, RMS; None where no orientation is read. probability: of this one among all that were looked for. same_as: other
    names of it, and others that explain the readings as well. alike: how far these make the same motion at every
    recorded posture, so that no such station can tell them apart. repairable: whether the sizes are enough to correct
    the model.
    """

    kind: str
    place: str
    label: str
    sentence: str
    sizes: tuple[SizeFound, ...]
    moved_mm: tuple[float, float, float]
    turned_deg: float | None
    probability: float
    same_as: tuple[str, ...]
    alike: Alike
    repairable: bool

    @property
    def likely(self) -> bool:
        """Whether angles are off by no more than a gear can be; a curve of any course may take up anything."""
        return all(s.name != "rms_over_stations" or s.value < 1e3 * OF_A_GEAR for s in self.sizes)


def named(
    change: FittedChange, columns: Array, positions: int, alike: Alike = "", untried_mm: float = 0.0
) -> NamedChange:
    """The change for people.

    columns: motions of the readings per unit of each size (n, k), whose first ``positions`` rows are positions,
    component by component; of a curve the motion of each station's angle (n, S). untried_mm: what the calibration
    corrects where most stations stand beyond its ranges, so that as much may be missing there.
    """
    h, noise = change.hypothesis, change.hypothesis.kind == NOISE
    sizes = _sizes(change)
    moved = (0.0, 0.0, 0.0) if noise else _moved(change, columns[:positions])
    turned = None
    if not noise and len(columns) > positions:
        turned = float(np.degrees(np.sqrt(3.0 * np.mean((columns[positions:] @ change.sizes) ** 2))))
    rivals = tuple(dict.fromkeys(j.hypothesis.label for j in change.same_as))
    # scatter and a curve of any course look like any error; a move that leaves noise is a move
    if (noise or h.free) and moved[0] < untried_mm:
        rivals, alike = (UNTRIED, *rivals), ""
    said = _sentence(change, sizes)
    if not noise:
        turn = "" if turned is None else f" and {turned:.3f}°"
        said += f", {moved[0]:.3f} mm ({moved[1]:.3f} … {moved[2]:.3f}){turn} RMS at the tool"
    if rivals:
        more = len(rivals) - _LISTED
        others = " or ".join(rivals[:_LISTED]) + (f" or one of {more} other changes" if more > 0 else "")
        said += f". It may as well be {others}: {_WHY[alike]}"
    same, repairable = (*h.names, *rivals), noise or bool(h.sizes)
    of = (sizes, moved, turned, change.probability, same, alike, repairable)
    return NamedChange(h.kind, h.place, h.label, f"{said}.", *of)


def _sizes(change: FittedChange) -> tuple[SizeFound, ...]:
    h, values, names = change.hypothesis, change.sizes, KINDS[change.hypothesis.kind].sizes
    std = np.sqrt(np.maximum(np.diag(change.covariance), 0.0))
    if h.kind == NOISE:
        factors = zip(("position", "orientation"), change.judged.noise, strict=True)
        return tuple(SizeFound(what, factor, factor, factor, "times") for what, factor in factors if factor > 1.0)
    if h.free:
        names, values = (("rms_over_stations", 1e3, "mrad"),), np.array([np.sqrt(np.mean(values**2))])
        std = np.array([np.sqrt(np.mean(std**2) / len(std))])
    elif h.replaces >= 0:
        names = (("growth", 100.0, "%"),)
    elif h.kind == PAYLOAD:
        names = tuple((f"compliance of {e.place}", *COMPLIANCE[1:]) for e in h.effects)
    elif h.kind == GEAR and len(values) > 1:  # a wave, and one of twice its cycles
        pairs = values.reshape(-1, 2)
        values = np.linalg.norm(pairs, axis=1)
        ways = pairs / np.maximum(values, 1e-300)[:, None]
        parts = (change.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(pairs)))
        std = np.array([float(np.sqrt(max(way @ C @ way, 0.0))) for way, C in zip(ways, parts, strict=True)])
        names = (("amplitude", 1e3, "mrad"), ("amplitude_2", 1e3, "mrad"))
    elif len(h.motions) == 1 < len(names):  # of one size, along one twist
        way = np.array(h.motions[0].twist)
        values, std = values[0] * way, std[0] * np.abs(way)
    elif h.kind == ZERO and h.motions[0].twist[5] == 0.0:  # of a joint that slides
        names = (("zero", 1e3, "mm"),)
    return tuple(
        SizeFound(name, factor * v, factor * (v - _95 * d), factor * (v + _95 * d), unit)
        for (name, factor, unit), v, d in zip(names, values.tolist(), std.tolist(), strict=False)
    )


def _moved(change: FittedChange, columns: Array) -> tuple[float, float, float]:
    """RMS of the tool's motion [mm] and its 95 % interval."""
    count = max(columns.shape[0] // 3, 1)
    moved = columns @ change.sizes
    rms = float(np.sqrt(np.sum(moved**2) / count))
    gradient = columns.T @ moved / (count * max(rms, 1e-300))
    std = float(np.sqrt(max(float(gradient @ change.covariance @ gradient), 0.0)))
    return 1e3 * rms, max(1e3 * (rms - _95 * std), 0.0), 1e3 * (rms + _95 * std)


def _sentence(change: FittedChange, sizes: tuple[SizeFound, ...]) -> str:
    """What changed and by how much, without what that makes at the tool."""
    h, size = change.hypothesis, str(sizes[0]) if sizes else ""
    if h.replaces >= 0:
        what = f"The curve of {h.place}'s gear" if h.kind == GEAR else f"The deflection of {h.place} under load"
        return f"{what} has grown by {size}"
    if h.free:
        return f"The gear of {h.place} has changed: its curve differs by {sizes[0].value:.3g} mrad RMS"
    if h.kind == GEAR:
        cycles = h.effect.shape.settings.get("cycles", 0.0)
        size = f"{size} at {cycles:.4g} a turn" if cycles else f"its ratio by {size}"
    shift, turn = (float(np.linalg.norm([s.value for s in sizes if s.unit == unit])) for unit in ("mm", "mrad"))
    moved = f"{', more and more' if h.growing else ''}: {shift:.3f} mm and {turn:.3f} mrad"
    factors = " and ".join(f"{s.value:.1f} times in {s.name}" for s in sizes)
    return h.worded(KINDS[h.kind].said, size=size, moved=moved, factors=factors)
