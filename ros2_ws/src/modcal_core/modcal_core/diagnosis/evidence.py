"""How much each candidate effect would explain of what a fit leaves over, and how much pure noise would.

A candidate's columns are the derivatives of the readings with respect to its amplitudes. What the fitted parameters
could still explain is projected out of residual and candidates, so nothing is found that they could have taken up.

Noise is not white in a tracker's frame: a joint that does not repeat throws the tool along its own columns. What can be
relied on is that stations are independent and their noise is as likely to point one way as the other. So the residual
vectors of whole stations are given random signs, everything is scanned again, and the best candidate found in such a
recording of pure noise is noted (wild bootstrap; Wu 1986, Liu 1988). Those maxima follow an extreme-value law (Gumbel),
which gives the chance that noise makes a best as good as the real one, all candidates looked at included.

Every candidate is a direction at a place times numbers, one a sample. So each (place, direction) is contracted with the
residual and with the projector once, and the thousands of candidates that share it cost a product with their numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from modcal_core.calibration.distributions import beyond_gumbel, gumbel_of, log10_beyond_f
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import RowView, linearise
from modcal_core.calibration.noise import Groups
from modcal_core.calibration.runs import independent_unit
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, LENGTH, Effect, columns, place_index
from modcal_core.effects.shapes import PERIODIC, periodic
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

FLIPS = 199  # trials; with the recording itself 200: ranks are steps of half a per cent, beyond them the law speaks
_LEAST_FREEDOM = 20  # rows beyond what is fitted
_AT_ONCE = 256  # candidates; what they explain in all trials then stays near the processor
_FARTHEST = 8.0  # times the median size: noise of any usual tail stays inside, and no sample may rule alone
_LEAST_NEW = 0.0025  # share of a candidate's square (5 % of its size) that the fit cannot make by itself

Key = tuple[int, object]


@dataclass(frozen=True)
class Bank:
    """Candidates whose columns stand at the same places and directions. numbers: (C, m, N)."""

    effects: tuple[Effect, ...]
    keys: tuple[Key, ...]
    numbers: Array


@dataclass(frozen=True)
class Evidence:
    """What C candidates explain. effects: the candidates. explained: share of the residual's squares, (C,). score: how
    unlikely that share would be of white noise, −log10 p, (C,). p_value: that pure noise would have as good a best.
    inflation: how much larger scores of this noise are than those of white noise. freedom: rows beyond what is fitted.
    """

    effects: tuple[Effect, ...]
    explained: Array
    score: Array
    p_value: float
    inflation: float
    freedom: int


@dataclass(frozen=True)
class _Explained:
    """What C candidates of a bank explain. squares: of the residual, (C,). sizes: numbers of new directions, (C,).
    most: by size, the most squares that one of them explains in each trial, (trials,).
    """

    squares: Array
    sizes: np.ndarray
    most: dict[int, Array]


class Scanner:
    """Candidates at certain samples, set up once and weighed against the residual of any fit."""

    def __init__(self, effects: Sequence[Effect], drivers: Drivers) -> None:
        """effects: the candidates. drivers: at the samples they are looked for on."""
        self.drivers = drivers
        self._composed: dict[Key, list[tuple[int, int, Array | float]]] = {}
        groups: dict[tuple[Key, ...], tuple[list[Effect], list[Array]]] = {}
        for alike in _alike(effects):
            keys, numbers = self._factor(alike[0])
            together = numbers[None]
            if len(alike) > 1:
                cycles = np.array([e.shape.settings["cycles"] for e in alike])
                together = periodic(alike[0].shape.kind, cycles, drivers.values(alike[0].driver))
            members = groups.setdefault(keys, ([], []))
            members[0].extend(alike)
            members[1].append(together)
        self.banks = [Bank(tuple(e), keys, np.concatenate(n)) for keys, (e, n) in groups.items()]
        self.unit = independent_unit(drivers.samples)
        self._last: tuple[Fit, Space] | None = None

    def space_of(self, fit: Fit) -> Space:
        """The rows of this fit at the samples."""
        if self._last is None or self._last[0] is not fit:
            self._last = (fit, Space.of(fit, self.drivers))
        return self._last[1]

    def evidence(self, fit: Fit, rng: np.random.Generator | None = None, flips: int = FLIPS) -> Evidence:
        """What each candidate explains of this fit's residual; without rng nothing is said of noise (p_value 1)."""
        space = self.space_of(fit)
        signs = np.ones((1, self.unit.max() + 1))
        if rng is not None:
            signs = np.concatenate([signs, rng.choice([-1.0, 1.0], (flips, self.unit.max() + 1))])
        trials = space.trials(signs[:, self.unit])
        effects: list[Effect] = []
        found: list[_Explained] = []
        for bank in self.banks:
            effects += bank.effects
            found.append(self._explained(bank, space, trials))
        share = np.concatenate([part.squares for part in found]) / trials.total[0]
        size = np.concatenate([part.sizes for part in found])
        score = np.zeros(len(share))
        best = np.zeros(len(signs))
        for m in np.unique(size):
            table = _score_table(int(m), space.freedom)
            if table is not None:
                score[size == m] = np.interp(share[size == m], *table)
                # more explained is a better score: of candidates alike in size only the best in a trial is asked for
                most = np.max([part.most[m] for part in found if m in part.most], axis=0)
                best = np.maximum(best, np.interp(most / trials.total, *table))
        p_value, inflation = _against_noise(best, len(effects))
        return Evidence(tuple(effects), share, score, p_value, inflation, space.freedom)

    def enough(self, fit: Fit) -> bool:
        """Whether the samples leave rows enough beyond what is fitted to say anything."""
        return self.space_of(fit).freedom >= _LEAST_FREEDOM

    def amplitudes(self, fit: Fit, effect: Effect) -> Array:
        """The amplitudes with which an effect explains most of this fit's residual, (m,)."""
        keys, numbers = self._factor(effect)
        space = self.space_of(fit)
        bank = Bank((effect,), keys, numbers[None])
        n, gram = self._products(bank, space, space.trials(np.ones((1, len(self.drivers))))), self._gram(bank, space)
        own = np.einsum("cii->ci", gram)[0]
        scale = np.where(own > 1e-12 * own.max(initial=1e-300), np.sqrt(np.abs(own)), np.inf)  # no sample, no amplitude
        solution = np.linalg.lstsq(gram[0] / np.outer(scale, scale), n[0, :, 0] / scale, rcond=1e-4)[0]
        return np.asarray(solution / scale)

    def _factor(self, effect: Effect) -> tuple[tuple[Key, ...], Array]:
        """The directions at places of an effect's columns, and their numbers (m, N)."""
        terms = columns(effect, self.drivers)
        if all(len(t) == 1 for t in terms):
            return tuple((t[0].place, t[0].direction) for t in terms), np.stack([t[0].size for t in terms])
        if effect.direction == LENGTH:
            k = place_index(effect.place, self.drivers.arm.chain)
            along = self.drivers.arm.chain.length_direction(k)
            key: Key = (k, LENGTH)
            self._composed[key] = [(k, d, float(along[d])) for d in range(3)]
            basis = effect.shape.basis(self.drivers.values(effect.driver, effect.lag))
            return (key,) * len(basis), basis
        keys: list[Key] = []
        for i, several in enumerate(terms):
            own = f" {i} {sorted(effect.shape.settings.items())}" if len(terms) > 1 else ""
            keys.append((several[0].place, effect.direction + effect.driver + own))
            self._composed[keys[-1]] = [(t.place, t.direction, t.size) for t in several]
        return tuple(keys), np.ones((len(keys), len(self.drivers)))

    def _column(self, key: Key, space: Space) -> Array:
        if key not in space.columns:
            parts = self._composed.get(key) or [(key[0], int(key[1]), 1.0)]  # type: ignore[call-overload]
            space.columns[key] = np.sum([space.column(k, d) * share for k, d, share in parts], axis=0)
        return space.columns[key]

    def _explained(self, bank: Bank, space: Space, trials: _Trials) -> _Explained:
        """What the candidates of a bank explain."""
        gram = self._gram(bank, space)
        own = np.einsum("caN,aN->ca", bank.numbers**2, self._squares(bank, space))
        scale = 1.0 / np.sqrt(np.maximum(own, 1e-300))
        value, vector = np.linalg.eigh(gram * scale[:, :, None] * scale[:, None, :])
        keep = value > _LEAST_NEW
        scaled = vector * scale[:, :, None]
        part = np.where(keep, 1.0 / np.maximum(value, _LEAST_NEW), 0.0)[:, None]
        inverse = (scaled * part) @ scaled.transpose(0, 2, 1)
        sizes = keep.sum(axis=1)
        squares = np.empty(len(bank.numbers))
        most = {int(m): np.zeros(len(trials.signs)) for m in np.unique(sizes)}
        for first in range(0, len(bank.numbers), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            explained = _quadratic(inverse[rows], self._products(bank, space, trials, rows))
            squares[rows] = explained[:, 0]
            for m, so_far in most.items():
                alike = sizes[rows] == m
                if alike.all():
                    np.maximum(so_far, explained.max(axis=0), out=so_far)
                elif alike.any():
                    np.maximum(so_far, explained[alike].max(axis=0), out=so_far)
        return _Explained(squares, sizes, most)

    def _squares(self, bank: Bank, space: Space) -> Array:
        return np.stack([np.sum(self._column(key, space) ** 2, axis=0) for key in bank.keys])

    def _against(self, key: Key, space: Space) -> Array:
        """Contraction, sample by sample, of a column with the projector, (N, P)."""
        if key not in space.against:
            space.against[key] = np.einsum("cN,cNp->Np", self._column(key, space), space.Q)
        return space.against[key]

    def _products(self, bank: Bank, space: Space, trials: _Trials, rows: slice = slice(None)) -> Array:
        """Products with the trials (C, m, trials) of some of its candidates, the fitted projected out."""
        for key in bank.keys:
            if key not in trials.known:
                trials.known[key] = trials.seen_by(self._column(key, space), self._against(key, space))
        return _contracted(bank.numbers[rows], [trials.known[key] for key in bank.keys])

    def _gram(self, bank: Bank, space: Space) -> Array:
        """Products of each candidate's columns with each other (C, m, m), the fitted projected out."""
        m = len(bank.keys)
        projected = _contracted(bank.numbers, [self._against(key, space) for key in bank.keys])  # (C, m, P)
        if len(set(bank.keys)) == 1:
            square = np.sum(self._column(bank.keys[0], space) ** 2, axis=0)
            gram = (bank.numbers * square) @ bank.numbers.transpose(0, 2, 1)
        else:
            gram = np.empty((len(bank.effects), m, m))
            for a in range(m):
                for b in range(a, m):
                    both = self._column(bank.keys[a], space) * self._column(bank.keys[b], space)
                    numbers = bank.numbers[:, b] * np.sum(both, axis=0)
                    gram[:, a, b] = gram[:, b, a] = np.einsum("cN,cN->c", bank.numbers[:, a], numbers)
        return np.asarray(gram - projected @ projected.transpose(0, 2, 1))


def _contracted(numbers: Array, by: Sequence[Array]) -> Array:
    """Numbers (C, m, N) times one matrix (N, k) for each of the m, (C, m, k)."""
    if all(matrix is by[0] for matrix in by):
        return np.asarray((numbers.reshape(-1, numbers.shape[-1]) @ by[0]).reshape(*numbers.shape[:2], -1))
    return np.stack([numbers[:, a] @ matrix for a, matrix in enumerate(by)], axis=1)


def _quadratic(inverse: Array, n: Array) -> Array:
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


def _alike(effects: Sequence[Effect]) -> Iterable[list[Effect]]:
    """The effects in lists: those that repeat along one driver and differ in their cycles alone are set up at once.

    Nine in ten candidates are of that kind.
    """
    lists: dict[object, list[Effect]] = {}
    for i, effect in enumerate(effects):
        repeats = effect.shape.kind in PERIODIC and effect.direction == AXIS
        key = (effect.place, effect.driver, effect.shape.kind) if repeats else i
        lists.setdefault(key, []).append(effect)
    return lists.values()


@dataclass(frozen=True)
class _Trials:
    """The residual with the signs of each trial, (6, N) by signs (trials, N), what is fitted projected out.

    seen: products of the signed residual with the projector, (trials, P). total: squares left, (trials,).
    """

    residual: Array
    signs: Array
    seen: Array
    total: Array
    known: dict[Key, Array] = field(default_factory=dict)

    def seen_by(self, column: Array, against: Array) -> Array:
        """Contraction, sample by sample, of a column (6, N) with the trials, (N, trials)."""
        own = np.sum(column * self.residual, axis=0)
        return np.asarray(own[:, None] * self.signs.T - against @ self.seen.T)


@dataclass(frozen=True)
class Space:
    """Weighted residual and columns, sample by sample: (6, N), rows 3 … 5 zero where there is no orientation.

    Q: orthonormal columns of all that is fitted, (6, N, P). Parameters are held by their priors, as extra rows that ask
    each to stay and are left out here: without them a direction that the readings hardly show would explain anything.
    """

    view: RowView
    weight: Array
    residual: Array
    Q: Array
    freedom: int
    columns: dict[Key, Array] = field(default_factory=dict)
    against: dict[Key, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Fit, drivers: Drivers) -> Space:
        """Those of a fit at these drivers' samples."""
        samples = drivers.samples
        weight = sample_weights(fit, samples)
        values = np.concatenate([np.zeros(len(fit.parameters)), *(e.values for e in fit.model.effects)])
        now = linearise(fit.model, fit.parameters, values, samples, drivers=drivers)
        view = RowView.of(fit.model, samples, drivers)
        J = np.empty((6, len(samples), len(now.J)))  # of a frozen model without effects nothing is fitted
        for p, row in enumerate(now.J):
            J[..., p] = _by_sample(row, view) * weight
        held = np.zeros(J.shape[-1])
        held[: len(fit.parameters)] = [1.0 / p.prior_std for p in fit.parameters]
        N, P = len(samples), J.shape[-1]
        Q = _orthonormal(J.reshape(6 * N, P), held).reshape(6, N, P)
        residual = _drawn_in(_by_sample(now.residual, view) * weight)
        # What the training set got wrong of the fitted lies in its own columns: it must not be given signs, or it would
        # join the noise and hide how uneven that is.
        residual = residual - Q @ np.einsum("cNp,cN->p", Q, residual)
        rows = Groups.of(samples, bool(fit.model.instruments)).rows
        return cls(view, weight, residual, Q, round(rows) - round(float(np.sum(Q**2))))

    def column(self, place: int, direction: int) -> Array:
        """Motion of the tool per unit of a direction at a place, weighted, (6, N)."""
        return _by_sample(self.view.unit_column(place, direction), self.view) * self.weight

    def trials(self, signs: Array) -> _Trials:
        """The residual under signs (trials, N)."""
        seen = signs @ np.einsum("cNp,cN->Np", self.Q, self.residual)
        return _Trials(self.residual, signs, seen, np.sum(self.residual**2) - np.sum(seen**2, axis=1))


def sample_weights(fit: Fit, samples: Samples) -> Array:
    """Inverse standard deviations of the readings, (6, N)."""
    position = np.sqrt(fit.noise.of(samples) ** 2 + np.nan_to_num(samples.sigma_position) ** 2)
    rotation = np.sqrt(fit.noise.rotation**2 + np.nan_to_num(samples.sigma_rotation) ** 2)
    return np.concatenate([np.tile(1.0 / position, (3, 1)), np.tile(1.0 / rotation, (3, 1))])


def _orthonormal(J: Array, held: Array) -> Array:
    """Orthonormal columns of J (m, P) with the rows diag(held) below it, those rows left out again, (m, P)."""
    size = np.maximum(np.sqrt(np.einsum("ij,ij->j", J, J) + held**2), 1e-300)
    J, held = J / size, held / size
    L = np.linalg.cholesky(J.T @ J + np.diag(held**2 + 1e-12))
    return np.asarray(solve_triangular(L, J.T, lower=True, check_finite=False).T)


def _drawn_in(residual: Array) -> Array:
    """The residual (6, N) with samples beyond several times the usual size brought in to there."""
    size = np.linalg.norm(residual, axis=0)
    limit = _FARTHEST * float(np.median(size))
    return residual * np.minimum(1.0, limit / np.maximum(size, 1e-300))


def _by_sample(row: Array, view: RowView) -> Array:
    """A row of a linearisation, (3 N + 3 M,), as (6, N)."""
    N = view.position.shape[1]
    out = np.zeros((6, N))
    out[:3] = row[: 3 * N].reshape(3, N)
    out[3:, view.pose] = row[3 * N :].reshape(3, -1)
    return out


def _score_table(m: int, freedom: int) -> tuple[Array, Array] | None:
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


def _against_noise(best: Array, candidates: int) -> tuple[float, float]:
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
