"""An arm of which one link is far off, with its ball in sockets: no socket's readings are wrong for that."""

from __future__ import annotations

from dataclasses import replace

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from modcal_core.calibration.cell import Cell
from modcal_core.geometry import Array, se3
from modcal_core.loop import calibrate
from modcal_core.measurements import TOUCH, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import Chain, forward, read_chain

CHAIN = read_chain((Path(__file__).resolve().parents[2] / "examples" / "robots" / "iiwa14.urdf").read_text(encoding="utf-8"))


def in_sockets(seed: int, each: int = 20) -> tuple[Chain, Samples]:
    """The arm as it was built, and stations at which its ball lies in one of four sockets."""
    rng, drawn = np.random.default_rng(seed), CHAIN
    off = rng.normal(0.0, [2.5e-4] * 3 + [5e-4] * 3, (len(drawn.origins), 6))
    off[5] += rng.normal(0.0, [6e-3] * 3 + [1.2e-2] * 3)
    built = replace(drawn, origins=drawn.origins @ se3.exp(off))
    ball = np.array([0.03, -0.02, 0.12, 1.0])
    middle = np.array([0.4, 0.7, 0.3, -1.2, 0.6, 0.9, 0.2])

    def followed(q: Array) -> Array:
        """A joint that follows two others, which no parameter stands for."""
        return np.asarray(q + np.eye(7)[1] * 6e-4 * np.sin(q[2]) * np.cos(q[3]))

    def at(q: Array) -> Array:
        return np.asarray((forward(built, followed(q)[None])[0] @ ball)[:3])

    sockets = at(middle) + np.array([[0.0, 0.0, 0.0], [0.12, 0.0, 0.0], [0.0, 0.12, 0.03], [-0.06, -0.08, 0.05]])
    q, frame = [], []
    for k, socket in enumerate(sockets):
        while frame.count(k) < each:
            found = least_squares(lambda x, p=socket: at(x) - p, middle + rng.uniform(-0.7, 0.7, 7), xtol=1e-14)
            if np.abs(found.fun).max() < 1e-7:
                q.append(found.x)
                frame.append(k)
    N = len(q)
    order = rng.permutation(N)
    return drawn, Samples(
        names=drawn.names,
        frames=tuple(f"socket_{k}" for k in range(4)),
        q=(np.array(q) + 1e-5 * rng.standard_normal((N, 7)))[order],
        stamps=1.7e9 + 10.0 * np.arange(N),
        station=np.arange(N),
        frame=np.array(frame)[order],
        kind=np.full(N, TOUCH, dtype=KIND_NAMES),
        reading=np.zeros((N, 3)),
        R=np.tile(np.eye(3), (N, 1, 1)),
        sigma_position=np.full(N, np.nan),
        sigma_rotation=np.full(N, np.nan),
        velocity=np.zeros((N, 7)),
        moving=np.zeros(N, bool),
        sockets=tuple(f"socket_{k}" for k in range(4)),
    )


def test_no_socket_is_rejected_because_a_link_is_far_off() -> None:
    drawn, samples = in_sockets(SEED)
    found = calibrate(samples, drawn, np.random.default_rng(0), Cell(), look_for_effects=False)
    assert found.report.rejected == 0
