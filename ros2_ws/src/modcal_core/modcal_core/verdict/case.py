"""What is judged: the final model at samples, how far it misses them, and how well its parameters are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.distances import AnyDistance
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import Spread
from modcal_core.calibration.parameters import Parameter
from modcal_core.calibration.score import Errors, errors
from modcal_core.calibration.split import Split
from modcal_core.calibration.store import Calibration
from modcal_core.calibration.uncertainty import Uncertainty, uncertainty
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

_MOST_FITTED = 1500  # samples that a covariance is made from; more are thinned and count for those left out
_WIDE = 1.0  # m, rad; of a base or tool that was found again on this recording


@dataclass(frozen=True)
class Case:
    """The final model and what it is judged by.

    samples: all of them. wrong: those rejected (N,). held_out: rows that are scored, without those rejected. unit: what
    the split kept together, "station" or "block". model: the final one. known: covariance of its parameters and of the
    values of its effects; None where a calibration did not keep it. spread: of its residuals when it was fitted.
    errors: of the scored rows by stage. missed: of the final model at all samples. fitted: whether the parameters were
    found from these samples; otherwise the model is frozen and ``known`` is all that may be blamed on them.
    """

    samples: Samples
    wrong: np.ndarray
    held_out: np.ndarray
    unit: str
    model: Model
    known: Uncertainty | None
    spread: Spread
    errors: dict[str, Errors]
    missed: Errors
    fitted: bool

    @property
    def scored(self) -> Samples:
        """The samples of the scored rows."""
        return self.samples.select(self.held_out)


def fitted_case(
    fit: Fit,
    samples: Samples,
    sets: Split,
    wrong: np.ndarray,
    left: dict[str, Errors],
    distances: Sequence[AnyDistance] = (),
) -> Case:
    """The case of a fit to *train*. wrong: rejected samples (N,). left: errors of the held-out rows not rejected."""
    rows = np.unique(np.linspace(0, len(sets.train) - 1, min(len(sets.train), _MOST_FITTED)).astype(int))
    part = replace(fit, weights=fit.weights[rows] * (len(sets.train) / max(len(rows), 1)))
    known = uncertainty(fit.model, samples.select(sets.train[rows]), fit.parameters, part, distances)
    held_out = sets.held_out[~wrong[sets.held_out]]
    missed = errors(fit.model, samples)
    return Case(samples, wrong, held_out, sets.unit, fit.model, known, fit.spread, left, missed, fitted=True)


def frozen_case(
    calibration: Calibration,
    model: Model,
    samples: Samples,
    unit: str,
    rows: np.ndarray,
    wrong: np.ndarray,
    left: dict[str, Errors],
    refit_base: bool = False,
    refit_tool: bool = False,
) -> Case:
    """The case of a frozen calibration at another recording.

    model: its final one, base and tool refitted if asked. unit: see :class:`Case`. rows: those that are scored, (k,).
    """
    known = None if calibration.uncertainty is None else _carried(calibration, model, refit_base, refit_tool)
    missed = errors(model, samples)
    return Case(samples, wrong, rows, unit, model, known, calibration.spread, left, missed, fitted=False)


def _carried(calibration: Calibration, model: Model, refit_base: bool, refit_tool: bool) -> Uncertainty | None:
    """The covariance that a calibration kept, for the frames of this model; None where it does not fit this model.

    Base and tool that were found again on this recording may be anywhere.
    """
    kept, tool = calibration.uncertainty, calibration.calibrated.chain.tool_place
    assert kept is not None
    if len(kept.covariance) != len(kept.parameters) + sum(len(e.values) for e in model.effects):
        return None
    frames = calibration.calibrated.frames
    rows, parameters = [], []
    for i, p in enumerate(kept.parameters):
        again = (refit_base and p.place == 0) or (refit_tool and p.place == tool)
        elsewhere = p.place == 0 and frames[p.frame] not in model.frames
        if again or elsewhere or p.instrument >= len(model.instruments):
            continue
        rows.append(i)
        parameters.append(replace(p, frame=model.frames.index(frames[p.frame])) if p.place == 0 else p)
    rows += range(len(kept.parameters), len(kept.covariance))
    free = [Parameter(f"frame {name}", 0, d, f) for f, name in enumerate(model.frames) for d in range(6)]
    free = [*(free if refit_base else ()), *(Parameter("tool", tool, d) for d in range(6) if refit_tool)]
    P, K, F = len(parameters), len(rows), len(free)
    covariance = np.zeros((K + F, K + F))
    covariance[:F, :F] = _WIDE**2 * np.eye(F)
    covariance[F:, F:] = kept.covariance[np.ix_(rows, rows)]
    assert P + F + sum(len(e.values) for e in model.effects) == K + F
    return Uncertainty((*free, *parameters), covariance)


def by_sample(row: Array, pose: np.ndarray, count: int) -> Array:
    """Rows of a linearisation (…, 3 N + 3 M) as (…, 6, N), zeros where there is no orientation. pose: rows of the M."""
    out = np.zeros((*row.shape[:-1], 6, count))
    out[..., :3, :] = row[..., : 3 * count].reshape(*row.shape[:-1], 3, count)
    out[..., 3:, pose] = row[..., 3 * count :].reshape(*row.shape[:-1], 3, -1)
    return out


def derivatives(model: Model, parameters: Sequence[Parameter], samples: Samples) -> tuple[Array, Array]:
    """Residuals (6, N) from the root and their derivatives (K, 6, N) with respect to parameters and effects."""
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
    at = linearise(model, parameters, values, samples)
    pose = np.flatnonzero(samples.is_pose)
    return by_sample(at.residual, pose, len(samples)), by_sample(at.J, pose, len(samples))
