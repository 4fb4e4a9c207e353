"""A change in words and numbers: sizes in the units of people, how far it moves the tool, and its sentence."""

from __future__ import annotations

import numpy as np

from modcal_core.checking.known import UNTRIED, BeyondRanges
from modcal_core.checking.outcome import Alike, NamedChange, SizeFound
from modcal_core.geometry import Array
from modcal_core.moves import (
    BASE,
    FRAME,
    GEAR,
    LENGTH,
    LINK,
    LOAD,
    NOISE,
    PAYLOAD,
    PLAY,
    SCALE,
    STEP,
    TOOL,
    ZERO,
    CellChange,
    FittedChange,
)

_95 = 1.959964  # standard deviations
_LISTED = 3  # others that a sentence has room for; check.json and the page have them all
_PLACED = (BASE, FRAME, TOOL, LINK, PLAY, STEP)  # of up to six sizes
_CURVE = ("rms_over_stations", 1e3, "mrad")
_ONE = {  # name, factor and unit of a change of one size
    ZERO: ("zero", 1e3, "mrad"),
    LENGTH: ("growth", 1e3, "mm"),
    SCALE: ("scale", 1e6, "ppm"),
    LOAD: ("compliance", 1e6, "urad/(N m)"),
    GEAR: ("ratio", 1e6, "ppm"),
}


def named(
    change: FittedChange, columns: Array, positions: int, alike: Alike, beyond: BeyondRanges | None = None
) -> NamedChange:
    """The change for people.

    columns: motions of the readings per unit of each size (n, k), whose first ``positions`` rows are positions,
    component by component; of a curve the motion of each station's angle (n, S). beyond: how many of the stations stand
    where the calibration was not made.
    """
    h = change.hypothesis
    sizes = _sizes(change)
    moved = (0.0, 0.0, 0.0) if h.kind == NOISE else _moved(change, columns[:positions])
    turned = None if h.kind == NOISE or len(columns) <= positions else _turned(change, columns[positions:])
    repairable = h.kind == NOISE or bool(h.sizes)
    rivals = tuple(dict.fromkeys(j.label for j in change.same_as))
    shapeless = h.kind == NOISE or h.curve >= 0  # what any error would look like; a move that leaves noise is a move
    if shapeless and beyond is not None and beyond.doubts(moved[0]):
        rivals, alike = (UNTRIED, *rivals), ""
    return NamedChange(
        h.kind,
        h.place,
        h.label,
        _sentence(h, sizes, _at_the_tool(moved, turned), rivals, alike),
        sizes,
        moved,
        turned,
        change.probability,
        (*h.names, *rivals),
        alike,
        repairable,
    )


def _sizes(change: FittedChange) -> tuple[SizeFound, ...]:
    h, values = change.hypothesis, change.sizes
    std = np.sqrt(np.maximum(np.diag(change.covariance), 0.0)) if len(change.covariance) else np.zeros(len(values))
    if h.kind == NOISE:
        factors = zip(("position", "orientation"), change.judged.noise, strict=True)
        return tuple(SizeFound(what, factor, factor, factor, "times") for what, factor in factors if factor > 1.0)
    if h.kind in _PLACED and len(h.motions) == 1:  # of one size, along one twist
        way = np.array(h.motions[0].twist)
        values, std = values[0] * way, std[0] * np.abs(way)
    if h.curve >= 0:
        rms = float(np.sqrt(np.mean(values**2)))
        names, values, std = [_CURVE], np.array([rms]), np.array([float(np.sqrt(np.mean(std**2) / max(len(std), 1)))])
    elif h.kind in _PLACED:
        names = [(n, 1e3, "mm") for n in ("x", "y", "z")] + [(n, 1e3, "mrad") for n in ("rx", "ry", "rz")]
    elif h.replaces >= 0:
        names = [("growth", 100.0, "%")]
    elif h.kind == PAYLOAD:
        names = [(f"compliance of {e.place}", *_ONE[LOAD][1:]) for e in h.effects]
    elif h.kind == GEAR and len(values) > 1:  # a wave, and one of twice its cycles
        pairs = [slice(k, k + 2) for k in range(0, len(values), 2)]
        names = [("amplitude", 1e3, "mrad"), ("amplitude_2", 1e3, "mrad")][: len(pairs)]
        std = np.array([_along(values[pair], change.covariance[pair, pair]) for pair in pairs])
        values = np.array([np.hypot(*values[pair]) for pair in pairs])
    else:
        slides = h.kind == ZERO and h.motions[0].twist[5] == 0.0
        names = [("zero", 1e3, "mm") if slides else _ONE[h.kind]]
    return tuple(_size(n, v, s, factor, u) for (n, factor, u), v, s in zip(names, values, std, strict=False))


