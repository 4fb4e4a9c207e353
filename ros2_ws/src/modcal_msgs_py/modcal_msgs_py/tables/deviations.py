"""Standard deviations that an instrument states of every reading: which columns, of what, in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.tables.candidates import Numbers
from modcal_msgs_py.tables.fitted import Fitted
from modcal_msgs_py.tables.joints import UNITS

_FINEST = 1e-6  # m, rad; standard deviations of instruments are more
_STD = {"std", "stdev", "stddev", "sigma", "sd", "deviation", "u"}  # the last only where a coverage is stated
_ALONG, _ABOUT = ("x", "y", "z"), ("rx", "ry", "rz", "roll", "pitch", "yaw")
_TURNED = {"rot", "rotation", "angle", "orientation", "ori", "angular"}


def stated_deviations(numbers: Numbers, fitted: Fitted) -> tuple[dict[str, Any], set[int], list[str]]:
    """What a mapping states under ``std``, the columns that it takes, and what is to be said of them.

    By their labels, of positions and of orientations; empty where the table has none.
    """
    used: set[int] = set()
    said: list[str] = []
    if fitted.body.points:
        return {}, used, said
    groups: dict[tuple[str, str], dict[str, int]] = {}
    for k in range(numbers.values.shape[1]):
        label = numbers.labels[k]
        words = [w for w in label.words if not w.isdigit()]
        axis = next((w for w in words if w in _ALONG or w in _ABOUT), "")
        marked = bool((_STD if label.coverage else _STD - {"u"}) & set(words))
        short = re.fullmatch(rf"(?:s|sd|std|sigma{'|u' if label.coverage else ''})([xyz])", "".join(words))
        if k in fitted.columns or not (marked or short) or not _stated(numbers.values[:, k]):
            continue
        axis = short[1] if short is not None else axis
        turned = axis in _ABOUT or bool(_TURNED & set(words))
        groups.setdefault(("orientation" if turned else "position", label.coverage), {}).setdefault(axis, k)
    stated: dict[str, Any] = {}
    for (what, factor), found in groups.items():
        columns = _axes(found)
        coverage = float(factor or 1.0)
        if not columns or what in stated or (what == "orientation" and fitted.best.meaning.turning is None):
            continue
        if stated and coverage != float(stated.get("coverage", 1.0)):
            continue
        unit = _unit_of_std(numbers, fitted, columns, what, coverage)
        shown = ", ".join(numbers.shown(k) for k in columns)
        if unit is None:
            said.append(f"standard deviations {shown} are not used: no unit makes them plausible; state std")
            continue
        keys = [numbers.key(k) for k in columns]
        stated[what] = keys if len(keys) == 3 else keys[0]
        stated["unit" if what == "position" else "orientation_unit"] = unit
        if coverage > 1.0:
            stated["coverage"] = coverage
        of = f"{factor} standard deviations" if coverage > 1.0 else "standard deviations"
        each = "" if len(columns) == 3 else " along each axis"
        said.append(f"{shown} are {of} of the {what}{each}, in {unit}")
        used |= set(columns)
    return stated, used, said


def _stated(values: Array) -> bool:
    there = values[np.isfinite(values)]
    return len(there) > 0 and bool((there >= 0.0).all()) and bool((there > 0.0).any())


def _axes(found: Mapping[str, int]) -> list[int]:
    for names in (("x", "y", "z"), ("rx", "ry", "rz"), ("roll", "pitch", "yaw")):
        if set(names) <= set(found):
            return [found[name] for name in names]
    return [found[""]] if "" in found else []


def _unit_of_std(numbers: Numbers, fitted: Fitted, columns: Sequence[int], what: str, coverage: float) -> str | None:
    """The unit by the label; else that of the readings, or another one, with which the size is an instrument's."""
    label, typical = numbers.labels[columns[0]], float(np.nanmedian(numbers.values[:, list(columns)])) / coverage
    if what == "orientation":
        if label.unit in ("deg", "rad"):
            return label.unit
        if label.unit is not None or label.told:
            return None
        turning = fitted.best.meaning.turning
        assert turning is not None
        fits = [u for u in ("rad", "deg") if _FINEST < UNITS[u] * typical < max(fitted.best.match.typical_angle, 1e-3)]
        if turning.form in ("euler", "rotvec"):
            same = "deg" if turning.degrees else "rad"
            return same if same in fits else None
        return fits[0] if len(fits) == 1 else None
    if label.unit in ("mm", "m", "in", "cm"):
        return label.unit
    if label.unit is not None or label.told:
        return None
    most = max(fitted.best.match.typical, 1e-4)
    same = fitted.best.meaning.unit
    return next((u for u in (same, "mm", "m") if _FINEST < UNITS[u] * typical < most), None)
