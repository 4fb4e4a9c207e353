"""The published two-pose task: how soon is an arm of five joints found, how good does it become, and by which search?

    make bench NAME=synthesis ARGS="--only ours --seeds 20 --budget 1000"

Three searches judge as many assemblies as the budget allows. Noted are the first that meets every requirement (no rule
of structure broken, both poses reached within the limits and by less than 1e-6, way in m and axis in rad, checked with
the chain of the assembly) and the least cost in the end.

* ours: modcal_core.modules.evaluation, as `modcal synthesize` runs it, without its patience.
* random: assemblies that keep the rules of structure, drawn evenly, judged by the same evaluator.
* published: the genetic search as printed. Bit strings, one cut, bits flipped; 10000 for whatever breaks a hard
  requirement; the best are kept. One descent for each target, limits looked at afterwards, 0.01 counts as reached. Not
  printed, so chosen here: 100 candidates, 2 kept, tournaments of two, a cut in 80 %, one bit flipped. Its descents are
  our damped ones, for a plain Newton step is lost at the first singular posture, and its best 50 are judged again by
  our evaluator, so that the costs compare.

Judging takes the longer the more candidates reach the targets: random_longer and published_longer get about as much
time as ours. Candidates are counted with those that repeat; time is the processor's, of one process. Exits with 1 where
ours finds no arm in more than 5 % of the seeds.
"""

from __future__ import annotations

import harness

# isort: split
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import yaml
from harness import over

from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.evaluation import Evaluator, SearchSettings, Verdicts, evolve, uses_of, valid
from modcal_core.modules.library import Assembly, chain_of, published
from modcal_core.modules.requirements import BuiltArm
from modcal_core.modules.synthesis import SynthesisTask, task_from_data
from modcal_core.modules.targets import Arms
from modcal_core.robots.kinematics import chain_forward

LIBRARY = published()
CODING = Coding(LIBRARY)
LIMIT = 1e-6
JOINTS = 5
GENE_BITS, BASE_BITS = 10, 5


Batches = Iterator[np.ndarray]


def two_poses() -> SynthesisTask:
    file = harness.ROOT / "examples" / "synthesis" / "two_poses.yaml"
    return task_from_data(yaml.safe_load(file.read_text()), file.name)


def checked(task: SynthesisTask, genome: np.ndarray, q: np.ndarray) -> float:
    """The worst miss of the arm as the rest of the suite sees it; inf where a limit is broken."""
    chain = chain_of(CODING.assembly(genome), LIBRARY)
    if not ((q >= chain.lower - 1e-9) & (q <= chain.upper + 1e-9)).all():
        return np.inf
    T = chain_forward(chain, q)
    return max(float(max(target.miss(T[k]))) for k, target in enumerate(task.targets))


def ours(task: SynthesisTask, seed: int, budget: int) -> harness.Result:
    out, start = {"found": False}, time.process_time()
    evaluator = Evaluator(LIBRARY, task.targets, task.uses, seed)
    settings = SearchSettings(generations=budget, patience=budget)

    def enough(archive: Any) -> bool:
        at = archive.verdicts
        if not out["found"]:
            out.update(judged=archive.judged, descents=int(at.descents.sum()), seconds=time.process_time() - start)
            if at.met.any():
                best = at.order()[0]
                out["error"] = checked(task, archive.genomes[best], at.q[best])
                out["found"] = out["error"] < LIMIT
        return archive.judged >= budget

    archive = evolve(CODING, JOINTS, evaluator, np.random.default_rng([seed, JOINTS]), settings, enough=enough)
    return {**out, "cost": float(archive.verdicts.cost.min()), "whole": time.process_time() - start}


def at_random(task: SynthesisTask, seed: int, budget: int) -> harness.Result:
    rng, evaluator = np.random.default_rng([seed, JOINTS]), Evaluator(LIBRARY, task.targets, task.uses, seed)
    batches = (valid(CODING, JOINTS, 128, rng) for _ in itertools.count())
    return searched(task, evaluator, batches, budget, [])


class AsPrinted(Evaluator):
    """One descent for each target, whatever the limits, and of postures that are whole turns apart the one near 0."""

    STARTS, AGAIN, HOPELESS = 1, 0, np.inf

    def arms(self, assemblies: Sequence[Assembly]) -> Arms:
        arms = super().arms(assemblies)
        free = np.full_like(arms.lower, np.inf)
        return arms._replace(lower=-free, upper=free)

    def choose(self, out: Verdicts, i: int, arm: BuiltArm, found: np.ndarray) -> None:
        q = np.where(arm.chain.revolute, np.angle(np.exp(1j * arm.q)), arm.q)
        super().choose(out, i, replace(arm, q=q), found)


