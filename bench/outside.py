"""Outside what a fit has seen: is a frozen calibration there worse than geometry alone?

    make bench NAME=outside ARGS="--only ur5 planted --seeds 4"

Each part is calibrated where one joint is in the lower or the upper three fifths of its postures, and judged where that
joint is more than 0.05 rad beyond; or, of the grids of a UR5 and a WAM, on all but the outer fifth of the recording (by
joint angles or by positions), judged in blocks of it. *Worse* is an error above that of geometry alone by the lower
end of the 95 % interval of the difference of their mean squares, from resampled postures.

fifth_ur5, fifth_wam7: the outer fifth, in blocks. ur10: every fifteenth pose of its long series, five joints, both
sides. ur5, wam7, cubes: grids and ISO cubes joint by joint. planted: a Panda and an xArm 7 of bench/undeclared with one
to five faults (seeds from 97000), twice at a joint that carries a fault, once at another. Last figures:

| | parts | full model worse | shipped worse | geometry, RMS mm | full | shipped |
| --- | --: | --: | --: | --: | --: | --: |
| planted | 144 | 10 | 1 | 0.132 | 0.082 | 0.097 |
| ur5 | 12 | 4 | 0 | 0.135 | 0.171 | 0.124 |
| wam7 | 14 | 1 | 1 | 4.160 | 3.758 | 3.759 |
| cubes | 10 | 4 | 1 | 1.647 | 4.948 | 1.631 |
"""

from __future__ import annotations

import harness

# isort: split
import sys
import zlib
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
import recorded
import scenarios as kinds
from arms import ROBOTS as TIPS
from harness import over
from recordings import plant, record
from sites import Cell, point_to_point

from modcal_core.calibration.noise import errors
from modcal_core.evaluation import evaluate
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import ORDER_ONLY, JointTrack, ReadingTrack, Recording
from modcal_core.measurements.samples import Samples
from modcal_core.preprocess import prepare
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.cli.inputs import read_robot

Array = np.ndarray
BLOCKS, SEEN, BLEND = 5, 0.6, 0.05  # of the outer fifth; share of the postures that is calibrated; rad beyond it
STATIONS, PERIOD = 260, 10.0  # of a planted cell; s between rows whose times nobody wrote down
PLANTED = {k: kinds.SCENARIOS[k] for k in ("encoder_eccentricity", "triangular_wave", "hose_drag", "gear_harmonic")}
PLANTED["two_curves"] = kinds.hose_drag, kinds.triangular_wave
PLANTED["everything"] = (
    kinds.encoder_eccentricity,
    kinds.gear_harmonic,
    *PLANTED["two_curves"][::-1],
    kinds.compliance,
)
FIFTHS, REAL = ("fifth_ur5", "fifth_wam7"), ("ur10", "ur5", "wam7", "cubes")
FIRST = 97000


def of_arrays(chain: Any, q: Array, read: Array, stamps: Array | None = None) -> Samples:
    """Samples of postures and points or poses; without stamps only the order of the rows is known."""
    t = 1.7e9 + PERIOD * np.arange(len(q)) if stamps is None else stamps
    unknown = np.full_like(q, np.nan)
    kind = "point" if read.shape[1] == 3 else "pose"
    tracks = (JointTrack(chain.names, t, q, unknown, unknown, t),), (ReadingTrack(kind, "tracker", t, read, t),)
    return prepare(Recording(*tracks, warnings=(ORDER_ONLY,) if stamps is None else ()), chain).samples


