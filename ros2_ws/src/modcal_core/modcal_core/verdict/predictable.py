"""What a regressor that knows no physics predicts of what is left, judged on samples that it was not trained on.

Groups of places with drivers (:mod:`drivers`) are fitted to four fifths of the stations (of blocks of time, where
neighbours in time are neighbours in posture) and predict the rest, for several ways of dealing them: the mean of these
does not hang on one of them. The best group counts; a place with a driver of it says where to look.

What the parameters' own error makes predictable does not count. Where they were fitted to these very samples, they are
fitted once more to all folds but the one that is predicted, and what they could predict is taken out of all columns.
Where the model is frozen, it is left in, and compared with what an error of the size of their covariance would gain.

What noise alone gains is found by giving what is left of whole stations (blocks) random signs, adding a drawn error of
the parameters where the model is frozen, and doing everything again, the choice of the group included (wild bootstrap;
Wu 1986, Liu 1988). How sure the gain itself is, is found by drawing stations again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import block_length, gumbel_of, units_of_stations
from modcal_core.geometry import Array
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.case import Case, derivatives
from modcal_core.verdict.crossfit import FOLDS, Baseline, Layout, Regressor, Ridge, Sparse, principal
from modcal_core.verdict.drivers import Part, PlaceDrivers
from modcal_core.verdict.rest import Rest, rows_asked
from modcal_core.verdict.verdict import MAX_PREDICTABLE, Share

_MAX = 500  # samples; a longer recording is thinned evenly
MIN_STATIONS = 15  # three in each fold; with fewer nothing can be said
_DEALS = 3  # ways of dealing stations to folds
_FLIPS, _FEW = 24, 6  # trials of noise, to which a Gumbel law is fitted; where too little is gained to be sure of it
_DRAWS = 400  # bootstrap samples
_FREE = 1e3  # deviations of the noise by which parameters may be off that were fitted to these very samples
_DOUBT = 2.0  # times; a kept covariance assumes white noise, which an arm that does not repeat has not
_MAX_COLUMNS = 300  # of a group; more are mixed at random, which keeps their products
_NEARLY = 0.93  # of the best share; with fewer functions that is plainer
_RIVAL = 0.97  # of the named share; what predicts as much from elsewhere is named beside it


@dataclass(frozen=True)
class Predictable:
    """What is predictable of a rest.

    both, position, rotation: shares of the squared error of both together (in variances), of position, of orientation;
    None where too few stations are left. source: what predicts it best, as text. rest: what was looked at, less what
    the parameters take in; predicted: of it by the best group, (6, N).
    """

    both: Share | None = None
    position: Share | None = None
    rotation: Share | None = None
    source: str = ""
    rest: Rest | None = None
    predicted: Array | None = None

    @property
    def sure(self) -> bool:
        """Whether a part of the rest is surely predictable."""
        return self.both is not None and self.both.sure


@dataclass(frozen=True)
class Dependence:
    """place: what errs ("joint elbow", "the tool"). driver: what it goes with. share: of the squares that is predicted
    from it at stations that were not fitted, 0 … 1. rivals: other pairs that predict as much.
    """

    place: str
    driver: str
    share: float
    rivals: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Text to follow "what is left ..."."""
        more = f"; as well: {'; '.join(self.rivals)}" if self.rivals else ""
        how = f"correlates with {self.driver}, as an error of {self.place}"
        return f"{how if self.driver else f'is a constant error of {self.place}'} ({self.share:.0%} of it{more})"


class RestStudy:
    """A rest, the units whose noise is independent of the others', and what parameters could make of it.

    free: whether those that were fitted to these very samples may be off; otherwise the model stays as it is.
    """

    def __init__(self, case: Case, rows: np.ndarray, free: bool) -> None:
        self.rest = Rest.of(case, rows)
        samples = self.rest.samples
        stations, rank = units_of_stations(case.samples)
        block = rank[np.searchsorted(stations, samples.station)] // block_length(case.samples)
        self.unit = np.unique(block, return_inverse=True)[1]
        self.J = derivatives(case.model, case.known.parameters, samples)[1] * self.rest.weight
        self.parameters = _parameters(self.J, case)
        self.free = self.parameters[:0]
        if free and case.fitted:  # a curve's functions that reach to no sample are nothing
            self.free = self.parameters[self.parameters.any(axis=(1, 2))]
        elif free and case.refitted:
            J = derivatives(case.model, case.refitted, samples)[1][: len(case.refitted)] * self.rest.weight
            self.free = _FREE * J / np.sqrt(np.einsum("kcn,kcn->k", J, J))[:, None, None]
        self.drivers = PlaceDrivers(self.rest)

    def deals(self) -> list[Baseline]:
        """What is free, prepared for each way of dealing units to folds."""
        count = int(self.unit.max()) + 1
        folds = ((np.random.default_rng(k).permutation(count) % FOLDS)[self.unit] for k in range(_DEALS))
        value, directions = principal(self.free)
        return [Baseline(value, directions, Layout.of(fold, self.rest.weight > 0.0)) for fold in folds]

    def groups(self) -> list[tuple[str, Array]]:
        """Names and columns (D, 6, N) of the groups."""
        found: dict[str, list[Array]] = {}
        for part in (*self.drivers.grouped(), *self.drivers.changed(self.J)):
            found.setdefault(part.group, []).append(part.columns)
        rng = np.random.default_rng(0)
        return [(name, _mixed(np.concatenate(columns), rng)) for name, columns in found.items() if name]


