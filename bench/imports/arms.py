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

Array = np.ndarray
ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = {"ur10": "tool0", "panda": "panda_hand_tcp", "iiwa14": None, "xarm7": None}  # link that carries the tool
TURNS = ("revolute", "continuous")


@dataclass(frozen=True)
class Recorded:
    """q: (N, n) [rad] as reported. T: tool in the tracker, (N, 4, 4) [m], with noise. And commanded joints."""

    robot: str
    names: tuple[str, ...]
    q: Array
    T: Array
    stamps: Array
    commanded: Array
    temperature: Array


def _numbers(element: ET.Element | None, key: str, default: str) -> Array:
    return np.array([float(v) for v in ("" if element is None else element.get(key, "")).split() or default.split()])


def _pose(element: ET.Element) -> tuple[Array, Rotation]:
    xyz, rpy = (_numbers(element.find("origin"), key, "0 0 0") for key in ("xyz", "rpy"))
    return xyz, Rotation.from_euler("xyz", rpy)


def _quaternion(R: Rotation) -> Array:
    return np.roll(R.as_quat(), 1)


def _chain(robot: str) -> tuple[ET.Element, list[ET.Element]]:
    """The description, and its joints from the root to the link that carries the tool."""
    root = ET.parse(ROBOTS / f"{robot}.urdf").getroot()
    above = {j.find("child").get("link"): j for j in root.findall("joint")}

    def path(link: str) -> list[ET.Element]:
        joint = above.get(link)
        return [] if joint is None else [*path(joint.find("parent").get("link")), joint]

    def depth(link: str) -> int:
        return sum(joint.get("type") in TURNS for joint in path(link))

    return root, path(ARMS[robot] or max((link.get("name") for link in root.findall("link")), key=depth))


def _bodies(
    robot: str, spec: mujoco.MjSpec, rng: np.random.Generator | None
) -> tuple[mujoco.MjsBody, list[ET.Element]]:
    """The arm's last body, and its moving joints. rng: every body a little off, of 0.1 kg; None: as it is drawn."""
    root, joints = _chain(robot)
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    body, ball = spec.worldbody, {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.01, 0, 0]}
    for k, joint in enumerate(joints):
        xyz, R = _pose(joint)
        if rng is not None:
            xyz = xyz + 6e-4 * rng.standard_normal(3)
            R = R * Rotation.from_rotvec(6e-4 * rng.standard_normal(3))
        body = body.add_body(name=f"b{k}", pos=xyz, quat=_quaternion(R))
        inertial = inertials.get(joint.find("child").get("link"))
        if rng is not None:
            body.add_geom(mass=0.1, **ball)
        elif inertial is not None:
            body.add_geom(pos=_pose(inertial)[0], mass=float(inertial.find("mass").get("value")), **ball)
        if joint.get("type") in TURNS:
            axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
            body.add_joint(name=joint.get("name"), type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
    return body, [joint for joint in joints if joint.get("type") in TURNS]


def record(robot: str, rng: np.random.Generator, rows: int, spread: float = 1.0, rate: float = 0.0) -> Recorded:
    """Postures of an arm whose links, axes and zeros are a little off, seen by a tracker. spread: of the joints.

    rate: rows a second of one smooth motion; 0: postures apart.
    """
    spec = mujoco.MjSpec()
    body, joints = _bodies(robot, spec, rng)
    limits = [joint.find("limit") for joint in joints]
    low, high = (
        np.array([float(_numbers(e, key, end)[0]) for e in limits])
        for key, end in (("lower", "-3.1"), ("upper", "3.1"))
    )
    low, high = np.maximum(low, -3.0), np.minimum(high, 3.0)
    tool = body.add_site(name="tool", pos=rng.uniform(-0.12, 0.12, 3))
    tool.quat = _quaternion(Rotation.random(random_state=rng))
    model = spec.compile()
    data, n = mujoco.MjData(model), len(joints)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    q = middle + spread * half * rng.uniform(-0.75, 0.75, (rows, n))
    if rate:
        t = np.arange(rows)[:, None] / rate
        turns = rng.uniform(0.05, 0.2, (2, 1, n))
        waves = [np.sin(2.0 * np.pi * f * t + rng.uniform(0, 6.28, n)) for f in turns]
        q = middle + spread * half * 0.4 * (waves[0] + waves[1])
    offset, B = 7e-4 * rng.standard_normal(n), np.eye(4)
    B[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    distance, way = rng.uniform(1.0, 3.5), rng.standard_normal(3)
    B[:3, 3] = distance * (way / np.linalg.norm(way))
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
    names = tuple(joint.get("name", "") for joint in joints)
    return Recorded(robot, names, q, T, stamps, commanded, 21.0 + np.cumsum(0.02 * rng.standard_normal(rows)))


def holding(robot: str, q: Array) -> Array:
    """Torques (N, n) [N m] with which actuators hold the described bodies at joints q, positive along the axes."""
    spec = mujoco.MjSpec()
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
    _bodies(robot, spec, None)
    model = spec.compile()
    data, out = mujoco.MjData(model), np.empty_like(q)
    for i, posture in enumerate(q):
        data.qpos[:], data.qvel[:] = posture, 0.0
        mujoco.mj_forward(model, data)
        out[i] = data.qfrc_bias
    return out