def real(name: str, every: int) -> tuple[Any, Samples, dict[str, Any], int]:
    """Chain, samples, what a calibration is told, and how many joints are looked at."""
    if name in recorded.GRIDS:
        chain = read_robot(harness.ROBOTS / f"{name}.yaml").chain
        return chain, of_arrays(chain, *recorded.grid(name)), {}, len(chain.names)
    chain = read_chain((harness.ROBOTS / "ur10.urdf").read_text(encoding="utf-8"))
    if name == "cubes":
        return chain, of_arrays(chain, *recorded.ur10("series_d_iso_cubes.csv")[1:]), {"block": 10}, 5
    table, q, poses = recorded.ur10("series_a_grid.csv", every)
    stamps = np.array([datetime.strptime(row["Timestamp"], "%Y%m%d%H%M%S").timestamp() for row in table.rows])
    return chain, of_arrays(chain, q, poses, stamps), {"block": max(200 // every, 1)}, 5


def planted(task: harness.Task) -> tuple[Any, Samples, dict[str, Any], Iterator[tuple[int, str]]]:
    """The same of an arm of MuJoCo, with its joints and sides."""
    robot, seed = task["robot"], task["seed"]
    rng = np.random.default_rng([zlib.crc32(f"outside {task['fault']} {robot}".encode()), seed])
    cell = Cell(robot, rng)
    plan = point_to_point(cell.arm, rng, STATIONS, 0.0)
    faults = plant(cell, PLANTED[task["fault"]], rng, float(plan.t[-1]))
    chain = read_chain(cell.arm.urdf, None, TIPS[robot], frozenset(cell.arm.names))
    samples = prepare(record(cell, plan, faults, rng, False, True)[0], chain).samples
    bent = {p for f in faults for p in f.place if p in chain.names and f.family[0] != "compliance"}
    draw = np.random.default_rng([seed, 7])
    own = int(draw.choice(sorted(chain.names.index(p) for p in bent)))
    other = int(draw.choice([j for j in range(len(chain.names)) if j != own]))
    parts = iter(((own, "below"), (own, "above"), (other, ("below", "above")[int(draw.integers(2))])))
    return chain, samples, {"inertias": read_inertias(cell.arm.urdf, chain)}, parts


def one(task: harness.Task) -> harness.Result:
    """A whole recording: its parts, each with the RMS or mean errors [mm] of every model, and what is worse."""
    if task["part"] == "planted":
        chain, samples, told, parts = planted(task)
    else:
        chain, samples, told, joints = real(task["part"].removeprefix("fifth_"), task["every"])
        if task["part"] in FIFTHS:
            return {"parts": [p for places in ("joints", "position") for p in outer(places, samples, chain)]}
        parts = ((j, side) for j in range(joints) for side in ("below", "above"))
    return {"parts": [beyond(samples, chain, j, side, told) for j, side in parts]}


def beyond(samples: Samples, chain: Any, joint: int, side: str, told: dict[str, Any]) -> harness.Result:
    """Calibrated on one side of a joint, judged on the other."""
    x = samples.q[:, joint] * (1.0 if side == "below" else -1.0)
    inside = x < np.quantile(x, SEEN)
    rest = samples.select(np.flatnonzero(x > x[inside].max() + BLEND))
    done = calibrate(samples.select(np.flatnonzero(inside)), chain, np.random.default_rng(0), **told).calibration
    models = {"nominal": done.nominal, "geometry": done.geometric, "full": replace(done.calibrated, fallback=None)}
    models["shipped"] = replace(done.calibrated, fallback=done.fallback(done.calibrated, done.geometric))
    missed = {name: np.asarray(errors(model, rest).position_norm) for name, model in models.items()}
    return {"what": f"{chain.names[joint]} {side}", "postures": len(rest), **compared(missed)}


def outer(places: str, samples: Samples, chain: Any) -> Iterator[harness.Result]:
    """Calibrated on what lies inside, judged on the outer fifth and its blocks."""
    block = outer_fifth(samples.q if places == "joints" else samples.reading)
    done = calibrate(samples.select(np.flatnonzero(block < 0)), chain, np.random.default_rng(0))
    for which in ("inside", "outer", *range(BLOCKS)):
        report = done.report
        if which != "inside":
            rows = np.flatnonzero(block >= 0 if which == "outer" else block == which)
            report = evaluate(done.calibration, samples.select(rows), np.random.default_rng(0))
        names = {"nominal": "nominal", "geometric": "geometry", "final": "shipped"}
        missed = {names[stage]: report.errors[stage].position_norm for stage in names}
        judged = {**compared(missed, np.mean), "status": report.judged.status, "postures": len(missed["shipped"])}
        yield {"what": f"by {places}, {which if isinstance(which, str) else f'block {which + 1}'}", **judged}


def compared(missed: dict[str, Array], size: Any = harness.rms) -> harness.Result:
    """Errors [mm], and what is worse than geometry: the model that is shipped, and the full one where it is known."""
    sizes = {f"{name}_mm": 1e3 * float(size(each)) for name, each in missed.items()}
    low, high = difference(missed["shipped"], missed["geometry"])
    full = "full" in missed and difference(missed["full"], missed["geometry"])[0] > 0.0
    out = {"full_mm": None, **sizes, "shipped² − geometry²": f"{low:+.4f} … {high:+.4f} mm²"}
    return {**out, "worse": bool(low > 0.0), "full_worse": bool(full)}


def difference(final: Array, geometric: Array) -> tuple[float, float]:
    """95 % interval of the mean of final² − geometric² of the same postures, both (N,) [m]; in mm²."""
    both = 1e6 * (final**2 - geometric**2)
    means = both[np.random.default_rng(0).integers(len(both), size=(4000, len(both)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def outer_fifth(places: Array) -> Array:
    """The block of each row of the outer fifth, −1 for those inside, (N,). Rows are joint angles or positions.

    Each joint or axis counts by its own spread; blocks lie about the two directions in which the fifth extends most.
    """
    away = (places - np.median(places, axis=0)) / places.std(axis=0)
    far = np.linalg.norm(away, axis=1)
    outside = far > np.quantile(far, 0.8)
    away = away - away[outside].mean(axis=0)
    directions = np.linalg.svd(away[outside], full_matrices=False)[2][:2]
    angle = np.arctan2(*(away @ directions.T).T)
    edges = np.quantile(angle[outside], np.linspace(0.0, 1.0, BLOCKS + 1)[1:-1])
    return np.where(outside, np.searchsorted(edges, angle), -1)


MODELS = ("nominal_mm", "geometry_mm", "full_mm", "shipped_mm")


def main() -> int:
    given = harness.options(__doc__, seeds=4, first=FIRST, names=(*FIFTHS, *REAL, "planted"), every=15)
    tasks = [{"part": part, "every": given.every} for part in given.names if part != "planted"]
    if "planted" in given.names:
        tasks += harness.tasks(given, part=["planted"], robot=("panda", "xarm7"), fault=PLANTED)
    results = harness.each(one, tasks, given, lambda r: f"{sum(p['worse'] for p in r['parts'])} worse")
    told = ("part", "robot", "fault", "seed")
    parts = [{**{k: r.get(k) for k in told}, **p} for r in results if not r["failed"] for p in r["parts"]]
    harness.rows("mm", parts, (*told, "what", "postures", *MODELS, "shipped² − geometry²", "worse"))
    columns = {"full worse": over("full_worse", sum), "shipped worse": over("worse", sum)}
    harness.summary("Means", parts, "part", columns | {key: over(key, np.mean) for key in MODELS[1:]})
    worse = sum(p["worse"] for p in parts)
    return harness.ended(results, (f"{worse} parts are worse than geometry", not worse))


if __name__ == "__main__":
    sys.exit(main())
