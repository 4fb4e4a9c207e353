"""What the rest of a model depends on: which joint, tool, base or instrument, and on which driver.

Where the verdict is open, a person has to know where to look, whether or not an effect exists for what is wrong. A
*place* is what errs: a joint about its axis, a link in all directions, tool, base, or the instrument. A *driver* is
what the error goes with: the joint's own position, how it arrived, the order of the stations, a load, gravity, a
signal, the distance. For each pair flexible functions of the driver, as motions of the place, are fitted to four fifths
of the stations and predict the rest (ridge). The share of the squares that they predict ranks the pairs; of pairs that
predict nearly as much the one with the fewest functions is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.diagnosis.dependence_pairs import Pair, pairs
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import is_serial_arm

WORTH_NAMING = 0.2  # share of the squared residual that must be predicted
_NEARLY = 0.93  # of the best share; with fewer functions that is plainer
_RIVAL = 0.97  # of the named share; what predicts as much from elsewhere is named beside it
_FOLDS = 5  # of cross-validation; the usual number (Breiman & Spector 1992)
_MIN_NEW = 0.02  # length that must be left of a column without what the parameters could make of it
_FARTHEST = 5.0  # times the median size; no sample may rule alone
_RIDGE = (1e-4, 1e-2, 1.0)  # of the mean square of the columns
_MAX = 400  # samples; more are thinned evenly
_MIN = 15  # stations; with fewer nothing is said
_SMALL = 1e-9  # of the largest column; less is rounding
_HALF = 0.5  # of what lies along one joint's motion, that a driver must predict to be worth naming beside that
_ALONG = 0.6  # share of the squares along one joint's motion beyond chance, from which that joint is named


@dataclass(frozen=True)
class Dependence:
    """place: what errs ("joint elbow", "tool"). driver: what it goes with. share: of the squares that is predicted from
    it at stations that were not fitted, 0 … 1. rivals: other pairs that predict as much.
    """

    place: str
    driver: str
    share: float
    rivals: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Text to follow "what is left ..."."""
        more = f"; as well: {'; '.join(self.rivals)}" if self.rivals else ""
        how = (
            f"correlates with {self.driver}, as an error of {self.place}"
            if self.driver
            else (f"is a constant error of {self.place}")
        )
        return f"{how} ({self.share:.0%} of it{more})"


def dependence(
    model: Model,
    samples: Samples,
    weight: Array,
    fitted: Array | None = None,
    least: float = WORTH_NAMING,
    constant: bool = True,
) -> Dependence | None:
    """What the residual of a model depends on most, None where no pair predicts a good part of it.

    weight: of the six components, (6, N). fitted: derivatives (P, 6, k) by the parameters that were fitted to these
    samples, at those of :func:`asked_of`; None where none were. least: share of the squares that is a good part.
    constant: whether constant errors are looked for, as of an arm that was not fitted to these samples.
    """
    if samples.stations < _MIN or not is_serial_arm(model.chain) or model.instruments:
        return None
    rows = asked_of(samples)
    view = RowView.of(model, samples, model.drivers(samples))
    residual = np.zeros((6, len(samples)))
    residual[:3], residual[3:, view.pose] = view.position, view.rotation
    residual = _drawn_in((residual * weight)[:, rows])
    take = (weight[:, rows] > 0.0).ravel()
    r = residual.ravel()[take]
    whole = float(r @ r)
    out = None
    if fitted is not None:
        out = _orthonormal((fitted * weight[:, rows]).reshape(len(fitted), -1)[:, take])
    r = r if out is None else r - out @ (out.T @ r)
    fold = np.tile(_folds(samples.station[rows]), 6)[take]
    found: list[tuple[float, int, str, str]] = []
    asked: list[tuple[Pair, Array]] = []
    for pair in pairs(model, samples, view, rows, constant=constant):
        X = (pair.columns * weight[:, rows]).reshape(len(pair.columns), -1)[:, take]
        size = np.linalg.norm(X, axis=1)
        asked.append((pair, X[size > _SMALL * max(size.max(initial=0.0), 1e-300)]))
    whole_of = np.concatenate([X for _, X in asked])
    size = np.linalg.norm(whole_of, axis=1)
    if out is not None:
        whole_of = whole_of - (whole_of @ out) @ out.T
    left = np.linalg.norm(whole_of, axis=1)
    ends = np.cumsum([0, *(len(X) for _, X in asked)])
    for (pair, _), first, last in zip(asked, ends, ends[1:], strict=False):
        new = first + np.flatnonzero(left[first:last] > _MIN_NEW * size[first:last])
        if len(new):
            share = _predicted((whole_of[new] / left[new, None]).T, r, fold) / max(whole, 1e-300)
            found.append((share, len(new), pair.place, pair.driver))
    named, moved = _named(found, least), _by_motion(model, view, residual, weight[:, rows], rows)
    if named is None or (moved is not None and named.share < _HALF * moved.share):
        return moved
    return named


