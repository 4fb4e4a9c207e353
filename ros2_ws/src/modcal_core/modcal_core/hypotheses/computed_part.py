"""Stations whose readings were computed from the joints, among others that were measured.

A script that fills gaps with the controller's pose leaves readings that the arm as it is drawn reproduces exactly, with
one base and one tool, while no measured one is met like that. Three poses tell base and tool exactly; of points, which
are linear in the turns and places of the tip, fourteen tell that map. Draws of so few stations, of those that the model
rejects and of neighbours too, are asked how many others they reproduce (RANSAC; Fischler & Bolles 1981).
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import FINEST, base_and_tool_turns, consecutive, tool_and_place
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism, forward, is_serial_arm

_MIN = 30  # stations
_MAX = 400  # the same at most
_POSES, _POINTS = 3, 14  # stations in a draw
_DRAWS = 300  # of each kind
_ENOUGH = 8  # stations beyond those drawn that are met to the last digit
_MAX_AGREE = 0.95  # where more do, all are computed
_COARSEST = 1e-5  # m; rounded more coarsely, measured readings are met by chance
_FINEST_STEP, _NO_STEP = 5e-7, 1e-7  # m or rad: of the last digits that are looked for, and what is none


def computed_in_part(samples: Samples, chain: Mechanism, wrong: np.ndarray | None = None) -> tuple[str, ...]:
    """A sentence where many stations, though not all, hold what the nominal arm says to the last digit; else nothing.

    wrong: True for samples that a model rejects, (N,), which are drawn from by themselves too.
    """
    if not is_serial_arm(chain) or not len(samples):
        return ()
    f = int(np.argmax(np.bincount(samples.frame)))
    rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")) & ~samples.moving)
    if samples.frames[f] in samples.sockets:
        return ()
    rows = rows[np.argsort(samples.stamps[rows], kind="stable")][:_MAX]
    if len(rows) < _MIN:
        return ()
    limit = max(FINEST, *map(last_step, samples.reading[rows].T))
    if limit > _COARSEST:
        return ()
    part = samples.select(rows)
    try:
        met = _met(forward(chain, part.q), part, None if wrong is None else wrong[rows], limit)
    except np.linalg.LinAlgError:
        return ()
    count = int(met.sum())
    if count < _ENOUGH + (_POSES if part.is_pose.all() else _POINTS) or count > _MAX_AGREE * len(rows):
        return ()
    runs, number = consecutive(met), part.station
    where = "here and there"
    if len(runs) <= 3:
        where = "stations " + " and ".join(f"{number[a]} to {number[b - 1]}" for a, b in runs)
    return (
        f"The nominal model reproduces the readings of {count} of {len(rows)} stations ({where}) to {1e6 * limit:.2g} "
        "µm with one base and one tool, which no instrument does: they were probably computed from the joints (by the "
        "controller, or by a script where the tracker lost its target), and are not a measurement. Leave them out.",
    )


def _met(A: Array, samples: Samples, wrong: np.ndarray | None, limit: float) -> np.ndarray:
    """Stations of the draw that reproduces most to the limit, (N,)."""
    poses = bool(samples.is_pose.all())
    size, p = _POSES if poses else _POINTS, samples.reading
    draws = _draws(len(samples), size, wrong, np.random.default_rng(0))
    design = np.concatenate([A[:, :3, :3].reshape(-1, 9), A[:, :3, 3], np.ones((len(A), 1))], axis=1)

    def near(rows: np.ndarray, times: float) -> np.ndarray:
        """Stations (D, N) that base and tool of some rows (D, k), or the linear map of points, meet."""
        if poses:
            Y, _ = base_and_tool_turns(A[rows][..., :3, :3], samples.R[rows])
            _, x, t = tool_and_place(Y, A[rows], p[rows])
            point = np.einsum("nij,cj->cni", A[:, :3, :3], x) + A[:, :3, 3]
            left = p - (point @ np.swapaxes(Y, 1, 2) + t[:, None])
        else:
            left = p - design @ (np.linalg.pinv(design[rows], rcond=1e-10) @ p[rows])
        return np.asarray(np.linalg.norm(left, axis=2) < times * limit)

    drawn = near(draws, 10.0)  # so few do not tell them to the last digit
    best: np.ndarray = drawn[int(np.argmax(drawn.sum(axis=1)))]
    for _ in range(2):
        if best.sum() < size:
            return np.zeros(len(samples), bool)
        best = near(np.flatnonzero(best)[None], 1.0)[0]
    return best


def _draws(N: int, size: int, wrong: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
    """Rows (D, size): of all where few are drawn, of neighbours, and of those that are wrong."""
    sets: list[np.ndarray] = []
    if size == _POSES:
        sets += [rng.permuted(np.tile(np.arange(N), (_DRAWS, 1)), axis=1)[:, :size]]
    first = rng.integers(0, max(N - 2 * size, 1), _DRAWS)
    sets.append(first[:, None] + rng.permuted(np.tile(np.arange(2 * size), (_DRAWS, 1)), axis=1)[:, :size])
    out = np.flatnonzero(wrong) if wrong is not None else np.zeros(0, int)
    if len(out) >= size:
        sets.append(out[rng.permuted(np.tile(np.arange(len(out)), (_DRAWS, 1)), axis=1)[:, :size]])
    return np.minimum(np.concatenate(sets), N - 1)


def last_step(x: Array) -> float:
    """The step of which all numbers (N,) are multiples, but for what they have in common; 0 where it is finer than
    instruments are, or numbers do not differ.
    """
    size = 0.0
    for gap in np.diff(np.unique(x)):
        a, b = max(size, float(gap)), min(size, float(gap))
        while b > _NO_STEP:
            a, b = b, abs(a - b * round(a / b))
        size = a
        if size < _FINEST_STEP:
            return 0.0
    return size
