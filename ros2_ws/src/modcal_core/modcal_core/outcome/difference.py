"""The difference of two calibrations at the tool, and what their uncertainty explains of it.

Base and tool are other ones in every session, and say nothing of the arm. So the tool is predicted by both models at
the postures of both recordings, one model's base and tool are fitted to the other's, and what then is left is compared
with what two calibrations of the same arm would differ by: draws from the covariance of both, treated the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Calibration, ErrorSize, Model, outside_drivers
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.outcome.joint_offsets import base_and_tool_motions as taken_by
from modcal_core.outcome.joint_offsets import parameter_motions, poses_at, twists, without

_MAX = 300  # postures; the differences are smooth, and more say the same
_DRAWS = 1000  # of the covariances; the 95 % quantile then has 50 above it
_TAIL = 0.05  # of the draws
_OWN = 0.02  # of what a parameter moves the tool by; less is the tilt of a calibrated axis against the nominal one


@dataclass(frozen=True)
class ToolDifference:
    """What the two models differ by at the tool, second less first, in the arm's base.

    q: postures (N, n). points: where the tool is (N, 3) [m]. apart: (N, 3) [m], base and tool fitted to each other.
    size_mm, size_deg: of that, None for readings without orientations. as_they_are_mm: of the arms from base link to
    tip, nothing fitted. expected_mm: what the uncertainty of both explains, 95 % quantile of the RMS; None where one of
    them does not keep its uncertainty.
    left_out: effects of either that postures alone do not determine. of_base_or_tool: parameters that base and tool
    can take up, so that their values may differ between sessions and the arm be the same.
    """

    q: Array
    points: Array
    apart: Array
    size_mm: ErrorSize
    size_deg: ErrorSize | None
    as_they_are_mm: ErrorSize
    expected_mm: float | None
    left_out: tuple[str, ...]
    of_base_or_tool: frozenset[str] = frozenset()


def tool_difference(first: Calibration, second: Calibration) -> ToolDifference | None:
    """Difference of two calibrations at the tool; None where neither keeps its postures."""
    kept = [c.postures for c in (first, second) if len(c.postures)]
    if not kept:
        return None
    q = np.concatenate(kept)
    q = q[spread_rows(len(q), _MAX)]
    turns = first.kind == second.kind == "pose"
    (one, left_one), (two, left_two) = _standing(first), _standing(second)
    # one tool for both, so that the point that is compared is the same on the arm
    models = (one, replace(two, T_tip_tool=one.T_tip_tool))
    samples = tuple(poses_at(model, q) for model in models)
    T = [model.predict_samples(at) for model, at in zip(models, samples, strict=True)]
    taken = taken_by(T[0], turns)
    left = without(twists(T[0], T[1])[:, : 6 if turns else 3], taken)
    bare = [replace(model, T_tip_tool=np.eye(4)) for model in models]
    tips = [model.predict_samples(at)[:, :3, 3] for model, at in zip(bare, samples, strict=True)]
    mm = ErrorSize.of(1e3 * np.linalg.norm(left[:, :3], axis=1))
    raw = ErrorSize.of(1e3 * np.linalg.norm(tips[1] - tips[0], axis=1))
    assert mm is not None
    assert raw is not None
    return ToolDifference(
        q=q,
        points=T[0][:, :3, 3],
        apart=left[:, :3],
        size_mm=mm,
        size_deg=ErrorSize.of(np.degrees(np.linalg.norm(left[:, 3:], axis=1))) if turns else None,
        as_they_are_mm=raw,
        expected_mm=_expected((first, second), models, q, taken),
        left_out=tuple(dict.fromkeys((*left_one, *left_two))),
        of_base_or_tool=_taken_up(first, models[0], q, taken),
    )


def _standing(calibration: Calibration) -> tuple[Model, tuple[str, ...]]:
    """The calibrated model in its base, with the effects that a posture alone determines; names of the others."""
    model = calibration.calibrated
    kept = tuple(e for e in model.effects if not outside_drivers(e))
    others = tuple(e.label for e in model.effects if outside_drivers(e))
    frames = np.tile(np.eye(4), (len(model.frames), 1, 1))
    return replace(model.with_effects(kept), T_frame_base=frames, instruments=()), others


def _expected(
    calibrations: tuple[Calibration, Calibration], models: tuple[Model, ...], q: Array, taken: Array
) -> float | None:
    """The 95 % quantile [mm] of the RMS that two calibrations of the same arm, as sure as these, would differ by."""
    rng = np.random.default_rng(0)  # the same calibrations give the same bytes
    total = np.zeros((_DRAWS, *taken.shape[:2]))
    for calibration, model in zip(calibrations, models, strict=True):
        moved = _drawn(calibration, model, q, rng)
        if moved is None:
            return None
        total = total + moved[:, :, : taken.shape[1]]
    left = without(total, taken)[..., :3]
    return 1e3 * float(np.quantile(np.sqrt(np.mean(np.sum(left**2, axis=-1), axis=-1)), 1.0 - _TAIL))


def _taken_up(calibration: Calibration, model: Model, q: Array, taken: Array) -> frozenset[str]:
    """Names of the parameters that change nothing at the tool which base and tool could not."""
    if calibration.uncertainty is None:
        return frozenset()
    parameters = tuple(p for p in calibration.uncertainty.parameters if p.instrument < 0)
    moved = parameter_motions(model, parameters, q)[..., : taken.shape[1]]
    left = np.linalg.norm(without(moved, taken), axis=(1, 2))
    all_of_it = np.linalg.norm(moved, axis=(1, 2))
    return frozenset(p.name for p, rest, whole in zip(parameters, left, all_of_it, strict=True) if rest < _OWN * whole)


def _drawn(calibration: Calibration, model: Model, q: Array, rng: np.random.Generator) -> Array | None:
    """Twists at the tool (draws, N, 6) for parameters drawn from the covariance; None if none is kept."""
    known = calibration.uncertainty
    if known is None:
        return None
    usable = [k for k, p in enumerate(known.parameters) if p.instrument < 0]
    parameters = tuple(known.parameters[k] for k in usable)
    index, here = list(usable), len(known.parameters)
    for effect in calibration.calibrated.effects:
        index += range(here, here + len(effect.values)) if not outside_drivers(effect) else ()
        here += len(effect.values)
    of_effects = np.concatenate([np.empty(0), *(e.values for e in model.effects)])
    J = parameter_motions(model, parameters, q, of_effects)
    C = known.covariance[np.ix_(index, index)]
    size, axes = np.linalg.eigh(C)
    draws = rng.standard_normal((_DRAWS, len(index))) * np.sqrt(np.maximum(size, 0.0)) @ axes.T
    return np.asarray(np.tensordot(draws, J, 1))
