"""A task of topology synthesis from plain data, as its YAML file holds it, checked at the door."""

from __future__ import annotations

from collections.abc import Mapping
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
from modcal_core.robots import rotation_to_axis
from modcal_core.schema import NUMBER, POSITIVE, SIZE, TEXT, Schema, list_of, record, require, stated, whole

_FORMAT = 1
_SEE = "see docs/synthesis.md"
_PUBLISHED = ("structure", "reachability", "joint_range", "dexterity", "upright")
_ALWAYS = ("structure", "reachability")
_LAST, _MAX_JOINTS = 7, 10
_FARTHEST = 20.0  # m; farther targets were written in millimetres
_ROUNDING = 0.02  # how far a printed rotation may be from one

_POINT = list_of(NUMBER, 3, 3)
_ROTATIONS = {
    "rotation": list_of(_POINT, 3, 3),
    "rpy_rad": _POINT,
    "quaternion_xyzw": list_of(NUMBER, 4, 4),
    "z_axis": _POINT,
}
# options of requirements that are no plain sizes
_OPTIONS = {
    "spheres": list_of(record(("center_m", "radius_m"), center_m=_POINT, radius_m={**POSITIVE, "maximum": 20}), 1),
    "tolerance": {**POSITIVE, "maximum": 0.1},
}


def _of_requirement(known: Requirement) -> Schema:
    own = {key: _OPTIONS.get(key, SIZE) for key in known.options}
    own |= {"hard": {"type": "boolean"}} if known.hard and known.soft else {}
    own |= {"weight": SIZE} if known.soft else {}
    return record([key for key, default in known.options.items() if default is None], **own)


_SCHEMA = record(
    ("modcal_synthesis", "targets"),
    modcal_synthesis={"enum": [_FORMAT]},
    name=TEXT,
    targets=list_of(record(("position_m",), name=TEXT, position_m=_POINT, mask={}, **_ROTATIONS), 1),
    requirements=record((), **{name: _of_requirement(known) for name, known in REQUIREMENTS.items()}),
    joints=record((), first=whole(1, _MAX_JOINTS), last=whole(1, _MAX_JOINTS)),
    search=record((), population=whole(32, 100_000), generations=whole(1, 100_000), patience=whole(1, 100_000)),
    listed=whole(1, 1000),
    modules=list_of(TEXT),
)


@refusing
def task_from_data(data: Any, source: str) -> SynthesisTask:
    """The task that nested mappings and lists describe; ``source`` is named in refusals. Raises BadTable."""
    wanted = data.get("requirements") if isinstance(data, Mapping) else None
    if isinstance(wanted, Mapping):  # a name alone asks for a requirement with its defaults
        data = {**data, "requirements": {name: {} if value is None else value for name, value in wanted.items()}}
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    targets = tuple(_target(item, f"{source}: target {i + 1}", i) for i, item in enumerate(top["targets"]))
    joints = top.get("joints", {})
    first = joints.get("first", max(t.constraints for t in targets))
    last = joints.get("last", max(_LAST, first))
    if last < first:
        raise BadTable(f"{source}: joints", f"run from {first} to {last}", "give first not above last")
    names = _ALWAYS if "requirements" in top else _PUBLISHED
    return SynthesisTask(
        targets=targets,
        uses=uses_of({**{name: {} for name in names}, **top.get("requirements", {})}),
        first=first,
        last=last,
        settings=SearchSettings(**top.get("search", {})),
        listed=top.get("listed", 10),
        modules=tuple(top.get("modules", ())),
        name=plain_name(top.get("name", "task"), source),
    )


def _target(data: Mapping[str, Any], what: str, i: int) -> Target:
    p = np.array(data["position_m"], dtype=float)
    if np.linalg.norm(p) > _FARTHEST:
        said = f"is {np.linalg.norm(p):.0f} m away, {_FARTHEST:g} m is the limit"
        raise BadTable(f"{what}: position_m", said, "give metres, not millimetres")
    mask = _mask(data.get("mask", "111111"), f"{what}: mask")
    given = [key for key in _ROTATIONS if key in data]
    if len(given) > 1 or (not given and mask[:3].any()):
        said = f"has {len(given)} rotations where its mask asks for one"
        raise BadTable(what, said, f"give one of {', '.join(_ROTATIONS)}")
    R = _rotation(given[0], np.array(data[given[0]], dtype=float), f"{what}: {given[0]}", mask) if given else np.eye(3)
    return Target.build(R, p, mask, data.get("name", f"target_{i + 1}"))


def _rotation(key: str, values: Array, what: str, mask: np.ndarray) -> Array:
    if key == "rpy_rad":
        return so3.from_rpy(values)
    length = float(np.linalg.norm(values))
    if key == "quaternion_xyzw":
        if abs(length - 1.0) > _ROUNDING:
            raise BadTable(what, f"has length {length:.3f}, not 1", "check its four numbers")
        return so3.from_quaternion(values)
    if key == "z_axis":
        if mask[2]:
            said = "leaves the turn about z open, the mask does not"
            raise BadTable(what, said, 'give mask: "110111", or a rotation')
        if length < 1e-6:
            raise BadTable(what, "has no length", "give a direction")
        return rotation_to_axis(values / length)
    off = float(np.abs(values @ values.T - np.eye(3)).max())
    if off > _ROUNDING or np.linalg.det(values) < 0.0:
        said = f"is not a rotation: R Rᵀ is off by {off:.2g}" if off > _ROUNDING else "is a reflection"
        raise BadTable(what, said, "give its three rows")
    return values


def _mask(stated_mask: Any, what: str) -> np.ndarray:
    digits = [str(d) for d in stated_mask] if isinstance(stated_mask, str | list | tuple) else []
    if len(digits) != 6 or not {"1"} <= set(digits) <= {"0", "1"}:
        remedy = 'write six digits in quotes, turns first: "110111"'
        raise BadTable(f"{what} {stated_mask!r}", "is not six of 0 and 1, at least one of them 1", remedy)
    return np.array([d == "1" for d in digits])
