"""Is a frozen calibration worse than geometry alone outside what was seen, on data that no number was chosen on?

Panda and xArm 7 of bench/undeclared with one to five planted faults: each is calibrated where one joint is in the lower
or the upper three fifths of its postures, and judged where that joint is more than 0.05 rad beyond. Twice at a joint
that carries a fault, once at another. And the grids of a UR5 and a WAM, joint by joint, and the UR10's ISO cubes.
``doubt.UNSURE`` is tried at half and twice its value as well; the calibration is the same, but for what depends on it.

    python bench/fits/held_outside.py --first 97000 --seeds 4
    python bench/fits/held_outside.py --seeds 0 --real wam7 ur5 cubes
"""

from __future__ import annotations

import argparse
import csv
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "bench"), str(ROOT / "bench" / "undeclared")]
import scenarios as kinds  # noqa: E402
from arm import ROBOTS as TIPS  # noqa: E402
from outside import BLEND, DATA, SEEN, UR10_JOINTS, difference, rows  # noqa: E402
from recordings import Cell, plant, point_to_point, record  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from modcal_core.calibration import doubt, finalise, outermost  # noqa: E402
from modcal_core.calibration.score import errors  # noqa: E402
from modcal_core.loop import calibrate  # noqa: E402
from modcal_core.measurements.recording import ORDER_ONLY, JointTrack, ReadingTrack, Recording  # noqa: E402
from modcal_core.measurements.samples import Samples  # noqa: E402
from modcal_core.preprocess import prepare  # noqa: E402
from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_core.robots.urdf_inertias import read_inertias  # noqa: E402
from modcal_nodes.cli.robot import read_robot  # noqa: E402

FACTORS, SHIPPED, STATIONS = (0.5, 1.0, 2.0), doubt.UNSURE, 260
PLANTED: dict[str, tuple[Any, ...]] = {
    **{k: kinds.SCENARIOS[k] for k in ("encoder_eccentricity", "triangular_wave", "hose_drag", "gear_harmonic")},
    "two_curves": (kinds.hose_drag, kinds.triangular_wave),
    "everything": (
        kinds.encoder_eccentricity, kinds.gear_harmonic, kinds.triangular_wave, kinds.hose_drag, kinds.compliance,
    ),
}  # fmt: skip
DECIDED: dict[float, bool] = {}
_ASKED = outermost.geometry_is_better


@dataclass(frozen=True)
class Part:
    """Samples of a robot, the joint and the side of it that is calibrated, and what else a calibration is told."""

    what: str
    samples: Samples
    chain: Any
    joint: int
    side: str
    told: dict[str, Any]


def _decide(*asked: Any) -> bool:
    """What the recording's own ends say, for each factor; returns that of the number as it is."""
    for factor in FACTORS:
        outermost.UNSURE = SHIPPED * factor
        DECIDED[factor] = _ASKED(*asked)
    outermost.UNSURE = SHIPPED
    return DECIDED[1.0]


def planted(first: int, count: int) -> Iterator[Part]:
    """Arms of MuJoCo, three parts of each."""
    for seed in range(first, first + count):
        for robot in ("panda", "xarm7"):
            for kind, makers in PLANTED.items():
                rng = np.random.default_rng([zlib.crc32(f"outside {kind} {robot}".encode()), seed])
                cell = Cell(robot, rng)
                plan = point_to_point(cell.arm, rng, STATIONS, 0.0)
                faults = plant(cell, makers, rng, float(plan.t[-1]))
                recording = record(cell, plan, faults, rng, False, True)[0]
                chain = read_chain(cell.arm.urdf, None, TIPS[robot], frozenset(cell.arm.names))
                samples, told = prepare(recording, chain).samples, {"inertias": read_inertias(cell.arm.urdf, chain)}
                bent = {p for f in faults for p in f.place if p in chain.names and f.family[0] != "compliance"}
                own = sorted(chain.names.index(p) for p in bent)
                draw = np.random.default_rng([seed, 7])
                joint = int(draw.choice(own))
                other = int(draw.choice([j for j in range(len(chain.names)) if j != joint]))
                parts = ((joint, "below"), (joint, "above"), (other, ("below", "above")[int(draw.integers(2))]))
                for j, side in parts:
                    yield Part(f"{robot} {kind} {seed}{' other' if j != joint else ''}", samples, chain, j, side, told)


