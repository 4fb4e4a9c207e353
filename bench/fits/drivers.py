"""Recordings with drivers as people record them: what the best model would leave, and what the cause is called.

Commands beside measured joints, a payload that a topic states, efforts that are missing in places, short standstills.
The arm is that of bench/verdict: MuJoCo's kinematics and statics of displaced bodies. ``ROWS`` has a maker by row.

    python bench/fits/drivers.py --seeds 20 --only late_joint late_in_part
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "verdict"))
sys.path.append(str(Path(__file__).resolve().parent))
from from_truth import HEADS, BesideTruth, beside_truth, together
from in_motion import moving
from scipy.spatial.transform import Rotation
from without_noise import WorksWithoutNoise, exact_samples
from workcell import BEGIN, Session, Works  # which puts bench/undeclared on the path

from arm import ROBOTS as TIPS  # isort: skip

from modcal_core.calibration.cell import Cell
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_core.preprocess import prepare
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias

Array = np.ndarray
ROBOTS = ("ur10", "panda", "xarm7")
SERVO = 1e-5  # rad; what a joint that has arrived differs from its command, besides what is planted


@dataclass(frozen=True)
class Planted:
    """A recording, what the best model leaves of it [mm, RMS], and what must be among the effects.

    named: (family, places) that one of the effects must be of, or nothing. never: families that must not be there.
    exact: the stations without noise; empty where stations are not what is recorded.
    """

    robot: str
    recording: Recording
    floor_mm: float
    named: tuple[str, tuple[str, ...]] | None = None
    never: tuple[str, ...] = ()
    exact: tuple[Session, ...] = ()


Maker = Callable[[np.random.Generator], Planted]


def commands(session: Session, told: Array) -> tuple[JointTrack, ...]:
    """Commanded joints (N, n) on a topic of their own, at the stamps of the stations."""
    unknown = np.full(told.shape, np.nan)
    stamps = BEGIN + session.t
    return (JointTrack(session.names, stamps, told, unknown, unknown, stamps, "/joint_commands"),)


def lagging(works: Works, count: int, share: float, *, effects: bool = False) -> tuple[Session, Array, int]:
    """Stations at which one joint's logged value has yet to come to its command; the arm is nearer to it, by a share.

    Session with the logged joints, commanded joints (N, n), and which joint it is.
    """
    rng = works.rng
    j = works.any_joint(0, 4)
    q, again = works.postures(count)
    bends = [works.elastic(3e-4)] if effects else []
    if effects:
        k = works.any_joint(0, 3)
        cycles = float(rng.integers(20, 80))
        bends.append(works.joint(k, lambda stations: 2e-4 * np.sin(cycles * stations.q[:, k])))
    session = works.observe(q, again, *bends)
    before = np.concatenate([works.arm.range.mean(axis=0)[None], q[:-1]])
    short = np.clip(q - before, -1.0, 1.0)[:, j] * rng.uniform(5e-4, 1.5e-3) * rng.uniform(0.3, 1.0, count)
    logged = q.copy()
    logged[:, j] = q[:, j] - share * short
    told = q + SERVO * rng.standard_normal(q.shape)
    told[:, j] = logged[:, j] + short
    return replace(session, q=logged), told, j


def late_joint(rng: np.random.Generator) -> Planted:
    """Station by station, one joint's logged value is stale by all of commanded − measured."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session, told, j = lagging(works, 130, 1.0)
    recording = replace(session.recording(), commands=commands(session, told))
    return Planted(
        works.robot, recording, session.floor_mm, ("joint_lag", (session.names[j],)), exact=tuple(works.exact)
    )


def late_in_part(rng: np.random.Generator) -> Planted:
    """The same where the arm itself has yet to go a part of the way."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session, told, j = lagging(works, 130, rng.uniform(0.4, 0.9))
    recording = replace(session.recording(), commands=commands(session, told))
    return Planted(
        works.robot, recording, session.floor_mm, ("joint_lag", (session.names[j],)), exact=tuple(works.exact)
    )


def late_at_times(rng: np.random.Generator) -> Planted:
    """At one station in seven the log was written long before the joint had arrived; elsewhere it is right."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    j = works.any_joint(0, 4)
    q, again = works.postures(130)
    session = works.observe(q, again)
    short = np.where(rng.random(130) < 1.0 / 7.0, rng.uniform(2e-3, 1e-2, 130) * rng.choice([-1.0, 1.0], 130), 0.0)
    logged = q.copy()
    logged[:, j] -= short
    told = q + SERVO * rng.standard_normal(q.shape)
    recording = replace(replace(session, q=logged).recording(), commands=commands(session, told))
    return Planted(
        works.robot, recording, session.floor_mm, ("joint_lag", (session.names[j],)), exact=tuple(works.exact)
    )


