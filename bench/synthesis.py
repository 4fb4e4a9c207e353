"""The published two-pose task: how soon is an arm of five joints found, how good does it become, and by which search?

    make bench NAME=synthesis ARGS="--only ours --seeds 20 --budget 1000"

Three searches judge as many assemblies as the budget allows. Noted are the first that meets every requirement (no rule
of structure broken, both poses reached within the limits and by less than 1e-6, way in m and axis in rad, checked with
the chain of the assembly) and the least cost in the end.

* ours: modcal_core.modules.genetic, as `modcal synthesize` runs it, without its patience.
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
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import yaml

from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.evaluation import Effort, Evaluator, uses_of
from modcal_core.modules.genetic import Archive, SearchSettings, evolve, valid
from modcal_core.modules.library import published
from modcal_core.modules.poe import chain_of
from modcal_core.modules.synthesis import SynthesisTask
from modcal_core.modules.synthesis_data import task_from_data
from modcal_core.robots.kinematics import chain_forward

LIBRARY = published()
CODING = Coding(LIBRARY)
LIMIT = 1e-6
JOINTS = 5
GENE_BITS, BASE_BITS = 10, 5


@dataclass
class Run:
    """One search.

    judged, descents, seconds: until the first arm, or until it gave up; error: of that arm, or NaN. cost: the least of
    all in the end; whole: seconds until then.
    """

    judged: int = 0
    descents: int = 0
    seconds: float = 0.0
    error: float = np.nan
    cost: float = np.inf
    whole: float = 0.0

    @property
    def found(self) -> bool:
        return self.error < LIMIT


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


def ours(task: SynthesisTask, seed: int, budget: int) -> Run:
    run, start = Run(), time.process_time()
    evaluator = Evaluator(LIBRARY, task.targets, task.uses, seed)
    settings = SearchSettings(generations=budget, patience=budget)

    def enough(archive: Archive) -> bool:
        at = archive.verdicts
        if not run.found:
            run.seconds = time.process_time() - start
            run.judged, run.descents = archive.judged, int(at.descents.sum())
            if at.met.any():
                best = at.order()[0]
                run.error = checked(task, archive.genomes[best], at.q[best])
        return archive.judged >= budget

    archive = evolve(CODING, JOINTS, evaluator, np.random.default_rng([seed, JOINTS]), settings, enough=enough)
    run.cost, run.whole = float(archive.verdicts.cost.min()), time.process_time() - start
    return run


def searched(
    task: SynthesisTask,
    evaluator: Evaluator,
    batches: Iterator[np.ndarray],
    budget: int,
    tell: list,
    again: Evaluator | None = None,
) -> Run:
    """Judges batch after batch; ``tell`` gets the verdicts, for the search that makes the next one."""
    run, start, judged, sure = Run(), time.process_time(), 0, np.inf
    kept: dict[bytes, tuple[float, np.ndarray]] = {}
    for genomes in batches:
        verdicts = evaluator(genomes)
        tell[:] = [verdicts]
        judged += len(genomes)
        met = np.flatnonzero(verdicts.met)
        kept |= {genomes[i].tobytes(): (float(verdicts.cost[i]), genomes[i]) for i in met}
        exact = [i for i in met if checked(task, genomes[i], verdicts.q[i]) < LIMIT]
        sure = min([sure, *(float(verdicts.cost[i]) for i in exact)])
        if not run.found:
            run.judged, run.seconds = judged, time.process_time() - start
            run.descents += int(verdicts.descents.sum())
            run.error = min((checked(task, genomes[i], verdicts.q[i]) for i in exact), default=np.nan)
        if judged >= budget:
            break
    run.whole = time.process_time() - start
    best = sorted(kept.values(), key=lambda pair: pair[0])[:50]
    if best:
        run.cost = float(again(np.stack([g for _, g in best])).cost.min()) if again else best[0][0]
        run.cost = min(run.cost, sure)
    return run


def at_random(task: SynthesisTask, seed: int, budget: int) -> Run:
    rng = np.random.default_rng([seed, JOINTS])
    evaluator = Evaluator(LIBRARY, task.targets, task.uses, seed)
    batches = (valid(CODING, JOINTS, 128, rng) for _ in itertools.count())
    return searched(task, evaluator, batches, budget, [])


def as_published(task: SynthesisTask, seed: int, budget: int) -> Run:
    rng = np.random.default_rng([seed, JOINTS])
    weights = {u.name: {**u.options, "weight": u.weight} for u in task.uses if u.weight}
    uses = uses_of({"structure": {}, "reachability": {"tolerance": 0.01}, **weights})
    plain = Effort(starts=1, again=0, hopeless=np.inf, within_limits=False)
    evaluator = Evaluator(LIBRARY, task.targets, uses, seed, plain)
    again = Evaluator(LIBRARY, task.targets, task.uses, seed)
    verdicts: list = []
    return searched(task, evaluator, printed_search(rng, verdicts), budget, verdicts, again)


def printed_search(rng: np.random.Generator, verdicts: list, size: int = 100, kept: int = 2) -> Iterator[np.ndarray]:
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
    """What one search came to."""
    search, _, times = SEARCHES[task["search"]]
    run = search(two_poses(), task["seed"], int(times * task["budget"]))
    return {**asdict(run), "found": run.found}


def main() -> int:
    parser = harness.parser(__doc__, seeds=None, names=SEARCHES)
    parser.add_argument("--budget", type=int, default=1000, help="candidates that a search may judge")
    given = harness.parsed(parser)
    tasks = [
        {"search": name, "seed": given.first + k, "budget": given.budget}
        for name in given.names
        for k in range(SEARCHES[name][1] if given.seeds is None else given.seeds)
    ]
    results = harness.each(one, tasks, given)
    rows, keys = [], ("judged", "descents", "seconds", "cost", "whole")
    for name in given.names:
        runs = [r for r in results if r["search"] == name and not r["failed"]]
        middle = {k: sorted(float(r[k]) for r in runs) for k in keys if runs}
        told = [f"{np.median(v):.3g} ({v[0]:.3g} to {v[-1]:.3g})" for v in middle.values()]
        worst = max((r["error"] for r in runs if r["found"]), default=np.nan)
        rows.append([name, harness.share(r["found"] for r in runs), f"{worst:.0e}", *told])
    heads = (
        "search",
        "found",
        "worst error",
        "judged till then",
        "descents",
        "time, s",
        "least cost in the end",
        "time, s",
    )
    harness.table("Medians and ranges", heads, rows)
    own = [r["found"] for r in results if r["search"] == "ours" and not r["failed"]]
    return int(bool(harness.failures(results))) or harness.met(("ours in 95 %", not own or np.mean(own) >= 0.95))


if __name__ == "__main__":
    sys.exit(main())
