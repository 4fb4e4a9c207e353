"""The account: where the nominal model's squared error goes, row by row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.verdict.case import Case
from modcal_core.verdict.contributions import Contribution, mean_square, resampled
from modcal_core.verdict.floor import Floor
from modcal_core.verdict.verdict import Row, Share


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
