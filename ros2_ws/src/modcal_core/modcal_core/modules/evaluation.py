"""What each of many candidates is worth, and the genetic search over assemblies of a given number of joints.

Requirements are checked in the order of what they cost: structure, length, descents
(:mod:`modcal_core.modules.targets`) from a few postures with a few steps, which go on where they may get there. What
reaches every target is looked for again from more postures, the best of which is taken by the other requirements.

Unlike the source's search (``bench/synthesis.py`` compares) candidates that break something are compared by how much
(Deb's rules), what breaks the rules of structure is not made, cuts are between modules and changes take one field or
swap two sub-assemblies, and none is judged twice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from modcal_core.geometry import Array
from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.library import Assembly, Library
from modcal_core.modules.requirements import REACH, REQUIREMENTS, STRUCTURE, BuiltArm, Options, structure
from modcal_core.modules.targets import Arms, Target, reach

MET = -1  # no requirement is broken
_KEPT = 3  # starts that go on after the first steps
_FIRST_STEPS, _STEPS = 10, 40


@dataclass(frozen=True)
class Use:
    """A requirement in use. hard: whether to reject; weight: of its cost, 0: none; options: its own."""

    name: str
    hard: bool
    weight: float
    options: Options


@dataclass(frozen=True)
class Verdicts:
    """What N candidates are worth. Rows belong to the genomes in the order given.

    broken: index of the first requirement that is broken among those in use, or MET, (N,). level: 0 where all are met,
    1 where all targets are reached but something else is broken, 2 unreached, 3 not built. amount: by how much, (N,);
    of unreached targets the error that is left [m and rad]. cost: weighted sum, (N,), inf where not all is met. terms:
    costs before weighting, (N, requirements), NaN where not known. q: chosen postures, (N, K, n). descents: how many.
    """

    broken: np.ndarray
    level: np.ndarray
    amount: Array
    cost: Array
    terms: Array
    q: Array
    descents: np.ndarray

    @property
    def met(self) -> np.ndarray:
        """Which meet all that is hard, (N,)."""
        return self.level == 0

    @classmethod
    def joined(cls, parts: Sequence[Verdicts]) -> Verdicts:
        """Verdicts of several batches, concatenated."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def order(self) -> np.ndarray:
        """Indices from the best to the worst: cost among those that meet everything, then level, then amount."""
        return np.lexsort((self.cost, self.amount, self.level))


