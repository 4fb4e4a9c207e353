"""How wrong the arm's links and the effects nobody named are likely to be, weighed by the readings; draws of the rest.

A value is normal, of a deviation that is a product: its usual size, a common width of its sort (lengths, angles, each
sort of functions), and a factor of what it belongs to (a link, one joint's functions) by which the law becomes
Student's, for one link may be far off. Given all widths and the noise of each kind of reading the law of the values is
closed; given the values, those of the widths and of the noise are: they are drawn in turn (Gibbs sampling, Geman and
Geman 1984). With d the values less those of the calibrated model, D their deviations, and H and g those of
:mod:`neighbourhood`, divided by the squared noise:

    d = D (1 + D H D)⁻¹ (D g − shipped / D) + D (1 + D H D)^(-½) z
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.claim.neighbourhood import FREE, ArmEvidence, Neighbourhood
from modcal_core.geometry import Array

# Common widths of lengths, angles, waves, loads, signs and warps, in usual sizes: log-normal, with a steep end. Most
# joints have none of what functions stand for, and one may have much of it: their law has the wider tails.
USUAL, SPREAD, MOST = np.log([1.4, 1.4, 0.1, 0.3, 0.1, 0.05]), np.log(2.5), np.log(5.6)
_ROUNDING = 1e-9  # of a diagonal, by which a matrix of sums of squares may miss being positive
_STEEP = 50.0  # how they fall off beyond that
FREEDOM = np.array([4.0, 4.0, 2.0, 2.0, 2.0, 2.0])  # of Student's law
_EDGES = np.linspace(np.log(0.01), np.log(20.0), 81)  # logarithms, between which the law of a common width is taken
_WIDTHS = 0.5 * (_EDGES[1:] + _EDGES[:-1])
_SETTLE, _ROUNDS = 30, 120  # until it is forgotten where the rounds began, and those that are drawn from
_WORTH = 1.0  # readings that say that an instrument's noise is as usual


@dataclass(frozen=True)
class Drawn:
    """D draws. values: of the true arm less those of the calibrated model (D, K). open: the part of it that only what
    arms are usually like holds (D, K). scale: the noise of the main kind of each, in units of the fit's (D,). widths:
    in usual sizes (D, K), of free values 1. std: usual deviations of the values (K,), and noise: of kinds, over all.
    """

    values: Array
    open: Array
    scale: Array
    widths: Array
    std: Array
    noise: Array


@dataclass(frozen=True)
class _Round:
    """noise: of each kind (S,). width: of each value (K,). drawn: values (m, K) of this mean (K,)."""

    noise: Array
    width: Array
    mean: Array
    drawn: Array


def draw(about: ArmEvidence, count: int, rng: np.random.Generator) -> Drawn:
    """Draws of what the readings leave possible."""
    each = -(-count // _ROUNDS)
    rounds = list(_rounds(about, each, rng))
    values = np.concatenate([r.drawn for r in rounds])
    mean, width, noise = (
        np.repeat(np.array(parts), each, axis=0)
        for parts in zip(*((r.mean, r.width, r.noise) for r in rounds), strict=True)
    )
    std, usual = about.std * np.exp(np.log(width).mean(axis=0)), np.exp(np.log(noise).mean(axis=0))
    gain, V = np.linalg.eigh(about.equations(usual)[0] * np.outer(std, std))
    V = V[:, gain < 1.0]
    opened = ((values - mean) / std) @ V @ V.T * std
    return Drawn(values, opened, noise[:, about.main], width, std, usual)


def usual_std(about: Neighbourhood) -> Array:
    """Deviations (K,) that values have in usual arms, by the law of the common widths, whatever the readings say."""
    return about.std * np.exp(np.r_[USUAL, 0.0])[about.sort]


def widths_of_links(about: Neighbourhood) -> dict[int, float]:
    """By place the width of its errors that the readings make most likely, on average, in usual errors."""
    logs = np.log(draw(about, _ROUNDS, np.random.default_rng(0)).widths).mean(axis=0)
    places = np.unique(about.place[about.place >= 0])
    return {int(place): float(np.exp(logs[about.place == place].mean())) for place in places}


def _rounds(about: ArmEvidence, each: int, rng: np.random.Generator) -> Iterator[_Round]:
    """The rounds, with so many draws each."""
    expected = np.flatnonzero(about.sort != FREE)
    (sorts, of_sort), (groups, of_group) = (
        np.unique(x[expected], return_inverse=True) for x in (about.sort, about.group)
    )
    freedom = np.ones(len(groups))
    freedom[of_group] = FREEDOM[about.sort[expected]]
    in_sort, in_group = np.bincount(of_sort), np.bincount(of_group)
    common, tail, noise = np.exp(USUAL[sorts]), np.ones(len(groups)), np.ones(len(about.rows))
    width = np.ones(len(about.std))
    prior = -0.5 * ((_WIDTHS - USUAL[sorts, None]) / SPREAD) ** 2
    prior -= _STEEP * np.maximum(_WIDTHS - MOST, 0.0) ** 2
    for k in range(_SETTLE + _ROUNDS):
        width[expected] = common[of_sort] * tail[of_group]
        mean, drawn = _values(about, about.std * width, noise, each if k >= _SETTLE else 1, rng)
        if k >= _SETTLE:
            yield _Round(noise, width.copy(), mean, drawn)
        d = drawn[0]
        square = np.maximum(about.square - 2.0 * about.g @ d + (about.H @ d) @ d, 0.0) + _WORTH * about.usual**2
        noise = np.sqrt(0.5 * square / rng.standard_gamma(0.5 * (about.rows + _WORTH)))
        size = ((d + about.shipped)[expected] / about.std[expected]) ** 2
        in_all = np.bincount(of_group, size / common[of_sort] ** 2)
        tail = np.sqrt(0.5 * (freedom + in_all) / rng.standard_gamma(0.5 * (freedom + in_group)))
        in_all = np.bincount(of_sort, size / tail[of_group] ** 2)
        log = prior - in_sort[:, None] * _WIDTHS - 0.5 * in_all[:, None] * np.exp(-2.0 * _WIDTHS)
        below = np.cumsum(np.exp(log - log.max(axis=1, keepdims=True)), axis=1)
        at = rng.random(len(sorts)) * below[:, -1]
        common = np.exp([np.interp(x, np.r_[0.0, sums], _EDGES) for x, sums in zip(at, below, strict=True)])


def _values(about: ArmEvidence, D: Array, noise: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Mean (K,) and draws (count, K) of the values, given their deviations D and the noise of each kind."""
    H, g = about.equations(noise)
    A = H * np.outer(D, D)
    A.flat[:: len(A) + 1] += 1.0
    root, failed = scipy.linalg.lapack.dpotrf(A, lower=1, clean=1)
    if failed:  # values of which nothing is expected, beside others known to a micrometre: positive but for rounding
        A.flat[:: len(A) + 1] *= 1.0 + _ROUNDING
        root = np.linalg.cholesky(A)
    mean = D * scipy.linalg.lapack.dpotrs(root, D * (g + about.pull) - about.shipped / D, lower=1)[0]
    own = scipy.linalg.lapack.dtrtrs(root, rng.standard_normal((len(D), count)), lower=1, trans=1)[0]
    return mean, mean + (D[:, None] * own).T
