"""The minimal parameters for a robot and the kinds of reading it is watched by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.calibration.distances import Distance, distance_rows
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import (
    Parameter,
    View,
    drop_fixed,
    independent_columns,
    ordered_candidates,
)
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POSE
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward, spatial_jacobian

_SEED = 20  # postures must be general, not new: the same robot always gets the same parameters


def views_of(samples: Samples) -> tuple[View, ...]:
    """The distinct (kind, frame) pairs of the samples, and which of them only ever show one fixed point."""
    pairs = sorted({(int(f), str(k)) for f, k in zip(samples.frame, samples.kind, strict=True)})
    return tuple(View(kind, frame, samples.is_same_point(frame)) for frame, kind in pairs)


def random_postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform within the limits; a full turn, or ±0.5 m, where there is none."""
    span = np.where(chain.revolute, np.pi, 0.5)
    low = np.where(np.isfinite(chain.lower), chain.lower, -span)
    high = np.where(np.isfinite(chain.upper), chain.upper, span)
    return rng.uniform(low, high, (count, chain.n))


def postures_at_point(chain: Chain, tool: Array, q: Array, iterations: int = 40) -> Array:
    """Postures near q (N, n) that all hold the tool's origin where the first of them does, by damped Newton steps."""
    T = forward(chain, q) @ tool
    target = T[0, :3, 3]
    for _ in range(iterations):
        T = forward(chain, q) @ tool
        J = spatial_jacobian(chain, q)
        p = T[:, :3, 3]
        Jp = J[:, :3] + np.cross(J[:, 3:], p[:, :, None], axis=1)
        gap = target - p
        step = np.swapaxes(Jp, 1, 2) @ np.linalg.solve(Jp @ np.swapaxes(Jp, 1, 2) + 1e-9 * np.eye(3), gap[..., None])
        q = q + step[..., 0] * np.minimum(1.0, 0.5 / np.maximum(np.abs(step[..., 0]).max(axis=1, keepdims=True), 1e-12))
    return q[np.linalg.norm(gap, axis=1) < 1e-9]


def general_samples(model: Model, views: Sequence[View], each: int) -> Samples:
    """Exact readings at random postures, ``each`` per view, as the given model would make them."""
    rng = np.random.default_rng(_SEED)
    q_parts, frame, kind = [], [], []
    for view in views:
        q = random_postures(model.chain, each, rng)
        if view.same_point:
            q = postures_at_point(model.chain, model.T_tip_tool, random_postures(model.chain, 3 * each, rng))[:each]
        q_parts.append(q)
        frame += [view.frame] * len(q)
        kind += [view.kind] * len(q)
    q = np.concatenate(q_parts)
    frames = np.array(frame)
    T = model.predict(q, frames)
    N = len(q)
    return Samples(
        names=model.chain.names,
        frames=model.frames,
        q=q,
        stamps=np.zeros(N),
        station=np.arange(N),
        frame=frames,
        kind=np.array(kind, dtype="U8"),
        position=T[:, :3, 3],
        R=np.where((np.array(kind) == POSE)[:, None, None], T[:, :3, :3], np.eye(3)),
        sigma_position=np.full(N, np.nan),
        sigma_rotation=np.full(N, np.nan),
        moving=np.zeros(N, bool),
    )


def choose_parameters(
    model: Model, views: Sequence[View], fixed: Sequence[str] = (), distances: Sequence[Distance] = ()
) -> list[Parameter]:
    """The minimal, full-rank parameters for this model and these views, in order of place.

    fixed: names, places or patterns that must stay as they are. distances: known distances between frames, which can
    make scale visible. Raises BadTable for a pattern that names nothing.
    """
    candidates = drop_fixed(ordered_candidates(model.chain, model.frames, views), fixed)
    # For a point that stays put, place the frame's origin on it: that is where the rows of a distance start from.
    samples = general_samples(model, views, each=max(12, -(-2 * len(candidates) // max(1, len(views)))))
    model = _move_fixed_frames(model, views, samples)
    samples = _read_again(model, samples)
    J = linearise(model, candidates, np.zeros(len(candidates)), samples).J
    if distances:
        J = np.c_[J, distance_rows(model, candidates, np.zeros(len(candidates)), distances).J]
    kept = [candidates[j] for j in independent_columns(J.T)]
    return sorted(kept, key=lambda p: (p.place, p.frame))


def _move_fixed_frames(model: Model, views: Sequence[View], samples: Samples) -> Model:
    T = np.array(model.T_frame_base)
    for view in views:
        if view.same_point:
            T[view.frame] = se3.transform(p=-se3.apply(T[view.frame], _tool_in_base(model, samples, view.frame)))
    return Model(model.chain, model.frames, T, model.T_tip_tool)


def _tool_in_base(model: Model, samples: Samples, frame: int) -> Array:
    q = samples.q[samples.frame == frame][:1]
    return (forward(model.chain, q) @ model.T_tip_tool)[0, :3, 3]


def _read_again(model: Model, samples: Samples) -> Samples:
    T = model.predict(samples.q, samples.frame)
    R = np.where(samples.is_pose[:, None, None], T[:, :3, :3], np.eye(3))
    return replace(samples, position=T[:, :3, 3], R=R)

