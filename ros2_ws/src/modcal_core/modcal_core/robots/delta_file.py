"""A Delta as plain data, the way its YAML file holds it: docs/delta.md describes every key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array
from modcal_core.robots.delta import ARMS, AZIMUTH, DISTAL, OFFSET, PROXIMAL, RATIO, ZERO, Delta

FORMAT = 1
_ROWS = {
    "zero_rad": ZERO, "ratio": RATIO, "azimuth_rad": AZIMUTH, "offset_m": OFFSET, "proximal_m": PROXIMAL,
    "distal_m": DISTAL,
}  # fmt: skip
_RADII = ("fixed_radius_m", "platform_radius_m")
_KEYS = {"modcal_delta", "joints", "arms", "shaft_ratio", "limits_rad", "tool", "base", "tip"}
_REMEDY = "see docs/delta.md"


@refusing
def delta_from_data(data: Any, source: str) -> Delta:
    """The Delta that this data describes; raises BadTable, naming the source, for what is missing or not understood.

    Raises BadRobot for constants that no Delta has.
    """
    if not isinstance(data, Mapping) or "modcal_delta" not in data:
        raise BadTable(source, "is not a description of a Delta: it lacks modcal_delta: 1", _REMEDY)
    if data["modcal_delta"] != FORMAT:
        raise BadTable(source, f"modcal_delta {data['modcal_delta']}, {FORMAT} is read", _REMEDY)
    _only(data, _KEYS, source)
    names = data.get("joints")
    if not isinstance(names, Sequence) or isinstance(names, str) or len(names) not in (ARMS, ARMS + 1):
        raise BadTable(f"{source}: joints", "must name three arms, and the shaft where there is one", _REMEDY)
    names = [str(name) for name in names]
    arms = data.get("arms")
    if not isinstance(arms, Mapping):
        raise BadTable(f"{source}: arms", f"must have {', '.join(_ROWS)}", _REMEDY)
    _only(arms, {*_ROWS, *_RADII}, f"{source}: arms")
    given = {key: _numbers(arms[key], ARMS, f"{source}: arms: {key}", one_for_all=True) for key in arms}
    if all(key in given for key in _RADII) and "offset_m" not in given:
        given["offset_m"] = given[_RADII[0]] - given[_RADII[1]]
    elif any(key in given for key in _RADII) and not ("offset_m" in given and "fixed_radius_m" not in given):
        said = f"needs either offset_m, or both {' and '.join(_RADII)}"
        raise BadTable(f"{source}: arms", said, _REMEDY)
    missing = [key for key in ("offset_m", "proximal_m", "distal_m") if key not in given]
    if missing:
        raise BadTable(f"{source}: arms", f"lacks {', '.join(missing)}", _REMEDY)
    optional = {name: given[key] for name, key in
                (("zero", "zero_rad"), ("ratio", "ratio"), ("azimuth", "azimuth_rad")) if key in given}  # fmt: skip
    ratio = data.get("shaft_ratio", 1.0)
    limits = _limits(data.get("limits_rad"), names, source)
    return Delta.build(
        names,
        given["offset_m"],
        given["proximal_m"],
        given["distal_m"],
        **optional,
        lower=limits[:, 0],
        upper=limits[:, 1],
        tool=_tool(data.get("tool"), source),
        shaft_ratio=float(_numbers(ratio, 1, f"{source}: shaft_ratio", one_for_all=True)[0]),
        base=str(data.get("base", "base")),
        tip=str(data.get("tip", "tip")),
        platform_radius=float(given["platform_radius_m"].mean().round(12)) if "platform_radius_m" in given else 0.0,
    )


def delta_to_data(delta: Delta) -> dict[str, Any]:
    """The data that :func:`delta_from_data` reads back as the same Delta, no digit lost."""
    shaft = {"shaft_ratio": delta.shaft_ratio} if delta.has_shaft else {}
    radius = {"platform_radius_m": delta.platform_radius} if delta.platform_radius else {}
    return {
        "modcal_delta": FORMAT,
        "base": delta.base,
        "tip": delta.tip,
        "joints": list(delta.names),
        "arms": {**{key: delta.constants[row].tolist() for key, row in _ROWS.items()}, **radius},
        **shaft,
        "limits_rad": {
            name: [float(low), float(high)]
            for name, low, high in zip(delta.names, delta.lower, delta.upper, strict=True)
        },
        "tool": {"position_m": delta.tool[:3].tolist(), "rotation_rad": delta.tool[3:].tolist()},
    }


def _only(data: Mapping[str, Any], known: set[str], source: str) -> None:
    unknown = sorted(str(key) for key in data if key not in known)
    if unknown:
        raise BadTable(source, f"unknown key {', '.join(unknown)}; known are {', '.join(sorted(known))}", _REMEDY)


def _numbers(given: Any, count: int, source: str, one_for_all: bool = False) -> Array:
    """So many finite numbers, or one for all."""
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if one_for_all and values.ndim == 0:
        values = np.full(count, values)
    if values.shape != (count,) or not np.isfinite(values).all():
        said = f"must be {'one number or ' if one_for_all else ''}{count} numbers"
        raise BadTable(source, said, "correct the file")
    return values


def _limits(given: Any, names: Sequence[str], source: str) -> Array:
    """Limits (n, 2) [rad] by name; the usual ones of a Delta where none are stated."""
    plain = Delta.build(names, 0.1, 0.3, 0.8)
    out = np.c_[plain.lower, plain.upper]
    if given is None:
        return out
    if not isinstance(given, Mapping):
        raise BadTable(f"{source}: limits_rad", "must have a pair of numbers by joint", _REMEDY)
    _only(given, set(names), f"{source}: limits_rad")
    for name, pair in given.items():
        out[list(names).index(name)] = _numbers(pair, 2, f"{source}: limits_rad: {name}")
    return out


def _tool(given: Any, source: str) -> Array:
    if given is None:
        return np.zeros(6)
    if not isinstance(given, Mapping):
        raise BadTable(f"{source}: tool", "must have position_m and rotation_rad", _REMEDY)
    _only(given, {"position_m", "rotation_rad"}, f"{source}: tool")
    parts = [_numbers(given.get(key, [0.0] * 3), 3, f"{source}: tool: {key}") for key in ("position_m", "rotation_rad")]
    return np.concatenate(parts)
