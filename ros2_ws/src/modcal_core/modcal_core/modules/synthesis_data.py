"""A task of topology synthesis from plain data, as its YAML file holds it, checked at the door."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, so3
from modcal_core.modules.coding import plain_name
from modcal_core.modules.evaluation import uses_of
from modcal_core.modules.genetic import SearchSettings
from modcal_core.modules.requirements import REQUIREMENTS, Requirement
from modcal_core.modules.synthesis import SynthesisTask
from modcal_core.modules.targets import Target

FORMAT = 1
_SEE = "see docs/synthesis.md"
_PUBLISHED = ("structure", "reachability", "joint_range", "dexterity", "upright")
_ALWAYS = ("structure", "reachability")
_LAST, _MAX_JOINTS = 7, 10
_FARTHEST = 20.0  # m; farther targets were written in millimetres
_ROUNDING = 0.02  # how far a printed rotation may be from one
_ROTATIONS = ("rotation", "rpy_rad", "quaternion_xyzw", "z_axis")


@refusing
def task_from_data(data: Any, source: str) -> SynthesisTask:
    """The task that nested mappings and lists describe; ``source`` is named in refusals. Raises BadTable."""
    keys = ("modcal_synthesis", "name", "targets", "requirements", "joints", "search", "listed", "modules")
    top = _mapping(data, source, keys)
    if top.get("modcal_synthesis") != FORMAT:
        raise BadTable(source, f"is not a task of synthesis (modcal_synthesis: {FORMAT})", _SEE)
    name = plain_name(top.get("name", "task"), source)
    stated = top.get("targets")
    if not isinstance(stated, Sequence) or isinstance(stated, str) or not stated:
        raise BadTable(f"{source}: targets", "is not a list of poses", _SEE)
    targets = tuple(_target(item, f"{source}: target {i + 1}", i) for i, item in enumerate(stated))
    joints = _mapping(top.get("joints") or {}, f"{source}: joints", ("first", "last"))
    least = max(t.constraints for t in targets)
    first = _whole(joints.get("first", least), f"{source}: joints: first", 1, _MAX_JOINTS)
    last = _whole(joints.get("last", max(_LAST, first)), f"{source}: joints: last", 1, _MAX_JOINTS)
    if last < first:
        raise BadTable(f"{source}: joints", f"run from {first} to {last}", "give first not above last")
    modules = top.get("modules") or []
    if not isinstance(modules, Sequence) or isinstance(modules, str):
        raise BadTable(f"{source}: modules", "is not a list", "write modules: [JR, LC, LP, LR-I]")
    return SynthesisTask(
        targets=targets,
        uses=uses_of(_requirements(top.get("requirements"), f"{source}: requirements")),
        first=first,
        last=last,
        settings=_settings(top.get("search") or {}, f"{source}: search"),
        listed=_whole(top.get("listed", 10), f"{source}: listed", 1, 1000),
        modules=tuple(str(name) for name in modules),
        name=name,
    )


def _target(stated: Any, what: str, i: int) -> Target:
    data = _mapping(stated, what, ("name", "position_m", "mask", *_ROTATIONS))
    p = _numbers(data.get("position_m"), f"{what}: position_m", (3,))
    if np.linalg.norm(p) > _FARTHEST:
        said = f"is {np.linalg.norm(p):.0f} m away, {_FARTHEST:g} m is the limit"
        raise BadTable(f"{what}: position_m", said, "give metres, not millimetres")
    mask = _mask(data.get("mask", "111111"), f"{what}: mask")
    given = [key for key in _ROTATIONS if key in data]
    if len(given) > 1 or (not given and mask[:3].any()):
        said = f"has {len(given)} rotations where its mask asks for one"
        raise BadTable(what, said, f"give one of {', '.join(_ROTATIONS)}")
    R = _rotation(given[0], data[given[0]], f"{what}: {given[0]}", mask) if given else np.eye(3)
    return Target.build(R, p, mask, str(data.get("name", f"target_{i + 1}")))


def _rotation(key: str, stated: Any, what: str, mask: np.ndarray) -> Array:
    if key == "rpy_rad":
        return so3.from_rpy(_numbers(stated, what, (3,)))
    if key == "quaternion_xyzw":
        quaternion = _numbers(stated, what, (4,))
        if abs(np.linalg.norm(quaternion) - 1.0) > _ROUNDING:
            raise BadTable(what, f"has length {np.linalg.norm(quaternion):.3f}, not 1", "check its four numbers")
        return so3.from_quaternion(quaternion)
    if key == "z_axis":
        if mask[2]:
            said = "leaves the turn about z open, the mask does not"
            raise BadTable(what, said, 'give mask: "110111", or a rotation')
        z = _numbers(stated, what, (3,))
        if np.linalg.norm(z) < 1e-6:
            raise BadTable(what, "has no length", "give a direction")
        z /= np.linalg.norm(z)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (z @ x)
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)
    R = _numbers(stated, what, (3, 3))
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _ROUNDING or np.linalg.det(R) < 0.0:
        said = f"is not a rotation: R Rᵀ is off by {off:.2g}" if off > _ROUNDING else "is a reflection"
        raise BadTable(what, said, "give its three rows")
    return R


def _mask(stated: Any, what: str) -> np.ndarray:
    digits = list(stated) if isinstance(stated, str | list | tuple) else []
    if len(digits) != 6 or any(str(d) not in ("0", "1") for d in digits) or not any(str(d) == "1" for d in digits):
        remedy = 'write six digits in quotes, turns first: "110111"'
        raise BadTable(f"{what} {stated!r}", "is not six of 0 and 1, at least one of them 1", remedy)
    return np.array([str(d) == "1" for d in digits])


def _requirements(stated: Any, what: str) -> dict[str, dict[str, Any]]:
    if stated is None:
        return {name: {} for name in _PUBLISHED}
    data = _mapping(stated, what, None)
    out: dict[str, dict[str, Any]] = {name: {} for name in _ALWAYS}
    for name, options in data.items():
        if name not in REQUIREMENTS:
            close = difflib.get_close_matches(str(name), REQUIREMENTS, n=2, cutoff=0.4) or list(REQUIREMENTS)
            raise BadTable(f"{what}: '{name}'", "is not a known requirement", f"use {', '.join(close)}")
        out[str(name)] = _options(REQUIREMENTS[name], options or {}, f"{what}: {name}")
    return out


def _options(known: Requirement, stated: Any, what: str) -> dict[str, Any]:
    extra = (("hard",) if known.hard and known.soft else ()) + (("weight",) if known.soft else ())
    data = dict(_mapping(stated, what, (*known.options, *extra)))
    missing = [key for key, default in known.options.items() if default is None and data.get(key) is None]
    if missing:
        raise BadTable(what, f"{missing[0]} is not given", _SEE)
    if not isinstance(data.get("hard", True), bool):
        raise BadTable(f"{what}: hard", f"is {data['hard']!r}", "give true or false")
    for key in data:
        if key == "spheres":
            data[key] = _spheres(data[key], f"{what}: spheres")
        elif key != "hard":
            data[key] = float(_numbers(data[key], f"{what}: {key}", ()))
            if data[key] < 0.0 or (key == "tolerance" and not 0.0 < data[key] <= 0.1):
                raise BadTable(f"{what}: {key}", f"is {data[key]:g}", "give a positive number")
    return data


def _spheres(stated: Any, what: str) -> list[dict[str, Any]]:
    if not isinstance(stated, Sequence) or isinstance(stated, str) or not stated:
        raise BadTable(what, "is not a list", "write [{center_m: [x, y, z], radius_m: r}]")
    out = []
    for i, item in enumerate(stated):
        data = _mapping(item, f"{what} {i + 1}", ("center_m", "radius_m"))
        radius = float(_numbers(data.get("radius_m"), f"{what} {i + 1}: radius_m", ()))
        if not 0.0 < radius < _FARTHEST:
            raise BadTable(f"{what} {i + 1}: radius_m", f"is {radius:g}", "give a positive radius in metres")
        center = _numbers(data.get("center_m"), f"{what} {i + 1}: center_m", (3,))
        out.append({"center_m": [float(x) for x in center], "radius_m": radius})
    return out


def _settings(stated: Any, what: str) -> SearchSettings:
    data = _mapping(stated, what, ("population", "generations", "patience"))
    default = {f.name: getattr(SearchSettings(), f.name) for f in fields(SearchSettings)}
    least = {"population": 32, "generations": 1, "patience": 1}
    return SearchSettings(**{k: _whole(data.get(k, default[k]), f"{what}: {k}", least[k], 100_000) for k in least})


def _mapping(data: Any, what: str, keys: Sequence[str] | None) -> Mapping[str, Any]:
    if not isinstance(data, Mapping):
        raise BadTable(what, "is not a mapping", _SEE)
    unknown = [str(k) for k in data if keys is not None and k not in keys]
    if unknown:
        raise BadTable(what, f"'{unknown[0]}' does not belong there", f"keys are {', '.join(keys or ())}")
    return data


def _numbers(stated: Any, what: str, shape: tuple[int, ...]) -> Array:
    try:
        out = np.array(stated, dtype=float) if not isinstance(stated, bool | str | type(None)) else np.full(1, np.nan)
    except (TypeError, ValueError, OverflowError):
        out = np.full(1, np.nan)
    if out.shape != shape or not np.isfinite(out).all():
        wanted = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise BadTable(what, f"needs {wanted}", _SEE)
    return out


def _whole(stated: Any, what: str, least: int, most: int) -> int:
    if isinstance(stated, bool) or not isinstance(stated, int) or not least <= stated <= most:
        raise BadTable(what, f"is {stated!r}", f"give a whole number from {least} to {most}")
    return stated
