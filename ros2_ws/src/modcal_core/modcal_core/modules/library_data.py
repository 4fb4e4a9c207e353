"""A module library from plain data, as its YAML file holds it, checked at the door."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.library import (
    BASE,
    GRIPPER,
    JOINT,
    LINK,
    ROLES,
    SIZES,
    Library,
    ModulePoint,
    ModuleTolerance,
    ModuleType,
)

FORMAT = 1
_SEE = "see docs/modules.md"
_KEYS = {"role", "code", "motion", "length_m", "output", "elbows", "limits", "radius_m", "mass_kg", "mass_kg_per_m"}
_MOTIONS = {"revolute": True, "prismatic": False}
_LONGEST = 10.0  # m; a module that is longer was written in millimetres


def published_text() -> str:
    """The text of the library that is used where no other is given."""
    return files("modcal_core.modules").joinpath("published.yaml").read_text(encoding="utf-8")


def published() -> Library:
    """The published library: B, G, JR, JP, LC, LP, LR-I, LR-II."""
    import yaml

    return library_from_data(yaml.safe_load(published_text()), "published.yaml")


@refusing
def library_from_data(data: Any, source: str) -> Library:
    """The library that nested mappings and lists describe; ``source`` is named in refusals. Raises BadTable."""
    top = _mapping(data, source, {"modcal_modules", "name", "tolerances", "modules"})
    if top.get("modcal_modules") != FORMAT:
        raise BadTable(source, f"is not a module library (modcal_modules: {FORMAT})", _SEE)
    modules = _mapping(top.get("modules"), f"{source}: modules", None)
    types = {str(name): _type(str(name), stated, f"{source}: {name}") for name, stated in modules.items()}
    for role in ROLES:
        if not any(t.role == role for t in types.values()):
            raise BadTable(f"{source}: modules", f"there is no {role}", f"add a module with role: {role}")
    for role in (JOINT, LINK):
        codes = [t.code for t in types.values() if t.role == role]
        if len(set(codes)) < len(codes):
            raise BadTable(f"{source}: modules", f"two kinds of {role} have the same code", "give each its own code")
    tolerances = _mapping(top.get("tolerances") or {}, f"{source}: tolerances", {"module", "interface"})
    default = Library("", {})
    return Library(
        str(top.get("name", source)),
        types,
        _tolerance(tolerances.get("module"), default.module, f"{source}: tolerances: module"),
        _tolerance(tolerances.get("interface"), default.interface, f"{source}: tolerances: interface"),
    )


def _type(name: str, stated: Any, what: str) -> ModuleType:
    data = _mapping(stated, what, _KEYS)
    role = data.get("role")
    if role not in ROLES:
        raise BadTable(what, f"its role is {role!r}", f"give one of {', '.join(ROLES)}")
    motion = data.get("motion", "revolute")
    if motion not in _MOTIONS or (("motion" in data) != (role == JOINT)):
        raise BadTable(what, "a joint, and nothing else, has a motion", "give motion: revolute or prismatic")
    length = _mapping(data.get("length_m") or {"first": 0.0, "step": 0.0}, f"{what}: length_m", {"first", "step"})
    first, step = (_number(length.get(key, 0.0), f"{what}: length_m: {key}") for key in ("first", "step"))
    output = _mapping(data.get("output"), f"{what}: output", {"xyz", "along", "rpy"})
    place = _point(output, f"{what}: output")
    if role in (BASE, GRIPPER, LINK) and step and not place.along.any():
        raise BadTable(f"{what}: output", "has a length without a direction", "give along: [x, y, z]")
    limits = _mapping(data.get("limits") or {}, f"{what}: limits", {"lower", "upper", "velocity", "effort"})
    low, high = (
        _number(limits.get(k, d), f"{what}: limits: {k}", finite=False)
        for k, d in (("lower", -np.inf), ("upper", np.inf))
    )
    if not low < high:
        raise BadTable(f"{what}: limits", f"run from {low:g} to {high:g}", "give lower below upper")
    if motion == "prismatic" and not (np.isfinite(low) and np.isfinite(high)):
        raise BadTable(f"{what}: limits", "a sliding joint has an end", "give lower and upper")
    numbers = {
        "velocity": limits.get("velocity", 1.0),
        "effort": limits.get("effort", 100.0),
        "radius": data.get("radius_m", 0.03),
        "mass": data.get("mass_kg", 0.0),
        "mass_per_metre": data.get("mass_kg_per_m", 0.0),
    }
    checked = {key: _number(value, f"{what}: {key}") for key, value in numbers.items()}
    for key, value in checked.items():
        if value < 0.0 or (value == 0.0 and key == "radius"):
            raise BadTable(f"{what}: {key}", f"is {value:g}", "give a positive number")
    made = ModuleType(
        name=name,
        role=role,
        output=place,
        R=so3.from_rpy(_three(output.get("rpy", (0, 0, 0)), f"{what}: output: rpy")),
        revolute=_MOTIONS[motion],
        code=_code(data.get("code", 0 if motion == "revolute" else 1), what),
        first=first,
        step=step,
        elbows=tuple(
            _point(_mapping(e, f"{what}: elbows", {"xyz", "along"}), f"{what}: elbows")
            for e in data.get("elbows") or ()
        ),
        lower=low,
        upper=high,
        **checked,
    )
    longest = max(float(np.linalg.norm(made.output.at(made.length(n)))) for n in (0, SIZES - 1))
    if longest > _LONGEST:
        raise BadTable(what, f"is {longest:.0f} m long, {_LONGEST:g} m is the limit", "give metres, not millimetres")
    return made


def _tolerance(stated: Any, default: ModuleTolerance, what: str) -> ModuleTolerance:
    data = _mapping(stated or {}, what, {"length_m", "angle_rad", "zero_rad"})
    values = (
        _number(data.get("length_m", default.length), f"{what}: length_m"),
        _number(data.get("angle_rad", default.angle), f"{what}: angle_rad"),
        _number(data.get("zero_rad", default.zero), f"{what}: zero_rad"),
    )
    if min(values[:2]) <= 0.0 or values[2] < 0.0 or max(values) > 1.0:
        raise BadTable(what, "standard deviations are above 0 and below 1 (m, rad)", _SEE)
    return ModuleTolerance(*values)


def _mapping(data: Any, what: str, keys: set[str] | None) -> Mapping[str, Any]:
    if not isinstance(data, Mapping):
        raise BadTable(what, "is not a mapping", _SEE)
    unknown = [str(k) for k in data if keys is not None and k not in keys]
    if unknown:
        raise BadTable(what, f"'{unknown[0]}' does not belong there", f"keys are {', '.join(sorted(keys or ()))}")
    return data


def _point(data: Mapping[str, Any], what: str) -> ModulePoint:
    return ModulePoint(
        _three(data.get("xyz", (0, 0, 0)), f"{what}: xyz"), _three(data.get("along", (0, 0, 0)), f"{what}: along")
    )


def _three(values: Any, what: str) -> Array:
    try:
        out = np.array([float(v) for v in values])
    except (TypeError, ValueError, OverflowError):
        out = np.empty(0)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise BadTable(what, "needs 3 finite numbers", _SEE)
    out.flags.writeable = False
    return out


def _number(value: Any, what: str, finite: bool = True) -> float:
    try:
        out = float(value)
    except (TypeError, ValueError, OverflowError):
        out = np.nan
    if isinstance(value, bool) or np.isnan(out) or (finite and np.isinf(out)):
        raise BadTable(what, f"{value!r} is not a number", _SEE)
    return out


def _code(value: Any, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 4:
        raise BadTable(f"{what}: code", f"is {value!r}", "give 0 to 3")
    return value
