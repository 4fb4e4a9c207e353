"""Readings of every instrument, made from MuJoCo's tool poses by formulas written out here, one posture at a time.

Nothing of the code under test is used but the containers: anchors, stations, planes and rays stand in the world of the
base link, and what an instrument reads there is worked out from school geometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from cells import samples_of as as_samples
from cells import ur10

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_nodes.simulation.mjcf import World

Reading = Callable[[Array], Array]  # pose of the tool in the base (4, 4) -> what is read
TOOL = se3.exp([0.05, 0.03, 0.12, 0.2, -0.1, 0.3])


def world(seed: int, chain: Chain | None = None, length_std: float = 5e-4, angle_std: float = 1e-3) -> World:
    """A displaced UR10 with a tool."""
    return World(chain or ur10(), np.random.default_rng(seed), length_std, angle_std, T_tip_tool=TOOL)


def wire(anchor: Array, zero: float = 0.0, hook: Array | None = None) -> Reading:
    """A draw wire from an anchor in the base to a hook in the tool's frame [m]."""

    def read(T: Array) -> Array:
        p = T[:3, 3] if hook is None else T[:3, :3] @ hook + T[:3, 3]
        return np.array([np.sqrt(np.sum((p - anchor) ** 2)) + zero])

    return read


def theodolite(T_base_station: Array) -> Reading:
    """Horizontal and vertical angle of the tool's origin, as a direction in the station's frame."""

    def read(T: Array) -> Array:
        x, y, z = T_base_station[:3, :3].T @ (T[:3, 3] - T_base_station[:3, 3])
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
        return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])

    return read


def gauge(normal: Array, offset: float) -> Reading:
    """Height of the tool's origin above the plane normal · p = offset."""
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    return lambda T: np.array([n @ T[:3, 3] - offset])


def laser(origin: Array, direction: Array, normal: Array, offset: float) -> Reading:
    """Distance along a ray, given in the tool's frame, to the plane normal · p = offset of the base."""
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    d = np.asarray(direction, dtype=float) / np.linalg.norm(direction)

    def read(T: Array) -> Array:
        start, along = T[:3, :3] @ origin + T[:3, 3], T[:3, :3] @ d
        return np.array([(offset - n @ start) / (n @ along)])

    return read


def tracker(T_tracker_base: Array) -> Reading:
    """Position of the tool's origin."""
    return lambda T: T_tracker_base[:3, :3] @ T[:3, 3] + T_tracker_base[:3, 3]


def samples_of(
    chain: Chain, q: Array, poses: Array, frame: str, kind: str, read: Reading, noise: float, rng: np.random.Generator
) -> Samples:
    """Samples of one instrument with noise in its own unit, for postures q (N, n) and tool poses (N, 4, 4)."""
    values = np.array([read(T) for T in poses])
    values = values + noise * rng.standard_normal(values.shape)
    if kind == "bearing":
        values /= np.linalg.norm(values, axis=1, keepdims=True)
    values = np.pad(values, ((0, 0), (0, 3 - values.shape[1])))
    return as_samples(chain, q, se3.transform(p=values), kind, frame)


def together(parts: list[Samples]) -> Samples:
    """Samples of several instruments that read at the same stations."""
    out = parts[0]
    for part in parts[1:]:
        joined = out.followed_by(part)
        station = np.round((joined.stamps - joined.stamps.min()) / 2.0).astype(int)
        out = replace(joined, station=station)
    return out


def postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    """Random joint positions (count, n)."""
    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (count, chain.n))


def facing(
    w: World, origin: Array, direction: Array, normal: Array, offset: float, count: int, rng: np.random.Generator
) -> Array:
    """Postures (count, n) in which a ray of the tool meets a plane in front of it, within 60 degrees and 1.5 m."""
    read = laser(origin, direction, normal, offset)
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    out: list[Array] = []
    while len(out) < count:
        q = postures(w.nominal, 1, rng)[0]
        T = w.tool_in_base(q)
        slope = abs(n @ T[:3, :3] @ direction) / np.linalg.norm(direction)
        if slope > 0.5 and 0.05 < read(T)[0] < 1.5:
            out.append(q)
    return np.array(out)
