"""Real arms outside what the fit has seen: the outer fifth of a recording, frozen, in blocks.

The grids of a UR5 and of a Barrett WAM (../shared/data/serial_robots), regular grids of positions. The outer fifth is
taken twice: by joint angles, and by measured positions. The distance from the middle counts each joint, or axis, by its
own spread; the farthest fifth is held out and parted into blocks about the two directions in which it extends most. In
no block may the full model be worse than the geometry that was fitted beside it: the lower end of the 95 % interval of
the difference of their mean squares, from resampled postures, must not lie above zero.

And a UR10's long series (../shared/data/ipa_ur10): calibrated where one joint is in the lower, or in the upper three
fifths of its postures, frozen, and judged where that joint is beyond all that was seen.
"""

from __future__ import annotations

import argparse
import csv
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from modcal_core.measurements.recording import Recording
    from modcal_core.measurements.samples import Samples
    from modcal_core.report.report import Report
    from modcal_core.robots.chain import Chain

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data" / "serial_robots"
ROBOTS = {"ur5": "ur5_grid.csv", "wam7": "wam_grid.csv"}
BLOCKS = 5
STAGES = ("nominal", "geometric", "final")
UR10_JOINTS = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
SEEN, BLOCK = 0.6, 200  # share of the postures that is calibrated; poses that its split keeps together
BLEND = 0.05  # rad beyond what was seen, from where on a posture is outside
PERIOD = 10.0  # s between rows, whose times nobody wrote down


def rows(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Commanded joints (N, n) [rad] and measured positions (N, 3) [m]: what was aimed at less the difference to it."""
    with (DATA / ROBOTS[name]).open() as stream:
        table = list(csv.DictReader(stream))

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in table])

    q = np.deg2rad(columns(*(key for key in table[0] if key.startswith("joint_"))))
    return q, 1e-3 * (columns("x_t", "y_t", "z_t") - columns("x_dif", "y_dif", "z_dif"))


def series(every: int) -> Recording:
    """Every so manyth pose of the UR10's long series."""
    from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

    with (DATA.parent / "ipa_ur10" / "series_a_grid.csv").open(encoding="utf-8") as stream:
        table = list(csv.DictReader(stream, delimiter=";"))[::every]

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in table])

    q = columns(*UR10_JOINTS)
    stamps = np.array([datetime.strptime(row["Timestamp"], "%Y%m%d%H%M%S").timestamp() for row in table])
    turns = Rotation.from_euler("XYZ", columns(*(f"measurement_r{a}" for a in "xyz")), degrees=True)
    poses = np.concatenate([1e-3 * columns(*(f"measurement_{a}" for a in "xyz")), turns.as_quat()], axis=1)
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(UR10_JOINTS, stamps, q, unknown, unknown, stamps)
    return Recording((joints,), (ReadingTrack("pose", "tracker", stamps, poses, stamps),))


