"""What is judged: the final model at samples, how far it misses them, and how well its parameters are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration import (
    FINEST,
    AnyDistance,
    Calibration,
    Errors,
    Fit,
    Model,
    ModelParameter,
    NoiseModel,
    Split,
    Uncertainty,
    errors,
    known_sigma,
    linearise,
    uncertainty_of,
)
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows

_MAX_REFITTED = 400  # the same of base and tool
_WIDE = 1.0  # m, rad; where base or tool may be that were found again


@dataclass(frozen=True)
class Case:
    """The final model and what it is judged by.

    samples: all of them. wrong: those rejected (N,). held_out: rows that are scored, without those rejected. unit: what
    the split kept together, "station" or "block". model: the final one. known: covariance of its parameters and of the
    values of its effects. noise: of its residuals when it was fitted.
    errors: of the scored rows by stage. residuals: of the final model at all samples. fitted: whether the parameters
    were found from these samples; otherwise the model is frozen and ``known`` is all that may be blamed on them.
    refitted: of a frozen model, the parameters of base and tool that were found again. again: of a fitted one, the
    covariance that another noise leaves.
    """

    samples: Samples
    wrong: np.ndarray
    held_out: np.ndarray
    unit: str
    model: Model
    known: Uncertainty
    noise: NoiseModel
    errors: dict[str, Errors]
    residuals: Errors
    fitted: bool
    refitted: tuple[ModelParameter, ...] = ()
    again: Callable[..., Uncertainty] | None = None

    def with_floor(self, position_mm: float | None, rotation_deg: float | None) -> Case:
        """The case with a covariance that comes from the floor (RMS), where that is known, and not from the misfit."""
        if self.again is None or (position_mm, rotation_deg) == (None, None):
            return self

        def beside(rms: float | None, own: float, known: Array) -> float:
            """Noise per axis [m or rad] beside what readings know of their own scatter."""
            if rms is None or not len(known):
                return own
            return float(np.sqrt(max(rms**2 / 3.0 - float(np.median(known_sigma(known))) ** 2, FINEST**2)))

        turned = self.samples.sigma_rotation[self.samples.is_pose]
        mm = None if position_mm is None else 1e-3 * position_mm
        rad = None if rotation_deg is None else float(np.radians(rotation_deg))
        noise = NoiseModel(
            beside(mm, self.noise.position, self.samples.sigma_position),
            beside(rad, self.noise.rotation, turned),
            self.noise.others,
        )
        return replace(self, known=self.again(noise=noise))

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
    again = partial(uncertainty_of, fit, samples, sets.train, distances)
    held_out = sets.held_out[~wrong[sets.held_out]]
    residuals = errors(fit.model, samples)
    return Case(
        samples, wrong, held_out, sets.unit, fit.model, again(), fit.noise, left, residuals, fitted=True, again=again
    )


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
    known, free = own_uncertainty(calibration, model), base_and_tool(model, refit_base, refit_tool)
    if free:
        train = ~wrong
        train[rows] = False
        part = np.flatnonzero(train)
        part = part[spread_rows(len(part), _MAX_REFITTED)]
        known = _refitted(known, model, samples.select(part), calibration.noise, free)
    residuals = errors(model, samples)
    return Case(samples, wrong, rows, unit, model, known, calibration.noise, left, residuals, False, free)


def base_and_tool(model: Model, base: bool, tool: bool) -> tuple[ModelParameter, ...]:
    """The parameters of all base frames, of the tool, or of both."""
    frames = [ModelParameter(f"frame {name}", 0, d, f) for f, name in enumerate(model.frames) for d in range(6)]
    at_tool = [ModelParameter("tool", model.chain.tool_place, d) for d in range(6)]
    return (*(frames if base else ()), *(at_tool if tool else ()))


def own_uncertainty(calibration: Calibration, model: Model) -> Uncertainty:
    """The covariance that a calibration kept, for the frames of this model; nothing is uncertain where it kept none."""
    values = sum(len(e.values) for e in model.effects)
    kept = calibration.uncertainty
    if kept is None or len(kept.covariance) != len(kept.parameters) + values:
        kept = Uncertainty((), np.zeros((values, values)))
    frames = calibration.calibrated.frames
    rows, parameters = [], []
    for i, p in enumerate(kept.parameters):
        elsewhere = p.place == 0 and frames[p.frame] not in model.frames
        if not elsewhere and p.instrument < len(model.instruments):
            rows.append(i)
            parameters.append(replace(p, frame=model.frames.index(frames[p.frame])) if p.place == 0 else p)
    rows += range(len(kept.parameters), len(kept.covariance))
    return Uncertainty(tuple(parameters), kept.covariance[np.ix_(rows, rows)])


def _refitted(
    known: Uncertainty, model: Model, samples: Samples, noise: NoiseModel, free: tuple[ModelParameter, ...]
) -> Uncertainty:
    """The same where base or tool (``free``) were found again from some samples, with the arm as it was calibrated.

    With J_a the derivatives of the arm and J_b those of base and tool, in units of the noise, they answer an error δ of
    the arm by −B δ, B = (J_bᵀJ_b)⁻¹ J_bᵀJ_a, and noise by (J_bᵀJ_b)⁻¹.
    """
    places = {p.place for p in free}
    again = [p.place in places for p in known.parameters]
    rows = np.r_[np.flatnonzero(~np.array(again, bool)), len(again) : len(known.covariance)].astype(int)
    arm = tuple(p for p, a in zip(known.parameters, again, strict=True) if not a)
    _, J = derivatives(model, (*free, *arm), samples)
    J = (J * weights(noise, samples)).reshape(len(J), -1)
    F = len(free)
    inverse = np.linalg.inv(J[:F] @ J[:F].T + np.eye(F) / _WIDE**2)
    B = inverse @ (J[:F] @ J[F:].T)
    C = known.covariance[np.ix_(rows, rows)]
    return Uncertainty((*free, *arm), np.block([[B @ C @ B.T + inverse, -B @ C], [-C @ B.T, C]]))


def weights(noise: NoiseModel, samples: Samples) -> Array:
    """Inverse deviations of the readings, (6, N); zero where there is no orientation."""
    known_p, known_r = np.nan_to_num(samples.sigma_position), np.nan_to_num(samples.sigma_rotation)
    position = 1.0 / np.sqrt(noise.of(samples) ** 2 + known_p**2)
    rotation = np.where(samples.is_pose, 1.0 / np.sqrt(noise.rotation**2 + known_r**2), 0.0)
    return np.concatenate([np.tile(position, (3, 1)), np.tile(rotation, (3, 1))])


def by_sample(row: Array, pose: np.ndarray, count: int) -> Array:
    """Rows of a linearisation (…, 3 N + 3 M) as (…, 6, N), zeros where there is no orientation. pose: rows of the M."""
    out = np.zeros((*row.shape[:-1], 6, count))
    out[..., :3, :] = row[..., : 3 * count].reshape(*row.shape[:-1], 3, count)
    out[..., 3:, pose] = row[..., 3 * count :].reshape(*row.shape[:-1], 3, len(pose))
    return out


def derivatives(model: Model, parameters: Sequence[ModelParameter], samples: Samples) -> tuple[Array, Array]:
    """Measured less predicted (6, N), and derivatives (K, 6, N) of what is predicted by parameters and effects."""
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
    at = linearise(model, parameters, values, samples)
    pose = np.flatnonzero(samples.is_pose)
    return by_sample(at.residual, pose, len(samples)), by_sample(at.J, pose, len(samples))
