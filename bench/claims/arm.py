"""The arms of this bench and what is wrong with them, from numbers alone: nothing of modcal is imported.

A serial arm is a product ``origin · error · turn`` a joint, read from a URDF by the few lines below. A Delta is three
spheres. What moves the tool besides is put in as a turn of the joints or of the base, at every posture.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray
LINKS = ("even", "one far", "bent", "one direction")
EFFECTS = ("none", "compliance", "gear", "backlash", "base bends", "joint follows others", "kink")
OUTSIDE = EFFECTS[4:]  # of modcal's vocabulary
LENGTH, ANGLE = 5e-4, 1e-3  # m, rad: how far an even arm is off
GRAVITY = 9.81


def turn(v: Array) -> Array:
    """Rotation matrices (…, 3, 3) of rotation vectors (…, 3) [rad]."""
    v = np.asarray(v, float)
    return np.asarray(Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix().reshape(*v.shape, 3))


def pose(p: Array, v: Array) -> Array:
    """Homogeneous matrices (…, 4, 4) of places (…, 3) and rotation vectors (…, 3)."""
    out = np.zeros((*np.shape(p)[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = turn(v), p, 1.0
    return out


@dataclass(frozen=True)
class Serial:
    """origins (n + 1, 4, 4): of each joint in the one before, then of the tip. axes (n, 3). low, high (n,): of joints.
    weights: (mass [kg], centre (3,) [m]) behind each joint.
    """

    names: tuple[str, ...]
    origins: Array
    axes: Array
    low: Array
    high: Array
    weights: tuple[tuple[float, Array], ...]

    def frames(self, q: Array) -> Array:
        """Poses of every link and of the tip in the base, (n + 1, N, 4, 4), for joints q (N, n)."""
        T, out = np.broadcast_to(np.eye(4), (len(q), 4, 4)), []
        for k in range(len(self.names)):
            T = T @ self.origins[k] @ pose(np.zeros((len(q), 3)), q[:, k, None] * self.axes[k])
            out.append(T)
        return np.stack([*out, T @ self.origins[-1]])

    def tips(self, q: Array) -> Array:
        """Poses of the tip (N, 4, 4)."""
        return np.asarray(self.frames(q)[-1])

    def torques(self, q: Array) -> Array:
        """Torque of weight about each joint's axis, (N, n) [N m]."""
        T = self.frames(q)
        centre = [T[k, :, :3, :3] @ c + T[k, :, :3, 3] for k, (_, c) in enumerate(self.weights)]
        out = np.zeros(q.shape)
        for k in range(q.shape[1]):
            axis = T[k, :, :3, :3] @ self.axes[k]
            for m in range(k, q.shape[1]):
                arm = np.cross(axis, centre[m] - T[k, :, :3, 3])
                out[:, k] -= self.weights[m][0] * GRAVITY * arm[:, 2]
        return out

    def wrong(self, how: str, rng: np.random.Generator) -> Serial:
        """The arm as it was built: off from its drawing in one of the ways of LINKS."""
        n = len(self.origins)
        length, angle = np.array([LENGTH, ANGLE]) * np.exp(rng.normal(0.0, 0.4, 2))
        size = 0.5 if how in ("one far", "one direction") else 1.0
        off = size * rng.normal(0.0, [length] * 3 + [angle] * 3, (n, 6))
        origins = self.origins
        if how == "one far":
            off[rng.integers(1, n - 1)] += rng.normal(0.0, [8.0 * length] * 3 + [8.0 * angle] * 3)
        if how == "one direction":
            off[:, :3] += rng.normal(0.0, 2.0 * length) * np.sign(self.origins[:, :3, 3])
            off[:, 3:] += rng.normal(0.0, 2.0 * angle, 3)
        if how == "bent":
            half = self.origins.copy()
            half[:, :3, 3] *= 0.5
            half[:, :3, :3] = np.eye(3)
            bend = rng.normal(0.0, 4.0 * angle, (n, 3)) * (rng.random(n) < 0.5)[:, None]
            origins = half @ pose(np.zeros((n, 3)), bend) @ np.linalg.inv(half) @ self.origins
        return replace(self, origins=origins @ pose(off[:, :3], off[:, 3:]))


