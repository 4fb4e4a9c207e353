"""How wrong the arm's links and the effects nobody named are likely to be, weighed by the readings; draws of the rest.

Values of which nothing is expected are put where they suit best (a Schur complement). Of the others, with H and g of
:mod:`neighbourhood` and D their widths in units of the noise s, the evidence is closed (MacKay 1992):

    log p = −m log s − ½ log|I + M| − ½ (yᵀy − gᵀ x) / s²,   M = D H D,   x = D (I + M)⁻¹ D g

For a given ratio of the widths of links and of functions, one set of eigenvectors of M serves every width and every s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.claim.neighbourhood import ARM, FREE, Neighbourhood
from modcal_core.geometry import Array

WIDTHS = np.geomspace(0.1, 10.0, 14)  # of links, in units of the noise s
RATIOS = np.geomspace(0.02, 5.0, 7)  # of the width of functions to that of links
# widths of links, and of functions beside them: log-normal, the first cut off
USUAL, SPREAD, MOST = np.log(1.4), np.log(2.5), 5.6
UNNAMED_USUAL, UNNAMED_SPREAD = np.log(0.7), np.log(3.0)
_STEEP = 50.0  # how the law of links falls off beyond that
FREEDOM = 4.0  # of Student's law, by which links are off
_AROUND = np.linspace(-2.4, 2.4, 7)  # deviations of log s about its best


@dataclass(frozen=True)
class Drawn:
    """D draws. values: of the true arm less those of the calibrated model (D, K). open: the part of it that only what
    arms are usually like holds (D, K). scale: the noise of each, in units of the fit's (D,). width: of links (D,).
    """

    values: Array
    open: Array
    scale: Array
    width: Array


@dataclass(frozen=True)
class _Expected:
    """The values of which something is expected, the others put where they suit best. rows: of them, and of the others.
    H, g, square: of the former. root: of (H of the free + their priors)⁻¹, lower. response: of the free to the former.
    """

    rows: np.ndarray
    free: np.ndarray
    H: Array
    g: Array
    square: float
    root: Array
    response: Array
    alone: Array
    pull: Array


@dataclass(frozen=True)
class _Weighed:
    """share: how likely, (ratios, widths, scales). scales: of the noise there. parts: for each ratio the sizes D, and
    eigenvalues, eigenvectors and what the readings say along them. tail: of each value, how much wider its place is.
    """

    share: Array
    scales: Array
    parts: list[tuple[Array, Array, Array, Array]]
    tail: Array


def _weighed(about: Neighbourhood, of: _Expected) -> _Weighed:
    """The evidence. A link that is far off is one that has a width of its own, by what a first look says of its values
    (an expectation step for links by Student's law).
    """
    first = _by_width(about, of, RATIOS[::3], np.ones(len(of.rows)))
    r, w, k = np.unravel_index(int(first.share.argmax()), first.share.shape)
    (_, mu, V, seen), s = first.parts[r], float(first.scales[r, w, k])
    gain = WIDTHS[w] ** 2 * mu
    mean = V @ (WIDTHS[w] * seen / (1.0 + gain)) / s
    square = mean**2 + (V**2 / (1.0 + gain)).sum(axis=1)
    place = about.place[of.rows]
    tail = np.ones(len(of.rows))
    for one in np.unique(place[place >= 0]):
        here = place == one
        tail[here] = np.sqrt((FREEDOM + square[here].sum()) / (FREEDOM + here.sum()))
    return _by_width(about, of, RATIOS, tail)


def _by_width(about: Neighbourhood, of: _Expected, ratios: Array, tail: Array) -> _Weighed:
    arm = about.kind[of.rows] == ARM
    ratios = ratios if not arm.all() else ratios[:1]
    left = max(about.rows - len(of.free), 1.0)
    log = np.full((len(ratios), len(WIDTHS), len(_AROUND)), -np.inf)
    scales, parts = np.ones_like(log), []
    for r, ratio in enumerate(ratios):
        D = about.std[of.rows] * np.where(arm, tail, ratio)
        mu, V = np.linalg.eigh(of.H * np.outer(D, D))
        mu, seen = np.maximum(mu, 0.0), V.T @ (D * of.g)
        parts.append((D, mu, V, seen))
        gain = WIDTHS[:, None] ** 2 * mu
        square = np.maximum(of.square - (WIDTHS[:, None] ** 2 * seen**2 / (1.0 + gain)).sum(axis=1), 1e-9)
        s = np.sqrt(square / left)[:, None] * np.exp(_AROUND / np.sqrt(2.0 * left))
        links = np.log(WIDTHS[:, None] * s)
        prior = -0.5 * ((links - USUAL) / SPREAD) ** 2
        if len(ratios) > 1:
            prior -= 0.5 * ((links + np.log(ratio) - UNNAMED_USUAL) / UNNAMED_SPREAD) ** 2
        told = -left * np.log(s) - 0.5 * np.log1p(gain).sum(axis=1)[:, None] - 0.5 * square[:, None] / s**2
        log[r] = told + prior - _STEEP * np.maximum(links - np.log(MOST), 0.0) ** 2
        scales[r] = s
    share = np.exp(log - log.max())
    return _Weighed(share / share.sum(), scales, parts, tail)


def widths_of_links(about: Neighbourhood) -> dict[int, float]:
    """By place the width of its errors that the readings make most likely, on average, in usual errors."""
    of = _expected(about)
    place = about.place[of.rows]
    if not (place >= 0).any():
        return {}
    told = _weighed(about, of)
    width = float(np.exp((told.share * np.log(WIDTHS[:, None] * told.scales)).sum()))
    return {int(one): width * float(told.tail[place == one][0]) for one in np.unique(place[place >= 0])}


def draw(about: Neighbourhood, count: int, rng: np.random.Generator) -> Drawn:
    """Draws of what the readings leave possible."""
    of = _expected(about)
    told = _weighed(about, of)
    share, scales, parts = told.share, told.scales, told.parts
    counts = rng.multinomial(count, share.ravel())
    K = len(about.kind)
    values, opened, scale, width = np.zeros((count, K)), np.zeros((count, K)), np.zeros(count), np.zeros(count)
    first = 0
    for index in np.flatnonzero(counts):
        r, w, k = np.unravel_index(index, share.shape)
        (D, mu, V, seen), s, some = parts[r], float(scales[r, w, k]), slice(first, first + int(counts[index]))
        first, D = some.stop, D * WIDTHS[w]
        gain = WIDTHS[w] ** 2 * mu
        z = rng.standard_normal((int(counts[index]), len(mu))) * (s / np.sqrt(1.0 + gain))
        mean = WIDTHS[w] * (seen + s**2 * (V.T @ (parts[r][0] * of.pull))) / (1.0 + gain)
        values[some, of.rows] = ((mean + z) @ V.T) * D
        opened[some, of.rows] = (np.where(gain < 1.0, z, 0.0) @ V.T) * D
        scale[some], width[some] = s, WIDTHS[w] * s
    own = (rng.standard_normal((count, len(of.free))) * scale[:, None]) @ of.root.T
    values[:, of.free] = of.alone + own - values[:, of.rows] @ of.response.T
    opened[:, of.free] = -opened[:, of.rows] @ of.response.T
    return Drawn(values - about.shipped, opened, scale, width)


def _expected(about: Neighbourhood) -> _Expected:
    free, rows = np.flatnonzero(about.kind == FREE), np.flatnonzero(about.kind != FREE)
    H, g = about.H, about.g
    if not len(free):
        empty = np.zeros((0, 0))
        return _Expected(rows, free, H, g, about.square, empty, np.zeros((0, len(rows))), np.zeros(0), about.pull)
    unit = about.std[free]
    A = H[np.ix_(free, free)] * np.outer(unit, unit)
    A.flat[:: len(A) + 1] += 1.0
    lower = np.linalg.cholesky(A)
    half = scipy.linalg.solve_triangular(lower, unit[:, None] * np.c_[H[np.ix_(free, rows)], g[free]], lower=True)
    root = unit[:, None] * scipy.linalg.solve_triangular(lower, np.eye(len(free)), lower=True).T
    solved = root @ half
    return _Expected(
        rows,
        free,
        H[np.ix_(rows, rows)] - half[:, :-1].T @ half[:, :-1],
        g[rows] - half[:, :-1].T @ half[:, -1],
        about.square - float(half[:, -1] @ half[:, -1]),
        root,
        solved[:, :-1],
        solved[:, -1],
        about.pull[rows] - solved[:, :-1].T @ about.pull[free],
    )
