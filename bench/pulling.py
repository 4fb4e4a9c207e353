"""Random doors and drawers, pulled open through the real nodes over DDS, and in plain ways for comparison.

    make doors                                  # python bench/pulling.py
    python bench/pulling.py --scenes 10 --plain # the plain ways only, in this process, faster than real time
    python bench/pulling.py --one-process       # modcal's way as well, without nodes between it and the physics

Every scene is drawn anew (modcal_nodes/simulation/furniture.py): hinges left, right, above or below, a radius of 22 to
60 cm, dry friction, damping, a closing spring, a grasp that holds firmly or that lets the hand turn, a hand that points
some degrees beside the way the handle sets off. What is known to modcal is the tool's weight and that one pulls along
the hand. Then objects that must not be forced: locked, jammed half way, and a folding door, which no joint describes.

Time is simulated, and waits for the next setpoint, so that the physics does not depend on what else runs; --time-factor
says how fast it may be, 0 takes real time. Writes pulling.md, pulling.json and pulling.png into the folder. Exit code
1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from nodes import own_pull  # noqa: E402
from nodes.plain_pulls import Pull, Way, learnt_wrong, pull, straight  # noqa: E402
from nodes.pulling import PANDA, Opening, open_it  # noqa: E402

from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_nodes.simulation.furniture import Furniture, draw  # noqa: E402
from modcal_nodes.simulation.pulling import Pulling  # noqa: E402

URDF = PANDA.read_text()
CHAIN = read_chain(URDF)
STIFF = "stiff, straight"
PLAIN: dict[str, tuple[Callable[[Furniture], Way], bool]] = {
    STIFF: (straight, False),
    "admittance, straight": (straight, True),
    "stiff, learnt wrong": (learnt_wrong, False),
    "admittance, learnt wrong": (learnt_wrong, True),
}
MIN_OPENED, MAX_PEAK, MAX_MEAN, MIN_RATIO, MAX_REFUSED = 0.95, 40.0, 12.0, 8.0, 60.0
STUBBORN: dict[str, dict[str, Any]] = {
    "locked door": {"kind": "door", "stop": 0.0},
    "locked drawer": {"kind": "drawer", "stop": 0.0},
    "door that jams at 25°": {"kind": "door", "stop": 0.436},
    "drawer that jams at 12 cm": {"kind": "drawer", "stop": 0.12},
    "folding door": {"kind": "folding"},
}


@dataclass(frozen=True)
class Run:
    """One pull in one scene."""

    way: str
    seed: int
    kind: str
    grasp: str
    radius: float | None
    pull: Pull
    seconds: float | None = None
    gap: float | None = None


def scene(seed: int, chosen: dict[str, Any] | None = None) -> Furniture:
    """The scene of a seed, which the node draws again."""
    return draw(CHAIN, np.random.default_rng(seed), chosen)


def plainly(name: str, seed: int, drawn: Furniture) -> Run:
    way, compliant = PLAIN[name]
    made = pull(Pulling.of(URDF, CHAIN, drawn, np.random.default_rng(seed)), way(drawn), compliant)
    return _run(name, seed, drawn, made)


def alone(name: str, seed: int, chosen: dict[str, Any]) -> Run:
    """As modcal pulls, in this process."""
    drawn = scene(seed, chosen)
    return _run(name, seed, drawn, own_pull.pull(Pulling.of(URDF, CHAIN, drawn, np.random.default_rng(seed)), URDF))


def really(name: str, seed: int, chosen: dict[str, Any], factor: float) -> tuple[Run, Opening]:
    """Through the nodes, in real time where factor is 0, else in a simulated time that runs so fast."""
    drawn = scene(seed, chosen)
    paced = {"publish_clock": True, "keep_step": True, "time_factor": factor} if factor else {}
    with tempfile.TemporaryDirectory() as folder:
        opening = open_it(Path(folder), drawn, {"seed": seed, **chosen, **paced}, patience=240.0)
    return _run(name, seed, drawn, opening.pull, opening.seconds, opening.gap), opening


def _run(
    name: str, seed: int, drawn: Furniture, made: Pull, seconds: float | None = None, gap: float | None = None
) -> Run:
    radius = drawn.radius if drawn.turns else None
    return Run(name, seed, drawn.kind, drawn.grasp, radius, made, seconds, gap)


HEAD = (
    "| | peak N, median | largest | mean N, median | largest | opened, median | to the goal |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def row(name: str, runs: Iterable[Run]) -> str:
    pulls = [run.pull for run in runs]
    peak, mean = np.array([p.peak for p in pulls]), np.array([p.mean for p in pulls])
    share = np.array([p.opened / p.goal for p in pulls])
    return (
        f"| {name} | {np.median(peak):.1f} | {peak.max():.1f} | {np.median(mean):.1f} | {mean.max():.1f} "
        f"| {100.0 * np.median(share):.0f} % | {sum(p.done for p in pulls)} of {len(pulls)} |"
    )


def verdicts(opened: list[Run], stiff: list[Run], stubborn: list[Run]) -> list[tuple[bool, str]]:
    """Whether each target is met, and what was found."""
    peaks = np.array([run.pull.peak for run in opened])
    means = np.array([run.pull.mean for run in opened])
    share = np.mean([run.pull.done for run in opened])
    # over all scenes together: where a drawer happens to be pulled straight, stiffness does no harm
    ratio = sum(run.pull.peak for run in stiff) / peaks.sum()
    found = [
        (share >= MIN_OPENED, f"opened: {100.0 * share:.0f} %, at least {100.0 * MIN_OPENED:.0f} %"),
        (peaks.max() <= MAX_PEAK, f"largest peak: {peaks.max():.1f} N, at most {MAX_PEAK:g} N"),
        (means.max() <= MAX_MEAN, f"largest mean: {means.max():.1f} N, at most {MAX_MEAN:g} N"),
        (ratio >= MIN_RATIO, f"peaks below the stiff, straight pull's by {ratio:.1f}, at least {MIN_RATIO:g}"),
    ]
    if stubborn:
        worst = max(run.pull.peak for run in stubborn)
        found.append((worst < MAX_REFUSED, f"what cannot be opened: {worst:.1f} N, below {MAX_REFUSED:g} N"))
    return found


def plot(path: Path, runs: list[Run], openings: list[Opening]) -> None:
    """Peaks of all ways against how far things came, and force against time of each pull through the nodes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11.0, 4.5), layout="constrained")
    for way in dict.fromkeys(run.way for run in runs):
        pulls = [run.pull for run in runs if run.way == way]
        left.plot([100.0 * p.opened / p.goal for p in pulls], [p.peak for p in pulls], ".", label=way)
    left.axhline(MAX_PEAK, color="k", linewidth=0.5)
    left.set(yscale="log", xlabel="opened [% of the goal]", ylabel="peak of the contact force [N]")
    left.legend(fontsize="small")
    for opening in openings:
        right.plot(opening.forces[:, 0], opening.forces[:, 1], linewidth=0.6)
    right.axhline(MAX_PEAK, color="k", linewidth=0.5)
    right.set(xlabel="time since it was asked for [s]", ylabel="contact force [N]", title="modcal")
    figure.savefig(path, dpi=150)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--stubborn", type=int, default=2, help="scenes of each kind that cannot be opened")
    parser.add_argument("--time-factor", type=float, default=1.0, help="of simulated time; 0: real time")
    parser.add_argument("--one-process", action="store_true", help="modcal without its nodes")
    parser.add_argument("--plain", action="store_true", help="without the nodes")
    parser.add_argument("--stiff-only", action="store_true", help="of the plain ways the stiff, straight one alone")
    parser.add_argument("--out", type=Path, default=Path("demo/pulling"))
    chosen = parser.parse_args()
    seeds = range(chosen.seed, chosen.seed + chosen.scenes)
    lines, runs, openings, stubborn = [HEAD], [], [], []
    print(HEAD)

    def say(name: str, done: list[Run]) -> None:
        runs.extend(done)
        lines.append(row(name, done))
        print(lines[-1], flush=True)

    scenes = {seed: scene(seed) for seed in seeds}
    for name in [STIFF] if chosen.stiff_only else PLAIN:
        say(name, [plainly(name, seed, drawn) for seed, drawn in scenes.items()])
    met: list[tuple[bool, str]] = []
    own = "modcal, in one process" if chosen.one_process else "modcal, over DDS"

    def ours(name: str, seed: int, what: dict[str, Any]) -> Run:
        begun = time.monotonic()
        if chosen.one_process:
            run = alone(name, seed, what)
        else:
            run, opening = really(name, seed, what, chosen.time_factor)
            openings.append(opening)
        took = f"{time.monotonic() - begun:.0f} s of wall time"
        print(f"  seed {seed}: {run.kind}, {run.grasp}, {took}: {run.pull}", file=sys.stderr, flush=True)
        return run

    if not chosen.plain:
        made = [ours(own, seed, {}) for seed in seeds]
        say(own, made)
        for name, what in STUBBORN.items():
            done = [ours(name, seed, what) for seed in range(chosen.seed, chosen.seed + chosen.stubborn)]
            stubborn += done
            if done:
                say(f"modcal: {name}", done)
        met = verdicts(made, [run for run in runs if run.way == STIFF], stubborn)
        lines += ["", *(f"- {'met' if ok else 'MISSED'}: {text}" for ok, text in met)]
        print("\n".join(lines[-len(met) :]))
    chosen.out.mkdir(parents=True, exist_ok=True)
    (chosen.out / "pulling.md").write_text("\n".join(lines) + "\n")
    (chosen.out / "pulling.json").write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    plot(chosen.out / "pulling.png", runs, openings)
    return int(not all(ok for ok, _ in met))


if __name__ == "__main__":
    sys.exit(main())
