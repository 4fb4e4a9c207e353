"""Wires whose zero shifts, joints that slip, clocks that stamp arrivals, what gives in motion: what is named?

    make bench NAME=gauges ARGS="--seeds 20 --only three"

The arms are those of bench/claims, which share no code with modcal. Wires: 160 rows of three, or 300 of one; the zero
of the first is off by 0.5 to 5 mm between two rows, or its anchor moves, or a joint slips. Clocks: 90 s in motion, a
tracker at 50 Hz with exponential delays of 4 ms, 2 % of them 30 ms more, or bursts of 17; one joint that stays behind
by 1 to 4 mrad per rad/s², or a target by 0.5 to 2 mm per m/s², each as a mass on a spring and a damper. *Second* is
the RMS error over the noise on a second recording without wires' faults, with clocks'.
"""

from __future__ import annotations

import harness

# isort: split
import sys

import numpy as np

sys.path.insert(0, str(harness.BENCH / "claims"))
from arm import Array, Serial, pose, serial
from scipy.signal import lsim

from modcal_core.evaluation import evaluate
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import ORDER_ONLY, JointTrack, ReadingTrack, Recording
from modcal_core.preprocess import prepare
from modcal_core.robots.urdf import read_chain

ARMS = (("ur10", "tool0"), ("panda", "panda_link8"), ("iiwa14", "iiwa_link_ee"))
WIRES = ("wire clean", "wire shifts", "wire anchor", "wire slips", "three clean", "three shifts")
CLOCKS = ("clock clean", "clock arrivals", "clock lost", "clock bursts", "motion winds", "motion swings")
NOISE, REPEAT = 3e-5, 1e-5  # m, rad
DAMPED = 0.15  # of what would not swing
ANCHORS = np.array([[2.0, 0.5, 0.3], [-1.0, 2.0, 0.5], [0.2, -2.2, 1.0]])
NAMED = {
    "winds": "compliance joint",
    "swings": "compliance tool",
    "shifts": "step frame wire_0",
    "anchor": "step base",
    "slips": "step joint",
}


def wires(kind: str, built: Serial, tool: Array, count: int, rng: np.random.Generator, fault: bool) -> Recording:
    """Rows without times, of one wire or of three."""
    q, row, shift = rng.uniform(built.low, built.high, (count, len(built.low))), np.arange(count), np.zeros(count)
    anchors = np.repeat((ANCHORS + rng.normal(0.0, 1e-9, (3, 3)))[:, None], count, axis=1)
    slip, since = np.zeros_like(q), row >= rng.uniform(0.3, 0.7) * count
    if fault and kind.endswith("shifts"):
        between = (row >= rng.uniform(0.15, 0.35) * count) & (row < rng.uniform(0.6, 0.85) * count)
        shift = rng.choice([-1.0, 1.0]) * rng.uniform(5e-4, 5e-3) * between
    elif fault and kind.endswith("anchor"):
        anchors[0] += since[:, None] * rng.normal(0.0, 2e-3, 3)
    elif fault and kind.endswith("slips"):
        slip[:, rng.integers(1, q.shape[1] - 1)] = since * rng.uniform(8e-4, 2.5e-3)
    p = (built.tips(q + slip + rng.normal(0.0, REPEAT, q.shape)) @ tool)[:, :3, 3]
    t = 1.7e9 + 10.0 * row + (0.0 if fault else 1e5)
    tracks = []
    for k in range(3 if kind.startswith("three") else 1):
        d = np.linalg.norm(p - anchors[k], axis=1) + 0.02 * k + rng.normal(0.0, NOISE, count) + shift * (k == 0)
        tracks.append(ReadingTrack("range", f"wire_{k}", t, d[:, None], t))
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(built.names, t, q, unknown, unknown, t)
    return Recording((joints,), tuple(tracks), warnings=(ORDER_ONLY,))


def behind(t: Array, x: Array, gives: float) -> Array:
    """By how much what hangs on x (N, …) by a spring and a damper stays behind it. gives: in the long run, per m/s²."""
    stiff = 1.0 / gives
    spring = ([1.0, 0.0, 0.0], [1.0, 2.0 * DAMPED * np.sqrt(stiff), stiff])
    columns = [lsim(spring, one - one[0], t - t[0])[1] for one in x.reshape(len(t), -1).T]
    return np.stack(columns, axis=1).reshape(x.shape)


