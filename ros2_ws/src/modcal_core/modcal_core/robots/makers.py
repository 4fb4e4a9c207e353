"""Kinematics in the forms that the makers' own descriptions read.

Universal Robots' description takes a ``kinematics`` table keyed by link (``kinematics_params_file:=``), Franka's one
keyed by joint, any other arm's is keyed by joint name; all hold, for each joint, the xyz [m] and rpy [rad] of its URDF
``<origin>``. The description that was calibrated may lay out the same arm in other frames (the older ones of UR have
axes along y) than the maker's file: the axes are then the same lines, bases and tips differ by right angles, and the
factory's frames are moved onto the calibrated axes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import DH, from_dh, vector
from modcal_core.robots.kinematics import chain_forward

_UR = {
    "shoulder_pan_joint": "shoulder",
    "shoulder_lift_joint": "upper_arm",
    "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1",
    "wrist_2_joint": "wrist_2",
    "wrist_3_joint": "wrist_3",
}
_FRANKA = re.compile(r"(?P<prefix>(?:.*_)?(?:panda|fer|fr3|fp3)(?:v[\d_]*\d)?_)joint(?P<number>[1-7])")

_AS_MADE = "give the file as the manufacturer's own tool wrote it for this arm"
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z: UR's description puts it before the table
_SAME_M = 1e-6  # by which the description of a model may be off its DH numbers
_FAR_MM, _FAR_DEG = 15.0, 3.0  # farther apart than calibrations of one arm lie
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
NO_HASH = """\
# No hash: it is the one of the arm's own controller, which no recording contains. The driver compares the two and
# complains where they differ. Give the file that the manufacturer's tool took from this arm (for UR: ur_calibration,
# calibration_correction.launch.py) to `modcal calibrate --factory-kinematics FILE`, or copy its line here:
#   hash: calib_...
"""


def kinematics_yaml_data(
    chain: Chain, origins: Mapping[str, Array] | None = None, factory: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The joints' origins as plain data, in the form of the arm's maker where the chain's joints are recognised.

    origins: ``T_parent_joint`` (4, 4) of the joints of the corrected URDF, fixed ones included. Without them the
    chain's constants are taken, which are the same unless fixed joints lie between (as before UR's first).
    factory: what the manufacturer's tool took from this very arm; its form, its hash and all else in it are kept.
    Raises BadTable where it is not of this arm.
    """
    origins = dict(zip(chain.names, chain.origins, strict=False)) if origins is None else origins
    found = _in_makers_form(chain, origins)
    if factory is None:
        return found
    filled = _filled_in(factory, found, "factory kinematics")
    if _ur_prefix(chain.names) is None:
        return filled
    made = from_ur_kinematics(factory)
    own = _behind_the_half_turn({name: origins[name] for name in chain.names})
    table = [_HALF_TURN @ made.origins[0], *made.origins[1:-1]]
    if all(_near(F, T) for F, T in zip(table, own.values(), strict=True)):
        return filled
    return _filled_in(factory, _ur_form(_as_laid_out(chain, made)), "")


def lacks_hash(data: Mapping[str, Any]) -> bool:
    """Whether this is of an arm whose driver expects a hash, and there is none."""
    table = data.get("kinematics")
    return isinstance(table, Mapping) and "hash" not in table


@refusing
def from_ur_kinematics(data: Mapping[str, Any]) -> Chain:
    """The arm that UR's description makes of a ``kinematics`` table, from base_link to tool0, each joint within one
    turn to either side. Raises BadTable.
    """
    rows = data.get("kinematics")
    if not isinstance(rows, Mapping) or not all(isinstance(rows.get(link), Mapping) for link in _UR.values()):
        raise BadTable("UR kinematics", f"needs kinematics: {', '.join(_UR.values())}", _AS_MADE)
    values = [vector([rows[link].get(key) for key in _KEYS], 6, f"kinematics: {link}") for link in _UR.values()]
    origins = np.stack([*(se3.transform(so3.from_rpy(v[3:]), v[:3]) for v in values), np.eye(4)])
    origins[0] = _HALF_TURN @ origins[0]
    most = np.full(len(_UR), 2.0 * np.pi)
    return Chain.build(tuple(_UR), origins, lower=-most, upper=most, base="base_link", tip="tool0")


