"""Loads as they are: arms on walls, payloads that change between recordings, columns that tilt, another arm beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from arm import TILT_X, TILT_Y, TURN
from workcell import BEGIN, Bend, Session
from works import GRAVITY, OTHER, Exact, Planted, Row, carrying, floor_of, other_torque, with_other_arm

from modcal_core.measurements.recording import SignalTrack

Array = np.ndarray
Rng = np.random.Generator
PAUSE = 600.0  # s between two recordings
CARRIED = {"ur10": (0.5, 8.0), "panda": (0.2, 2.5), "xarm7": (0.2, 3.0)}  # kg
SPRINGS = ("compliance", "payload")


def pulled(works: Exact, rng: Rng) -> Array:
    """Weight pulls at 10° to 180° from straight down from now on: that unit vector in the base."""
    angle, way = rng.uniform(np.radians(10.0), np.pi), rng.uniform(0.0, 2.0 * np.pi)
    down = np.array([np.sin(angle) * np.cos(way), np.sin(angle) * np.sin(way), -np.cos(angle)])
    works.arm._model.opt.gravity[:] = GRAVITY * down
    return down


def off_centre(works: Exact, rng: Rng, i: int) -> Bend:
    """An encoder that is off its centre."""
    size, phase = rng.uniform(2e-4, 4e-4), rng.uniform(0.0, 2.0 * np.pi)
    return works.joint(i, lambda stations: size * np.sin(stations.q[:, i] + phase))


def single(session: Session, named: Any = None, **told: Any) -> Planted:
    return Planted((session.recording(),), session.floor_mm, named, **told)


def wall(works: Exact, rng: Rng) -> Planted:
    """An arm on a wall, a slope or a ceiling, of which nobody said so; some of its joints are elastic."""
    down = pulled(works, rng)
    session = works.clean(140, works.sagging(rng.random(works.arm.n) < 0.8, 4e-4))
    return single(session, (SPRINGS, session.names), down=down)


def wall_stiff(works: Exact, rng: Rng) -> Planted:
    """The same, stiff: nothing shows which way weight pulls, and nothing may be said of it."""
    pulled(works, rng)
    return single(works.clean(140), never=("*",))


def upright(works: Exact, rng: Rng) -> Planted:
    """An arm on the floor with elastic joints and an encoder off its centre: weight pulls straight down."""
    off = off_centre(works, rng, works.any_joint(1, 4))
    return single(works.clean(140, works.sagging(rng.random(works.arm.n) < 0.8, 3e-4), off), (SPRINGS, works.names))


def eccentric(works: Exact, rng: Rng) -> Planted:
    """A stiff arm on the floor, two encoders off their centres: the error of a joint, not a load of another way."""
    off = [off_centre(works, rng, int(i)) for i in rng.choice(np.arange(1, 5), 2, replace=False)]
    return single(works.clean(140, *off), (("gear_harmonic",), works.names), never=SPRINGS)


def several(works: Exact, masses: tuple[float, ...], count: int, bend_of: Callable[[float], Bend]) -> list[Session]:
    """A recording for each payload, one after the other."""
    out, begin = [], 0.0
    for kg in masses:
        q, again = works.postures(count, 6)
        out.append(works.observe(q, again, bend_of(kg), begin=begin))
        begin = float(out[-1].t[-1]) + PAUSE
    return out


def payloads(works: Exact, rng: Rng, told: bool) -> Planted:
    """Three recordings, each with another payload, on elastic joints. told: a topic in each says how much."""
    low, high = CARRIED[works.robot]
    drawn = (0.0, *rng.uniform(low + 0.2 * (high - low), high, 2))
    masses = tuple(float(drawn[i]) for i in rng.permutation(3))
    springs = works.sagging(np.ones(works.arm.n, bool), 3e-4)
    sessions = several(works, masses, 70, lambda kg: carrying(springs, kg))
    if told:
        tracks = [
            SignalTrack("signal:/payload_kg", BEGIN + s.t, np.full((len(s), 1), kg), "/payload_kg")
            for kg, s in zip(masses, sessions, strict=True)
        ]
        sessions = [replace(s, signals=(track,)) for s, track in zip(sessions, tracks, strict=True)]
    recordings = tuple(s.recording() for s in sessions)
    return Planted(recordings, floor_of(sessions), (SPRINGS, works.names), carried=() if told else masses)


def payload_unknown(works: Exact, rng: Rng) -> Planted:
    """One recording with a payload that nobody stated; elastic joints."""
    low, high = CARRIED[works.robot]
    kg = float(rng.uniform(low + 0.4 * (high - low), high))
    session = works.clean(160, works.sagging(np.ones(works.arm.n, bool), 3e-4, kg))
    return single(session, (SPRINGS, session.names), carried=(kg,))


def clean_recordings(works: Exact, rng: Rng) -> Planted:
    """Three recordings of a stiff arm: nothing is wrong."""
    stiff = np.zeros(works.arm.n, bool)
    sessions = several(works, (0.0, 1.0, 2.0), 60, lambda _: works.sagging(stiff, 3e-4))
    return Planted(tuple(s.recording() for s in sessions), floor_of(sessions), never=("*",))


def column(works: Exact, rng: Rng) -> Planted:
    """A lifting column that tilts under the moment of the arm that it carries."""
    stiffness = float(works.rms_torque(0, slice(TILT_X, TILT_Y + 1))) / rng.uniform(2e-4, 6e-4)

    def bend(arm: Any, stations: Any, deviation: Any) -> None:
        deviation.linear[0, TILT_X : TILT_Y + 1] = stiffness

    return single(works.clean(140, bend), (SPRINGS, ("lift", "lift_link")))


def other_arm(works: Exact, rng: Rng) -> Planted:
    """An elastic torso that carries another arm as well, whose joints are recorded beside the measured arm's."""
    turns = rng.uniform(-1.5, 1.5, (140, 2))
    stiffness = float(works.rms_torque(0)) / rng.uniform(4e-4, 9e-4)

    def bend(arm: Any, stations: Any, deviation: Any) -> None:
        deviation.linear[0, TURN] = stiffness
        deviation.x[:, 0, TURN] += other_torque(stations.q[:, 0], turns) / stiffness

    session = works.clean(140, bend)
    more = {name: turns[:, i] for i, (name, *_) in enumerate(OTHER)}
    return single(replace(session, urdf=with_other_arm(session.urdf), more=more), (SPRINGS, ("torso", "torso_link")))


ROWS = {
    "other_arm": Row(other_arm, ("torso",)),
    "payload_unknown": Row(payload_unknown),
    "payloads_unknown": Row(lambda works, rng: payloads(works, rng, False)),
    "payloads_topic": Row(lambda works, rng: payloads(works, rng, True)),
    "column": Row(column, ("lifted",)),
    "wall": Row(wall),
    "wall_stiff": Row(wall_stiff),
    "clean_recordings": Row(clean_recordings),
    "upright": Row(upright),
    "eccentric": Row(eccentric),
}
