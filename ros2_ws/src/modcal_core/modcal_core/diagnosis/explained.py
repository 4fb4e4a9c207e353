"""What candidates of a few columns each explain, ``nᵀ G⁻¹ n`` with n their products with a residual, G with each other,
and the chance that noise makes as good a best.

Thousands are asked at once, nearly all of one, two or four columns. Scores are −log10 of the chance in white noise. The
best scores of trials with random signs follow an extreme-value law (Gumbel).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from modcal_core.calibration import beyond_gumbel, gumbel_of, log10_beyond_f
from modcal_core.geometry import Array

_ONLY_ROUNDING = 1e-13  # added to what is inverted, so that it can be
# A column is nothing whose square is less of the largest, as where a sample touches the end of a curve's function by
# rounding; and where all are less than that, whose inverse single precision has no number for
_ROUNDING, _NO_SQUARE = 1e-24, 1e-30
_WIDE = 6  # columns; of more, some direction is hardly ever new, and what there is to know is taken apart at once
_MIN_NEW = 0.0025  # share of a candidate's square (5 % of its size) that the fit cannot make by itself
FIRST_FLIPS = 39  # trials after which a clear answer is given: their law's location is known to a sixth of its scale
FLIPS = 199  # trials; with the recording itself 200: ranks are steps of half a per cent, beyond them the law speaks
_AS_GOOD = 4  # of the first trials that do as well as the recording: it is noise
_CLEAR = 2e-5  # a hundredth of the chance below which the search believes an effect


def inverses(gram: Array, own: Array) -> tuple[Array, np.ndarray]:
    """Inverses (C, m, m) of products of columns with each other, and how many directions are new, (C,).

    own: squares of the columns (C, m). Directions that the fit can nearly make by itself are left out.
    """
    least = np.maximum(_ROUNDING * own.max(axis=1, keepdims=True), _NO_SQUARE)
    scale = np.where(own > least, 1.0 / np.sqrt(np.maximum(own, least)), 0.0)
    scaled = gram * scale[:, :, None] * scale[:, None, :]
    # Where all directions are new, which is most often, there is nothing to take apart: the least eigenvalue is no less
    # than one over the size of the inverse.
    C, m, _ = scaled.shape
    if m == 1:
        out = 1.0 / np.maximum(scaled, 1e-300)
        rest = np.flatnonzero(scaled[:, 0, 0] <= _MIN_NEW)
    elif m == 2:
        a, b, d = scaled[:, 0, 0], scaled[:, 0, 1], scaled[:, 1, 1]
        out = np.array([[d, -b], [-b, a]]).transpose(2, 0, 1) / np.maximum(a * d - b * b, 1e-300)[:, None, None]
        rest = np.flatnonzero(0.5 * (a + d) - np.hypot(0.5 * (a - d), b) <= _MIN_NEW)
    elif m == 4:
        with np.errstate(over="ignore", invalid="ignore"):  # of those that are singular
            out = _inverses_of_four(scaled)
            rest = np.flatnonzero(~(np.einsum("cij,cij->c", out, out) < _MIN_NEW**-2))
    elif m > _WIDE:
        out, rest = np.empty_like(scaled), np.arange(C)
    else:
        out = np.asarray(np.linalg.inv(scaled + _ONLY_ROUNDING * np.eye(m)), dtype=float)
        rest = np.flatnonzero(~(np.einsum("cij,cij->c", out, out) < _MIN_NEW**-2))
    sizes = np.full(len(scaled), m)
    value, vector = np.linalg.eigh(scaled[rest])
    keep = value > _MIN_NEW
    part = np.where(keep, 1.0 / np.maximum(value, _MIN_NEW), 0.0)[:, None]
    out[rest], sizes[rest] = (vector * part) @ vector.transpose(0, 2, 1), keep.sum(axis=1)
    return out * scale[:, :, None] * scale[:, None, :], sizes


def _inverses_of_four(scaled: Array) -> Array:
    """Inverses of symmetric matrices (C, 4, 4), block by block; without meaning where they are singular."""
    a, b, d = scaled[:, :2, :2], scaled[:, :2, 2:], scaled[:, 2:, 2:]
    of_a = _inverses_of_two(a)
    ab = _times(of_a, b)
    of_rest = _inverses_of_two(d - _times(b.transpose(0, 2, 1), ab))
    across = -_times(ab, of_rest)
    out = np.empty_like(scaled)
    out[:, :2, :2] = of_a - _times(across, ab.transpose(0, 2, 1))
    out[:, :2, 2:], out[:, 2:, :2], out[:, 2:, 2:] = across, across.transpose(0, 2, 1), of_rest
    return out


def _inverses_of_two(x: Array) -> Array:
    """Inverses of symmetric matrices (C, 2, 2), with _ONLY_ROUNDING added."""
    a, b, d = x[:, 0, 0] + _ONLY_ROUNDING, x[:, 0, 1], x[:, 1, 1] + _ONLY_ROUNDING
    return np.asarray(
        np.array([[d, -b], [-b, a]]).transpose(2, 0, 1) / np.maximum(a * d - b * b, 1e-300)[:, None, None]
    )


def _times(x: Array, y: Array) -> Array:
    """Products of matrices (C, 2, 2): without a call for each of them."""
    return np.asarray(x[:, :, :1] * y[:, :1] + x[:, :, 1:] * y[:, 1:])


def explained(inverse: Array, n: Array) -> Array:
    """``nᵀ inverse n`` of each candidate and trial, (C, trials): inverse (C, m, m), n (C, m, trials)."""
    if n.shape[1] == 1:
        return np.asarray(n[:, 0] ** 2 * inverse[:, 0])
    if n.shape[1] == 2:  # nine in ten: without a product of small matrices for each of them
        out = n[:, 0] * inverse[:, 0, :1]
        out += n[:, 1] * (2.0 * inverse[:, 0, 1:])
        out *= n[:, 0]
        out += n[:, 1] ** 2 * inverse[:, 1, 1:]
        return np.asarray(out)
    return np.asarray(np.einsum("cmf,cmf->cf", inverse @ n, n))


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
