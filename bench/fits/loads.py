"""Loads as they are: other arms, payloads that change between recordings, columns that tilt, arms on walls.

The arm is that of bench/verdict: MuJoCo's statics of displaced bodies, its springs at the posture that is reached. Only
the writing of recordings comes from modcal. ``ROWS`` has a maker by row.

    python bench/fits/loads.py --seeds 20 --only wall payloads_unknown
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "verdict"))
sys.path.append(str(Path(__file__).resolve().parent))
from bodies_beside import GRAVITY, OTHER, other_torque, with_other_arm
from from_truth import HEADS, BesideTruth, beside_truth, together
from without_noise import WorksWithoutNoise, exact_samples
from workcell import BEGIN, Bend, Session, Works  # which puts bench/undeclared on the path

from arm import DESCRIBED, TILT_X, TILT_Y, TURN  # isort: skip
from arm import ROBOTS as TIPS  # isort: skip

from modcal_core.calibration.cell import Cell
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import Recording, SignalTrack
from modcal_core.measurements.sequence import between
from modcal_core.preprocess import prepare
from modcal_core.report.report import Report
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias

Array = np.ndarray
ROBOTS = ("ur10", "panda", "xarm7")
PAUSE = 600.0  # s between two recordings
CARRIED = {"ur10": (0.5, 8.0), "panda": (0.2, 2.5), "xarm7": (0.2, 3.0)}  # kg


@dataclass(frozen=True)
class Planted:
    """One or several recordings, what the best model leaves of them [mm, RMS], and what must be among the effects.

    named: (families, places) that one of the effects must be of, or nothing. never: families that must not be there.
    down: unit vector (3,) in which weight pulls in the base. carried: payloads [kg], one a recording. exact: the
    recordings without noise.
    """

    robot: str
    recordings: tuple[Recording, ...]
    floor_mm: float
    named: tuple[tuple[str, ...], tuple[str, ...]] | None = None
    never: tuple[str, ...] = ()
    cell: Cell = field(default_factory=Cell)
    down: Array | None = None
    carried: tuple[float, ...] = ()
    exact: tuple[Session, ...] = ()


Maker = Callable[[np.random.Generator], Planted]
SPRINGS = ("compliance", "payload")


def sagging(works: Works, joints: Array, sag: float, payload: float = 0.0) -> Bend:
    """Joints that deflect by about ``sag`` [rad] under the arm's weight."""
    sample = works.arm.coordinates(works.rng.uniform(*works.arm.range, (60, works.arm.n)))
    rms = np.sqrt(np.mean(works.arm.holding(sample)[..., TURN] ** 2, axis=0))
    stiffness = np.where(joints, np.maximum(rms, 0.1 * rms.max()) / sag, np.inf)

    def bend(arm: object, stations: object, deviation: object) -> None:
        deviation.linear[:, TURN] = stiffness  # type: ignore[attr-defined]
        deviation.payload += payload  # type: ignore[attr-defined]

    return bend


def pulled(works: Works, down: Array) -> None:
    """Weight pulls this way in the base from now on."""
    works.arm._model.opt.gravity[:] = GRAVITY * down


def tilted(rng: np.random.Generator, low: float, high: float) -> Array:
    """A direction of weight that is so far [rad] from straight down."""
    angle, way = rng.uniform(low, high), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.sin(angle) * np.cos(way), np.sin(angle) * np.sin(way), -np.cos(angle)])


def several(works: Works, masses: tuple[float, ...], count: int, bend_of: Callable[[float], Bend]) -> list[Session]:
    """A recording for each payload, one after the other."""
    out, begin = [], 0.0
    for mass in masses:
        q, again = works.postures(count, 6)
        session = works.observe(q, again, bend_of(mass), begin=begin)
        begin = float(session.t[-1]) + PAUSE
        out.append(session)
    return out


def floor_of(sessions: list[Session]) -> float:
    return float(np.sqrt(np.average([s.floor_mm**2 for s in sessions], weights=[len(s) for s in sessions])))


