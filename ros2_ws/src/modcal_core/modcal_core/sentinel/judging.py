"""Which change explains later recordings, since when, and is it sure?

Hypotheses, their prices and the prior of their sizes are those of ``moves``: the mean over all changes, and over the
recordings that each may have begun with, of how much more probable they make what was recorded is an e-value. It is
tempered: to the power at which no reference recording, each judged by the others, shows more than as many of them do by
chance (Markov). The limit aims at one false name in a hundred hours of recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from scipy.special import log_ndtr

from modcal_core.geometry import Array
from modcal_core.moves import AS_PROBABLE, KINDS, SIZES, JudgedChange, SizeFound, by_name, e_value, log_priors
from modcal_core.sentinel.cells import Cells
from modcal_core.sentinel.channels import ChangeColumns, candidates
from modcal_core.sentinel.normal import Moments, Normal, Spoken, spoken_since

AN_HOUR = 0.01  # false alarms
SHORTEST = 60.0  # s: a shorter recording counts as this long
NEWEST = 50  # recordings that are judged together; a change that began before them is in all of them
_SIZES = 4.0 * SIZES  # standard deviations of what all cells together say, from 2 to 4000
_MOST = 2  # changes at once
_STATIONS = 10  # as many as a check asks for
_OCCAM = float(np.log(len(_SIZES)) + 0.5 * np.log1p(_SIZES[1] ** 2))  # nats for one size of which nothing is known
_95 = 1.959964
_DATES = 1e9  # s; a simulation's clock begins at zero
_BENT = 0.01  # of a change's evidence: columns are linear, and a tenth of a large change's course is another one
_OFTEN = 1.645  # standard deviations: in 95 of 100 cases
_UNSEEN = 1e-9  # of the largest square: a sum of columns that nothing shows
_FARTHEST = {"mrad": 350.0, "ppm": 2e5}  # sizes beyond which it is not said that a change would have been noticed


@dataclass(frozen=True)
class ChangeEstimate:
    """A change. label, sentence: for people. since: the recording that it began with, or the first and the last that it
    may have. probability: that it is this one of all. same_as: labels of what explains the recordings as well.
    """

    kind: str
    place: str
    label: str
    sentence: str
    since: str
    sizes: tuple[SizeFound, ...]
    probability: float
    same_as: tuple[str, ...]


@dataclass(frozen=True)
class BagValues:
    """One recording by itself. share: of its cells that are inside what the reference covers. values: size and standard
    deviation of single changes [people's units], by label.
    """

    name: str
    began: float
    reference: bool
    share: float
    values: Mapping[str, tuple[str, float, float]]


@dataclass(frozen=True)
class ArmVerdict:
    """status: "unchanged", "changed" or "cannot_tell". log_e [nats], asked: what a change needs. noticed: by label, the
    size that would have been noticed in 95 of 100 cases, and its unit. unseen: changes that these signals do not show.
    untold: signals outside the reference. stations (10, n): postures of these recordings that are farthest apart, to
    measure when something has changed.
    """

    status: str
    changes: tuple[ChangeEstimate, ...]
    bags: tuple[BagValues, ...]
    log_e: float
    asked: float
    weight: float
    noticed: Mapping[str, tuple[float, str]]
    unseen: tuple[str, ...]
    untold: tuple[str, ...]
    hours: float
    stations: Array
    joints: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The answer."""
        if self.status == "cannot_tell":
            return "Cannot tell: the last recording shows nothing that the reference period covers."
        if not self.changes:
            return f"Nothing has changed that {60.0 * self.hours:.0f} minutes of recordings would show."
        return " ".join(change.sentence for change in self.changes)


@dataclass(frozen=True)
class _Asked:
    """Candidates with their columns as sums (K, k) of named ones, their log priors (H,), and joints that slide."""

    candidates: Sequence[ChangeColumns]
    sums: Sequence[Array]
    log_prior: Array
    sliding: frozenset[str]

    @classmethod
    def of(cls, normal: Normal, names: Sequence[str]) -> _Asked:
        every = candidates(normal.arm, names, normal.shares)
        sums = [np.array([[c.get(name, 0.0) for c in one.columns] for name in names]) for one in every]
        chain, names = normal.arm.chain, normal.arm.names
        sliding = frozenset(n for j, n in enumerate(names) if chain is not None and not chain.revolute[j])
        return cls(every, sums, log_priors([one.change for one in every]), sliding)

    def unit(self, h: int, unit: str) -> str:
        """The unit of a candidate's size: of a sliding joint a length."""
        return unit.replace("mrad", "mm") if self.candidates[h].change.place in self.sliding else unit

    def alone(self, h: int, said: Spoken) -> tuple[float, float]:
        """Information on the one size of a candidate, and its estimate."""
        B = self.sums[h]
        A = (B.T @ said.information @ B).item()
        return A, (B.T @ said.vector).item() / max(A, 1e-300)

    def judged(self, said: Spoken, taken: Sequence[int] = ()) -> list[JudgedChange]:
        """The Bayes factor of each candidate, beside those of these numbers of whatever size."""
        left = _without(said, [self.sums[h] for h in taken])
        each, information = zip(self.candidates, self.sums, strict=True), said.information
        return [_judged(c, B.T @ left.information @ B, B.T @ information @ B, B.T @ left.vector) for c, B in each]


def _judged(candidate: ChangeColumns, A: Array, whole: Array, b: Array) -> JudgedChange:
    """Over all sizes. A (k, k), b (k,): information on them. whole: the same before other changes were taken out."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    squares, vectors = np.linalg.eigh(scale[:, None] * A * scale)
    kept = squares > _UNSEEN * len(b)
    along = vectors.T @ (scale * b)
    seen = np.where(kept, along**2 / np.where(kept, squares, 1.0), 0.0)
    spread = _SIZES[:, None] ** 2 / max(int(kept.sum()), 1) * kept
    each = 0.5 * (spread / (1.0 + spread) * seen - np.log1p(spread)).sum(axis=1)
    if KINDS[candidate.change.kind].grows and len(b) == 1:  # half of the prior, and what is left of it behind zero
        each += np.log(2.0) + log_ndtr(np.sqrt(spread[:, 0] / (1.0 + spread[:, 0]) * seen) * np.sign(b))
    factor = float(np.logaddexp.reduce(each)) - float(np.log(len(_SIZES)))
    return JudgedChange(candidate.change, factor, 0.5 * float(seen.sum()), float(_SIZES[int(np.argmax(each))]))


def tempered(normal: Normal) -> float:
    """The power at which none of the m reference recordings, each judged by the others, has an e-value above m."""
    logs, every = [], range(len(normal.moments))
    for i in every:
        others = normal.solved([k for k in every if k != i])
        (said,) = spoken_since(others, [normal.moments[i]])
        asked = _Asked.of(others, said.names)
        logs.append(e_value(asked.judged(said), asked.log_prior))
    return min(1.0, float(np.log(len(logs))) / max(*logs, 1e-9))


@dataclass(frozen=True)
class HeardBag:
    """What a later recording says, by itself in people's units too. signals: by name. postures (N, n): of its cells."""

    alone: BagValues
    seconds: float
    signals: Mapping[str, Moments]
    postures: Array

    @property
    def spoken_of(self) -> str:
        """Its name and, where its stamps are dates, its date (UTC)."""
        name, began = self.alone.name, self.alone.began
        return name + (datetime.fromtimestamp(began, UTC).strftime(" of %Y-%m-%d %H:%M") if began > _DATES else "")


class ArmJudge:
    """Judges later recordings by what is normal. weight: the power to which evidence counts."""

    def __init__(self, normal: Normal) -> None:
        self.normal, self.weight = normal, tempered(normal)
        self._asked = _Asked.of(normal, spoken_since(normal, [{}])[0].names)
        bags = zip(normal.bags, normal.moments, strict=True)
        self._reference = tuple(self._alone(*about, True, of) for about, of in bags)

    def hear(self, cells: Cells, other_payload: bool = False) -> HeardBag:
        """A later recording. other_payload: whether it is declared to carry another than the reference recordings."""
        signals = self.normal.of(cells, other_payload)
        return HeardBag(self._alone(cells.name, cells.began, False, signals), cells.seconds, signals, cells["q"])

    def _alone(self, name: str, began: float, reference: bool, of: Mapping[str, Moments]) -> BagValues:
        (said,), values = spoken_since(self.normal, [of]), {}
        for h, label, factor, unit in _single(self._asked):
            A, size = self._asked.alone(h, said)
            if A > 0.0:
                values[label] = (unit, factor * size, factor / float(np.sqrt(A)))
        share = float(np.mean([of[s].share if s in of else 0.0 for s in self.normal.signals]))
        return BagValues(name, began, reference, share, values)

    def judged(self, bags: Sequence[HeardBag]) -> ArmVerdict:
        """What has changed since the reference period, by later recordings; by the newest NEWEST of them."""
        normal, asked, bags = self.normal, self._asked, sorted(bags, key=lambda bag: bag.alone.began)
        newest = bags[-NEWEST:]
        last = newest[-1]
        asked_for = -float(np.log(AN_HOUR * max(last.seconds, SHORTEST) / 3600.0))
        said = spoken_since(normal, [bag.signals for bag in newest])
        silent = [n for n in normal.signals if n not in last.signals or not last.signals[n].share]
        changes: list[ChangeEstimate] = []
        log_e, since, rest, taken = -np.inf, 0, 0.0, list[int]()
        while len(changes) < _MOST:
            starts = range(since, since + 1) if taken else range(len(newest))
            judged = [asked.judged(said[s], taken) for s in starts]
            each = np.array([e_value(j, asked.log_prior, self.weight) for j in judged]) - rest
            now = float(np.logaddexp.reduce(each) - np.log(len(each)))
            log_e = log_e if taken else now
            if now <= asked_for:
                break
            best = int(np.argmax(each))
            since = starts[best]
            likely = [newest[starts[k]].spoken_of for k in np.flatnonzero(each > each[best] - AS_PROBABLE)]
            when = likely[0] if likely[0] == likely[-1] else f"{likely[0]}, or up to {likely[-1]}"
            when += " or before" if len(bags) > len(newest) and likely[0] == newest[0].spoken_of else ""
            h, estimate = _named(asked, judged[best], said[since], self.weight, when, taken)
            taken.append(h)
            rest += self.weight * _BENT * judged[best][h].likelihood
            changes.append(estimate)
        noticed, unseen = _noticed(asked, said[-1], asked_for / max(self.weight, 1e-6))
        status = "changed" if changes else "unchanged" if len(silent) < len(normal.signals) else "cannot_tell"
        every = self._reference + tuple(bag.alone for bag in bags)
        hours = sum(bag.seconds for bag in newest) / 3600.0
        return ArmVerdict(
            status, tuple(changes), every, log_e, asked_for, self.weight, noticed, unseen,
            normal.dropped + tuple(silent), hours, _stations(newest), normal.arm.names,
        )  # fmt: skip


def _stations(bags: Sequence[HeardBag]) -> Array:
    """Postures that are farthest apart, each of what was recorded, so that the arm can take it."""
    q = np.concatenate([bag.postures for bag in bags])
    chosen = [int(np.argmax(np.sum((q - q.mean(axis=0)) ** 2, axis=1)))]
    away = np.full(len(q), np.inf)
    while len(chosen) < _STATIONS:
        away = np.minimum(away, np.sum((q - q[chosen[-1]]) ** 2, axis=1))
        chosen.append(int(np.argmax(away)))
    return np.asarray(q[chosen])


def _without(said: Spoken, sums: Sequence[Array]) -> Spoken:
    """What is said beside changes of whatever size."""
    for B in sums:
        A = said.information @ B
        gain = A @ np.linalg.pinv(B.T @ A, hermitian=True)
        said = Spoken(said.names, said.information - gain @ A.T, said.vector - gain @ (B.T @ said.vector))
    return said


def _named(
    asked: _Asked, judged: Sequence[JudgedChange], said: Spoken, weight: float, since: str, taken: Sequence[int]
) -> tuple[int, ChangeEstimate]:
    """The most probable change, and its number."""
    named = by_name(judged, asked.log_prior, weight)
    key = max(named, key=lambda k: named[k][0])
    probability, best = named[key]
    h = next(i for i, j in enumerate(judged) if j is best)
    sizes = _sizes(asked, h, _without(said, [asked.sums[i] for i in taken]))
    near = probability * np.exp(-AS_PROBABLE)
    rivals = sorted(((p, j) for k, (p, j) in named.items() if k != key and p > near), key=lambda pair: -pair[0])
    same, change = tuple(j.hypothesis.label for _, j in rivals), best.hypothesis
    size = ", ".join(f"{s.value:+.3g} {s.unit} ({s.low:+.3g} … {s.high:+.3g})" for s in sizes)
    said_of = change.worded(KINDS[change.kind].said, size=size, moved=f" ({size})")
    said_of += f"; it may as well be the {' or the '.join(same)}" if same else ""
    of = (f"{said_of}, since {since}.", since, sizes, probability, same)
    return h, ChangeEstimate(change.kind, change.place, change.label, *of)


def _sizes(asked: _Asked, h: int, said: Spoken) -> tuple[SizeFound, ...]:
    """Sizes of a candidate with their 95 % intervals."""
    B, kind = asked.sums[h], KINDS[asked.candidates[h].change.kind]
    A = B.T @ said.information @ B
    covariance = np.linalg.pinv(A, hermitian=True)
    x, std = covariance @ (B.T @ said.vector), np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(
        SizeFound(name, factor * v, factor * (v - _95 * d), factor * (v + _95 * d), asked.unit(h, unit))
        for (name, factor, unit), v, d in zip(kind.sizes, x.tolist(), std.tolist(), strict=False)
    )


def _single(asked: _Asked) -> list[tuple[int, str, float, str]]:
    """Candidates of one size: number, label, factor and unit of what people read; one of each name."""
    out: dict[str, tuple[int, str, float, str]] = {}
    for h, one in enumerate(asked.candidates):
        sizes = KINDS[one.change.kind].sizes
        if len(one.columns) == 1 and sizes:
            out.setdefault(one.change.label, (h, one.change.label, sizes[0][1], asked.unit(h, sizes[0][2])))
    return list(out.values())


def _noticed(asked: _Asked, said: Spoken, asked_for: float) -> tuple[dict[str, tuple[float, str]], tuple[str, ...]]:
    """The size of each change that the last recording alone would have shown in 95 of 100 cases, and which it does not.

    A change needs the evidence that is asked for, its price, and half the logarithm of how sharply it is seen.
    """
    out, unseen = {}, []
    for h, label, factor, unit in _single(asked):
        A, _ = asked.alone(h, said)
        nats = asked_for - float(asked.log_prior[h]) + _OCCAM
        size = factor * (np.sqrt(2.0 * nats) + _OFTEN) / np.sqrt(A) if A > 0.0 else np.inf
        if size < _FARTHEST.get(unit, np.inf):
            out[label] = (float(size), unit)
        else:
            unseen.append(label)
    return out, tuple(unseen)
