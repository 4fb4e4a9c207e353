"""Which change explains later recordings, since when, and is it sure?

Hypotheses, their prices and the prior of their sizes are those of ``moves``: the mean over all changes, and over the
recordings that each may have begun with, of how much more probable they make what was recorded is an e-value. What is
said while nothing has changed is known from the reference recordings (``predictive``). The limit aims at one false name
in a hundred hours of recordings. Which change it is, two changes tell by what each leaves to the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from modcal_core.geometry import Array
from modcal_core.moves import AS_PROBABLE, KINDS, SIZES, JudgedChange, SizeFound, by_name, e_value, log_priors
from modcal_core.sentinel.cells import Cells
from modcal_core.sentinel.channels import ChangeColumns, candidates
from modcal_core.sentinel.normal import Moments, Normal
from modcal_core.sentinel.predictive import Number, Scatter, Spoken, left_out, spoken_since

AN_HOUR = 0.01  # false alarms
SHORTEST = 60.0  # s: a shorter recording counts as this long
NEWEST = 50  # recordings that are judged together; a change that began before them is in all of them
_SIZES = 4.0 * SIZES  # standard deviations of what all cells together say, from 2 to 4000
_MOST = 2  # changes at once
_STATIONS = 10  # as many as a check asks for
_DATES = 1e9  # s; a simulation's clock begins at zero
_BENT = 0.01  # of a change's square: columns are linear, and a tenth of its course may be another one
_OFTEN, _WITHIN = 0.95, 0.975  # of cases; end of an interval with as many
_MOST_LOG = 14.0  # logarithm of a number [standard deviations] that no recording reaches
Probabilities = Mapping[tuple[str, str], tuple[float, JudgedChange]]
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
    references: int
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
    """Candidates with their columns as sums (K, k) of named ones, units (k,) that make the information of a reference
    recording about 1, log priors (H,), joints that slide, and what each reference recording says by the others.
    """

    candidates: Sequence[ChangeColumns]
    sums: Sequence[Array]
    units: Sequence[Array]
    log_prior: Array
    sliding: frozenset[str]
    reference: Sequence[Spoken]

    @classmethod
    def of(cls, normal: Normal) -> _Asked:
        reference, chain = left_out(normal), normal.arm.chain
        names = reference[0].names
        every = candidates(normal.arm, names, normal.shares)
        sums = [np.array([[c.get(name, 0.0) for c in one.columns] for name in names]) for one in every]
        whole = np.mean([one.information for one in reference], axis=0)
        units = [1.0 / np.sqrt(np.maximum(np.diag(B.T @ whole @ B), 1e-300)) for B in sums]
        sliding = frozenset(n for j, n in enumerate(normal.arm.names) if chain is not None and not chain.revolute[j])
        scaled = [B * unit for B, unit in zip(sums, units, strict=True)]
        return cls(every, scaled, units, log_priors([one.change for one in every]), sliding, reference)

    @cached_property
    def scatter(self) -> list[Scatter]:
        """How each candidate scatters among the reference recordings."""
        return [Scatter.of(B, self.reference) for B in self.sums]

    def beside(self, h: int) -> _Asked:
        """The same beside a candidate of whatever size."""
        return replace(self, reference=[one.beside(self.sums[h]) for one in self.reference])

    def unit(self, h: int, unit: str) -> str:
        """The unit of a candidate's size: of a sliding joint a length."""
        return unit.replace("mrad", "mm") if self.candidates[h].change.place in self.sliding else unit

    def sizes(self, h: int, said: Spoken) -> tuple[list[float], list[float]]:
        """Sizes of a candidate, and by how much they scatter from one reference recording to the next."""
        found, spread = self.scatter[h].sizes(said)
        return (self.units[h] * found).tolist(), (self.units[h] * spread).tolist()

    def judged(self, said: Spoken, bent: float = 0.0) -> list[JudgedChange]:
        """The Bayes factor of each candidate. bent: as below."""
        return [_judged(c, one.number(said), bent) for c, one in zip(self.candidates, self.scatter, strict=True)]

    def left(self, g: int, h: int, said: Spoken, bent: float) -> JudgedChange:
        """The Bayes factor of candidate g beside h."""
        number = Scatter.of(self.sums[g], self.beside(h).reference).number(said.beside(self.sums[h]))
        return _judged(self.candidates[g], number, bent)

    def named(self, said: Spoken, odds: Sequence[JudgedChange]) -> tuple[int, Probabilities]:
        """The number of the most probable change, and the probability of everything that can be named.

        Of two changes that one is the more probable beside which the other has less left to explain. odds: of each.
        """
        bent, tried = [_BENT * one.number(said).square for one in self.scatter], set[int]()
        while True:
            named = by_name(odds, self.log_prior, 1.0)
            best = max(named.values(), key=lambda pair: pair[0])[1]
            h = next(i for i, j in enumerate(odds) if j is best)
            if h in tried:
                return h, named
            tried.add(h)
            odds = []
            for g in range(len(bent)):
                other, own = self.left(g, h, said, bent[h]), self.left(h, g, said, bent[g])
                odds.append(replace(other, log_factor=other.log_factor - own.log_factor))

    def noticed(self, said: Spoken, asked_for: float) -> tuple[dict[str, tuple[float, str]], tuple[str, ...]]:
        """The size of each change that a recording would have shown in 95 of 100 cases; and what it does not show.

        The recording itself scatters as those of the reference do.
        """
        out, unseen = {}, []
        for h, label, factor, unit in self.single():
            number, (_, (std,)), size = self.scatter[h].number(said), self.sizes(h, said), np.inf
            if number.directions:
                needed = _needed(self.candidates[h], number, asked_for - float(self.log_prior[h]))
                size = factor * std * (needed + float(stdtrit(number.freedom, _OFTEN)))
            if size < _FARTHEST.get(unit, np.inf):
                out[label] = (float(size), unit)
            else:
                unseen.append(label)
        return out, tuple(unseen)

    def single(self) -> list[tuple[int, str, float, str]]:
        """Candidates of one size: number, label, factor and unit of what people read; one of each name."""
        out: dict[str, tuple[int, str, float, str]] = {}
        for h, one in enumerate(self.candidates):
            sizes = KINDS[one.change.kind].sizes
            if len(one.columns) == 1 and sizes:
                out.setdefault(one.change.label, (h, one.change.label, sizes[0][1], self.unit(h, sizes[0][2])))
        return list(out.values())