def predictable(case: Case) -> Predictable:
    """The predictable shares of a case; none where too few stations are left.

    A fitted model is judged on all samples that were not rejected, for leaving its parameters out makes them alike; a
    frozen one on those that are scored.
    """
    rows = rows_asked(case, _MAX)
    if case.samples.select(rows).stations < MIN_STATIONS:
        return Predictable()
    study = RestStudy(case, rows, case.fitted)
    groups, waves, deals = study.groups(), list(study.drivers.waves()), study.deals()
    tests: list[list[tuple[str, Regressor]]] = []
    for deal in deals:
        some = [(name, deal.new(columns)) for name, columns in groups]
        few = [(part.group, deal.new(part.columns)) for part in waves]
        tests.append([(name, Ridge(columns, deal)) for name, columns in some if len(columns)])
        tests[-1] += [(name, Sparse(columns, deal)) for name, columns in few if len(columns)]
    return _weighed(study, deals, tests)


def _weighed(study: RestStudy, deals: list[Baseline], tests: list[list[tuple[str, Regressor]]]) -> Predictable:
    """The shares by the best of these regressors, in the mean over all deals."""
    rest, unit = study.rest, study.unit
    predictions: list[list[Array]] = []
    for deal, some in zip(deals, tests, strict=True):
        trials = deal.trials(deal.layout.flat(rest.residual)[:, None])
        left = deal.layout.grid(trials.left[:, 0])
        made = [(name, p) for name, test in some for p in test.predictions(trials)]
        names = [name for name, _ in made]
        predictions.append([deal.layout.grid(p[:, 0]) for _, p in made])
    gains = np.mean([[left**2 - (left - p) ** 2 for p in some] for some in predictions], axis=0)  # (T, 6, N)
    best = int(np.argmax(gains.sum(axis=(1, 2))))
    predicted = np.mean([some[best] for some in predictions], axis=0)
    flips = _FLIPS if gains[best].sum() > MAX_PREDICTABLE * np.sum(left**2) else _FEW
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], (unit.max() + 1, flips))[unit]
    own = study.parameters[: 0 if len(study.free) else None]
    error = np.tensordot(own, rng.normal(size=(len(own), flips)), axes=(0, 0))  # (6, N, flips)
    drawn = (left - predicted)[..., None] * signs + error
    noise = np.mean([_by_noise(deal, some, drawn) for deal, some in zip(deals, tests, strict=True)], axis=0)
    top = noise[:, np.argmax(noise[0], axis=0), np.arange(flips)]  # (3, flips)
    kinds = zip((slice(0, 6), slice(0, 3), slice(3, 6)), top, strict=True)
    both, position, rotation = (
        _share(left[rows], gains[best][rows], unit, by_noise) if rest.weight[rows].any() else None
        for rows, by_noise in kinds
    )
    return Predictable(both, position, rotation, names[best], rest.without(rest.residual - left), predicted)


def _by_noise(deal: Baseline, tests: list[tuple[str, Regressor]], drawn: Array) -> Array:
    """Gains in squares of all, of positions, of orientations (3, T, flips) in residuals (6, N, flips)."""
    layout = deal.layout
    trials = deal.trials(drawn[layout.component, layout.order[layout.sample]])
    moved = layout.component < 3
    out = []
    for _, test in tests:
        for p in test.predictions(trials):
            gain = p * (2.0 * trials.left - p)
            position = gain[moved].sum(axis=0)
            rotation = gain[~moved].sum(axis=0)
            out.append([position + rotation, position, rotation])
    return np.stack(out, axis=1)


