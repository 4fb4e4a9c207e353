"""What it may be that has changed: a first answer from the few samples since, for a person and for the diagnosis.

Each thing that can happen to a cell is one hypothesis: columns of motions, all zero before the change. The one that
takes most of the residual away, with what its number of columns would take by chance counted against it (Schwarz 1978),
is named, and with it those that explain nearly as much. It is a suspicion: the diagnosis decides on more data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.online.change_detector import ChangeDetector, Seen
from modcal_core.robots.mechanism import payload_wrench

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
    judged.sort(key=lambda j: -j[0])
    score, best, gain, size, turn = judged[0]
    rivals = tuple(h.label for s, h, *_ in judged[1:] if s > score - _AS_GOOD)
    return ChangeHypothesis(best.place, best.direction, best.driver, since, size, turn, gain, total, rivals)


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
            if k > 0:
                yield _Hypothesis(name, "axis", driver, *of(k, axis, scale))
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