def wall(rng: np.random.Generator) -> Planted:
    """An arm on a wall, a slope or a ceiling, of which nobody said so; some of its joints are elastic."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    down = tilted(rng, np.radians(10.0), np.pi)
    pulled(works, down)
    session = works.clean(140, sagging(works, rng.random(works.arm.n) < 0.8, 4e-4))
    return Planted(
        works.robot,
        (session.recording(),),
        session.floor_mm,
        (SPRINGS, session.names),
        down=down,
        exact=tuple(works.exact),
    )


def wall_stiff(rng: np.random.Generator) -> Planted:
    """The same, stiff: nothing shows which way weight pulls, and nothing may be said of it."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    pulled(works, tilted(rng, np.radians(10.0), np.pi))
    session = works.clean(140)
    return Planted(works.robot, (session.recording(),), session.floor_mm, None, ("*",), exact=tuple(works.exact))


def upright(rng: np.random.Generator) -> Planted:
    """An arm on the floor with elastic joints and encoders off their centres: weight pulls straight down."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    i, size, phase = works.any_joint(1, 4), rng.uniform(2e-4, 4e-4), rng.uniform(0.0, 2.0 * np.pi)
    session = works.clean(
        140,
        sagging(works, rng.random(works.arm.n) < 0.8, 3e-4),
        works.joint(i, lambda stations: size * np.sin(stations.q[:, i] + phase)),
    )
    return Planted(
        works.robot, (session.recording(),), session.floor_mm, (SPRINGS, session.names), exact=tuple(works.exact)
    )


def eccentric(rng: np.random.Generator) -> Planted:
    """A stiff arm on the floor, two encoders off their centres: the error of a joint, not a load of another way."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    off = []
    for i in rng.choice(np.arange(1, 5), 2, replace=False):
        size, phase = rng.uniform(2e-4, 4e-4), rng.uniform(0.0, 2.0 * np.pi)
        off.append(works.joint(int(i), lambda s, i=i, size=size, phase=phase: size * np.sin(s.q[:, i] + phase)))
    session = works.clean(140, *off)
    return Planted(
        works.robot,
        (session.recording(),),
        session.floor_mm,
        (("gear_harmonic",), session.names),
        SPRINGS,
        exact=tuple(works.exact),
    )


def _loads(rng: np.random.Generator) -> tuple[WorksWithoutNoise, tuple[float, ...], list[Session]]:
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    low, high = CARRIED[works.robot]
    masses = tuple(float(m) for m in (0.0, *rng.uniform(low + 0.2 * (high - low), high, 2)))
    masses = tuple(masses[i] for i in rng.permutation(3))
    joints = np.ones(works.arm.n, bool)
    springs = sagging(works, joints, 3e-4)

    def bend_of(mass: float) -> Bend:
        def bend(arm: object, stations: object, deviation: object) -> None:
            springs(arm, stations, deviation)
            deviation.payload += mass  # type: ignore[attr-defined]

        return bend

    return works, masses, several(works, masses, 70, bend_of)


def payloads_unknown(rng: np.random.Generator) -> Planted:
    """Three recordings, each with another payload that nobody stated; elastic joints."""
    works, masses, sessions = _loads(rng)
    recordings = tuple(s.recording() for s in sessions)
    return Planted(
        works.robot, recordings, floor_of(sessions), (SPRINGS, works.names), carried=masses, exact=tuple(works.exact)
    )


def payloads_topic(rng: np.random.Generator) -> Planted:
    """The same, a topic in each recording says how much."""
    works, masses, sessions = _loads(rng)
    recordings = []
    for mass, session in zip(masses, sessions, strict=True):
        told = SignalTrack("signal:/payload_kg", BEGIN + session.t, np.full((len(session), 1), mass), "/payload_kg")
        recordings.append(replace(session, signals=(told,)).recording())
    return Planted(works.robot, tuple(recordings), floor_of(sessions), (SPRINGS, works.names), exact=tuple(works.exact))