def real(name: str) -> Iterator[Part]:
    """A real recording, both sides of each joint; of the cubes those of the first five."""
    told: dict[str, Any] = {}
    if name == "cubes":
        chain, told = read_chain((ROOT / "examples/robots/ur10.urdf").read_text(encoding="utf-8")), {"block": 10}
        with (DATA.parent / "ipa_ur10" / "series_d_iso_cubes.csv").open(encoding="utf-8-sig") as stream:
            table = list(csv.DictReader(stream, delimiter=";"))
        q, p, turns = (
            np.array([[float(row[n].replace(",", ".")) for n in names] for row in table])
            for names in (UR10_JOINTS, [f"measurement_{a}" for a in "xyz"], [f"measurement_r{a}" for a in "xyz"])
        )
        read = np.concatenate([1e-3 * p, Rotation.from_euler("XYZ", turns, degrees=True).as_quat()], axis=1)
    else:
        chain = read_robot(ROOT / "examples" / "robots" / f"{name}.yaml")
        q, read = rows(name)
    stamps, unknown = 1.7e9 + 10.0 * np.arange(len(q)), np.full_like(q, np.nan)
    joints = JointTrack(chain.names, stamps, q, unknown, unknown, stamps)
    readings = ReadingTrack("pose" if name == "cubes" else "point", "tracker", stamps, read, stamps)
    samples = prepare(Recording((joints,), (readings,), warnings=(ORDER_ONLY,)), chain).samples
    for j in range(5 if name == "cubes" else len(chain.names)):
        for side in ("below", "above"):
            yield Part(name, samples, chain, j, side, told)


def judged(part: Part) -> tuple[np.ndarray, list[float], float]:
    """Print a row; (final worse than geometry by factor, RMS by factor [mm], RMS of geometry [mm])."""
    x = part.samples.q[:, part.joint] * (1.0 if part.side == "below" else -1.0)
    inside = x < np.quantile(x, SEEN)
    beyond = part.samples.select(np.flatnonzero(x > x[inside].max() + BLEND))
    seen = part.samples.select(np.flatnonzero(inside))
    done = calibrate(seen, part.chain, np.random.default_rng(0), **part.told).calibration
    decided = dict(DECIDED) if done.calibrated.effects else dict.fromkeys(FACTORS, False)

    def missed(model: Any) -> np.ndarray:
        return np.asarray(errors(model, beyond).position_norm)

    full, alone = missed(replace(done.calibrated, fallback=None)), missed(done.geometric)
    sizes, worse = [], []
    for factor in FACTORS:
        doubt.UNSURE = SHIPPED * factor
        asked = replace(done, geometry_outside=decided[factor])
        final = missed(replace(asked.calibrated, fallback=asked.fallback(asked.calibrated, asked.geometric)))
        sizes.append(1e3 * float(np.sqrt(np.mean(final**2))))
        worse.append(difference(final, alone, np.random.default_rng(0))[0] > 0.0)
    doubt.UNSURE = SHIPPED
    rms = [1e3 * float(np.sqrt(np.mean(each**2))) for each in (alone, full)]
    figures = "".join(f"{v:9.3f}" for v in (*rms, *sizes))
    bad = "  WORSE" if worse[1] else ""
    print(f"{part.what:<40}{part.chain.names[part.joint]:<22}{part.side:<6}{len(beyond):>5}{figures}{bad}", flush=True)
    return np.array(worse), sizes, rms[0]


def main() -> None:
    """Print a row for each part, and how often each factor is worse than geometry alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=97000)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--real", nargs="*", default=[], choices=("wam7", "ur5", "cubes"))
    asked = parser.parse_args()
    finalise.geometry_is_better = _decide
    print(f"{'RMS, mm':<68}{'n':>5}" + "".join(f"{h:>9}" for h in ("geometry", "full", "x 0.5", "as is", "x 2")))
    parts = [planted(asked.first, asked.seeds), *(real(name) for name in asked.real)]
    done = [judged(part) for each in parts for part in each]
    worse = np.sum([row[0] for row in done], axis=0)
    ratio = np.exp(np.mean([np.log(np.array(row[1]) / row[2]) for row in done], axis=0))
    print(f"{len(done)} parts; worse than geometry at x {FACTORS}: {worse}")
    print(f"RMS over geometry's, geometric mean: {ratio.round(2)}")


if __name__ == "__main__":
    main()
