"""Has anything changed since the model was trusted?

Every sample's residual is compared with what the model and its covariance expect. For each direction of each place, and
each moment since when it might have moved, the sum of all residuals along that motion is tested (a generalised
likelihood ratio, Willsky & Jones 1976). Two things keep it quiet where nothing happened: one sample can say only so
much, so a glint is no change; and a posture speaks once, by its latest sample, for a model that misses there by a
little does so every time.

Each thing that can happen to a cell is one hypothesis: columns of motions, all zero before the change. The one that
takes most of the residual away, with what its number of columns would take by chance counted against it (Schwarz 1978),
is named, or what outside the arm takes as much away, and with it those that explain nearly as much. It is a suspicion:
the diagnosis decides on more data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import INSTRUMENT, Model, ModelParameter, NoiseModel
from modcal_core.effects import BY_HAND, one_motion, put_back_first
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.online.fixed_linearisation import FixedLinearisation
from modcal_core.robots import payload_wrench

POSTURES = 48  # distinct postures that are remembered
_SAME = 0.03  # rad or m; postures closer than this are one
_MAX_SAID = 6.0  # standard deviations that one sample may say at most
# Of the largest of some thousand sums of squares: 7.7 standard deviations, which no noise reaches, with room for a
# model that misses a little more than it says
ALARM = 60.0
_MIN = 3  # postures that must agree
_MIN_GAP = 0.2  # s between samples of an arm in motion, whose residuals are alike


@dataclass(frozen=True)
class Seen:
    """What the watch remembers of one sample: the row, its residual (6,) and the motions (6, C), both whitened, and the
    motions as they are, in m and rad per unit (6, C).
    """

    sample: Samples
    residual: Array
    motions: Array
    unwhitened: Array

    @property
    def stamp(self) -> float:
        """[s]."""
        return float(self.sample.stamps[0])


class ChangeDetector:
    """Watches the residuals of a model that is trusted."""

    def __init__(
        self, model: Model, parameters: Sequence[ModelParameter], covariance: Array, noise: NoiseModel
    ) -> None:
        """covariance: of the parameters, (P, P); what effects add to it is left out. noise: of the fit."""
        self.model = model
        self.directions = all_directions(model)
        names = {_key(p): i for i, p in enumerate(self.directions)}
        # constants of instruments move nothing that is watched here
        moving = [i for i, p in enumerate(parameters) if p.place != INSTRUMENT]
        self.directions += tuple(p for p in (parameters[i] for i in moving) if _key(p) not in names)
        names = {_key(p): i for i, p in enumerate(self.directions)}
        self._known = np.array([names[_key(parameters[i])] for i in moving], dtype=int)
        self._covariance = covariance[np.ix_(moving, moving)]
        self._noise_model = noise
        self._frozen = FixedLinearisation(model, self.directions, np.zeros(len(self.directions)))
        self.seen: list[Seen] = []
        self.largest = 0.0
        C = len(self.directions)
        self._q, self._b, self._A = np.empty((0, model.chain.n)), np.empty((0, C)), np.empty((0, C))

    def add(self, sample: Samples) -> float | None:
        """Take in one sample; returns the stamp since when something is different, or None."""
        if self.seen and sample.moving[0] and 0.0 <= sample.stamps[0] - self.seen[-1].stamp < _MIN_GAP:
            return None
        new = self._whitened(sample)
        far = np.flatnonzero(np.abs(self._q - sample.q).max(axis=1) > _SAME)[-POSTURES + 1 :]
        self.seen = [*(self.seen[i] for i in far), new]
        said = new.residual * min(1.0, _MAX_SAID / max(float(np.linalg.norm(new.residual)), 1e-300))
        self._q = np.concatenate([self._q[far], sample.q])
        self._b = np.concatenate([self._b[far], said[None] @ new.motions])
        self._A = np.concatenate([self._A[far], np.sum(new.motions**2, axis=0)[None]])
        return self._since()

    def _whitened(self, sample: Samples) -> Seen:
        r, J = self._frozen(sample)
        known_p, known_r = sample.sigma_position[0], sample.sigma_rotation[0]
        variance = np.full(len(r), self._noise_model.position**2 + (known_p**2 if np.isfinite(known_p) else 0.0))
        variance[3:] = self._noise_model.rotation**2 + (known_r**2 if np.isfinite(known_r) else 0.0)
        part = J[:, self._known]
        L = np.linalg.cholesky(part @ self._covariance @ part.T + np.diag(variance))
        residual, motions = np.linalg.solve(L, r), np.linalg.solve(L, J)
        if len(motions) < 6:
            residual, motions = np.r_[residual, np.zeros(3)], np.r_[motions, np.zeros((3, motions.shape[1]))]
        return Seen(sample, residual, motions, J)

    def _since(self) -> float | None:
        if len(self.seen) < _MIN:
            return None
        b, A = np.cumsum(self._b[::-1], axis=0), np.cumsum(self._A[::-1], axis=0)  # newest first
        gain = (b**2 / np.maximum(A, 1e-300))[_MIN - 1 :]
        self.largest = float(gain.max())
        if self.largest < ALARM:
            return None
        suffix = int(np.argmax(gain.max(axis=1))) + _MIN
        return self.seen[-suffix].stamp


def _key(parameter: ModelParameter) -> tuple[int, int, int]:
    return parameter.place, parameter.direction, parameter.frame


def all_directions(model: Model) -> tuple[ModelParameter, ...]:
    """All six directions of every frame, of every place of the arm, and of the tool."""
    frames = [ModelParameter(f"frame {name}/{d}", 0, d, f) for f, name in enumerate(model.frames) for d in range(6)]
    n = model.chain.tool_place
    places = [ModelParameter(f"place {k}/{d}", k, d) for k in range(1, n + 1) for d in range(6)]
    return (*frames, *places)


_AS_GOOD = 10.0  # difference of the criterion below which two hypotheses are not told apart


@dataclass(frozen=True)
class ChangeHypothesis:
    """place, direction, driver: as in reports. since: [s]. size, turn: RMS of how far the tool is moved [m] and turned
    [rad], NaN without orientations. same_as: what would explain it as well. gain: of squared standard deviations that
    it takes away, of ``total``. mistake: what the readings look like instead, and the remedy, where nothing has changed
    but how they are written.
    """

    place: str
    direction: str
    driver: str
    since: float
    size: float
    turn: float
    gain: float
    total: float
    same_as: tuple[str, ...]
    mistake: str = ""

    @property
    def label(self) -> str:
        """Name of the change without its size."""
        return f"{self.place} {self.direction} by {self.driver}"

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        if self.mistake:
            return self.mistake
        text = f"{self.place} ({self.direction}, by {self.driver}) has changed by {1e3 * self.size:.2f} mm"
        if np.isfinite(self.turn):
            text += f" and {np.degrees(self.turn):.3g}°"
        return text + (f"; it may as well be {', '.join(self.same_as)}" if self.same_as else "")


@dataclass(frozen=True)
class _Hypothesis:
    place: str
    direction: str
    driver: str
    columns: Array  # (m, k, 6): whitened motions at m samples
    lengths: Array  # (m, k, 3 or 6): the same in m and rad, of the tool

    @property
    def label(self) -> str:
        return f"{self.place} {self.direction} by {self.driver}"


def find_change(detector: ChangeDetector, since: float) -> ChangeHypothesis:
    """The hypothesis that explains best what the watch has seen since this stamp [s]."""
    seen = [s for s in detector.seen if s.stamp >= since]
    residual = np.stack([s.residual for s in seen])
    total = float(np.sum(residual**2))
    judged = []
    for hypothesis in _hypotheses(detector, seen):
        A = hypothesis.columns.transpose(0, 2, 1).reshape(-1, hypothesis.columns.shape[1])
        values = np.linalg.lstsq(A, residual.ravel(), rcond=1e-8)[0]
        gain = total - float(np.sum((residual.ravel() - A @ values) ** 2))
        moved = np.einsum("mki,k->mi", hypothesis.lengths, values)
        size, turn = (float(np.sqrt(np.mean(np.sum(m**2, axis=1)))) for m in (moved[:, :3], moved[:, 3:]))
        cost = A.shape[1] * np.log(residual.size)
        judged.append((gain - cost, hypothesis, gain, size, turn if moved.shape[1] == 6 else np.nan))
    score = np.array([j[0] for j in judged])
    outside = [j[1].place in (*BY_HAND, *detector.model.frames) for j in judged]
    at = put_back_first(int(np.argmax(score)), outside, 0.5 * np.array([j[2] for j in judged]))
    _, best, gain, size, turn = judged[at]
    as_well = sorted(np.flatnonzero(score > score[at] - _AS_GOOD).tolist(), key=lambda i: -score[i])
    names = one_motion(best.place) if len(detector.model.frames) == 1 or best.place == "tool" else ()
    same = (
        *(f"{name} {best.direction} by {best.driver}" for name in names),
        *(judged[i][1].label for i in as_well if i != at),
    )
    return ChangeHypothesis(best.place, best.direction, best.driver, since, size, turn, gain, total, same)


def _hypotheses(detector: ChangeDetector, seen: Sequence[Seen]) -> Iterator[_Hypothesis]:
    chain = detector.model.chain
    n, F = chain.tool_place, len(detector.model.frames)
    motions = np.stack([s.motions for s in seen])  # (m, 6, C)
    rows = min(len(s.unwhitened) for s in seen)
    lengths = np.stack([s.unwhitened[:rows] for s in seen])  # (m, 3 or 6, C)
    columns = {(p.place, p.direction, p.frame): i for i, p in enumerate(detector.directions)}
    t = np.array([s.stamp for s in seen])
    growing = (t - t[0]) / max(float(np.ptp(t)), 1e-9)

    def of(place: int, directions: Array, scale: Array | None = None, frame: int = -1) -> tuple[Array, Array]:
        """Columns along combinations (k, 6) of a place's directions, times a number for each sample (m,)."""
        index = [columns[place, d, frame] for d in range(6)]
        factor = np.ones(len(seen)) if scale is None else scale
        moved = [np.einsum("mid,kd,m->mki", a[:, :, index], directions, factor) for a in (motions, lengths)]
        return moved[0], moved[1]

    def of_all_frames(directions: Array, scale: Array | None = None) -> tuple[Array, Array]:
        """The same in front of the arm, where every frame has columns of its own."""
        parts = [of(0, directions, scale, f) for f in range(F)]
        return np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)

    every = np.eye(6)
    for driver, scale in (("time (at once)", None), ("time (growing)", growing)):
        yield _Hypothesis("base", "all", driver, *of_all_frames(every, scale))
        yield _Hypothesis("tool", "all", driver, *of(n, every, scale))
        for j, name in enumerate(chain.names):
            k = chain.first_place + j
            along = chain.length_direction(k)
            if along.any() and k > 0:
                yield _Hypothesis(name, "length", driver, *of(k, np.r_[along, np.zeros(3)][None], scale))
            axis = every[[5 if chain.revolute[j] else 2]]
            turned = of(k, axis, scale) if k else of_all_frames(axis, scale)
            yield _Hypothesis(name, "axis", driver, *turned)
        if F > 1:
            for f, name in enumerate(detector.model.frames):
                only = np.array([int(s.sample.frame[0]) == f for s in seen], dtype=float)
                yield _Hypothesis(name, "all", driver, *of(0, every, only if scale is None else only * scale, f))
    load = payload_wrench(chain, np.concatenate([s.sample.q for s in seen]))
    given = []
    for j, name in enumerate(chain.names):
        k, row = chain.first_place + j, 5 if chain.revolute[j] else 2
        axis = every[[row]]
        given.append(of(k, axis, load[j, row]) if k else of_all_frames(axis, load[j, row]))
        yield _Hypothesis(name, "axis", f"load:{name}", *given[-1])
    heaviest = int(np.argmax([np.sum(g[1] ** 2) for g in given]))
    yield _Hypothesis(
        chain.names[heaviest],
        "axis",
        f"load:{chain.names[heaviest]} (and all other joints)",
        np.concatenate([g[0] for g in given], axis=1),
        np.concatenate([g[1] for g in given], axis=1),
    )