def as_published(task: SynthesisTask, seed: int, budget: int) -> harness.Result:
    weights = {u.name: {**u.options, "weight": u.weight} for u in task.uses if u.weight}
    uses = uses_of({"structure": {}, "reachability": {"tolerance": 0.01}, **weights})
    evaluator, verdicts = AsPrinted(LIBRARY, task.targets, uses, seed), []
    batches = printed_search(np.random.default_rng([seed, JOINTS]), verdicts)
    return searched(task, evaluator, batches, budget, verdicts, Evaluator(LIBRARY, task.targets, task.uses, seed))


def searched(
    task: SynthesisTask, evaluator: Evaluator, batches: Batches, budget: int, tell: list, again: Evaluator | None = None
) -> harness.Result:
    """Judges batch after batch; ``tell`` gets the verdicts, for the search that makes the next one."""
    out, start, judged, sure = {"found": False, "descents": 0, "cost": np.inf}, time.process_time(), 0, np.inf
    kept: dict[bytes, tuple[float, np.ndarray]] = {}
    for genomes in batches:
        verdicts = evaluator(genomes)
        tell[:] = [verdicts]
        judged += len(genomes)
        met = np.flatnonzero(verdicts.met)
        kept |= {genomes[i].tobytes(): (float(verdicts.cost[i]), genomes[i]) for i in met}
        missed = {i: miss for i in met if (miss := checked(task, genomes[i], verdicts.q[i])) < LIMIT}
        sure = min([sure, *(float(verdicts.cost[i]) for i in missed)])
        if not out["found"]:
            out |= {"judged": judged, "seconds": time.process_time() - start, "found": bool(missed)}
            out["descents"] += int(verdicts.descents.sum())
            out["error"] = min(missed.values(), default=None)
        if judged >= budget:
            break
    out["whole"] = time.process_time() - start
    best = sorted(kept.values(), key=lambda pair: pair[0])[:50]
    if best:
        cost = float(again(np.stack([g for _, g in best])).cost.min()) if again else best[0][0]
        out["cost"] = min(cost, sure)
    return out


def printed_search(rng: np.random.Generator, verdicts: list, size: int = 100, kept: int = 2) -> Batches:
    """Populations; ``verdicts`` holds what the last one was worth."""
    bits = rng.integers(0, 2, (size, BASE_BITS + JOINTS * GENE_BITS))
    while True:
        yield genomes_of(bits)
        cost = np.where(verdicts[0].met, verdicts[0].cost, 10_000.0)
        elite = np.argsort(cost, kind="stable")[:kept]
        pairs = rng.integers(size, size=(2, size - kept, 2))
        chosen = np.where(cost[pairs[..., 0]] <= cost[pairs[..., 1]], pairs[..., 0], pairs[..., 1])
        length = bits.shape[1]
        cut = np.where(rng.random(size - kept) < 0.8, rng.integers(1, length, size - kept), length)
        child = np.where(np.arange(length) < cut[:, None], bits[chosen[0]], bits[chosen[1]])
        child ^= rng.random(child.shape) < 1.0 / length
        bits = np.concatenate([bits[elite], child])


def genomes_of(bits: np.ndarray) -> np.ndarray:
    base = bits[:, :BASE_BITS] @ (1 << np.arange(BASE_BITS)[::-1])
    genes = bits[:, BASE_BITS:].reshape(len(bits), JOINTS, GENE_BITS) @ (1 << np.arange(GENE_BITS)[::-1])
    assert base.max() < BASES
    return np.column_stack([base, genes])


# Searches, the seeds of each, and what they may judge in budgets
SEARCHES = {"ours": (ours, 20, 1.0), "random": (at_random, 8, 1.0), "published": (as_published, 8, 1.0)}
SEARCHES |= {"random_longer": (at_random, 8, 2.5), "published_longer": (as_published, 8, 3.0)}


def one(task: harness.Task) -> harness.Result:
    """One search. judged, descents, seconds: until the first arm, or until it gave up; error: of that arm. cost: the
    least of all in the end; whole: seconds until then.
    """
    search, _, times = SEARCHES[task["search"]]
    return search(two_poses(), task["seed"], int(times * task["budget"]))


def main() -> int:
    given = harness.options(__doc__, seeds=None, names=SEARCHES, budget=1000)
    counts = {name: count for name, (_, count, _) in SEARCHES.items()}
    tasks = harness.tasks(given, counts, search=given.names, budget=[given.budget])
    results, middle = harness.each(one, tasks, given), lambda v: f"{np.median(v):.3g} ({min(v):.3g} to {max(v):.3g})"
    columns = {"found": over("found", harness.share), "worst error": over("error", max)}
    columns |= {key: over(key, middle) for key in ("judged", "descents", "seconds", "cost", "whole")}
    harness.summary("Medians and ranges", results, "search", columns)
    own = [r["found"] for r in results if r["search"] == "ours" and not r["failed"]]
    return harness.ended(results, ("ours in 95 %", not own or np.mean(own) >= 0.95))


if __name__ == "__main__":
    sys.exit(main())
