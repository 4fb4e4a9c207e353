"""A gripper with range sensors in MuJoCo: rays by its own ray casting on a floor and on boxes, noise, bias, mounting.

Sensors are mounted askew and off, and read too much by a bias of their own, which a calibration has to find. Truth is
where MuJoCo has the box in the tracked target.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from cells import joint_track, ur10
from cli.recordings import URDF
from instruments import worlds

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_msgs_py.recording_write import write_recording

NOISE = 5e-5  # m, of a reading
BEGUN = 1.7e9
T_TRACKER_BASE = se3.exp([0.5, 1.0, 0.2, 0.3, 0.4, 0.5])
# Where sensors sit in the tip [m], and which way they look
_MOUNTS = [
    (o, d)
    for d, places in {
        (0, 0, 1): [(-0.05, -0.03, 0.0), (0.05, -0.03, 0.0), (0.0, 0.04, 0.0)],
        (0, 0, -1): [(-0.03, 0.02, 0.42), (0.03, -0.02, 0.42)],
        (1, 0, 0): [(-0.25, -0.03, 0.13), (-0.25, 0.03, 0.17), (-0.25, 0.0, 0.12)],
        (-1, 0, 0): [(0.25, -0.03, 0.14), (0.25, 0.03, 0.17)],
        (0, 1, 0): [(-0.05, -0.25, 0.14), (0.05, -0.25, 0.15), (0.0, -0.25, 0.17)],
        (0, -1, 0): [(-0.04, 0.25, 0.14), (0.04, 0.25, 0.17)],
    }.items()
    for o in places
]
NAMES = tuple(f"laser_{i + 1}" for i in range(len(_MOUNTS)))


def cast(geom: str, T: Array, rays: Array) -> Array:
    """Lengths (N,) [m] of rays (N, 6) up to one geom at a pose, NaN where they meet nothing."""
    position, turn = (
        " ".join(map(repr, map(float, part))) for part in np.split(se3.to_pose(T)[[0, 1, 2, 6, 3, 4, 5]], [3])
    )
    world = f'<mujoco><worldbody><geom {geom} pos="{position}" quat="{turn}"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(world)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    far = [mujoco.mj_ray(model, data, ray[:3], ray[3:], None, 1, -1, hit, None) for ray in rays]
    return np.where(np.array(far) < 0.0, np.nan, far)


@dataclass(frozen=True)
class Held:
    """A box in the gripper. T_target_box: of its centre in the tracked target. size [m]. lengths: what sensors read."""

    T_target_box: Array
    size: Array
    lengths: Array


class Gripper:
    """A displaced UR10 with a tracked target, and fifteen sensors around what it holds."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.world = worlds.world(seed)
        mounts = np.array([[*o, *d] for o, d in _MOUNTS], dtype=float)
        mounts[:, :3] += self.rng.uniform(-3e-3, 3e-3, (len(mounts), 3))
        mounts[:, 3:] = np.einsum(
            "nij,nj->ni", so3.exp(0.03 * self.rng.standard_normal((len(mounts), 3))), mounts[:, 3:]
        )
        self.rays = self.seen_from(se3.inverse(worlds.TOOL), mounts)  # in the tracked target
        self.bias = self.rng.uniform(-3e-3, 3e-3, len(mounts))

    @staticmethod
    def seen_from(T: Array, rays: Array) -> Array:
        return np.concatenate([se3.apply(T, rays[:, :3]), rays[:, 3:] @ T[:3, :3].T], axis=1)

    def read(self, geom: str, T: Array, rays: Array) -> Array:
        return cast(geom, T, rays) + self.bias + NOISE * self.rng.standard_normal(len(rays))

    def calibrating(self, path: Path, each: int = 40) -> None:
        """A bag of stations: the tracker's poses, and distances to the floor, so many at least of every sensor."""
        floor = se3.transform(so3.exp([0.05, -0.03, 0.0]), [0.0, 0.0, -0.5])
        q, lengths = np.empty((0, 6)), np.empty((0, len(NAMES)))
        while (few := np.isfinite(lengths).sum(axis=0) < each).any():
            new = worlds.postures(ur10(), 1, self.rng)
            rays = self.seen_from(self.world.tool_in_base(new[0]), self.rays)
            far = self.read('type="plane" size="9 9 1"', floor, rays)
            seen = np.where((np.abs(rays[:, 3:] @ floor[:3, 2]) > 0.4) & (far < 2.0), far, np.nan)
            if np.isfinite(seen[few]).any():
                q, lengths = np.r_[q, new], np.r_[lengths, seen[None]]
        poses, count = self.world.tool_in_base(q), len(q)
        t = BEGUN + 2.0 * np.arange(count)
        noise = se3.exp(5e-5 * self.rng.standard_normal((count, 6)))
        tracks = [ReadingTrack("pose", "tracker", t, se3.to_pose(T_TRACKER_BASE @ poses @ noise), t)]
        tracks += [_track(n, t[k], d[k]) for n, d in zip(NAMES, lengths.T, strict=True) for k in [np.isfinite(d)]]
        joints = joint_track(ur10().names, t, q)
        write_recording(Recording((joints,), tuple(tracks), robot_description=URDF.read_text(), source="made"), path)

    def hold(self, lean: float = 0.15) -> Held:
        """A random box, turned by up to ``lean`` rad about each axis of the tip."""
        size = self.rng.uniform([0.18, 0.14, 0.16], [0.3, 0.26, 0.22])
        T_tip_box = se3.transform(
            so3.exp(self.rng.uniform(-lean, lean, 3)),
            [*self.rng.uniform(-0.01, 0.01, 2), 0.15 + self.rng.uniform(0, 0.02)],
        )
        T = se3.inverse(worlds.TOOL) @ T_tip_box
        geom = f'type="box" size="{" ".join(map(repr, map(float, size / 2.0)))}"'
        return Held(T, size, self.read(geom, T, self.rays))


def holding(path: Path, boxes: list[Held]) -> None:
    """A bag in which each box rests for a second at 20 Hz, one after another; sensors that meet nothing say nothing."""
    rng = np.random.default_rng(0)
    t = BEGUN + np.concatenate([3.0 * k + 0.05 * np.arange(20) for k in range(len(boxes))])
    lengths = np.repeat([b.lengths for b in boxes], 20, axis=0)
    lengths = lengths + 1e-5 * rng.standard_normal(lengths.shape)
    late = 1e-3 * np.arange(len(NAMES))  # each at its own time
    tracks = [
        _track(n, t[k] + s, d[k]) for n, d, s in zip(NAMES, lengths.T, late, strict=True) for k in [np.isfinite(d)]
    ]
    write_recording(Recording(readings=tuple(tracks), source="made"), path)


def _track(name: str, stamps: Array, lengths: Array) -> ReadingTrack:
    return ReadingTrack("ray", name, stamps, lengths[:, None], stamps, "/gripper/range")