def _judged(candidate: ChangeColumns, number: Number, bent: float = 0.0) -> JudgedChange:
    """Over all sizes. bent: the square that changes which were taken out may have left, for they are not as straight as
    their columns.
    """
    each = number.log_factor(_SIZES, KINDS[candidate.change.kind].grows)
    factor = float(np.logaddexp.reduce(each) - np.log(len(_SIZES))) - number.evidence(min(bent, number.square))
    return JudgedChange(candidate.change, factor, number.evidence(), float(_SIZES[int(np.argmax(each))]))


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
    """Judges later recordings by what is normal."""

    def __init__(self, normal: Normal) -> None:
        self.normal, self._asked = normal, _Asked.of(normal)
        bags = zip(normal.bags, self._asked.reference, strict=True)
        self._reference = tuple(self._alone(*about, True, said, 1.0) for about, said in bags)

    def hear(self, cells: Cells, other_payload: bool = False) -> HeardBag:
        """A later recording. other_payload: whether it is declared to carry another than the reference recordings."""
        signals = self.normal.of(cells, other_payload)
        (said,) = spoken_since(self.normal, [signals])
        share = float(np.mean([signals[s].share if s in signals else 0.0 for s in self.normal.signals]))
        return HeardBag(self._alone(cells.name, cells.began, False, said, share), cells.seconds, signals, cells["q"])

    def _alone(self, name: str, began: float, reference: bool, said: Spoken, share: float) -> BagValues:
        values = {}
        for h, label, factor, unit in self._asked.single():
            (size,), (std,) = self._asked.sizes(h, said)
            if std > 0.0:
                values[label] = (unit, factor * size, factor * std)
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
        log_e, bent, since = -np.inf, 0.0, 0
        while len(changes) < _MOST:
            judged = [asked.judged(one, bent) for one in said]
            each = np.array([e_value(j, asked.log_prior) for j in judged])
            now = float(np.logaddexp.reduce(each) - np.log(len(each)))
            log_e = log_e if changes else now
            if now <= asked_for:
                break
            best = int(np.argmax(each))
            h, named = asked.named(said[best], judged[best])
            numbers = [asked.scatter[h].number(one) for one in said]
            k, when = _since(numbers, newest[since:][: len(said)], len(bags) > len(newest))
            changes.append(_estimate(asked, h, named, said[k], when))
            bent += _BENT * numbers[k].square
            since, said, asked = since + k, [said[k].beside(asked.sums[h])], asked.beside(h)
        noticed, unseen = self._asked.noticed(spoken_since(normal, [last.signals])[0], asked_for)
        status = "changed" if changes else "unchanged" if len(silent) < len(normal.signals) else "cannot_tell"
        every = self._reference + tuple(bag.alone for bag in bags)
        hours = sum(bag.seconds for bag in newest) / 3600.0
        return ArmVerdict(
            status, tuple(changes), every, log_e, asked_for, len(self._reference), noticed, unseen,
            normal.dropped + tuple(silent), hours, _stations(newest), normal.arm.names,
        )  # fmt: skip