def clocks(
    kind: str, built: Serial, tool: Array, seconds: float, rng: np.random.Generator, gives: tuple[int, float]
) -> Recording:
    """Joint states at 100 Hz and points at 50 Hz of a motion of sums of sines. gives: which joint, and by how much."""
    middle, half = 0.5 * (built.low + built.high), 0.5 * (built.high - built.low)
    quick = (0.2, 1.5) if kind.startswith("motion") else (0.08, 0.6)  # rad/s
    turns, phase = (rng.uniform(*ends, (5, len(half))) for ends in (quick, (0.0, 2.0 * np.pi)))
    share = 0.95 * half * rng.dirichlet(np.ones(5), len(half)).T

    def course(t: Array) -> Array:
        return np.asarray(
            middle + np.sum(share[:, None] * np.sin(turns[:, None] * t[None, :, None] + phase[:, None]), 0)
        )

    k = np.arange(round(50.0 * seconds))
    t, taken, kept = np.arange(0.0, seconds, 0.01), 0.2 + 0.02 * k, np.ones(len(k), bool)
    stamps = taken
    if kind.endswith(("arrivals", "lost")):
        delay = 0.006 + rng.exponential(0.004, len(k)) + 0.03 * (rng.random(len(k)) < 0.02)
        stamps = np.maximum.accumulate(taken + delay) + 1e-9 * k
        kept = rng.random(len(k)) > (0.02 if kind.endswith("lost") else 0.0)
    elif kind.endswith("bursts"):
        last = np.minimum(k // 17 * 17 + 16, len(k) - 1)
        stamps = taken[last] + 0.004 + rng.exponential(0.003, len(k))[last] + 2e-4 * (k % 17)
    before = np.arange(-3.0, seconds + 0.3, 0.002)  # a beginning that has died away when readings begin
    at = np.round((taken + 3.0) / 0.002).astype(int)
    postures, moved = course(taken), course(before) if kind.startswith("motion") else np.empty(0)
    if kind.endswith("winds"):
        postures[:, gives[0]] -= behind(before, moved[:, gives[0]], gives[1])[at]
    p = (built.tips(postures) @ tool)[:, :3, 3]
    if kind.endswith("swings"):
        p -= behind(before, (built.tips(moved) @ tool)[:, :3, 3], 0.5 * gives[1])[at]
    p += [0.3, 2.0, -0.4] + rng.normal(0.0, NOISE, (len(k), 3))
    q, unknown = course(t) + rng.normal(0.0, REPEAT, (len(t), len(half))), np.full((len(t), len(half)), np.nan)
    begin = 1.7e9 + rng.uniform(0.0, 1e4)
    joints = JointTrack(built.names, begin + t, q, unknown, unknown, begin + t)
    readings = ReadingTrack("point", "tracker", begin + stamps[kept], p[kept], begin + stamps[kept])
    return Recording((joints,), (readings,))


def one(task: harness.Task) -> harness.Result:
    """What is named in one recording, and the error on a second over its noise."""
    kind, rng, (name, tip) = task["kind"], np.random.default_rng([55, task["seed"]]), ARMS[task["seed"] % 3]
    drawn = serial(harness.ROOT / "examples" / "robots" / f"{name}.urdf", tip)
    built, tool = drawn.wrong("even", rng), pose(rng.normal(0.0, 0.05, 3) + [0.0, 0.0, 0.12], np.zeros(3))
    chain = read_chain((harness.ROOT / "examples" / "robots" / f"{name}.urdf").read_text(encoding="utf-8"), None, tip)
    if kind in CLOCKS:
        draw = np.random.default_rng([56, task["seed"]])
        gives = int(draw.integers(1, len(built.low) - 2)), float(draw.uniform(1e-3, 4e-3))
        first, second = (clocks(kind, built, tool, seconds, rng, gives) for seconds in (90.0, 40.0))
    else:
        count = 160 if kind.startswith("three") else 300
        first, second = (wires(kind, built, tool, n, rng, fault) for n, fault in ((count, True), (100, False)))
    made = calibrate(prepare(first, chain).samples, chain, np.random.default_rng(0))
    left = (
        evaluate(made.calibration, prepare(second, chain).samples, np.random.default_rng(0)).errors["final"].size_mm()
    )
    found = {f"{e.family} {'joint' if e.place in chain.names else e.place}" for e in made.report.effects}
    wanted = NAMED.get(kind.partition(" ")[2])
    floor = 1e3 * NOISE * (np.sqrt(3.0) if kind in CLOCKS else 1.0)
    single = (
        {"outliers tracker"} if kind == "clock lost" else set()
    )  # late by a period and more before one that is lost
    right = found - single == ({wanted} if wanted else set())
    return {"named": right, "found": sorted(found), "status": made.report.status, "second": left.rms / floor}


def main() -> int:
    """Run them, and print how often what was named is right."""
    given = harness.options(__doc__, seeds=4, names=[*WIRES, *CLOCKS], jobs=1)
    tasks = harness.tasks(given, kind=given.names)
    results = harness.each(one, tasks, given, lambda r: f"{r['found']} {r['status']} {r['second']:.2f}")
    harness.counts("named", results, "kind", "named", ("True", "False"))
    for kind in given.names:
        second = [r["second"] for r in results if r["kind"] == kind and not r["failed"]]
        harness.say(f"{kind}: error over noise on a second recording {np.median(second or [np.nan]):.2f}")
    return harness.failures(results) or harness.met(("all is named", all(r.get("named") for r in results)))


if __name__ == "__main__":
    raise SystemExit(main())