def asked_of(samples: Samples) -> np.ndarray:
    """The samples that are asked, (k,): all, or a part of many."""
    return spread_rows(len(samples), _MAX)


def _by_motion(model: Model, view: RowView, residual: Array, weight: Array, rows: np.ndarray) -> Dependence | None:
    """The joint along whose motion most of the residual (6, N) lies, station by station, whatever it goes with.

    A residual that points anywhere lies along a motion by one part in as many as a reading has components.
    """
    size = float(np.sum(residual**2))
    found: list[tuple[float, str]] = []
    for j, name in enumerate(model.chain.names):
        column = view.unit_column(place_index(name, model.chain), 5 if model.chain.revolute[j] else 2)
        motion = np.zeros((6, len(view.samples)))
        motion[:3] = column[: 3 * motion.shape[1]].reshape(3, -1)
        motion[3:, view.pose] = column[3 * motion.shape[1] :].reshape(3, -1)
        motion = motion[:, rows] * weight
        along = np.sum(motion * residual, axis=0) ** 2 / np.maximum(np.sum(motion**2, axis=0), 1e-300)
        found.append((float(along.sum()) / max(size, 1e-300), name))
    found.sort(reverse=True)
    chance = 1.0 / max(float(np.mean(np.sum(weight > 0.0, axis=0))), 1.0)
    share = (found[0][0] - chance) / (1.0 - chance)
    if share < _ALONG:
        return None
    rivals = tuple(f"the same of joint {name}" for one, name in found[1:2] if one > _RIVAL * found[0][0])
    return Dependence(f"joint {found[0][1]}", "nothing that was recorded", share, rivals)


def _named(found: list[tuple[float, int, str, str]], least: float) -> Dependence | None:
    best = max((share for share, *_ in found), default=0.0)
    if best < least:
        return None
    share, _, place, driver = min((f for f in found if f[0] >= _NEARLY * best), key=lambda f: (f[1], -f[0]))
    rivals = [f for f in found if f[0] >= _RIVAL * max(share, best) and f[2] != place]
    rivals.sort(key=lambda f: (f[1], -f[0]))
    return Dependence(place, driver, share, tuple(f"{d or 'a constant error'}, of {p}" for _, _, p, d in rivals[:1]))


def _predicted(X: Array, r: Array, fold: np.ndarray) -> float:
    """The squares of r (R,) that X (R, D) predicts of each fold, fitted to the others, at the best ridge."""
    parts = [(X[fold == k], r[fold == k]) for k in range(_FOLDS)]
    grams, sides = [x.T @ x for x, _ in parts], [x.T @ y for x, y in parts]
    G, g = sum(grams), sum(sides)
    unit = float(np.trace(G)) / len(G)
    best = -np.inf
    for ridge in _RIDGE:
        missed = 0.0
        for (x, y), gram, side in zip(parts, grams, sides, strict=True):
            missed += float(np.sum((y - x @ np.linalg.solve(G - gram + ridge * unit * np.eye(len(G)), g - side)) ** 2))
        best = max(best, float(r @ r) - missed)
    return best


def _folds(station: np.ndarray) -> np.ndarray:
    _, of = np.unique(station, return_inverse=True)
    return np.asarray(np.random.default_rng(0).permutation(of.max() + 1)[of] % _FOLDS)


def _drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    return np.asarray(residual * np.minimum(1.0, _FARTHEST * float(np.median(size)) / np.maximum(size, 1e-300)))


def _orthonormal(J: Array) -> Array:
    """Orthonormal columns (R, P) of the space that rows J (P, R) span."""
    size = np.linalg.norm(J, axis=1, keepdims=True)
    seen = size[:, 0] > 0.0  # a curve's functions that reach to no sample are nothing
    J = J[seen] / size[seen]
    value, vector = np.linalg.eigh(J @ J.T)
    keep = value > 1e-9 * value.max()
    return np.asarray(J.T @ vector[:, keep] / np.sqrt(value[keep]))
