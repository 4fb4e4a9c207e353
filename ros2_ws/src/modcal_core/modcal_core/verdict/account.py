"""The account: where the nominal model's squared error goes, row by row, and what each effect takes away.

An effect is worth what its removal costs on held-out, everything else fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from modcal_core.calibration import Errors, errors, without
from modcal_core.effects import STEPS, Effect, claimed, companionless, with_companions
from modcal_core.geometry import Array
from modcal_core.verdict.case import Case
from modcal_core.verdict.floor import Floor
from modcal_core.verdict.verdict import Interval, Row, Share

DRAWS = 400  # bootstrap samples; ends of a 95 % interval then move by an eighth of a deviation
_MAX_COUNTED = 5000  # stations, of which 16 MB are kept; of more it is worked out each time
TOGETHER = "small curves"  # what no effect of its own stands for


@dataclass(frozen=True)
class Contribution:
    """What effects of these numbers, an entry of the report or all that none names, are worth together. mm2, deg2: what
    their removal costs on held-out, as mean square, with 95 % intervals by drawing held-out stations again. deg2: None
    where nothing has an orientation. label: of the first.
    """

    numbers: tuple[int, ...]
    label: str
    mm2: float
    ci95_mm2: Interval
    deg2: float | None = None
    ci95_deg2: Interval | None = None


def contributions_of(case: Case) -> tuple[Contribution, ...]:
    """One for each entry of a report (:func:`entries_of`), in its order, and one for all other effects together.

    The cost is that of the model so changed (:func:`left_without`), without linearising.
    """
    effects, scored = case.model.effects, case.scored
    if not effects or not len(scored):
        return ()
    with_all = errors(case.model, scored)
    labelled = [(effects[own[0]].label, with_companions(effects, own)) for own in entries_of(effects)]
    others = companionless(effects)
    out = []
    for label, numbers in (*labelled, *([(TOGETHER, others)] if others else [])):
        gone = left_without(case, numbers)
        cost, interval = resampled(1e6 * (gone.position_norm**2 - with_all.position_norm**2), scored.station)
        turned = (None, None)
        if scored.is_pose.any():
            deg2 = np.degrees(gone.rotation_norm) ** 2 - np.degrees(with_all.rotation_norm) ** 2
            turned = resampled(deg2, scored.station[scored.is_pose])  # type: ignore[assignment]
        out.append(Contribution(numbers, label, cost, interval, *turned))
    return tuple(out)


def entries_of(effects: Sequence[Effect]) -> list[tuple[int, ...]]:
    """Numbers of the effects that are one entry of a report: of a place and driver; each move is one of its own."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, effect in enumerate(effects):
        if claimed(effect):
            key = (*effect.key, effect.shape.settings["at"]) if effect.shape.kind in STEPS else effect.key
            groups.setdefault(key, []).append(i)
    return [tuple(numbers) for numbers in groups.values()]


def left_without(case: Case, effects: Sequence[int]) -> Errors:
    """Errors of scored samples without the effects of these numbers, all else fitted again.

    The fit is one step (:mod:`modcal_core.calibration.covariance`). Where that leads further off than geometry alone,
    it has left the range in which it holds, and geometry alone, which any fit without them can choose, stands for it.
    """
    gone, alone = errors(without(case.model, case.known, effects), case.scored), case.errors.get("geometric")
    worse = alone is not None and np.mean(gone.position_norm**2) > np.mean(alone.position_norm**2)
    return alone if alone is not None and worse else gone


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


def account(
    case: Case,
    parts: Sequence[Contribution],
    predictable: Share | None,
    estimation: float,
    floor: Floor | None,
    angle: bool,
) -> tuple[Row, ...]:
    """Rows [mm², or deg² of the angle] that sum to the nominal model's mean square on held-out.

    geometry, each effect by what its removal costs, ``shared`` (what effects explain together, or twice), then what is
    left of the final model: predictable, estimation, repeatability, instrument, and ``unaccounted``, which is negative
    where the parts before it were estimated too large.
    """
    nominal, geometric, final = (mean_square(case.errors[s], angle) for s in ("nominal", "geometric", "final"))
    station = case.samples.station[case.held_out]
    station = station[case.samples.is_pose[case.held_out]] if angle else station
    gain, interval = resampled(nominal - geometric, station)
    rows = [Row("geometry", gain, interval)]
    for part in parts:
        value, spread = (part.deg2, part.ci95_deg2) if angle else (part.mm2, part.ci95_mm2)
        if value is not None:
            rows.append(Row(f"effect:{part.label}", value, spread))
    square = float(final.mean())
    rows.append(Row("shared", float(geometric.mean()) - square - sum(r.value for r in rows[1:])))
    # the share of a fitted model is one of what its parameters leave, that of a frozen one of everything
    scale = max(square - estimation, 0.0) if case.fitted else square
    share = Share(0.0, (0.0, 0.0), 0.0) if predictable is None else predictable
    low, high = share.ci95
    repeatability = 0.0 if floor is None else floor.square - floor.instrument
    ends = None if floor is None else (floor.interval[0] - floor.instrument, floor.interval[1] - floor.instrument)
    left = [
        Row("predictable", share.share * scale, None if predictable is None else (low * scale, high * scale)),
        Row("estimation", estimation),
        Row("repeatability", repeatability, ends),
        Row("instrument", 0.0 if floor is None else floor.instrument),
    ]
    rows += [*left, Row("unaccounted", square - sum(r.value for r in left))]
    # differences of means, so that the rows sum exactly
    rounding = float(nominal.mean()) - float(np.sum([r.value for r in rows]))
    return (*rows[:-1], Row("unaccounted", rows[-1].value + rounding))
