"""Arms with errors of 1 to 3 mm, moved by MuJoCo: joints that the controller reports, and where the tool truly is.

Nothing here comes from modcal: the URDF is walked by hand, and MuJoCo does the kinematics.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
# file, link that carries the tool
ARMS = {"ur10": "tool0", "panda": "panda_hand_tcp", "iiwa14": None, "xarm7": None}


@dataclass(frozen=True)
class Recorded:
    """q: (N, n) [rad] as reported. T: tool in the tracker, (N, 4, 4) [m], with noise. commanded, temperature, stamps."""

    robot: str
    names: tuple[str, ...]
    q: np.ndarray
    T: np.ndarray
    stamps: np.ndarray
    commanded: np.ndarray
    temperature: np.ndarray


def _chain(robot: str) -> tuple[list[ET.Element], str]:
    """Joints from the root to the link that carries the tool."""
    root = ET.parse(ROBOTS / f"{robot}.urdf").getroot()
    by_child = {j.find("child").get("link"): j for j in root.findall("joint")}
    tip = ARMS[robot]

    def depth(link: str) -> int:
        count = 0
        while link in by_child:
            count += by_child[link].get("type") in ("revolute", "continuous")
            link = by_child[link].find("parent").get("link")
        return count

    if tip is None:
        tip = max((link.get("name") for link in root.findall("link")), key=depth)
    out, link = [], tip
    while link in by_child:
        out.append(by_child[link])
        link = by_child[link].find("parent").get("link")
    return out[::-1], tip


def _pose(joint: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    origin = joint.find("origin")
    text = ("", "") if origin is None else (origin.get("xyz", ""), origin.get("rpy", ""))
    xyz, rpy = (np.array([float(v) for v in t.split()] or [0.0] * 3) for t in text)
    return xyz, rpy


def record(robot: str, rng: np.random.Generator, rows: int, spread: float = 1.0, rate: float = 0.0) -> Recorded:
    """Postures of an arm whose links, axes and zeros are a little off, seen by a tracker. spread: of the joints.

    rate: rows a second of one smooth motion; 0: postures apart.
    """
    joints, _ = _chain(robot)
    spec = mujoco.MjSpec()
    body = spec.worldbody
    names, low, high = [], [], []
    for k, joint in enumerate(joints):
        xyz, rpy = _pose(joint)
        xyz = xyz + 6e-4 * rng.standard_normal(3)
        R = Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(6e-4 * rng.standard_normal(3))
        x, y, z, w = R.as_quat()
        body = body.add_body(name=f"b{k}", pos=xyz, quat=[w, x, y, z])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=0.1)
        if joint.get("type") in ("revolute", "continuous"):
            axis = joint.find("axis")
            along = [float(v) for v in (axis.get("xyz") if axis is not None else "1 0 0").split()]
            body.add_joint(name=joint.get("name"), type=mujoco.mjtJoint.mjJNT_HINGE, axis=along)
            limit = joint.find("limit")
            ends = (-3.1, 3.1) if limit is None else (float(limit.get("lower", -3.1)), float(limit.get("upper", 3.1)))
            names.append(joint.get("name"))
            low.append(max(ends[0], -3.0))
            high.append(min(ends[1], 3.0))
    tool = body.add_site(name="tool", pos=rng.uniform(-0.12, 0.12, 3))
    x, y, z, w = Rotation.random(random_state=rng).as_quat()
    tool.quat = [w, x, y, z]
    model = spec.compile()
    data = mujoco.MjData(model)
    low, high = np.array(low), np.array(high)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    q = middle + spread * half * rng.uniform(-0.75, 0.75, (rows, len(names)))
    if rate:
        t = np.arange(rows)[:, None] / rate
        turns = rng.uniform(0.05, 0.2, (2, 1, len(names)))
        waves = [np.sin(2.0 * np.pi * f * t + rng.uniform(0, 6.28, len(names))) for f in turns]
        q = middle + spread * half * 0.4 * (waves[0] + waves[1])
    offset = 7e-4 * rng.standard_normal(len(names))
    B = np.eye(4)
    B[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    B[:3, 3] = rng.uniform(1.0, 3.5) * (lambda v: v / np.linalg.norm(v))(rng.standard_normal(3))
    noise = rng.uniform(1e-5, 8e-5), rng.uniform(5e-5, 4e-4)
    T = np.tile(np.eye(4), (rows, 1, 1))
    for i in range(rows):
        data.qpos[:] = q[i] + offset
        mujoco.mj_kinematics(model, data)
        turn = data.site_xmat[0].reshape(3, 3)
        T[i, :3, :3] = B[:3, :3] @ turn @ Rotation.from_rotvec(noise[1] * rng.standard_normal(3)).as_matrix()
        T[i, :3, 3] = B[:3, :3] @ data.site_xpos[0] + B[:3, 3] + noise[0] * rng.standard_normal(3)
    stamps = 1.7e9 + (np.arange(rows) / rate if rate else np.cumsum(rng.uniform(4.0, 9.0, rows)))
    commanded = q + 2e-5 * rng.standard_normal(q.shape)
    temperature = 21.0 + np.cumsum(0.02 * rng.standard_normal(rows))
    return Recorded(robot, tuple(names), q, T, stamps, commanded, temperature)


def holding(robot: str, q: np.ndarray) -> np.ndarray:
    """Torques (N, n) [N m] with which actuators hold the described bodies at joints q, positive along the axes."""
    joints, _ = _chain(robot)
    root = ET.parse(ROBOTS / f"{robot}.urdf").getroot()
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    spec = mujoco.MjSpec()
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
    body = spec.worldbody
    for k, joint in enumerate(joints):
        xyz, rpy = _pose(joint)
        x, y, z, w = Rotation.from_euler("xyz", rpy).as_quat()
        body = body.add_body(name=f"b{k}", pos=xyz, quat=[w, x, y, z])
        inertial = inertials.get(joint.find("child").get("link"))
        if inertial is not None:
            centre, _ = _pose(inertial)
            mass = float(inertial.find("mass").get("value"))
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=centre, mass=mass)
        if joint.get("type") in ("revolute", "continuous"):
            axis = joint.find("axis")
            along = [float(v) for v in (axis.get("xyz") if axis is not None else "1 0 0").split()]
            body.add_joint(name=joint.get("name"), type=mujoco.mjtJoint.mjJNT_HINGE, axis=along)
    model = spec.compile()
    data = mujoco.MjData(model)
    out = np.empty_like(q)
    for i, posture in enumerate(q):
        data.qpos[:] = posture
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        out[i] = data.qfrc_bias
    return out
