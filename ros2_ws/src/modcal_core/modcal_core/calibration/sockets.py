"""Frames that show one fixed point: stated ones are sockets, any other is a tracker that stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.distances import Distance
from modcal_core.errors import BadRecording
from modcal_core.geometry import so3
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism, forward

_MOVED = 0.02  # m; the tip's RMS distance from its mean beyond which a target that follows must be seen to move
_STANDS = 1e-3  # of that distance, and as many radians: what readings of a target that stands still vary by, noise only
_THOUSANDTH = (0.5e-3, 2e-3)  # of the tip's motion, as of readings in metres that were taken for millimetres
_FOLLOWS, _ENOUGH = 0.7, 12  # share of their size that follows the tip: of 12 readings of noise 0.44 (mean)


def with_sockets(samples: Samples, cell: Cell, chain: Mechanism) -> Samples:
    """The samples with the frames named that are sockets: listed as such, or with a known distance to another.

    Raises BadRecording for a tracker whose readings stand still while the arm moves.
    """
    of_distances = (name for d in cell.distances if isinstance(d, Distance) for name in d.between)
    stated = dict.fromkeys((*samples.sockets, *cell.sockets, *of_distances))
    sockets = tuple(f for i, f in enumerate(samples.frames) if f in stated and samples.stands_still(i))
    samples = replace(samples, sockets=sockets)
    for f, frame in enumerate(samples.frames):
        if frame not in sockets:
            _require_moving(samples.select(samples.frame == f), frame, chain)
    return samples


def _require_moving(samples: Samples, frame: str, chain: Mechanism) -> None:
    rows = np.isin(samples.kind, (POINT, POSE))
    if rows.sum() < 3:
        return
    samples = samples.select(rows)
    tip = forward(chain, samples.q)[:, :3, 3]
    moved = _scatter(tip)
    if moved < _MOVED:
        return
    turned = 0.0
    if samples.is_pose.all():
        mean = so3.mean(samples.R)
        turned = float(np.sqrt(np.mean(np.sum(so3.log(mean.T @ samples.R) ** 2, axis=1))))
    seen = _scatter(samples.reading)
    topic = f"/tracker/{samples.kind[0]} ({frame})"
    if _THOUSANDTH[0] * moved < seen < _THOUSANDTH[1] * moved and _follows(tip, samples.reading):
        raise BadRecording(
            topic,
            f"readings follow the tip at a thousandth of its motion (RMS {1e3 * seen:.3g} of {1e3 * moved:.0f} mm)",
            "positions look like metres taken for millimetres: state the unit m",
        )
    if seen < _STANDS * moved and turned < _STANDS:
        raise BadRecording(
            topic,
            f"readings stand still (RMS {1e3 * seen:.3g} mm) while the joints move the tip by {1e3 * moved:.0f} mm",
            "check that the tracker follows its target and its driver sends new readings; "
            "a ball held in a socket is stated: list the frame under 'sockets' in the cell file (--cell)",
        )


def _follows(tip: np.ndarray, readings: np.ndarray) -> bool:
    """Whether readings (N, 3) follow the tip (N, 3), however little they move.

    What the best rotation or reflection makes alike is the sum of the singular values of their product.
    """
    a, b = tip - tip.mean(axis=0), readings - readings.mean(axis=0)
    alike = np.linalg.norm(a.T @ b, "nuc")
    return len(tip) >= _ENOUGH and bool(alike > _FOLLOWS * np.linalg.norm(a) * np.linalg.norm(b))


def _scatter(p: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
