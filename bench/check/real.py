"""Checks by real readings: series A of the IPA's UR10 (11 911 poses), and series D of another day.

    python bench/check/real.py --each 150

Calibrated from 662 random stations of series A. Nothing has changed for its other stations, whether ten are drawn from
all of them or ten that follow one another; then each reading is moved as by a base, a tool or a joint's zero. Series D
is of another day: base and tool stand elsewhere, the arm is the same.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import json  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
from collections import Counter  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

import modcal_core as modcal  # noqa: E402
from modcal_core.calibration.store import Calibration  # noqa: E402
from modcal_core.checking.known import pattern_of  # noqa: E402
from modcal_core.checkup import Checked  # noqa: E402
from modcal_core.errors import ModcalError  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402
from modcal_core.measurements.samples import Samples  # noqa: E402
from modcal_core.robot import Robot  # noqa: E402
from modcal_nodes.cli.main import run  # noqa: E402
from modcal_nodes.cli.robot import described  # noqa: E402
from modcal_nodes.io.recorded import opened  # noqa: E402
from modcal_nodes.measuring.measurers import one_a_station  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
CALIBRATED = 662  # stations
STATIONS = 10
MOVED = 3.0  # times the spread, RMS at the tool
Change = Callable[[Samples], tuple[Samples, str]]


def series(letter: str, folder: Path) -> tuple[Robot, Samples]:
    """The robot and the stations of a series, one reading each."""
    bag = folder / f"series_{letter}"
    mapping = ROOT / "examples" / "import" / f"ipa_ur10_series_{letter}.yaml"
    if not bag.exists() and run(["import", str(mapping), "--data", str(DATA), "--out", str(bag)]):
        sys.exit(f"series {letter} cannot be imported")
    recorded = opened(bag)
    robot = described(recorded.recording, None, None, None, None)
    return robot, one_a_station(recorded.samples(robot, 0.5))


def drawn(count: int, rng: np.random.Generator, neighbours: bool) -> np.ndarray:
    """Numbers of ten stations out of so many."""
    if neighbours:
        first = int(rng.integers(count - STATIONS))
        return np.arange(first, first + STATIONS)
    return np.sort(rng.choice(count, STATIONS, replace=False))


def moved(calibration: Calibration, kind: str, spread: float, rng: np.random.Generator) -> Change:
    """A change that moves the tool by three times the spread, put into readings; with what it is to be called."""
    chain = calibration.nominal.serial

    def change(samples: Samples) -> tuple[Samples, str]:
        T = se3.transform(samples.R, samples.reading)
        way = rng.normal(size=6) * np.r_[np.ones(3), 2.0 * np.ones(3)]
        joint = int(rng.integers(chain.n))

        def after(size: float) -> np.ndarray:
            if kind == "base":
                return se3.exp(size * way) @ T
            if kind == "tool":
                return T @ se3.exp(size * way)
            q = samples.q.copy()
            q[:, joint] += size
            return calibration.predict(replace(samples, q=q)) @ se3.inverse(calibration.predict(samples)) @ T

        size = 1e-4
        for _ in range(3):
            rms = np.sqrt(np.mean(np.sum((after(size)[:, :3, 3] - T[:, :3, 3]) ** 2, axis=1)))
            size *= MOVED * spread / max(float(rms), 1e-9)
            size = float(np.clip(size, -0.05, 0.05))  # a zero that hardly moves the tool
        new = after(size)
        label = f"zero of {chain.names[joint]}" if kind == "joint_zero" else kind
        return replace(samples, reading=new[:, :3, 3], R=new[:, :3, :3]), label

    return change


def said(found: Checked, label: str) -> str:
    """What was named, and whether it, or what explains as much, is what was planted."""
    names = " + ".join(" | ".join((c.label, *c.same_as)) for c in found.changes)
    if not names:
        return found.status
    right = any(label in (c.label, *c.same_as) for c in found.changes)
    return f"{'right, ' if right else 'another, ' if label else ''}{found.status}: {names}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=None, help="where the calibration is kept")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        robot, a = series("a", folder)
        some = np.sort(np.random.default_rng(0).choice(len(a), CALIBRATED, replace=False))
        kept = folder / "calibration"
        if not kept.exists():
            modcal.calibrate(robot, a.select(some), seed=0).save(kept, page=False)
        calibration = Calibration.load(kept)
        share = _share(kept)
        print(f"pattern {share:.2f}, spread {1e3 * np.sqrt(3.0) * calibration.noise.position:.3f} mm")
        others = np.setdiff1d(np.arange(len(a)), some)
        rng = np.random.default_rng([asked.seed, 26])
        spread = float(np.sqrt(3.0) * calibration.noise.position)
        for neighbours in (False, True):
            for kind in ("nothing", "base", "tool", "joint_zero"):
                change = None if kind == "nothing" else moved(calibration, kind, spread, rng)
                each = asked.each if kind == "nothing" else max(asked.each // 5, 1)
                table: Counter[str] = Counter()
                for _ in range(each):
                    samples, label = a.select(others[drawn(len(others), rng, neighbours)]), ""
                    if change is not None:
                        samples, label = change(samples)
                    table[_checked(calibration, samples, share, label)] += 1
                print(f"\n{'neighbours' if neighbours else 'random'}, {kind}:")
                for words, count in table.most_common():
                    print(f"  {count:4d}  {words}")
        _, d = series("d", folder)
        d = replace(d, frames=a.frames)
        for neighbours in (False, True):
            table = Counter()
            for _ in range(max(asked.each // 5, 1)):
                table[_checked(calibration, d.select(drawn(len(d), rng, neighbours)), share)] += 1
            print(f"\nanother day, {'neighbours' if neighbours else 'random'}:")
            for words, count in table.most_common():
                print(f"  {count:4d}  {words}")


def _share(folder: Path) -> float:
    share = json.loads((folder / "report.json").read_text())["predictable"]
    return pattern_of(None if share is None else share["share"])


def _checked(calibration: Calibration, samples: Samples, share: float, label: str = "") -> str:
    try:
        return said(modcal.check(calibration, samples, pattern=share), label)
    except ModcalError as error:
        return f"refused: {str(error)[:100]}"


if __name__ == "__main__":
    main()
