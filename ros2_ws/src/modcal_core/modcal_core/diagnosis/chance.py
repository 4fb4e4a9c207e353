"""The chance that noise makes as good a best as the recording's, by trials with random signs and by their law.

Scores are −log10 of the chance in white noise. The best scores of the trials follow an extreme-value law (Gumbel).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from modcal_core.calibration import beyond_gumbel, gumbel_of, log10_beyond_f
from modcal_core.geometry import Array

FIRST_FLIPS = 39  # trials after which a clear answer is given: their law's location is known to a sixth of its scale
FLIPS = 199  # trials; with the recording itself 200: ranks are steps of half a per cent, beyond them the law speaks
_AS_GOOD = 4  # of the first trials that do as well as the recording: it is noise
_CLEAR = 2e-5  # a hundredth of the chance below which the search believes an effect


def is_clear(best: Array) -> bool:
    """Whether the first trials tell already what all would: an effect beyond doubt, or noise.

    Of n trials a Gumbel law's location is known to 1.05 and its scale to 0.78 over √n of its scale (Johnson, Kotz,
    Balakrishnan, ch. 22). With both three standard deviations on the wrong side the chance must still be a hundredth of
    what counts as significant. Noise it is where so many trials do as well that of an effect worth a further look one
    in 10⁵ recordings would have them (a chance of 0.002: 4 of 39 or more, 1.3e-6).
    """
    noise = best[1:]
    if (noise >= best[0]).sum() >= _AS_GOOD:
        return True
    location, scale = gumbel_of(noise)
    wide = 3.0 / np.sqrt(len(noise))
    return bool(beyond_gumbel(float(best[0]), location + 1.05 * wide * scale, scale * (1.0 + 0.78 * wide)) < _CLEAR)


@lru_cache(maxsize=256)
def score_table(m: int, freedom: int) -> tuple[Array, Array] | None:
    """Shares, and −log10 of the chance that white noise gives a candidate of m new directions one as large.

    None where there is nothing to explain, or nothing left to compare with.
    """
    if not 0 < m < freedom - 1:
        return None
    grid = np.concatenate([np.linspace(0.0, 0.9, 400), 1.0 - np.geomspace(0.1, 1e-9, 300)])
    ratio = grid / m / ((1.0 - grid) / (freedom - m))
    table = -log10_beyond_f(ratio, m, freedom - m)
    # far out the tail underflows; there it is a power of what is left
    bad = ~np.isfinite(table)
    if bad.any():
        last = int(np.argmax(bad)) - 1
        table[bad] = table[last] + 0.5 * (freedom - m) * np.log10((1.0 - grid[last]) / (1.0 - grid[bad]))
    return grid, table


def against_noise(best: Array, candidates: int) -> tuple[float, float]:
    """(p value of the first best score among the others, how much larger those are than of white noise)."""
    if len(best) < 2:
        return 1.0, 1.0
    noise = best[1:]
    location, scale = gumbel_of(noise)
    p_value = beyond_gumbel(float(best[0]), location, scale)
    rank = float((noise >= best[0]).sum() + 1) / (len(noise) + 1)
    # within the trials their own count is the better witness; beyond them the law has to do
    p_value = max(p_value, 1e-300) if best[0] > noise.max() else rank
    return p_value, max(1.0, float(np.median(noise)) / max(np.log10(candidates) - 0.5, 1.0))
