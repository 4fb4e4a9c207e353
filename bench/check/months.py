"""Does ``modcal history`` see a gear's curve grow by a fifth in four months, and nothing where nothing grows?

    python bench/check/months.py --cells 12

Each cell is an arm of MuJoCo with a gear's wave, calibrated five times a month apart from 80 poses each; base and tool
are put elsewhere each time. In every second cell the wave grows by five per cent a month.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import json  # noqa: E402
import tempfile  # noqa: E402
from datetime import UTC, datetime, timedelta  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from cells import TURN, Arm, Array, Fault, Workplace, workplace  # noqa: E402
from fault import Deviation, Stations  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

import modcal_core as modcal  # noqa: E402
from modcal_nodes.cli.history import read_history  # noqa: E402

STATIONS, MONTHS, MONTH = 80, 5, timedelta(days=30.44)
AMPLITUDE, GROWTH = 4e-4, 0.05  # rad; a month
BEGIN = datetime(2026, 3, 1, tzinfo=UTC)


def wave(joint: int, cycles: int, phase: float, size: float) -> Fault:
    """A gear's wave."""

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, joint, TURN] += size * np.sin(cycles * stations.q[:, joint] + phase)

    return Fault(("gear_harmonic",), (f"joint {joint + 1}",), (), f"{1e3 * size:.3f} mrad", bend)


def calibrated(place: Workplace, rng: np.random.Generator, when: datetime, folder: Path) -> None:
    """A calibration in a folder that begins with its day."""
    arm = place.cell.arm
    q = rng.uniform(*arm.range, (STATIONS, arm.n))
    way = rng.normal(0.0, 0.1, 3)
    place.cell.tracker = place.cell.tracker[0] + way, place.cell.tracker[1] * Rotation.from_rotvec(way)
    seen = place.measure(q, rng, ())
    T: Array = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = seen.p, seen.R.as_matrix()
    stamps = when.timestamp() + 2.0 * np.arange(len(q))
    samples = modcal.Samples.from_arrays(q, poses=T, names=arm.names, stamps=stamps)
    robot = modcal.Robot.from_urdf(arm.urdf, tip=arm.tip)
    modcal.calibrate(robot, samples, seed=0).save(folder / f"{when:%Y-%m-%d}", page=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    named = covered = false = grown = 0
    for seed in range(asked.cells):
        place, rng = workplace(("ur10", "panda", "xarm7")[seed % 3], 3 * (seed + 1000 * asked.seed))
        joint, cycles, phase = int(rng.integers(1, 4)), int(rng.integers(1, 120)), rng.uniform(0, 2 * np.pi)
        growth = GROWTH if seed % 2 == 0 else 0.0
        with tempfile.TemporaryDirectory() as scratch:
            for month in range(MONTHS):
                place.old = (wave(joint, cycles, phase, AMPLITUDE * (1.0 + growth * month)),)
                calibrated(place, rng, BEGIN + month * MONTH, Path(scratch))
            (history,) = read_history(Path(scratch))
        name = f"curve of {place.cell.arm.names[joint]}"
        own = next((s for s in history.series if s.name == name), None)
        trends = [s for s in history.series if s.trend is not None]
        false += sum(s is not own or not growth for s in trends)
        true = 1e3 * AMPLITUDE / np.sqrt(2.0) * growth * (MONTHS - 1)  # of the RMS of a wave over whole turns, nearly
        if growth:
            grown += 1
            named += own is not None and own.trend is not None
            covered += own is not None and own.trend is not None and own.trend.low <= true <= own.trend.high
        values = [] if own is None else [(round(p.value, 4), round(p.std, 4)) for p in own.points]
        said = [s.sentence for s in trends]
        print(
            json.dumps({"seed": seed, "cycles": cycles, "true_mrad": round(true, 4), "values": values, "said": said}),
            flush=True,
        )
    print(f"growth named in {named} of {grown}, its interval holds the truth in {covered}")
    print(f"false trends: {false} in {asked.cells} cells")


if __name__ == "__main__":
    main()
