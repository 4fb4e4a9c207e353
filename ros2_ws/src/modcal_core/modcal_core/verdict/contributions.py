"""What each effect of the final model is worth: what its removal costs on held-out, everything else fitted again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from modcal_core.calibration import Errors, errors, without
from modcal_core.effects import Effect, claimed, companionless, with_companions
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.verdict.case import Case
from modcal_core.verdict.verdict import Interval

DRAWS = 400  # bootstrap samples; ends of a 95 % interval then move by an eighth of a deviation
_MAX_COUNTED = 5000  # stations, of which 16 MB are kept; of more it is worked out each time
TOGETHER = "small curves"  # what no effect of its own stands for
_MAX = 600  # scored samples; the mean over more is the same


@dataclass(frozen=True)
class Contribution:
    """One effect, by its number in the model, or all that no report names together, by their first. mm2, deg2: what
    its removal costs on held-out, as mean square, with 95 % intervals by drawing held-out stations again. deg2: None
    where nothing has an orientation.
    """

    effect: int
    label: str
    mm2: float
    ci95_mm2: Interval
    deg2: float | None = None
    ci95_deg2: Interval | None = None


def contributions_of(case: Case) -> tuple[Contribution, ...]:
    """One for each effect of the final model that a report names, in its order, and one for all others together.

    The cost is that of the model so changed (:func:`left_without`), without linearising.
    """
    effects = case.model.effects
    if not effects or not len(case.held_out):
        return ()
    rows = spread_rows(len(case.held_out), _MAX)
    scored = case.samples.select(case.held_out[rows])
    with_all = errors(case.model, scored)
    out = []
    for label, numbers in _entries(effects):
        gone = left_without(case, numbers, rows)
        mm2 = 1e6 * (gone.position_norm**2 - with_all.position_norm**2)
        cost, interval = resampled(mm2, scored.station)
        turned = (None, None)
        if scored.is_pose.any():
            deg2 = np.degrees(gone.rotation_norm) ** 2 - np.degrees(with_all.rotation_norm) ** 2
            turned = resampled(deg2, scored.station[scored.is_pose])  # type: ignore[assignment]
        out.append(Contribution(numbers[0], label, cost, interval, *turned))
    return tuple(out)


def left_without(case: Case, effects: Sequence[int], rows: np.ndarray | None = None) -> Errors:
    """Errors of scored samples without the effects of these numbers, all else fitted again.

    The fit is one step (:mod:`modcal_core.calibration.covariance`). Where that leads further off than geometry alone,
    it has left the range in which it holds, and geometry alone, which any fit without them can choose, stands for it.
    rows: among those scored, (k,); None: all.
    """
    rows = np.arange(len(case.held_out)) if rows is None else rows
    scored = case.samples.select(case.held_out[rows])
    gone = errors(without(case.model, case.known, effects), scored)
    alone = case.errors.get("geometric")
    if alone is None or np.mean(gone.position_norm**2) <= np.mean(alone.position_norm[rows] ** 2):
        return gone
    pose = case.samples.is_pose[case.held_out]
    turned = (np.cumsum(pose) - 1)[rows[pose[rows]]]
    return Errors(alone.position[rows], alone.rotation[turned], None if alone.lever is None else alone.lever[rows])


def _entries(effects: Sequence[Effect]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Labels and numbers of effects: of each that a report names and what goes with it, then of all others together."""
    yield from ((e.label, with_companions(effects, (i,))) for i, e in enumerate(effects) if claimed(e))
    others = companionless(effects)
    if others:
        yield TOGETHER, others


def resampled(square: Array, station: np.ndarray) -> tuple[float, Interval]:
    """Mean of numbers (N,) and its 95 % interval, by drawing their stations (N,) again."""
    _, of = np.unique(station, return_inverse=True)
    total, count = np.bincount(of, square), np.bincount(of)
    if len(count) <= _MAX_COUNTED:
        sums, of_all = (_often(len(count)) @ np.stack([total, count], axis=1)).T
        means = sums / of_all
    else:
        draws = _draws(len(count))
        means = total[draws].sum(axis=1) / count[draws].sum(axis=1)
    return float(square.mean()), (float(np.percentile(means, 2.5)), float(np.percentile(means, 97.5)))


def _draws(count: int) -> np.ndarray:
    """Indices of the units drawn in each resample, (DRAWS, count)."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


@lru_cache(maxsize=2)
def _often(count: int) -> Array:
    """How often each unit is drawn in each resample, (DRAWS, count); cached, because effects share it."""
    at = _draws(count) + count * np.arange(DRAWS)[:, None]
    return np.bincount(at.ravel(), minlength=DRAWS * count).reshape(DRAWS, count).astype(float)


def mean_square(residuals: Errors, angle: bool) -> Array:
    """Squared errors, (N,) [mm²] or (M,) [deg²]."""
    return np.degrees(residuals.rotation_norm) ** 2 if angle else 1e6 * residuals.position_norm**2
