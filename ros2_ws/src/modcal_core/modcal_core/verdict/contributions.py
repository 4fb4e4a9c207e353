"""What each effect of the final model is worth: what its removal costs on held-out, everything else fitted again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.effects import is_large_move
from modcal_core.calibration.linearise import model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.score import Errors, errors
from modcal_core.geometry.so3 import Array
from modcal_core.verdict.case import Case
from modcal_core.verdict.verdict import Interval

DRAWS = 400
_MOST = 600  # scored samples; the mean over more is the same


@dataclass(frozen=True)
class Contribution:
    """One effect, by its number in the model. mm2, deg2: what its removal costs on held-out, as mean square, with 95 %
    intervals by drawing held-out stations again. deg2: None where nothing has an orientation.
    """

    effect: int
    label: str
    mm2: float
    ci95_mm2: Interval
    deg2: float | None = None
    ci95_deg2: Interval | None = None

    @property
    def helps(self) -> bool:
        """Whether its removal surely costs something on held-out."""
        return self.ci95_mm2[0] > 0.0 or (self.ci95_deg2 is not None and self.ci95_deg2[0] > 0.0)


def contributions(case: Case) -> tuple[Contribution, ...]:
    """One for each effect of the final model, in its order.

    The others are fitted again by one step: with θ the values taken away and C the covariance of all, the rest moves by
    C_re C_ee⁻¹ θ, which is where the quadratic about the minimum has its least. The cost is then that of the model so
    changed, without linearising.
    """
    effects = case.model.effects
    if not effects or not len(case.held_out):
        return ()
    rows = case.held_out[np.unique(np.linspace(0, len(case.held_out) - 1, min(len(case.held_out), _MOST)).astype(int))]
    scored = case.samples.select(rows)
    with_all = errors(case.model, scored)
    out = []
    for i, effect in enumerate(effects):
        without = errors(removed(case, i), scored)
        mm2 = 1e6 * (without.position_norm**2 - with_all.position_norm**2)
        cost, interval = resampled(mm2, scored.station)
        turned = (None, None)
        if scored.is_pose.any():
            deg2 = np.degrees(without.rotation_norm) ** 2 - np.degrees(with_all.rotation_norm) ** 2
            turned = resampled(deg2, scored.station[scored.is_pose])  # type: ignore[assignment]
        out.append(Contribution(i, effect.label, cost, interval, *turned))
    return tuple(out)


def removed(case: Case, effect: int) -> Model:
    """The final model without one of its effects, the rest fitted again by one step."""
    P, effects = len(case.known.parameters), case.model.effects
    if is_large_move(effects[effect]):  # no small step of the others stands in for it
        return case.model.with_effects(effects[:effect] + effects[effect + 1 :])
    ends = P + np.cumsum([0, *(len(e.values) for e in effects)])
    own = slice(ends[effect], ends[effect + 1])
    gone = np.zeros(ends[effect + 1] - ends[effect])
    linear = len(effects[effect].amplitudes)
    gone[:linear] = -effects[effect].values[:linear]  # its settings mean nothing without it
    C = case.known.covariance
    step = C[:, own] @ np.linalg.lstsq(C[own, own], gone, rcond=1e-12)[0]
    values = np.concatenate([np.zeros(P), *(e.values for e in effects)]) + step
    values[own] = effects[effect].values + gone
    moved = model_at(case.model, case.known.parameters, values)
    return moved.with_effects(moved.effects[:effect] + moved.effects[effect + 1 :])


def resampled(square: Array, station: np.ndarray) -> tuple[float, Interval]:
    """Mean of numbers (N,) and its 95 % interval, by drawing their stations (N,) again."""
    _, of = np.unique(station, return_inverse=True)
    total, count = np.bincount(of, square), np.bincount(of)
    draws = np.random.default_rng(0).integers(len(count), size=(DRAWS, len(count)))
    means = total[draws].sum(axis=1) / count[draws].sum(axis=1)
    return float(square.mean()), (float(np.percentile(means, 2.5)), float(np.percentile(means, 97.5)))


def mean_square(missed: Errors, angle: bool) -> Array:
    """Squared errors, (N,) [mm²] or (M,) [deg²]."""
    return np.degrees(missed.rotation_norm) ** 2 if angle else 1e6 * missed.position_norm**2