@refusing
def ur_conf_table(text: str, nominal: Chain) -> dict[str, Any]:
    """The DH table of a UR controller's calibration.conf, which holds differences from its model's DH numbers.

    nominal: that model as UR's description lays it out, from base_link to tool0. Raises BadTable for anything else.
    """
    found = [re.search(rf"^\s*delta_{key}\s*=\s*\[([^\]]*)\]", text, re.MULTILINE) for key in DH]
    rows = zip(DH, found, strict=True)
    deltas = np.array([vector(row[1].split(",") if row else [], len(_UR), f"delta_{key}") for key, row in rows])
    if _ur_prefix(nominal.names) is None:
        raise BadTable("calibration.conf", f"is of a UR; this arm has {', '.join(nominal.names)}", "give its --urdf")
    first, links, numbers = _HALF_TURN @ nominal.origins[0], nominal.origins[1:-1], np.zeros((4, len(_UR)))
    alpha = np.arctan2(links[:, 2, 1], links[:, 1, 1])
    numbers[1] = np.r_[first[2, 3], np.cos(alpha) * links[:, 2, 3] - np.sin(alpha) * links[:, 1, 3]]
    numbers[2, :-1], numbers[3, :-1] = links[:, 0, 3], alpha

    def table(values: Array) -> dict[str, Any]:
        joints = [
            {"name": name, **dict(zip(DH, map(float, of), strict=True))}
            for name, of in zip(nominal.names, values.T, strict=True)
        ]
        ends = {"base_link": nominal.base, "tip_link": nominal.tip, "base": {"xyz": [0, 0, 0], "rpy": [0, 0, np.pi]}}
        limits = zip(joints, nominal.lower.tolist(), nominal.upper.tolist(), strict=True)
        return {"convention": "dh", **ends, "joints": [{**j, "lower": low, "upper": high} for j, low, high in limits]}

    q = np.linspace(-1.0, 1.0, 4 * nominal.n).reshape(4, -1)
    if np.abs(chain_forward(from_dh(table(numbers)), q) - chain_forward(nominal, q)).max() > _SAME_M:
        raise BadTable("robot description", "is not laid out as UR's present one", "give the URDF of ur_description")
    return table(numbers + deltas)


def laid_out_as(chain: Chain, nominal: Chain) -> Chain:
    """A UR arm with its frames where those of its model's description are, but on its own axes. Raises BadTable."""
    steps = np.stack(list(_as_laid_out(chain, nominal).values()))
    steps[0] = _HALF_TURN @ steps[0]
    return nominal.with_origins(np.concatenate([steps, nominal.origins[-1:]]))


def _as_laid_out(chain: Chain, made: Chain) -> dict[str, Array]:
    """The joints' origins (4, 4) by name in the frames of UR's description, as made has them, the first behind its half
    turn, put onto the axes of the chain. Raises BadTable where that is another arm.
    """
    at_zero, frames = chain.T_base_joint_home, made.T_base_joint_home
    axes = np.einsum("kij,kj->ki", at_zero[:-1, :3, :3], chain.axes)
    R = np.rint(so3.nearest_rotation(frames[:-1, :3, 2].T @ axes))  # layouts differ by right angles
    axes, points, tip = axes @ R.T, at_zero[:-1, :3, 3] @ R.T, se3.transform(R) @ at_zero[-1]
    tip = tip @ se3.transform(np.rint(tip[:3, :3].T @ frames[-1, :3, :3]))
    away = frames[:-1, :3, 3] - points
    away -= axes * np.sum(axes * away, axis=1, keepdims=True)
    off = 1e3 * np.r_[np.linalg.norm(away, axis=1), np.linalg.norm(tip[:3, 3] - frames[-1, :3, 3])]
    turned = np.degrees(np.arccos(np.clip(np.sum(axes * frames[:-1, :3, 2], axis=1), -1.0, 1.0)))
    far = (off > _FAR_MM) | (np.r_[turned, 0.0] > _FAR_DEG)
    if far.any() or np.linalg.det(R) < 0.5:
        k = int(np.argmax(far))
        name, angle = [*chain.names, chain.tip][k], [*turned, 0.0][k]
        said = f"puts {name} {off[k]:.0f} mm and {angle:.1f}° from where the robot description does"
        raise BadTable("factory kinematics", said, "give the file of this arm, in a layout of the same zeros")
    frames = np.array(frames[:-1])
    frames[-1] = tip
    for _ in range(2):  # of what is left of a small turn, nothing
        frames[:, :3, :3] = so3.exp(np.cross(frames[:, :3, 2], axes)) @ frames[:, :3, :3]
    frames[:, :3, 3] = points + axes * np.sum(axes * (frames[:, :3, 3] - points), axis=1, keepdims=True)
    steps = se3.inverse(np.concatenate([_HALF_TURN[None], frames[:-1]])) @ frames
    return dict(zip(chain.names, steps, strict=True))