class Evaluator:
    """Judges genomes of one task. Equal genomes get equal verdicts, whatever stands beside them.

    STARTS: of the first look; AGAIN: of the second, at what reaches every target. HOPELESS: who is farther off after
    the first steps [m and rad] is not followed.
    """

    STARTS, AGAIN, HOPELESS = 12, 10, 0.2

    def __init__(self, library: Library, targets: Sequence[Target], uses: Sequence[Use], seed: int) -> None:
        self.coding = Coding(library)
        self.targets = tuple(targets)
        self.uses = tuple(uses)
        self._seed = seed
        self._index = {use.name: i for i, use in enumerate(self.uses)}
        self._tolerance = float(self.uses[self._index[REACH]].options["tolerance"])

    def __call__(self, genomes: np.ndarray) -> Verdicts:
        """Verdicts on genomes (N, n + 1)."""
        count, n = len(genomes), genomes.shape[1] - 1
        out = Verdicts(
            broken=np.full(count, MET),
            level=np.zeros(count, int),
            amount=np.zeros(count),
            cost=np.full(count, np.inf),
            terms=np.full((count, len(self.uses)), np.nan),
            q=np.full((count, len(self.targets), n), np.nan),
            descents=np.zeros(count, int),
        )
        left = self._reject(out, np.arange(count), self._index[STRUCTURE], structure(genomes, self.coding), 3)
        if len(left):
            self._reach(out, left, [self.coding.assembly(genome) for genome in genomes[left]])
        return out

    def _reject(self, out: Verdicts, which: np.ndarray, requirement: int, amount: Array, level: int) -> np.ndarray:
        """Enters who breaks a requirement; who does not is given back."""
        bad = amount > 0.0
        out.broken[which[bad]], out.level[which[bad]], out.amount[which[bad]] = requirement, level, amount[bad]
        return which[~bad]

    def _reach(self, out: Verdicts, which: np.ndarray, assemblies: Sequence[Assembly]) -> None:
        """Fills in postures; who reaches every target is judged."""
        arms, at = self.arms(assemblies), self._index[REACH]
        short = np.max([arms.too_short(t) for t in self.targets], axis=0)
        left = self._reject(out, which, at, np.where(short > 0.0, short + self.HOPELESS, 0.0), 2)
        if not len(left):
            return
        arms = arms.take(np.flatnonzero(short <= 0.0))
        q, miss = self._descend(arms, self._unit(out.q.shape[-1], self.STARTS))
        out.descents[left] = self.STARTS * len(self.targets)
        out.q[left] = q
        left = self._reject(out, left, at, np.where(miss > self._tolerance, miss, 0.0), 2)
        if len(left):
            self._judge(out, left, [assembly for i, assembly in zip(which, assemblies, strict=True) if i in left])

    def arms(self, assemblies: Sequence[Assembly]) -> Arms:
        """The arms whose postures are sought."""
        return Arms.of(assemblies, self.coding.library)

    def _unit(self, n: int, count: int, skip: int = 0) -> Array:
        """Starts in the unit cube; the same for all arms of n joints, so that a verdict depends on the arm alone."""
        return np.random.default_rng([self._seed, n]).random((skip + count, n))[skip:]

    def _descend(self, arms: Arms, unit: Array) -> tuple[Array, Array]:
        """The best posture for each target (N, K, n), and what the worst target is missed by, (N,)."""
        first = [reach(arms, t, arms.starts(unit), _FIRST_STEPS) for t in self.targets]
        left = np.stack([f.left.min(axis=1) for f in first], axis=1)
        q = np.stack([np.take_along_axis(f.q, f.left.argmin(axis=1)[:, None, None], 1)[:, 0] for f in first], axis=1)
        on = np.flatnonzero((left.max(axis=1) < self.HOPELESS) & (left.max(axis=1) > self._tolerance))
        for k, target in enumerate(self.targets):
            # once one target is out of reach the others do not matter
            on = on[(left[on] < self.HOPELESS).all(axis=1)]
            if not len(on):
                break
            best = np.argsort(first[k].left[on], axis=1, kind="stable")[:, :_KEPT]
            more = reach(arms.take(on), target, np.take_along_axis(first[k].q[on], best[..., None], 1), _STEPS)
            pick = more.left.argmin(axis=1)
            left[on, k] = np.take_along_axis(more.left, pick[:, None], 1)[:, 0]
            q[on, k] = np.take_along_axis(more.q, pick[:, None, None], 1)[:, 0]
            on = on[left[on, k] <= self._tolerance] if k + 1 < len(self.targets) else on
        return q, left.max(axis=1)

    def _judge(self, out: Verdicts, which: np.ndarray, assemblies: Sequence[Assembly]) -> None:
        """Fills in everything else, for those who reach every target."""
        arms, first = self.arms(assemblies), out.q[which][:, :, None]
        unit = self._unit(first.shape[-1], self.AGAIN, self.STARTS)
        more = [reach(arms, t, arms.starts(unit), _STEPS) for t in self.targets]
        q = np.concatenate([first, np.stack([m.q for m in more], axis=1)], axis=2)
        left = np.stack([m.left for m in more], axis=1)
        found = np.concatenate([np.ones(first.shape[:3], bool), left <= self._tolerance], axis=2)
        out.descents[which] += self.AGAIN * len(self.targets)
        for i, assembly, postures, good in zip(which, assemblies, q, found, strict=True):
            self.choose(out, int(i), BuiltArm(assembly, self.coding.library, self.targets, postures), good)

    def choose(self, out: Verdicts, i: int, arm: BuiltArm, found: np.ndarray) -> None:
        """Enters the best posture for each target, and what the arm is worth with these. found: which reach, (K, S)."""
        measured = {}
        for r, use in enumerate(self.uses):
            if (measure := REQUIREMENTS[use.name].measure) is not None:
                measured[r] = [np.broadcast_to(value, found.shape) for value in measure(arm, use.options)]
        over = np.sum([amount for r, (amount, _) in measured.items() if self.uses[r].hard], axis=0)
        cost = np.sum([self.uses[r].weight * soft for r, (_, soft) in measured.items()], axis=0)
        # nothing broken before all, then the cost
        score = np.where(found, 1e6 * np.minimum(over, 1e6) + cost, np.inf)
        best = np.arange(len(found)), score.argmin(axis=1)
        out.q[i], out.cost[i] = arm.q[best], 0.0
        for r, (amount, soft) in measured.items():
            use, costs, broken = self.uses[r], soft[best], float(amount[best].max())
            out.terms[i, r] = costs.max() if REQUIREMENTS[use.name].worst else costs.sum()
            out.cost[i] += use.weight * out.terms[i, r]
            if use.hard and broken > 0.0:
                out.broken[i] = r if out.level[i] == 0 else out.broken[i]
                out.level[i] = 1
                out.amount[i] += broken
        if out.level[i]:
            out.cost[i] = np.inf