def payload_unknown(rng: np.random.Generator) -> Planted:
    """One recording with a payload that nobody stated; elastic joints."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    low, high = CARRIED[works.robot]
    mass = float(rng.uniform(low + 0.4 * (high - low), high))
    session = works.clean(160, sagging(works, np.ones(works.arm.n, bool), 3e-4, mass))
    recording = session.recording()
    return Planted(
        works.robot, (recording,), session.floor_mm, (SPRINGS, session.names), carried=(mass,), exact=tuple(works.exact)
    )


def clean_recordings(rng: np.random.Generator) -> Planted:
    """Three recordings of a stiff arm with three payloads: nothing is wrong."""
    works = WorksWithoutNoise(ROBOTS[rng.integers(3)], rng)
    sessions = several(works, (0.0, 1.0, 2.0), 60, lambda _: sagging(works, np.zeros(works.arm.n, bool), 3e-4))
    recordings = tuple(s.recording() for s in sessions)
    return Planted(works.robot, recordings, floor_of(sessions), None, ("*",), exact=tuple(works.exact))


def column(rng: np.random.Generator) -> Planted:
    """A lifting column that tilts under the moment of the arm that it carries."""
    works = WorksWithoutNoise("lifted", rng)
    sample = works.arm.coordinates(rng.uniform(*works.arm.range, (60, works.arm.n)))
    moment = works.arm.holding(sample)[:, 0, TILT_X : TILT_Y + 1]
    stiffness = float(np.sqrt(np.mean(np.sum(moment**2, axis=1)))) / rng.uniform(2e-4, 6e-4)

    def bend(arm: object, stations: object, deviation: object) -> None:
        deviation.linear[0, TILT_X : TILT_Y + 1] = stiffness  # type: ignore[attr-defined]

    session = works.clean(140, bend)
    return Planted(
        "lifted", (session.recording(),), session.floor_mm, (SPRINGS, ("lift", "lift_link")), exact=tuple(works.exact)
    )


def other_arm(rng: np.random.Generator) -> Planted:
    """An elastic torso that carries another arm as well, whose joints are recorded beside the measured arm's."""
    works = WorksWithoutNoise("torso", rng)
    turns = rng.uniform(-1.5, 1.5, (140, 2))
    sample = works.arm.coordinates(rng.uniform(*works.arm.range, (60, works.arm.n)))
    stiffness = float(np.sqrt(np.mean(works.arm.holding(sample)[:, 0, TURN] ** 2))) / rng.uniform(4e-4, 9e-4)

    def bend(arm: object, stations: object, deviation: object) -> None:
        deviation.linear[0, TURN] = stiffness  # type: ignore[attr-defined]
        own = other_torque(stations.q[:, 0], turns)  # type: ignore[attr-defined]
        deviation.x[:, 0, TURN] += own / stiffness  # type: ignore[attr-defined]

    session = works.clean(140, bend)
    urdf = with_other_arm(session.urdf)
    more = {name: turns[:, i] for i, (name, *_) in enumerate(OTHER)}
    recording = replace(session, urdf=urdf, more=more).recording()
    return Planted(
        "torso", (recording,), session.floor_mm, (SPRINGS, ("torso", "torso_link")), exact=tuple(works.exact)
    )


