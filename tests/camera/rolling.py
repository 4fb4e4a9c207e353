"""Views of a moving board by a camera that reads its image line by line: each corner from the pose of its own moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from camera.boards import seen
from camera.scenes import CameraScene

from modcal_core.camera.bundle import BoardView
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

_MOMENTS = 9  # of an image, between which corners are interpolated


def rolling_views(
    s: CameraScene, velocity: Array, delay_s: float, readout_s: float, rng: np.random.Generator, noise: float = 0.1,
    printed: Array | None = None, repeat_rad: float = 5e-5,
) -> CameraScene:  # fmt: skip
    """The same scene seen in motion. delay_s: images are stamped so much later than they were taken."""
    points = s.board.points if printed is None else printed
    share = np.linspace(-0.5, 0.5, _MOMENTS)
    own = repeat_rad * rng.standard_normal(s.q.shape)

    def poses(at: float) -> Array:
        T = s.truth(s.q + (at * readout_s - delay_s) * velocity + own)
        return se3.inverse(T) if s.on_tip else T

    T = np.stack([poses(at) for at in share], axis=1)
    out, keep = [], []
    for i in range(len(s.q)):
        exact = _when_read(np.stack([seen(pose, points, s.lens) for pose in T[i]]), share, s.lens.size[1])
        inside = np.flatnonzero(((exact > 0.0) & (exact < np.array(s.lens.size) - 1.0)).all(axis=1))
        if len(inside) < 8:
            continue
        noisy = exact[inside] + noise * rng.standard_normal((len(inside), 2))
        out.append(BoardView(f"{i}.png", inside, noisy, np.tile(noise**2 * np.eye(2), (len(inside), 1, 1))))
        keep.append(i)
    return replace(s, q=s.q[keep], T=s.T[keep], views=out)


def _when_read(pixels: Array, share: Array, height: int) -> Array:
    """Where corners (K, m, 2), known at K moments, are when the shutter is at their line, (m, 2)."""
    out = np.empty(pixels.shape[1:])
    for c in range(len(out)):
        at = 0.0
        for _ in range(6):
            at = float(np.clip(np.interp(at, share, pixels[:, c, 1]) / height - 0.5, -0.5, 0.5))
        out[c] = [np.interp(at, share, pixels[:, c, k]) for k in (0, 1)]
    return out
