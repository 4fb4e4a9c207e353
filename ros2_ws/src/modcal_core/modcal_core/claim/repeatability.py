"""What joints do not repeat, told from what an instrument misses, by where and along what readings scatter.

An instrument scatters alike everywhere; a joint scatters more where the arm is stretched out, and across it. What is
left at a station is e + Σ motion_j n_j: e of the instrument's size s, n_j of that of its joint: c, that all joints
have, beside o_j of its own, for gears are worn and models fail at single joints. These sizes are as usual or not, by
Student's law of their logarithms, and s² + square c² is 1, square being what joints move readings by. They are drawn in
turn, whatever joints missed and however large all of it is (collapsed Gibbs sampling); then what joints missed.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array

_USUAL, _USUAL_OWN = 1.5e-5, 4e-6  # rad; how well joints repeat, an arm of 1 m to some 0.02 mm, and one beyond others
_SPREAD = np.log(2.0)  # of the logarithms of sizes about usual ones
_SHARES = np.linspace(0.05, 0.99, 16) ** 2  # that all joints may have
_OWN = _USUAL_OWN * np.geomspace(0.1, 500.0, 121)
_SETTLE, _ROUNDS = 10, 40  # until it is forgotten where the rounds began, and those that are drawn from


def missed_by_joints(motions: Array, left: Array, equations: float, usual: float, rng: np.random.Generator) -> Array:
    """Draws of what J joints missed at N stations, (R, N, J) [rad, m], where the scatter as a whole is 1.

    motions: of readings per rad or m (N, J, d). left: what they miss (N, d), to a common factor. Both are 0 along what
    is not read. equations: how many rows have a reading. usual: what such instruments miss.
    """
    read = motions.any(axis=(0, 1)) | left.any(axis=0)
    motions, left = motions[..., read], left[..., read, None]
    (N, J, d), out = motions.shape, []
    square, share = max(float((motions**2).sum()) / equations, 1e-300), _SHARES[:, None, None, None]
    alike = (1.0 - share) * np.eye(d) + share / square * (np.swapaxes(motions, 1, 2) @ motions)
    blind = (N * d - equations) * np.log(1.0 - _SHARES)
    prior = _prior(np.sqrt(1.0 - _SHARES) / usual) + _prior(np.sqrt(_SHARES / square) / _USUAL)
    prior -= 0.5 * np.log(_SHARES) + np.log(1.0 - _SHARES) - 0.5 * blind
    own = np.full(J, _USUAL_OWN)
    for k in range(-_SETTLE, _ROUNDS):
        spread = alike + np.swapaxes(motions * own[:, None] ** 2, 1, 2) @ motions
        missed = np.maximum((left * np.linalg.solve(spread, left)).sum(axis=(1, 2, 3)), 1e-300)
        i = _drawn(prior - 0.5 * (np.linalg.slogdet(spread)[1].sum(axis=1) + equations * np.log(missed)), rng)
        here = spread[i]
        for j in range(J):
            m = motions[:, j, :, None]
            rest = here - own[j] ** 2 * m @ np.swapaxes(m, 1, 2)
            both = np.linalg.solve(rest, np.concatenate([m, left], axis=2))
            a, b = np.moveaxis((both * m).sum(axis=1), 1, 0)
            seen = np.outer(_OWN**2, a)
            missed = (both[..., 1:] * left).sum() - _OWN**2 * ((1.0 / (1.0 + seen)) @ b**2)
            told = np.log1p(seen).sum(axis=1) + equations * np.log(np.maximum(missed, 1e-300))
            own[j] = _OWN[_drawn(_prior(_OWN / _USUAL_OWN) - 0.5 * told, rng)]
            here = rest + own[j] ** 2 * m @ np.swapaxes(m, 1, 2)
        if k >= 0:
            size = _SHARES[i] / square + own**2
            scale = float(np.sqrt(max((left * np.linalg.solve(here, left)).sum() / equations, 1e-300)))
            n, e = np.sqrt(size) * rng.standard_normal((N, J)), rng.standard_normal((N, d, 1))
            short = left / scale - np.sqrt(1.0 - _SHARES[i]) * e - np.swapaxes(motions, 1, 2) @ n[..., None]
            out.append(scale * (n + size * (motions @ np.linalg.solve(here, short))[..., 0]))
    return np.array(out) / np.sqrt(max((left**2).sum() / equations, 1e-300))


def _prior(size: Array) -> Array:
    """How likely sizes are, in usual ones, in logs."""
    return np.asarray(-1.5 * np.log1p(0.5 * (np.log(size) / _SPREAD) ** 2))


def _drawn(log: Array, rng: np.random.Generator) -> int:
    """A number of one of these, as likely as they say."""
    below = np.cumsum(np.exp(log - log.max()))
    return int(np.searchsorted(below, rng.random() * below[-1], side="right"))
