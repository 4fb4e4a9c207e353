"""Corrected kinematics in the forms that the makers' own descriptions read.

Universal Robots' description takes a ``kinematics`` table keyed by link (``kinematics_params_file:=``), Franka's one
keyed by joint; both hold the origin of each joint as x y z [m] and roll pitch yaw [rad]. Any other arm gets the same
table keyed by joint name.
"""

from __future__ import annotations

import hashlib
import re
from typing import Any

import numpy as np

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
_FRANKA = re.compile(r".*(?:panda|fr3|fer|fp3)_(joint[1-7])$")


def kinematics_yaml_data(chain: Chain) -> dict[str, Any]:
    """The joints' origins as plain data, in the form of the arm's maker where its joint names are recognised."""
    links = [next((link for joint, link in _UR.items() if name.endswith(joint)), None) for name in chain.names]
    if chain.n == 6 and links == list(_UR.values()):
        table = {link: _origin(T) for link, T in zip(_UR.values(), chain.origins, strict=False)}
        return {"kinematics": {**table, "hash": _hash(chain)}}
    joints = [_FRANKA.match(name) for name in chain.names]
    if chain.n == 7 and all(joints):
        named = zip([m.group(1) for m in joints if m], chain.origins, strict=False)
        return {joint: {"kinematic": _origin(T)} for joint, T in named}
    return {name: _origin(T) for name, T in zip(chain.names, chain.origins, strict=False)}


def _origin(T: Array) -> dict[str, float]:
    values = np.concatenate([T[:3, 3], so3.to_rpy(T[:3, :3])])
    return {key: float(v) for key, v in zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)}


def _hash(chain: Chain) -> str:
    """A name for this set of values, of the length that the makers' own ones have."""
    digest = hashlib.sha256(np.ascontiguousarray(chain.origins).tobytes()).digest()
    return f"calib_{int.from_bytes(digest[:8], 'big'):020d}"