def _share(left: Array, gained: Array, unit: np.ndarray, by_noise: Array) -> Share:
    """The share of what is left (c, N) that was gained, (c, N), beyond what noise usually gains.

    unit: what to draw again, (N,). by_noise: gains in squares by noise alone.
    """
    total = np.bincount(unit, np.sum(left**2, axis=0))
    gain = np.bincount(unit, np.sum(gained, axis=0))
    draws = np.random.default_rng(0).integers(len(total), size=(_DRAWS, len(total)))
    whole = max(float(total.sum()), 1e-300)
    location, scale = gumbel_of(by_noise)
    usual = max(float(np.median(by_noise)), 0.0)
    noisy = [location - scale * float(np.log(-np.log(p))) for p in (0.975, 0.99)]
    drawn = (gain[draws].sum(axis=1) - usual) / np.maximum(total[draws].sum(axis=1), 1e-300)
    share = (float(gain.sum()) - usual) / whole
    low = min(float(np.percentile(drawn, 2.5)), (float(gain.sum()) - noisy[0]) / whole)
    lower99 = min(float(np.percentile(drawn, 1.0)), (float(gain.sum()) - noisy[1]) / whole)
    ends = np.clip([share, low, np.percentile(drawn, 97.5), lower99], 0.0, 1.0).tolist()
    return Share(ends[0], (ends[1], max(ends[2], ends[0])), ends[3])


def dependence(case: Case, rows: np.ndarray, least: float, free: bool = True) -> Dependence | None:
    """The place and driver that predict most of the rest at some rows, None if nothing predicts a good part of it.

    least: share of the squares that is a good part. free: whether what was fitted may be off.
    """
    if case.samples.select(rows).stations < MIN_STATIONS or not is_serial_arm(case.model.chain):
        return None
    study = RestStudy(case, rows, free)
    deals = study.deals()
    whole = float(np.sum(study.rest.residual**2))
    trials = [deal.trials(deal.layout.flat(study.rest.residual)[:, None]) for deal in deals]
    found = []
    for part in (*study.drivers.grouped(), *study.drivers.alone(constant=not (case.fitted and free))):
        new = [deal.new(part.columns) for deal in deals] if part.place else []
        if not new or not len(new[0]):
            continue
        gains = [
            [float(np.sum(p * (2.0 * trial.left - p))) for p in Ridge(columns, deal).predictions(trial)]
            for deal, columns, trial in zip(deals, new, trials, strict=True)
        ]
        found.append((float(np.mean(gains, axis=0).max()) / max(whole, 1e-300), len(new[0]), part))
    return _named(found, least)


def _named(found: Sequence[tuple[float, int, Part]], least: float) -> Dependence | None:
    best = max((share for share, *_ in found), default=0.0)
    if best < least:
        return None
    share, _, part = min((f for f in found if f[0] >= _NEARLY * best), key=lambda f: (f[1], -f[0]))
    rivals = [f for f in found if f[0] >= _RIVAL * max(share, best) and f[2].place != part.place]
    also = tuple(
        f"{p.driver or 'a constant error'}, of {p.place}" for *_, p in sorted(rivals, key=lambda f: (f[1], -f[0]))
    )
    return Dependence(part.place, part.driver, share, also[:1])


def _mixed(columns: Array, rng: np.random.Generator) -> Array:
    """Columns (D, 6, N), of very many as many random sums of them."""
    size = np.sqrt(np.einsum("dcn,dcn->d", columns, columns))
    columns = columns[size > 1e-9 * size.max(initial=1e-300)]
    if len(columns) <= _MAX_COLUMNS:
        return columns
    mix = rng.normal(size=(_MAX_COLUMNS, len(columns))) / np.sqrt(_MAX_COLUMNS)
    flat = columns.reshape(len(columns), -1)
    mix = mix / np.sqrt(np.einsum("dr,dr->d", flat, flat))
    return np.asarray((mix @ flat).reshape(-1, *columns.shape[1:]))


def _parameters(J: Array, case: Case) -> Array:
    """Regressors (K, 6, N) of unit variance: the parameters by a square root of their covariance.

    J: their derivatives (K, 6, N) in units of the noise.
    """
    flat = J.reshape(len(J), int(np.prod(J.shape[1:])))
    if case.fitted:
        held = np.array([1.0 / p.prior_std for p in case.known.parameters])
        held = np.r_[held, np.zeros(len(J) - len(held))]  # what the readings hardly show explains nothing
        size = np.sqrt(np.einsum("kr,kr->k", flat, flat) + held**2)
        return _FREE * J / np.maximum(size, 1e-300)[:, None, None]
    value, vector = np.linalg.eigh(case.known.covariance)
    return np.asarray((np.sqrt(_DOUBT * np.maximum(value, 0.0))[:, None] * (vector.T @ flat)).reshape(J.shape))
