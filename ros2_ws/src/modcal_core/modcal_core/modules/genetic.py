"""A genetic search over assemblies of a given number of joints.

The source's search keeps the best (elitism), cuts and joins bit strings, and gives every candidate that breaks a hard
requirement the same large cost, so that it is blind until chance finds the first one that breaks none. This one differs
in four things, each of which shows in ``bench/synthesis.py``:

* Candidates that break something are compared by how much they break (Deb's rules: meeting all comes first, then less
  broken, then cost), so a near miss is worth keeping.
* What can be seen to break the rules of structure is not made.
* Cuts are between modules, and a change takes one field of one module to another value, or swaps two sub-assemblies.
* No candidate is judged twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.evaluation import Verdicts
from modcal_core.modules.requirements import structure

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


@dataclass
class Archive:
    """Every candidate judged, once. genomes: (N, n + 1), verdicts in the same order."""

    genomes: np.ndarray
    verdicts: Verdicts
    seen: set[bytes] = field(default_factory=set)

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
    archive: Archive | None = None
    fresh = valid(coding, joints, settings.population, rng)
    best, since = np.inf, 0
    for number in range(settings.generations):
        fresh = _unseen(fresh, archive.seen if archive else set())
        at, seen = judge(fresh), {g.tobytes() for g in fresh}
        if archive:
            fresh, seen = np.concatenate([archive.genomes, fresh]), archive.seen | seen
            at = Verdicts.joined([archive.verdicts, at])
        archive = Archive(fresh, at, seen)
        order = at.order()
        met = int(at.met.sum())
        lead = order[0]
        if watch:
            missing = 0.0 if met else float(at.amount[lead])
            watch(Generation(joints, number, archive.judged, met, float(at.cost[lead]), missing))
        cost = float(at.cost[lead])
        if met and cost > best - max(0.01 * abs(best), 1e-9):
            since += 1
        else:
            best, since = cost, 0
        if (met and since >= settings.patience) or (enough and enough(archive)):
            break
        fresh = _offspring(coding, archive.genomes[order[: settings.population]], archive.seen, rng, settings)
        if not len(fresh):
            break  # everything there is has been judged
    assert archive is not None
    return archive


def valid(coding: Coding, joints: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random genomes (count, joints + 1) that keep the rules of structure, each kind of module equally likely."""
    out = np.empty((0, joints + 1), int)
    bases, genes = np.flatnonzero(coding.base_buildable), np.flatnonzero(coding.buildable)
    for _ in range(1000):
        drawn = np.column_stack([rng.choice(bases, 4 * count), rng.choice(genes, (4 * count, joints))])
        out = np.concatenate([out, drawn[structure(drawn, coding, {}) == 0.0]])[:count]
        if len(out) == count:
            break
    return out


def _unseen(genomes: np.ndarray, seen: set[bytes]) -> np.ndarray:
    """Genomes that are new, each once, in their order."""
    known = set(seen)
    keep = []
    for i, genome in enumerate(genomes):
        key = genome.tobytes()
        if key not in known:
            known.add(key)
            keep.append(i)
    return genomes[keep]


def _offspring(
    coding: Coding, parents: np.ndarray, seen: set[bytes], rng: np.random.Generator, settings: SearchSettings
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
        out = np.concatenate([out, child[structure(child, coding, {}) == 0.0]])
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