def serial(path: Path, tip: str) -> Serial:
    """The arm of a URDF from its root to a tip; joints turn, at most 2 rad either side of the middle of their range."""
    root = ET.parse(path).getroot()
    by_child = {j.find("child").get("link"): j for j in root.iter("joint")}  # type: ignore[union-attr]
    mass = {}
    for link in root.iter("link"):
        if (body := link.find("inertial")) is not None:
            centre = body.find("origin")
            place = "0 0 0" if centre is None else centre.get("xyz", "0 0 0")
            mass[link.get("name")] = (float(body.find("mass").get("value")), _three(place))  # type: ignore[union-attr]
    way = []
    while tip in by_child:
        way.append((by_child[tip], tip))
        tip = by_child[tip].find("parent").get("link")  # type: ignore[union-attr,assignment]
    T, names, origins, axes, ranges, weights = np.eye(4), [], [], [], [], []
    for joint, link in way[::-1]:
        at = joint.find("origin")
        xyz, rpy = ("0 0 0", "0 0 0") if at is None else (at.get("xyz", "0 0 0"), at.get("rpy", "0 0 0"))
        r, p, y = _three(rpy) * np.eye(3)
        for motion in (pose(_three(xyz), np.zeros(3)), *(pose(np.zeros(3), v) for v in (y, p, r))):
            T = T @ motion
        if joint.get("type") == "fixed":
            continue
        limit, axis = joint.find("limit"), joint.find("axis")
        low, high = float(limit.get("lower")), float(limit.get("upper"))  # type: ignore[union-attr,arg-type]
        middle, half = 0.5 * (low + high), min(0.4 * (high - low), 2.0)
        names.append(str(joint.get("name")))
        origins.append(T)
        axes.append(_three(axis.get("xyz", "0 0 1")))  # type: ignore[union-attr]
        ranges.append((middle - half, middle + half))
        weights.append(mass.get(link, (0.0, np.zeros(3))))
        T = np.eye(4)
    low_high = np.array(ranges)
    every = np.stack([*origins, T])
    return Serial(tuple(names), every, np.array(axes), low_high[:, 0], low_high[:, 1], tuple(weights))


def _three(text: str) -> Array:
    return np.array([float(x) for x in text.split()])


@dataclass(frozen=True)
class Delta:
    """Three arms by their zeros, azimuths, radii, and lengths [rad, m], (3,) each; a shaft turns the tool."""

    zero: Array
    azimuth: Array
    radius: Array
    upper: Array
    lower: Array
    names: tuple[str, ...] = ("arm_1", "arm_2", "arm_3", "shaft")
    low: Array = field(default_factory=lambda: np.array([-0.5, -0.5, -0.5, -2.0]))
    high: Array = field(default_factory=lambda: np.array([1.0, 1.0, 1.0, 2.0]))

    def tips(self, q: Array) -> Array:
        """Poses of the platform, turned by the shaft, (N, 4, 4); NaN where the rods do not meet."""
        angle = q[:, :3] + self.zero
        out = self.radius + self.upper * np.cos(angle)
        C = np.stack([out * np.cos(self.azimuth), out * np.sin(self.azimuth), -self.upper * np.sin(angle)], axis=-1)
        # differences of the three spheres are planes: p = a + z b, and one sphere gives z
        M = 2.0 * (C[:, 1:] - C[:, :1])
        right = (C[:, 1:] ** 2).sum(2) - (C[:, :1] ** 2).sum(2) - self.lower[1:] ** 2 + self.lower[0] ** 2
        xy = np.linalg.inv(M[:, :, :2])
        a = np.concatenate([(xy @ right[..., None])[..., 0], np.zeros((len(q), 1))], axis=1)
        b = np.concatenate([-(xy @ M[:, :, 2:])[..., 0], np.ones((len(q), 1))], axis=1)
        gap = a - C[:, 0]
        A, B, D = (b * b).sum(1), (b * gap).sum(1), (gap * gap).sum(1) - self.lower[0] ** 2
        with np.errstate(invalid="ignore"):
            z = (-B - np.sqrt(B * B - A * D)) / A
        return pose(a + z[:, None] * b, q[:, 3, None] * np.array([0.0, 0.0, 1.0]))

    def wrong(self, how: str, rng: np.random.Generator) -> Delta:
        """The robot as it was built; the ways of LINKS that it knows are sizes of the same errors."""
        size = np.full(3, 0.5 if how in ("one far", "one direction") else 1.0)
        if how == "one far":
            size[rng.integers(3)] = 5.0
        even = rng.normal(0.0, 2.0, 3) if how == "one direction" else np.zeros(3)
        off = size * rng.normal(size=(5, 3))
        return replace(
            self,
            zero=self.zero + ANGLE * (off[0] + even[0]),
            azimuth=self.azimuth + ANGLE * off[1],
            radius=self.radius + LENGTH * off[2],
            upper=self.upper + LENGTH * (off[3] + even[1]),
            lower=self.lower + LENGTH * (off[4] + even[2]),
        )


