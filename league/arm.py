"""Serial arms as every method here gets them: a chain of fixed steps about joints that turn around z, from a URDF.

Shares no code with modcal. Metres, radians; poses are (…, 4, 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray
_SMALL = 1e-12  # rad, below which a turn is none


def rotation(v: Array) -> Array:
    """Rotation matrices (…, 3, 3) of rotation vectors (…, 3) [rad]."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    K = cross(v / np.maximum(angle[..., 0], _SMALL))
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)


def rotation_vector(R: Array) -> Array:
    """Rotation vectors (N, 3) [rad] of rotations (N, 3, 3)."""
    return Rotation.from_matrix(R).as_rotvec()


def cross(v: Array) -> Array:
    """Matrices (…, 3, 3) whose product with u is v × u."""
    x, y, z = np.moveaxis(np.asarray(v, dtype=float), -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape((*o.shape, 3, 3))


def pose(R: Array, p: Array) -> Array:
    """Poses (…, 4, 4) of rotations (…, 3, 3) and positions (…, 3)."""
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def quaternion_rotation(x: Array) -> Array:
    """Rotations (…, 3, 3) of quaternions x y z w (…, 4)."""
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    K = cross(x[..., :3])
    return np.eye(3) + 2.0 * x[..., 3, None, None] * K + 2.0 * K @ K


def quaternion(R: Array) -> Array:
    """Quaternions x y z w (N, 4), by the largest of four forms."""
    d = np.stack([R[:, 0, 0], R[:, 1, 1], R[:, 2, 2], np.trace(R, axis1=1, axis2=2)], axis=1)
    out = np.empty((len(R), 4))
    for n, best in enumerate(np.argmax(d, axis=1)):
        M = R[n]
        if best == 3:
            x = np.r_[M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1], 1.0 + d[n, 3]]
        else:
            i, j, k = best, (best + 1) % 3, (best + 2) % 3
            x = np.empty(4)
            x[[i, j, k, 3]] = 1.0 + 2.0 * M[i, i] - d[n, 3], M[j, i] + M[i, j], M[k, i] + M[i, k], M[k, j] - M[j, k]
        out[n] = x / np.linalg.norm(x)
    return out


def rpy(text: str) -> Array:
    """The rotation (3, 3) of a URDF's roll, pitch, yaw."""
    r, p, y = (rotation(a * e) for a, e in zip(numbers(text), np.eye(3), strict=True))
    return y @ p @ r


def numbers(text: str) -> Array:
    """The numbers of an attribute."""
    return np.array([float(x) for x in text.split()])


