"""Whether a gear's curve is a wave: how many cycles a turn, found by scanning them all at once.

A few stations show a curve that varies from one to the next, and say little of its course between them. A wave has
three sizes, or five with the second harmonic that strain wave gears have; where one number of cycles explains what the
free curve explains, and no other does, the curve is known everywhere.
"""

from __future__ import annotations

import numpy as np
import scipy

from modcal_core.calibration import Model, RowView
from modcal_core.checking.evidence import SIZES, ChangeCandidate, ChangeJudge, JudgedChange
from modcal_core.checking.hypotheses import GEAR, CellChange, hypothesis_columns
from modcal_core.effects import Drivers
from modcal_core.effects.families import gear_harmonic
from modcal_core.geometry import Array

_SURE = 0.99  # probability that the cycles are these, within a cell or two of the scan
_NEAR = 1.6  # cells of the scan to either side that are one peak
_ROUNDS = 40  # of a golden section


def wave_of(joint: int, model: Model, view: RowView, drivers: Drivers, judge: ChangeJudge) -> JudgedChange | None:
    """The wave that one joint's curve is, None where the readings do not say which."""
    chain, samples = model.chain, view.samples
    if not chain.revolute[joint]:
        return None
    q = samples.q[:, joint]
    grid = gear_harmonic.cycle_grid(max(float(np.ptp(q)), 0.1))
    unit = view.unit_column(chain.first_place + joint, 5)
    sample = np.concatenate([np.tile(np.arange(len(samples)), 3), np.tile(view.pose, 3)]).astype(int)
    angle = q[sample]
    z = judge.whitened(judge.null.residual, judge.best)
    n = len(z)

    def factors(cycles: Array, double: bool) -> Array:
        phase = cycles[:, None] * angle
        parts = [np.sin(phase), np.cos(phase)] + ([np.sin(2.0 * phase), np.cos(2.0 * phase)] if double else [])
        A = np.stack([judge.whitened((unit * part).T, judge.best).T for part in parts], axis=1)  # (C, k, n)
        gram = A @ np.swapaxes(A, 1, 2) + 1e-9 * np.eye(len(parts)) * np.sum(A**2, axis=(1, 2), keepdims=True)
        along = A @ z
        gain = np.sum(along * np.linalg.solve(gram, along[..., None])[..., 0], axis=1)
        k = len(parts)
        g = SIZES**2 * n / k
        logs = -0.5 * k * np.log1p(g) + 0.5 * gain[:, None] * g / (1.0 + g)
        return np.asarray(scipy.special.logsumexp(logs, axis=1) - np.log(len(SIZES)))

    best: tuple[float, float, bool] | None = None  # evidence, cycles, double
    for double in (False, True):
        cycles = grid[grid <= 0.5 * gear_harmonic.MAX_CYCLES] if double else grid
        logs = factors(cycles, double)
        total = float(scipy.special.logsumexp(logs))
        top = int(np.argmax(logs))
        step = float(cycles[1] - cycles[0])
        peak = np.abs(cycles - cycles[top]) <= _NEAR * step
        sure = float(scipy.special.logsumexp(logs[peak])) - total > np.log(_SURE)
        evidence = total - np.log(len(cycles))
        if best is None or evidence > best[0]:
            at = _refined(lambda c, double=double: float(factors(np.array([c]), double)[0]), float(cycles[top]), step)
            best = (evidence, at if sure else np.nan, double)
    assert best is not None
    if np.isnan(best[1]):
        return None
    change = CellChange(GEAR, chain.names[joint], effect=gear_harmonic.wave(chain.names[joint], best[1], best[2]))
    columns = hypothesis_columns(change, model, view, drivers)
    judged = judge.judged(ChangeCandidate(change, judge.null.residual, columns, np.zeros(columns.shape[1])))
    own = factors(np.array([best[1]]), best[2])[0]
    return JudgedChange(
        judged.candidate, judged.log_factor + best[0] - float(own), judged.likelihood, judged.left, judged.size
    )


def _refined(value: object, at: float, step: float) -> float:
    """The cycles near a peak of the scan at which the value is largest (golden section)."""
    assert callable(value)
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    low, high = at - step, at + step
    for _ in range(_ROUNDS):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        if value(a) > value(b):
            high = b
        else:
            low = a
    return 0.5 * (low + high)