def delta() -> Delta:
    """The numbers of examples/robots/delta.yaml."""
    ones = np.ones(3)
    return Delta(0.0 * ones, np.array([0.0, 2.0, -2.0]) * np.pi / 3.0, 0.15 * ones, 0.3 * ones, 0.8 * ones)


@dataclass(frozen=True)
class World:
    """What stands there: the arm as built, the tool, one effect of a size. joint_noise: of where joints stop [rad]."""

    drawn: Serial | Delta
    built: Serial | Delta
    tool: Array
    effect: str
    sizes: Array
    joint_noise: float

    @cached_property
    def most_torque(self) -> float:
        """The largest torque in the joints' ranges [N m], the same for all that one arm does."""
        assert isinstance(self.drawn, Serial)
        q = np.random.default_rng(0).uniform(self.drawn.low, self.drawn.high, (500, len(self.drawn.low)))
        return max(float(np.abs(self.drawn.torques(q)).max()), 1.0)

    def poses(self, q: Array, approach: Array, noise: Array | float = 0.0) -> Array:
        """Poses of the tool in the base, (N, 4, 4), where joints report q (N, n) and last moved so (−1, 1)."""
        real, s, tilt = q + noise, self.sizes, np.zeros((len(q), 3))
        if self.effect == "compliance" and isinstance(self.drawn, Serial):
            real = real + 1e-3 * s[2] * self.drawn.torques(q) / self.most_torque
        elif self.effect == "gear":
            k = int(s[0]) % q.shape[1]
            real[:, k] += 2e-4 * s[2] * np.sin((1 + int(20 * s[1])) * q[:, k] + s[1])
        elif self.effect == "backlash":
            k = int(s[0]) % q.shape[1]
            real[:, k] += 2e-4 * s[2] * approach[:, k]
        elif self.effect == "joint follows others":
            a, b, c = (int(s[0]) + np.arange(3)) % q.shape[1]
            real[:, a] += 4e-4 * s[2] * np.sin(q[:, b]) * np.cos(q[:, c] + s[1])
        elif self.effect == "kink":
            k = int(s[0]) % q.shape[1]
            real[:, k] += 3e-4 * s[2] * np.abs(q[:, k] - 0.3 * s[1])
        elif self.effect == "base bends":
            p = self.built.tips(q)[:, :3, 3]
            tilt[:, 0], tilt[:, 1] = -3e-4 * s[2] * p[:, 1], 3e-4 * s[2] * p[:, 0]
        return np.asarray(pose(np.zeros((len(q), 3)), tilt) @ self.built.tips(real) @ self.tool)


def approaches(q: Array) -> Array:
    """How joints last moved when q (N, n) are gone through in their order; the first as the second."""
    moved = np.sign(np.diff(q, axis=0))
    return np.concatenate([moved[:1], moved])