def _behind_the_half_turn(origins: Mapping[str, Array]) -> dict[str, Array]:
    """Origins by joint, of which the first holds no half turn about z: UR's description has that in a joint before."""
    name = next(iter(origins))
    turned = origins[name][0, 0] < 0.0 and origins[name][2, 2] > 0.0
    return {**origins, **({name: _HALF_TURN @ origins[name]} if turned else {})}


def _near(F: Array, T: Array) -> bool:
    gap = se3.log(se3.inverse(F) @ T)
    return bool(1e3 * np.linalg.norm(gap[:3]) <= _FAR_MM and np.degrees(np.linalg.norm(gap[3:])) <= _FAR_DEG)


def _filled_in(factory: Any, found: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The factory's data with the values of the found ones in place of its own."""
    if not isinstance(factory, Mapping):
        raise BadTable(where, "is not a mapping", _AS_MADE)
    missing = [str(key) for key in found if key not in factory]
    if missing:
        raise BadTable(where, f"has no {', '.join(missing)}", _AS_MADE)
    out = dict(factory)
    for key, value in found.items():
        if isinstance(value, Mapping):
            out[key] = _filled_in(factory[key], value, f"{where}: {key}")
        elif isinstance(factory[key], bool) or not isinstance(factory[key], int | float):
            raise BadTable(f"{where}: {key}", "is not a number", _AS_MADE)
        else:
            out[key] = value
    return out


def _in_makers_form(chain: Chain, origins: Mapping[str, Array]) -> dict[str, Any]:
    """The origins as the maker's description reads them: UR's six, Franka's seven and the fixed one to its flange, any
    other arm's by joint name.
    """
    if _ur_prefix(chain.names) is not None:
        return _ur_form(_behind_the_half_turn({name: origins[name] for name in chain.names}))
    if (prefix := _franka_prefix(chain.names)) is not None:
        joints = [f"joint{i}" for i in range(1, 9) if f"{prefix}joint{i}" in origins]
        return {joint: {"kinematic": _origin(origins[prefix + joint])} for joint in joints}
    return {name: _origin(origins[name]) for name in chain.names}


def _ur_form(origins: Mapping[str, Array]) -> dict[str, Any]:
    """UR's table; the hash is left out: it is the arm's own controller that has one."""
    prefix = _ur_prefix(tuple(origins)) or ""
    return {"kinematics": {link: _origin(origins[prefix + joint]) for joint, link in _UR.items()}}


def _ur_prefix(names: tuple[str, ...]) -> str | None:
    prefixes = {name.removesuffix(joint) for name in names for joint in _UR if name.endswith(joint)}
    wanted = {prefix + joint for prefix in prefixes for joint in _UR}
    return next(iter(prefixes)) if len(prefixes) == 1 and wanted == set(names) else None


def _franka_prefix(names: tuple[str, ...]) -> str | None:
    found = [_FRANKA.fullmatch(name) for name in names]
    prefixes = {m["prefix"] for m in found if m}
    whole = sorted(m["number"] for m in found if m) == list("1234567") and len(names) == 7
    return prefixes.pop() if whole and len(prefixes) == 1 else None


def _origin(T: Array) -> dict[str, float]:
    values = np.concatenate([T[:3, 3], so3.to_rpy(T[:3, :3])])
    return {key: float(v) + 0.0 for key, v in zip(_KEYS, values, strict=True)}