def uses_of(stated: Mapping[str, Mapping[str, float]]) -> tuple[Use, ...]:
    """Requirements in use, in the order of the table, from options by name; ``weight`` and ``hard`` among them."""
    out = []
    for name, known in REQUIREMENTS.items():
        if name in stated:
            options = {**known.options, **stated[name]}
            hard = bool(options.pop("hard", known.hard))
            weight = float(options.pop("weight", known.weight))
            out.append(Use(name, hard, weight, options))
    return tuple(out)


Judge = Callable[[np.ndarray], Verdicts]


@dataclass(frozen=True)
class SearchSettings:
    """How a search goes about it.

    patience: generations without one that costs 1 % less, after which it ends, once one meets everything.
    """

    population: int = 128
    generations: int = 60
    patience: int = 6
    elite: int = 12
    newcomers: int = 12
    tournament: int = 3
    crossover: float = 0.8

    def longer(self) -> SearchSettings:
        """The same with time for better results."""
        return replace(self, generations=max(self.generations, 120), patience=max(self.patience, 20))


@dataclass(frozen=True)
class Generation:
    """What is known after a generation.

    Of all candidates judged until then: how many there were, how many met everything, the least cost among those, and
    where there is none, what the best is missing.
    """

    joints: int
    number: int
    judged: int
    met: int
    cost: float
    missing: float


@dataclass(frozen=True)
class Archive:
    """Every candidate judged, once. genomes: (N, n + 1), verdicts in the same order, of so many generations."""

    genomes: np.ndarray
    verdicts: Verdicts
    generations: int

    @property
    def judged(self) -> int:
        """Number of candidates evaluated so far."""
        return len(self.genomes)


def evolve(
    coding: Coding,
    joints: int,
    judge: Judge,
    rng: np.random.Generator,
    settings: SearchSettings,
    watch: Callable[[Generation], None] | None = None,
    enough: Callable[[Archive], bool] | None = None,
) -> Archive:
    """Every candidate of this many joints that the search has judged.

    judge: verdicts on genomes (N, n + 1). watch: called after every generation. enough: ends the search early.
    """
    genomes, parts = np.empty((0, joints + 1), int), list[Verdicts]()
    fresh = valid(coding, joints, settings.population, rng)
    best, since = np.inf, 0
    for number in range(settings.generations):
        fresh = _unseen(fresh, genomes)
        genomes, parts = np.concatenate([genomes, fresh]), [*parts, judge(fresh)]
        archive = Archive(genomes, Verdicts.joined(parts), number + 1)
        at = archive.verdicts
        order, met = at.order(), int(at.met.sum())
        cost = float(at.cost[order[0]])
        if watch:
            missing = 0.0 if met else float(at.amount[order[0]])
            watch(Generation(joints, number, archive.judged, met, cost, missing))
        if met and cost > best - max(0.01 * abs(best), 1e-9):
            since += 1
        else:
            best, since = cost, 0
        if (met and since >= settings.patience) or (enough and enough(archive)):
            break
        fresh = _offspring(coding, genomes[order[: settings.population]], genomes, rng, settings)
        if not len(fresh):
            break  # everything there is has been judged
    return archive