ROWS: dict[str, Maker] = {
    maker.__name__: maker
    for maker in (
        other_arm, payload_unknown, payloads_unknown, payloads_topic, column, wall,
        wall_stiff, clean_recordings, upright, eccentric,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a fit left, in units of the floor, whether the cause was named, and nothing that is not there.

    gravity_deg, kg: how far gravity's direction and the payloads are from the truth, NaN where nothing is said.
    beside: what is left over what the truth leaves of the same stations, and over the same fit begun at the truth.
    """

    ratio: float
    beside: BesideTruth
    named: bool
    clean: bool
    gravity_deg: float
    kg: float
    line: str


def judged(row: str, seed: int) -> Outcome:
    """One seed of a row."""
    planted = ROWS[row](np.random.default_rng([seed, *row.encode()]))
    first = planted.recordings[0]
    urdf = first.robot_description or ""
    tip = TIPS.get(planted.robot) or DESCRIBED[planted.robot][1]
    chain = read_chain(urdf, None, tip, frozenset(first.joints[0].names))
    began = time.process_time()
    samples, cell, cuts = prepare(first, chain).samples, planted.cell, []
    for recording in planted.recordings[1:]:
        later = prepare(recording, chain).samples
        cuts.append(between(samples, later))
        samples = samples.followed_by(later)
    if "between" in Cell.__dataclass_fields__:
        cell = replace(cell, between=tuple(cuts))
    done = calibrate(samples, chain, np.random.default_rng(0), cell, inertias=read_inertias(urdf, chain))
    report, spent = done.report, time.process_time() - began
    beside = beside_truth(done, exact_samples(report.samples, list(planted.exact)), cell)
    size = report.size_mm("final")
    assert size is not None
    assert report.judged is not None
    found = [(effect.family, effect.place) for effect in report.effects if effect.family != "outliers"]
    named = planted.named is None or any(f in planted.named[0] and p in planted.named[1] for f, p in found)
    clean = not (found if "*" in planted.never else [f for f, _ in found if f in planted.never])
    gravity, kg, told = compared(report, planted)
    if planted.down is None and np.isfinite(gravity):
        clean = False
    if planted.down is not None and not gravity < 5.0:
        named = False
    ratio = size.rms / planted.floor_mm
    said = ", ".join(f"{e.family} {e.place} {e.driver}" for e in report.effects)
    line = (
        f"{row} {seed} {planted.robot}: {size.rms:.4f} mm, {ratio:.2f} x the floor, "
        f"{'named' if named else 'NOT NAMED'}{'' if clean else ', NOT THERE'}, {report.judged.status}, "
        f"{spent:.0f} s; {beside.words}: {told}{said}"
    )
    return Outcome(ratio, beside, named, clean, gravity, kg, line)


def compared(report: Report, planted: Planted) -> tuple[float, float, str]:
    """Angle [deg] between found and true weight, largest error of a payload [kg], and both in words."""
    loads = getattr(report, "loads", None)
    if loads is None:
        return float("nan"), float("nan"), ""
    gravity, kg, said = float("nan"), float("nan"), ""
    if loads.down is not None:
        true = np.array([0.0, 0.0, -1.0]) if planted.down is None else planted.down
        gravity = float(np.degrees(np.arccos(np.clip(loads.down @ true, -1.0, 1.0))))
        said += f"gravity off by {gravity:.2f} deg (of {np.degrees(loads.down_std):.2f}); "
    if loads.payloads:
        true_kg = np.array(planted.carried or (0.0,) * len(loads.payloads))
        masses = np.array([p.mass for p in loads.payloads])
        if len(masses) == len(true_kg):
            kg = float(np.abs(masses - true_kg).max())
        said += f"carried {', '.join(f'{m:.2f}' for m in masses)} kg, truly {', '.join(f'{m:.2f}' for m in true_kg)}; "
    return gravity, kg, said


def main() -> None:
    """Run the rows and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
        off = [_median([getattr(o, name) for o in outcomes]) for name in ("gravity_deg", "kg")]
        inside = np.mean(ratios <= 1.1)
        table.append(
            f"| {row} | {len(outcomes)} | {np.median(ratios):.2f} | {ratios.max():.2f} | {inside:.0%} | "
            f"{shares[0]:.0f} % | {shares[1]:.0f} % | {off[0]} | {off[1]} | {together([o.beside for o in outcomes])} |"
        )
    print(f"| row | seeds | median | worst | within 1.1 | cause named | nothing else of its kind | ° | kg | {HEADS} |")
    print("| --- " * (9 + HEADS.count("|") + 1) + "|")
    print("\n".join(table))


def _median(values: list[float]) -> str:
    known = [v for v in values if np.isfinite(v)]
    return f"{np.median(known):.2f} ({len(known)})" if known else ""


if __name__ == "__main__":
    main()
