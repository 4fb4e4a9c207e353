"""Corrected kinematics in the forms that the makers' own descriptions read.

Universal Robots' description takes a ``kinematics`` table keyed by link (``kinematics_params_file:=``), Franka's one
keyed by joint; both hold, for each joint, the xyz [m] and rpy [rad] of its URDF ``<origin>``. Any other arm gets the
same values keyed by joint name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain

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
    own = dict(zip(chain.names, chain.origins, strict=False))
    origins = own if origins is None else origins
    found = _in_makers_form(chain, origins)
    return found if factory is None else _filled_in(factory, found, "factory kinematics")


def lacks_hash(data: Mapping[str, Any]) -> bool:
    """Whether this is of an arm whose driver expects a hash, and there is none."""
    table = data.get("kinematics")
    return isinstance(table, Mapping) and "hash" not in table


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
    if _ur_prefix(chain.names) is not None:
        return ur_kinematics({name: origins[name] for name in chain.names})
    prefix = _franka_prefix(chain.names)
    if prefix is not None:
        return franka_kinematics({name: T for name, T in origins.items() if name.startswith(prefix)})
    return {name: _origin(origins[name]) for name in chain.names}


def ur_kinematics(origins: Mapping[str, Array]) -> dict[str, Any]:
    """``{kinematics: {shoulder: {x, y, z, roll, pitch, yaw}, …}}`` of the six joints of one UR arm.

    origins: ``T_parent_joint`` (4, 4) by joint name; the names may share a prefix. The hash is left out: it is the
    arm's own controller that has one. Raises NotRepresentable when they are not a UR arm's.
    """
    prefix = _ur_prefix(tuple(origins))
    if prefix is None:
        raise NotRepresentable("UR kinematics", f"needs joints {', '.join(_UR)}", "choose another form")
    return {"kinematics": {link: _origin(origins[prefix + joint]) for joint, link in _UR.items()}}


def franka_kinematics(origins: Mapping[str, Array]) -> dict[str, Any]:
    """``{joint1: {kinematic: {x, y, z, roll, pitch, yaw}}, …}`` of the seven joints of one Franka arm.

    origins: ``T_parent_joint`` (4, 4) by joint name; joint 8, which is fixed and leads to the flange, is written too if
    it is there. Raises NotRepresentable when they are not a Franka arm's.
    """
    names = tuple(name for name in origins if _FRANKA.fullmatch(name))
    prefix = _franka_prefix(names)
    if prefix is None:
        raise NotRepresentable("Franka kinematics", "needs joints *_joint1 … *_joint7", "choose another form")
    joints = [f"joint{i}" for i in range(1, 9) if prefix + f"joint{i}" in origins]
    return {joint: {"kinematic": _origin(origins[prefix + joint])} for joint in joints}


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