def late_among_others(rng: np.random.Generator) -> Planted:
    """580 stations of an arm with elastic joints and a gear's error besides."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session, told, j = lagging(works, 580, 1.0, effects=True)
    recording = replace(session.recording(), commands=commands(session, told))
    return Planted(
        works.robot, recording, session.floor_mm, ("joint_lag", (session.names[j],)), exact=tuple(works.exact)
    )


def commanded_as_measured(rng: np.random.Generator) -> Planted:
    """The same recording, its commands given as joint states: the cleaner input must not end worse."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session, told, _ = lagging(works, 580, 1.0, effects=True)
    return Planted(
        works.robot,
        replace(session, q=told).recording(),
        session.floor_mm,
        None,
        ("joint_lag",),
        exact=tuple(works.exact),
    )


def followed_well(rng: np.random.Generator) -> Planted:
    """A sound log: joints differ from their commands, and say so truly. Nothing must be called late."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session = works.clean(130)
    told = session.q + 5e-4 * rng.standard_normal(session.q.shape)
    recording = replace(session.recording(), commands=commands(session, told))
    return Planted(works.robot, recording, session.floor_mm, None, ("joint_lag", "unknown"), exact=tuple(works.exact))


def payload_topic(rng: np.random.Generator) -> Planted:
    """Elastic joints, and a payload that changes between stations and that /payload_kg states."""
    return _carrying(rng, every=1, told=False)


def payload_told(rng: np.random.Generator) -> Planted:
    """The same where the payload is another for some stations at a time, and is told once, when it changes."""
    return _carrying(rng, every=int(rng.integers(3, 36)), told=True)


def _carrying(rng: np.random.Generator, every: int, told: bool) -> Planted:
    """A payload for so many stations; what it is comes with each of them, or two seconds before the first."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(2)], rng)
    q, again = works.postures(140)
    elastic = works.elastic(4e-4)
    levels = np.array([0.0, 1.0, 2.5, 4.0] if works.robot == "ur10" else [0.0, 0.5, 1.0, 2.0])
    carried = np.repeat(levels[rng.integers(len(levels), size=-(-len(q) // every))], every)[: len(q)]
    parts = []
    t = 4.0 * np.arange(len(q))
    for level in levels:
        rows = np.flatnonzero(carried == level)
        if not len(rows):  # of a few changes some levels are never drawn
            continue

        def bend(arm, stations, deviation, kg=level):  # type: ignore[no-untyped-def]
            elastic(arm, stations, deviation)
            deviation.payload += kg

        parts.append(replace(works.observe(q[rows], again[rows], bend), t=t[rows]))
        works.exact[-1] = replace(works.exact[-1], t=t[rows])
    when, what = t, carried
    if told:
        changed = np.r_[True, np.diff(carried) != 0.0]
        when, what = t[changed] - 2.0, carried[changed]
    order = np.argsort(np.concatenate([part.t for part in parts]), kind="stable")
    whole = replace(
        parts[0],
        t=np.concatenate([p.t for p in parts])[order], q=np.concatenate([p.q for p in parts])[order],
        p=np.concatenate([p.p for p in parts])[order], again=np.concatenate([p.again for p in parts])[order],
        R=Rotation.concatenate([p.R for p in parts])[order],
        floor_mm=float(np.sqrt(np.average([p.floor_mm**2 for p in parts], weights=[len(p) for p in parts]))),
        signals=(SignalTrack("signal:/payload_kg", BEGIN + when, what[:, None], "/payload_kg"),),
    )  # fmt: skip
    return Planted(
        works.robot, whole.recording(), whole.floor_mm, ("compliance", whole.names), exact=tuple(works.exact)
    )


def effort_in_places(rng: np.random.Generator) -> Planted:
    """Elastic joints; the joint states of every third station, and of the last tenth, carry no effort."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    session = works.clean(140, works.elastic(4e-4), effort=True)
    assert session.effort is not None
    effort = session.effort.copy()
    effort[::3] = np.nan
    effort[-14:] = np.nan
    return Planted(
        works.robot, replace(session, effort=effort).recording(), session.floor_mm, ("compliance", session.names),
        exact=tuple(works.exact),
    )  # fmt: skip


def short_stands(rng: np.random.Generator, stand: float = 0.4, gap: float = 3.6, rate: float = 25.0) -> Planted:
    """Standstills of 0.4 s, nothing recorded between; readings scatter by more than a station's mean."""
    works = Works(ROBOTS[rng.integers(3)], rng)
    session = works.clean(130, noise_mm=1e-3, noise_mrad=1e-3)
    period, scatter = stand + gap, 6e-5
    when = np.arange(0.0, stand, 1.0 / rate)
    t = BEGIN + (period * np.arange(len(session))[:, None] + when).ravel()
    q = np.repeat(session.q, len(when), axis=0) + 2e-6 * rng.standard_normal((len(t), works.arm.n))
    p = np.repeat(session.p, len(when), axis=0) + rng.normal(0, scatter, (len(t), 3))
    turn = Rotation.from_rotvec(rng.normal(0, scatter, (len(t), 3)))
    R = (Rotation.from_quat(np.repeat(session.R.as_quat(), len(when), axis=0)) * turn).as_quat()
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(session.names, t, q, unknown, unknown, t)
    read = t + 1.7e-3
    reading = ReadingTrack("pose", "tracker", read, np.concatenate([p, R], axis=1), read)
    mean = 1e3 * scatter * np.sqrt(3.0 / len(when))
    return Planted(
        works.robot, Recording((joints,), (reading,), (), session.urdf), float(np.hypot(session.floor_mm, mean))
    )


def short_pauses(rng: np.random.Generator) -> Planted:
    """An arm that goes from posture to posture, recorded all the time, and pauses for 0.4 s at each."""
    works = Works(ROBOTS[rng.integers(3)], rng)
    session = works.clean(130, noise_mm=1e-3, noise_mrad=1e-3)
    stand, leg, rate, scatter = 0.4, 1.6, 100.0, 6e-5
    period = stand + leg
    t = np.arange(0.0, period * len(session), 1.0 / rate)
    k = np.minimum((t / period).astype(int), len(session) - 1)
    before = np.concatenate([session.q[:1] - 0.1, session.q[:-1]])
    u = np.clip((t - period * k) / leg, 0.0, 1.0)[:, None]
    q = before[k] + (10 * u**3 - 15 * u**4 + 6 * u**5) * (session.q - before)[k]
    when = leg + np.arange(0.0, stand, 0.02)
    at = (period * np.arange(len(session))[:, None] + when).ravel()
    p = np.repeat(session.p, len(when), axis=0) + rng.normal(0, scatter, (len(at), 3))
    turn = Rotation.from_rotvec(rng.normal(0, scatter, (len(at), 3)))
    R = (Rotation.from_quat(np.repeat(session.R.as_quat(), len(when), axis=0)) * turn).as_quat()
    unknown = np.full_like(q, np.nan)
    joints = JointTrack(session.names, BEGIN + t, q, unknown, unknown, BEGIN + t)
    read = BEGIN + at + 1.7e-3
    reading = ReadingTrack("pose", "tracker", read, np.concatenate([p, R], axis=1), read)
    mean = 1e3 * scatter * np.sqrt(3.0 / (len(when) * 0.4))  # of what is left after settling, and before it leaves
    return Planted(
        works.robot, Recording((joints,), (reading,), (), session.urdf), float(np.hypot(session.floor_mm, mean))
    )


def slow_joint_states(rng: np.random.Generator) -> Planted:
    """An arm that never stops, its joint states at 8, 20 or 50 Hz with a jitter of a tenth of a step."""
    works = Works(ROBOTS[rng.integers(3)], rng)
    recording = moving(works, rng, float(rng.choice([8.0, 20.0, 50.0])))
    return Planted(works.robot, recording, 2e-2 * np.sqrt(3.0))


def late_joint_in_motion(rng: np.random.Generator) -> Planted:
    """An arm that never stops and follows its commands 10 ms behind; one joint's log is some milliseconds older."""
    works = Works(ROBOTS[rng.integers(3)], rng)
    j = works.any_joint(0, 4)
    late = rng.uniform(5e-3, 15e-3) * (np.arange(works.arm.n) == j)
    recording = moving(works, rng, 100.0, late, ahead=0.01)
    return Planted(works.robot, recording, 2e-2 * np.sqrt(3.0), ("joint_lag", (works.names[j],)))


def late_tracker_with_commands(rng: np.random.Generator) -> Planted:
    """The same with a sound log, and a tracker that is late: no joint must be blamed."""
    works = Works(ROBOTS[rng.integers(3)], rng)
    recording = moving(works, rng, 100.0, clock=rng.uniform(3e-3, 10e-3), ahead=0.01)
    return Planted(works.robot, recording, 2e-2 * np.sqrt(3.0), ("latency", ("tracker",)), ("joint_lag",))


ROWS: dict[str, Maker] = {
    maker.__name__: maker
    for maker in (
        late_joint, late_in_part, late_among_others, commanded_as_measured, followed_well, payload_topic, payload_told,
        effort_in_places, short_stands, short_pauses, slow_joint_states, late_at_times,
        late_joint_in_motion, late_tracker_with_commands,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a fit left, in units of the floor, and whether the cause was named and nothing that is not there. beside:
    the same beside the truth, where stations are what is recorded.
    """

    ratio: float
    beside: BesideTruth | None
    named: bool
    clean: bool
    line: str


def judged(row: str, seed: int) -> Outcome:
    """One seed of a row."""
    planted = ROWS[row](np.random.default_rng([seed, *row.encode()]))
    urdf = planted.recording.robot_description or ""
    chain = read_chain(urdf, None, TIPS[planted.robot], frozenset(planted.recording.joints[0].names))
    began = time.process_time()
    samples = prepare(planted.recording, chain).samples
    done = calibrate(samples, chain, np.random.default_rng(0), inertias=read_inertias(urdf, chain))
    report, spent = done.report, time.process_time() - began
    exact = exact_samples(report.samples, list(planted.exact)) if planted.exact else None
    beside = beside_truth(done, exact, Cell()) if exact is not None else None
    size = report.size_mm("final")
    assert size is not None
    found = [(effect.family, effect.place) for effect in report.effects]
    named = planted.named is None or any(f == planted.named[0] and p in planted.named[1] for f, p in found)
    clean = not any(family in planted.never for family, _ in found)
    ratio = size.rms / planted.floor_mm
    said = ", ".join(f"{e.family} {e.place} {e.driver}" for e in report.effects)
    line = (
        f"{row} {seed} {planted.robot}: {size.rms:.4f} mm, {ratio:.2f} x the floor, "
        f"{'named' if named else 'NOT NAMED'}{'' if clean else ', NOT THERE'}, {len(samples)} samples"
        f"{' in motion' if samples.moving.any() else ''}, {spent:.0f} s{'; ' + beside.words if beside else ''}: {said}"
    )
    return Outcome(ratio, beside, named, clean, line)


def main() -> None:
    """Run the rows and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=ROWS, default=list(ROWS))
    asked = parser.parse_args()
    table = []
    for row in asked.only:
        outcomes = []
        for seed in range(asked.first, asked.first + asked.seeds):
            outcomes.append(judged(row, seed))
            print(outcomes[-1].line, flush=True)
        ratios = np.array([o.ratio for o in outcomes])
        shares = [100.0 * np.mean([getattr(o, name) for o in outcomes]) for name in ("named", "clean")]
        table.append(
            f"| {row} | {len(outcomes)} | {np.sqrt(np.mean(ratios**2)):.3f} | {ratios.max():.2f} | "
            f"{np.mean(ratios <= 1.1):.0%} | {shares[0]:.0f} % | {shares[1]:.0f} % | "
            f"{together([o.beside for o in outcomes if o.beside])} |"
        )
    print(f"| row | seeds | RMS in floors | worst | within 1.1 | cause named | nothing else of its kind | {HEADS} |")
    print("| --- " * (7 + HEADS.count("|") + 1) + "|")
    print("\n".join(table))


if __name__ == "__main__":
    main()
