"""The regimes of a recording, as the moves of its model divide it."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import Model, station_numbers
from modcal_core.measurements import Samples
from modcal_core.moves import moves_of
from modcal_core.verdict.grounds import Regime


def regimes_of(model: Model, samples: Samples) -> tuple[Regime, ...]:
    """Stretches of stations, in order of time, that base or tool were moved between; empty where nothing moved.

    what: that of the move which begins the stretch; of the first one, of the move that ends it.
    """
    moves = moves_of(model)
    number = station_numbers(samples)
    part = np.searchsorted([move.at for move in moves], samples.stamps, side="right")
    parts = [number[part == k] for k in range(len(moves) + 1)]
    if not moves or not all(len(rows) for rows in parts):
        return ()
    return tuple(Regime(int(rows.min()), int(rows.max()), moves[max(k - 1, 0)].what) for k, rows in enumerate(parts))