def unseen_ranges(every: int) -> int:
    """Print a row for each joint's lower and upper part as what is calibrated; how often the full model is worse."""
    from modcal_core.evaluation import evaluate
    from modcal_core.loop import calibrate
    from modcal_core.preprocess import prepare
    from modcal_core.robots.urdf import read_chain

    chain = read_chain((ROOT / "examples" / "robots" / "ur10.urdf").read_text(encoding="utf-8"))
    samples, worse = prepare(series(every), chain).samples, 0
    for j, name in enumerate(UR10_JOINTS[:5]):
        for side, x in (("below", samples.q[:, j]), ("above", -samples.q[:, j])):
            inside = x < np.quantile(x, SEEN)
            beyond = np.flatnonzero(x > x[inside].max() + BLEND)
            block = max(BLOCK // every, 1)
            done = calibrate(samples.select(np.flatnonzero(inside)), chain, np.random.default_rng(0), block=block)
            report = evaluate(done.calibration, samples.select(beyond), np.random.default_rng(0))
            final, geometric = (report.errors[stage].position_norm for stage in ("final", "geometric"))
            low, high = difference(final, geometric, np.random.default_rng(0))
            worse += low > 0.0
            say(f"{name} {side}", report, f"{low:+.4f} … {high:+.4f} mm²{'  WORSE' if low > 0.0 else ''}", rms=True)
    return worse


def outer_fifth(places: np.ndarray) -> np.ndarray:
    """The block of each row of the outer fifth, −1 for those inside, (N,). Rows are joint angles or positions."""
    away = (places - np.median(places, axis=0)) / places.std(axis=0)
    far = np.linalg.norm(away, axis=1)
    outside = far > np.quantile(far, 0.8)
    away = away - away[outside].mean(axis=0)
    directions = np.linalg.svd(away[outside], full_matrices=False)[2][:2]
    angle = np.arctan2(*(away @ directions.T).T)
    edges = np.quantile(angle[outside], np.linspace(0.0, 1.0, BLOCKS + 1)[1:-1])
    return np.where(outside, np.searchsorted(edges, angle), -1)


def difference(final: np.ndarray, geometric: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of the mean of final² − geometric² of the same postures, both (N,) [m]; in mm²."""
    both = 1e6 * (final**2 - geometric**2)
    means = both[rng.integers(len(both), size=(4000, len(both)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def say(what: str, report: Report, end: str, rms: bool = False) -> None:
    """Print the mean errors [mm] of a report by stage, or their RMS."""
    missed = [report.errors[stage].position_norm for stage in STAGES]
    means = [float(np.sqrt(np.nanmean(each**2)) if rms else np.nanmean(each)) for each in missed]
    sizes = "".join(f"{1e3 * each:10.3f}" for each in means)
    print(f"{what:<28}{len(missed[-1]):>10}{sizes}  {end}", flush=True)


def outer(name: str, split: str, samples: Samples, block: np.ndarray, chain: Chain) -> int:
    """Calibrate on what lies inside, print its row, the outer fifth's and its blocks'; how many are worse."""
    from modcal_core.evaluation import evaluate
    from modcal_core.loop import calibrate

    rng, worse = np.random.default_rng(0), 0
    done = calibrate(samples.select(np.flatnonzero(block < 0)), chain, np.random.default_rng(0))
    say(f"{name} {split}, inside", done.report, done.report.judged.status)
    for which in (None, *range(BLOCKS)):
        chosen = np.flatnonzero(block >= 0 if which is None else block == which)
        report = evaluate(done.calibration, samples.select(chosen), np.random.default_rng(0))
        final, geometric = (report.errors[stage].position_norm for stage in ("final", "geometric"))
        low, high = difference(final, geometric, rng)
        bad = low > 0.0
        worse += bad
        say(
            f"{name} {split}, outer" if which is None else f"  block {which + 1}",
            report,
            report.judged.status if which is None else f"{low:+.4f} … {high:+.4f} mm²{'  WORSE' if bad else ''}",
        )
    return worse


def main() -> None:
    """Print the rows of each robot, split both ways, and those of the UR10."""
    from modcal_core.measurements.recording import ORDER_ONLY, JointTrack, ReadingTrack, Recording
    from modcal_core.preprocess import prepare
    from modcal_nodes.cli.robot import read_robot

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="robots whose name holds this")
    parser.add_argument("--every", type=int, default=15, help="so manyth pose of the UR10's series")
    asked = parser.parse_args()
    only = asked.only
    if not DATA.is_dir():
        sys.exit("no real recordings: ../shared/data is not beside this checkout")
    worse = 0
    heads = "".join(f"{head:>10}" for head in ("postures", *STAGES))
    print(f"{'mean error, mm':<28}{heads}  status, or final² − geometric²")
    for name in (name for name in ROBOTS if only in name):
        chain = read_robot(ROOT / "examples" / "robots" / f"{name}.yaml")
        q, p = rows(name)
        stamps = 1.7e9 + PERIOD * np.arange(len(q))
        unknown = np.full_like(q, np.nan)
        joints = JointTrack(chain.names, stamps, q, unknown, unknown, stamps)
        readings = ReadingTrack("point", "tracker", stamps, p, stamps)
        recording = Recording((joints,), (readings,), warnings=(ORDER_ONLY,))
        samples = prepare(recording, chain).samples
        for places, which_fifth in ((samples.q, "by joints"), (samples.reading, "by position")):
            worse += outer(name, which_fifth, samples, outer_fifth(places), chain)
    if only in "ur10":
        print("UR10, RMS, mm")
        worse += unseen_ranges(asked.every)
    sys.exit(f"{worse} worse than geometry" if worse else 0)


if __name__ == "__main__":
    main()