@dataclass(frozen=True)
class Arm:
    """names: of the n joints. steps: poses (n + 1, 4, 4), each before the joint of its number, the last one the tip.

    low, high: ranges (n,) [rad]. masses: of the link behind each joint (n, 1) [kg], zero where nothing is said.
    """

    names: tuple[str, ...]
    steps: Array
    low: Array
    high: Array
    masses: Array

    @classmethod
    def from_urdf(cls, text: str, tip: str) -> Arm:
        """The arm from the root of a URDF to a link. Raises ValueError for joints that neither turn nor are fixed."""
        root = ElementTree.fromstring(text)
        by_child = {j.find("child").get("link"): j for j in root.iter("joint") if j.find("child") is not None}
        bodies = {link.get("name"): link.find("inertial") for link in root.iter("link")}
        way, link = [], tip
        while link in by_child:
            way.append((by_child[link], link))
            link = by_child[link].find("parent").get("link")
        names, steps, low, high, masses, T = [], [], [], [], [], np.eye(4)
        for joint, link in way[::-1]:
            at = joint.find("origin")
            where = {} if at is None else at.attrib
            T = T @ pose(rpy(where.get("rpy", "0 0 0")), numbers(where.get("xyz", "0 0 0")))
            if joint.get("type") == "fixed":
                continue
            if joint.get("type") not in ("revolute", "continuous"):
                raise ValueError(f"joint {joint.get('name')} neither turns nor is fixed")
            axis, limit = joint.find("axis"), joint.find("limit")
            z = numbers("1 0 0" if axis is None else axis.get("xyz"))
            A = pose(_from_z(z / np.linalg.norm(z)), np.zeros(3))
            steps.append(T @ A)
            names.append(joint.get("name"))
            ends = (-np.pi, np.pi) if limit is None else (float(limit.get("lower")), float(limit.get("upper")))
            low.append(ends[0])
            high.append(ends[1])
            T, body = A.T.copy(), bodies.get(link)
            masses.append([0.0 if body is None else float(body.find("mass").get("value"))])
        return cls(tuple(names), np.stack([*steps, T]), np.array(low), np.array(high), np.array(masses))

    def frames(self, q: Array, steps: Array | None = None) -> Array:
        """Poses (N, n + 1, 4, 4) behind each step, the last one the tip, at joints q (N, n)."""
        steps = self.steps if steps is None else steps
        out = np.empty((len(q), len(steps), 4, 4))
        T = out[:, 0] = steps[0]
        for k, step in enumerate(steps[1:]):
            turn = rotation(q[:, k, None] * np.array([0.0, 0.0, 1.0]))
            T = out[:, k + 1] = T @ pose(turn, np.zeros(3)) @ step
        return out

    def urdf(self) -> str:
        """A URDF of these steps, with links ``base`` and ``tip``."""
        links = ["base", *(f"link_{k + 1}" for k in range(len(self.names))), "tip"]
        lines = ["<robot name='arm'>", *(f"  <link name='{link}'/>" for link in links)]
        for k, (step, name) in enumerate(zip(self.steps, (*self.names, "tip_joint"), strict=True)):
            xyz, turn = step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_euler("xyz")
            origin = " ".join(f"{a}='{' '.join(f'{x:.17g}' for x in v)}'" for a, v in (("xyz", xyz), ("rpy", turn)))
            kind, more = "fixed", ""
            if k < len(self.names):
                kind, ends = "revolute", f"lower='{self.low[k]:.17g}' upper='{self.high[k]:.17g}'"
                more = f"<axis xyz='0 0 1'/><limit {ends} effort='100' velocity='1'/>"
            between = f"<parent link='{links[k]}'/><child link='{links[k + 1]}'/>"
            lines.append(f"  <joint name='{name}' type='{kind}'>{between}<origin {origin}/>{more}</joint>")
        return "\n".join([*lines, "</robot>", ""])


def _from_z(axis: Array) -> Array:
    """A rotation (3, 3) that takes z to an axis."""
    v = np.cross([0.0, 0.0, 1.0], axis)
    sine = np.linalg.norm(v)
    return rotation(np.arctan2(sine, axis[2]) * (v / sine if sine > _SMALL else np.array([1.0, 0.0, 0.0])))


def align(T: Array, y: Array) -> tuple[Array, Array]:
    """Base (4, 4) and tool point (3,) [m] that take poses T (N, 4, 4) closest to points y (N, 3): y ≈ base (T tool).

    A linear fit without a guess, then Gauss and Newton's steps with a slight hold on the tool.
    """
    R, p = T[:, :3, :3], T[:, :3, 3]
    # p = Bᵀ y − R t − b: linear in the nine of B, in t and in b
    rows = np.concatenate([np.kron(np.eye(3), y[:, None]), -R, -np.broadcast_to(np.eye(3), R.shape)], axis=2).reshape(
        -1, 15
    )
    x = np.linalg.lstsq(rows, p.ravel(), rcond=1e-10)[0]
    t, B = x[9:12], np.eye(4)
    for _ in range(30):
        at = p + R @ t
        B = kabsch(at, y)
        turned = B[:3, :3] @ R
        left = y - at @ B[:3, :3].T - B[:3, 3]
        arms = at @ B[:3, :3].T
        J = np.concatenate([np.broadcast_to(np.eye(3), R.shape), -cross(arms), turned], axis=2).reshape(-1, 9)
        hold = np.concatenate([J, 1e-3 * np.eye(9)])
        step = np.linalg.lstsq(hold, np.r_[left.ravel(), np.zeros(9)], rcond=None)[0]
        t = t + step[6:]
        if np.linalg.norm(step[6:]) < 1e-10:
            break
    return kabsch(p + R @ t, y), t


def kabsch(a: Array, b: Array) -> Array:
    """The rigid motion (4, 4) that takes points a (N, 3) closest to b."""
    U, _, V = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = V.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(V.T @ U.T))]) @ U.T
    return pose(R, b.mean(0) - R @ a.mean(0))
