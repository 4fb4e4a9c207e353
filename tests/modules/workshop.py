"""A workshop with modules that are not what their drawing says, and a laser tracker.

The truth of these tests shares nothing with modcal's error model: frames are moved directly, with plain matrices and
SciPy's rotations. A link's output flange is shifted and turned as seen from its input flange; a joint's axis leans and
stands off the middle, its encoder has its zero elsewhere, and its output flange sits askew on the shaft; flanges are
bolted with a shift, a lean and a turn that are drawn anew each time. Everything is uniform, not Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.geometry.so3 import Array
from modcal_core.modules.library import Assembly, Module

TRACKER_M = 2e-5  # standard deviation of a reading, per axis
_UP = {"JR": 0.110, "JP": 0.180, "G": 0.120}


def place(xyz: Sequence[float] | Array, angles: Sequence[float] | Array = (0.0, 0.0, 0.0)) -> Array:
    """A transform of a position and Euler angles about x, y, z."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    T[:3, 3] = xyz
    return T


def drawn(kind: str, size: int) -> Array:
    """Output flange in the input flange, as the drawings say."""
    step = 0.005 * size
    if kind in _UP:
        return place([0, 0, _UP[kind]])
    if kind == "B":
        return place([0, 0, step])
    if kind == "LC":
        return place([0, 0, 0.040 + step])
    if kind == "LP":
        return place([0.180 + step, 0, 0.080])
    corner = [0.0715, 0, 0.0715 + step] if kind == "LR-I" else [0.0715 + step, 0, 0.0715]
    return place(corner, [0, np.pi / 2, 0])


@dataclass(frozen=True)
class Physical:
    """One module as it was made."""

    kind: str
    size: int
    flange: Array  # shift (3,) and angles (3,) of the output flange
    axis: Array  # shift x y and lean x y of a joint's axis
    zero: float

    def parts(self) -> tuple[Array, Array]:
        """From the input flange to where the motion is, along or about z, and from there to the output flange."""
        T = drawn(self.kind, self.size)
        T[:3, 3] += self.flange[:3]
        T[:3, :3] = Rotation.from_euler("xyz", self.flange[3:]).as_matrix() @ T[:3, :3]
        shaft = place([*self.axis[:2], 0.0], [*self.axis[2:], 0.0])
        return shaft, np.linalg.inv(shaft) @ T


@dataclass(frozen=True)
class Made:
    """How well modules are made and flanges bolted: largest errors [m, rad]."""

    length: float = 5e-4
    angle: float = 1.7e-3
    zero: float = 5e-3
    bolt_length: float = 5e-5
    bolt_angle: float = 3.5e-4

    def module(self, kind: str, size: int, rng: np.random.Generator) -> Physical:
        scale = np.array([self.length] * 3 + [self.angle] * 3)
        axis = rng.uniform(-1, 1, 4) * [self.length, self.length, self.angle, self.angle]
        zero = rng.uniform(-1, 1) * (self.zero if kind == "JR" else self.length)
        return Physical(kind, size, rng.uniform(-1, 1, 6) * scale, axis, float(zero))

    def bolt(self, turn: int, rng: np.random.Generator) -> Array:
        shift = rng.uniform(-1, 1, 3) * self.bolt_length
        lean = rng.uniform(-1, 1, 3) * self.bolt_angle
        return place(shift, lean) @ place([0, 0, 0], [0, 0, turn * np.pi / 2])


class Arm:
    """Physical modules bolted together, seen from a tracker that looks at a ball on the gripper."""

    def __init__(self, assembly: Assembly, shelf: dict[str, Physical], made: Made, rng: np.random.Generator) -> None:
        self.modules = [shelf[m.serial] for m in assembly.modules]
        self.bolts = [made.bolt(m.turn, rng) for m in assembly.modules[1:]]
        self.T_tracker_base = place(rng.uniform(-2, 2, 3), rng.uniform(-3, 3, 3))
        self.ball = np.array([0.03, 0.02, 0.05]) + rng.uniform(-0.002, 0.002, 3)

    def poses(self, q: Array) -> Array:
        """Gripper's output frame in the tracker at postures (N, n), (N, 4, 4)."""
        T, joint = np.tile(self.T_tracker_base, (len(q), 1, 1)), 0
        for bolt, module in zip((np.eye(4), *self.bolts), self.modules, strict=True):
            before, behind = module.parts()
            motion = np.tile(np.eye(4), (len(q), 1, 1))
            if module.kind[0] == "J":
                x = q[:, joint] + module.zero
                joint += 1
                if module.kind == "JR":
                    motion[:, 0, 0], motion[:, 0, 1], motion[:, 1, 0], motion[:, 1, 1] = (
                        np.cos(x),
                        -np.sin(x),
                        np.sin(x),
                        np.cos(x),
                    )
                else:
                    motion[:, 2, 3] = x
            T = T @ bolt @ before @ motion @ behind
        return T

    def readings(self, q: Array, rng: np.random.Generator, noise: float = TRACKER_M) -> Array:
        """The ball in the tracker at postures (N, n), (N, 3) [m]."""
        exact = (self.poses(q) @ np.r_[self.ball, 1.0])[:, :3]
        return exact + noise * rng.standard_normal(exact.shape)


def shelf_of(modules: Sequence[Module], made: Made, rng: np.random.Generator) -> dict[str, Physical]:
    """The physical modules by serial number."""
    return {m.serial: made.module(m.kind, m.size, rng) for m in modules}