def _estimate(asked: _Asked, h: int, named: Probabilities, said: Spoken, since: str) -> ChangeEstimate:
    """A candidate as it is told."""
    change = asked.candidates[h].change
    end = float(stdtrit(max(asked.scatter[h].freedom, 1), _WITHIN))
    sizes = tuple(
        SizeFound(name, factor * v, factor * (v - end * d), factor * (v + end * d), asked.unit(h, unit))
        for (name, factor, unit), v, d in zip(KINDS[change.kind].sizes, *asked.sizes(h, said), strict=False)
    )
    probability = named[change.key][0]
    near = probability * np.exp(-AS_PROBABLE)
    rivals = sorted(((p, j) for k, (p, j) in named.items() if k != change.key and p > near), key=lambda x: -x[0])
    same = tuple(j.hypothesis.label for _, j in rivals)
    size = ", ".join(f"{s.value:+.3g} {s.unit} ({s.low:+.3g} … {s.high:+.3g})" for s in sizes)
    said_of = change.worded(KINDS[change.kind].said, size=size, moved=f" ({size})")
    said_of += f"; it may as well be the {' or the '.join(same)}" if same else ""
    of = (f"{said_of}, since {since}.", since, sizes, probability, same)
    return ChangeEstimate(change.kind, change.place, change.label, *of)


def _since(numbers: Sequence[Number], bags: Sequence[HeardBag], more: bool) -> tuple[int, str]:
    """With which recording a change began, by what all from each of them on say of it, and how it is said.

    more: whether there are older ones.
    """
    square = np.array([one.square for one in numbers])
    best = int(np.argmax(square))
    left = [one.evidence(square[best] - one.square) for one in numbers]  # of the difference, a number like others
    likely = [bag.spoken_of for bag, nats in zip(bags, left, strict=True) if nats < AS_PROBABLE]
    when = likely[0] if likely[0] == likely[-1] else f"{likely[0]}, or up to {likely[-1]}"
    return best, when + (" or before" if more and likely[0] == bags[0].spoken_of else "")


def _stations(bags: Sequence[HeardBag]) -> Array:
    """Postures that are farthest apart, each of what was recorded, so that the arm can take it."""
    q = np.concatenate([bag.postures for bag in bags])
    chosen = [int(np.argmax(np.sum((q - q.mean(axis=0)) ** 2, axis=1)))]
    away = np.full(len(q), np.inf)
    while len(chosen) < _STATIONS:
        away = np.minimum(away, np.sum((q - q[chosen[-1]]) ** 2, axis=1))
        chosen.append(int(np.argmax(away)))
    return np.asarray(q[chosen])


def _needed(candidate: ChangeColumns, number: Number, nats: float) -> float:
    """The standard deviations from nothing of a number of which so much evidence comes."""

    def lacks(log: float) -> float:
        return _judged(candidate, replace(number, square=np.exp(2.0 * log), positive=True)).log_factor - nats

    return float(np.exp(brentq(lacks, 0.0, _MOST_LOG))) if lacks(_MOST_LOG) > 0.0 else np.inf