def valid(coding: Coding, joints: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random genomes (count, joints + 1) that keep the rules of structure, each kind of module equally likely."""
    out = np.empty((0, joints + 1), int)
    bases, genes = np.flatnonzero(coding.base_buildable), np.flatnonzero(coding.buildable)
    for _ in range(1000):
        drawn = np.column_stack([rng.choice(bases, 4 * count), rng.choice(genes, (4 * count, joints))])
        out = np.concatenate([out, drawn[structure(drawn, coding) == 0.0]])[:count]
        if len(out) == count:
            break
    return out


def _unseen(genomes: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Genomes that are not known, each once, in their order."""
    first = np.sort(np.unique(np.concatenate([known, genomes]), axis=0, return_index=True)[1])
    return genomes[first[first >= len(known)] - len(known)]


def _offspring(
    coding: Coding, parents: np.ndarray, seen: np.ndarray, rng: np.random.Generator, settings: SearchSettings
) -> np.ndarray:
    """New genomes, of parents in their order, best first; the best of all stay parents, so none is lost."""
    wanted = settings.population - settings.newcomers
    joints = parents.shape[1] - 1
    out = np.empty((0, joints + 1), int)
    for _ in range(20):
        # the index is the rank: the smallest of some draws wins; a share of the mothers comes from the elite
        draws = rng.integers(len(parents), size=(2, wanted, settings.tournament)).min(axis=2)
        elite = rng.random(wanted) < 0.25
        draws[0] = np.where(elite, rng.integers(min(settings.elite, len(parents)), size=wanted), draws[0])
        # the mother's modules up to a cut, the father's from there on
        cut = np.where(rng.random(wanted) < settings.crossover, rng.integers(1, joints + 1, wanted), joints + 1)
        child = np.where(np.arange(joints + 1) < cut[:, None], parents[draws[0]], parents[draws[1]])
        child = _changed(coding, child, rng)
        out = np.concatenate([out, child[structure(child, coding) == 0.0]])
        out = _unseen(out, seen)[:wanted]
        if len(out) == wanted:
            break
    newcomers = valid(coding, joints, settings.newcomers, rng)
    return _unseen(np.concatenate([out, newcomers]), seen)


def _changed(coding: Coding, genomes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same with one to three changes: a field of a gene, the base, or two sub-assemblies in each other's place."""
    out = genomes.copy()
    count, length = out.shape
    rows = np.arange(count)
    for change in range(3):
        doing = (change == 0) | (rng.random(count) < 0.4)
        what = rng.random(count)
        at = rng.integers(1, length, (count,))
        fields: list[np.ndarray] = list(coding.fields(out[rows, at]))
        which = rng.integers(len(fields), size=count)
        for f, size in enumerate(coding.shape):
            fields[f] = np.where(which == f, (fields[f] + rng.integers(1, size, count)) % size, fields[f])
        gene = np.asarray(np.ravel_multi_index(tuple(fields), coding.shape))
        field_changed = doing & (what < 0.8)
        out[rows[field_changed], at[field_changed]] = gene[field_changed]
        base = doing & (what >= 0.8) & (what < 0.88)
        out[base, 0] = rng.integers(BASES, size=(count,))[base]
        swap = doing & (what >= 0.88)
        other = rng.integers(1, length, (count,))
        a, b = out[rows, at], out[rows, other]
        out[rows[swap], at[swap]], out[rows[swap], other[swap]] = b[swap], a[swap]
    return out