def _along(values: Array, covariance: Array) -> float:
    """Standard deviation of the length of two values."""
    way = values / max(float(np.hypot(*values)), 1e-300)
    return float(np.sqrt(max(float(way @ covariance @ way), 0.0)))


def _size(name: str, value: float, std: float, factor: float, unit: str) -> SizeFound:
    low, high = (factor * (float(value) + k * _95 * float(std)) for k in (-1.0, 1.0))
    return SizeFound(name, factor * float(value), low, high, unit)


def _moved(change: FittedChange, columns: Array) -> tuple[float, float, float]:
    """RMS of the tool's motion [mm] and its 95 % interval."""
    count = max(columns.shape[0] // 3, 1)
    moved = columns @ change.sizes
    rms = float(np.sqrt(np.sum(moved**2) / count))
    if rms == 0.0 or not len(change.covariance):
        return 1e3 * rms, 1e3 * rms, 1e3 * rms
    gradient = columns.T @ moved / (count * rms)
    std = float(np.sqrt(max(float(gradient @ change.covariance @ gradient), 0.0)))
    return 1e3 * rms, max(1e3 * (rms - _95 * std), 0.0), 1e3 * (rms + _95 * std)


def _turned(change: FittedChange, columns: Array) -> float:
    """RMS of the tool's turn [deg], at the readings that have an orientation."""
    return float(np.degrees(np.sqrt(np.sum((columns @ change.sizes) ** 2) / (len(columns) / 3))))


def _at_the_tool(moved: tuple[float, float, float], turned: float | None) -> str:
    turn = "" if turned is None else f" and {turned:.3f}°"
    return f"{moved[0]:.3f} mm ({moved[1]:.3f} … {moved[2]:.3f}){turn} RMS at the tool"


def _said(size: SizeFound) -> str:
    return f"{size.value:+.3g} {size.unit} ({size.low:.3g} … {size.high:.3g})"


def _sentence(h: CellChange, sizes: tuple[SizeFound, ...], rms: str, rivals: tuple[str, ...], alike: Alike) -> str:
    first = _said(sizes[0]) if sizes else ""
    if h.kind == NOISE:
        what = " and ".join(f"{s.value:.1f} times in {s.name}" for s in sizes)
        out = f"The readings scatter more than when the calibration was made: {what}."
    elif h.kind in _PLACED:
        shift, turn = (float(np.linalg.norm([s.value for s in sizes if s.unit == unit])) for unit in ("mm", "mrad"))
        who = {
            FRAME: f"Frame {h.place} has moved",
            LINK: f"The link before {h.place} is bent",
            PLAY: "The tool or the target is loose and stands off to either side by its weight",
            STEP: f"The {h.place} moved between two stations of the recording",
        }.get(h.kind, " or the ".join((f"The {h.place}", *h.names)) + " has moved")
        out = f"{who}: {shift:.3f} mm and {turn:.3f} mrad, {rms}."
    else:
        link = "All links have grown" if h.place == "arm" else f"The link before {h.place} has grown"
        by = f"its deflection under load has grown by {first}" if h.replaces >= 0 else f"by {first}"
        said = {
            ZERO: f"The zero of {h.place} has changed by {first}",
            LENGTH: f"{link} by {first}, as heat does",
            SCALE: f"The tracker's readings are longer by {first}",
            PAYLOAD: "All joints deflect differently under load, as under another payload",
            LOAD: f"{h.place} deflects differently under load: {by}",
            GEAR: _of_a_gear(h, sizes),
        }[h.kind]
        out = f"{said}, {rms}."
    if not rivals:
        return out
    others = " or ".join(rivals[:_LISTED])
    if len(rivals) > _LISTED:
        others += f" or one of {len(rivals) - _LISTED} other changes"
    why = {
        "poses": "the same motion at every posture, so the repaired poses are the same",
        "positions": "the same positions at every posture, so these are repaired, but not the same orientations, which "
        "poses would tell",
    }.get(alike, "these stations cannot tell")
    return f"{out} It may as well be {others}: {why}."


def _of_a_gear(h: CellChange, sizes: tuple[SizeFound, ...]) -> str:
    if h.kind != GEAR:
        return ""
    if h.replaces >= 0:
        return f"The curve of {h.place}'s gear has grown by {_said(sizes[0])}"
    if h.curve >= 0:
        return f"The gear of {h.place} has changed: its curve differs by {sizes[0].value:.3g} mrad RMS"
    if sizes[0].name == "ratio":
        return f"The gear ratio of {h.place} has changed by {_said(sizes[0])}"
    cycles = h.effect.shape.settings["cycles"]
    return f"The gear or encoder of {h.place} has changed: {_said(sizes[0])} at {cycles:.4g} a turn"
