"""The same track otherwise: moved, mirrored, reversed, cut short, thinned, noisier, with gross outliers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.articulation.track import Track

Array = np.ndarray
OUTLIERS = 0.05


def _moved(track: Track, rng: np.random.Generator) -> Track:
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    R = None if track.rotations is None else turn @ track.rotations
    return Track(track.positions @ turn.T + shift, R)


def _mirrored(track: Track, rng: np.random.Generator) -> Track:
    flip = np.diag([-1.0, 1.0, 1.0])
    return Track(track.positions @ flip, None if track.rotations is None else flip @ track.rotations @ flip)


def _first(share: float) -> Callable[[Track, np.random.Generator], Track]:
    return lambda track, rng: track.part(np.arange(min(len(track), max(8, int(share * len(track))))))


def _noisier(track: Track, rng: np.random.Generator) -> Track:
    """White noise of the track's own size √3 times over, so that both together are twice as large."""
    bend = np.diff(track.positions, 2, axis=0)
    sigma = float(np.sqrt(np.median((bend**2).sum(axis=1)) / 2.366 / 6.0))  # χ² with 3; 1 + 4 + 1 of white noise
    p = track.positions + rng.normal(0.0, np.sqrt(3.0) * sigma, track.positions.shape)
    if track.rotations is None:
        return Track(p)
    R = Rotation.from_matrix(track.rotations)
    w = (R[:-1].inv() * R[1:]).as_rotvec()
    sway = float(np.sqrt(np.median((np.diff(w, axis=0) ** 2).sum(axis=1)) / 2.366 / 6.0))
    return Track(p, (R * Rotation.from_rotvec(rng.normal(0.0, np.sqrt(3.0) * sway, p.shape))).as_matrix())


def _outliers(track: Track, rng: np.random.Generator) -> Track:
    far = rng.random(len(track)) < OUTLIERS
    p = track.positions + far[:, None] * rng.normal(0.0, 0.15, track.positions.shape)
    if track.rotations is None:
        return Track(p)
    turn = Rotation.from_rotvec(far[:, None] * rng.normal(0.0, 0.5, p.shape)).as_matrix()
    return Track(p, track.rotations @ turn)


VARIANTS: dict[str, Callable[[Track, np.random.Generator], Track]] = {
    "as recorded": lambda track, rng: track,
    "moved": _moved,
    "mirrored": _mirrored,
    "reversed": lambda track, rng: track.part(np.arange(len(track))[::-1]),
    "first 70 %": _first(0.7),
    "first 50 %": _first(0.5),
    "first 30 %": _first(0.3),
    "every fifth": lambda track, rng: track.part(np.arange(0, len(track), 5)),
    "noise doubled": _noisier,
    "5 % outliers": _outliers,
}
