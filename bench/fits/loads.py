"""Loads as they are: arms on walls, payloads that change between recordings, columns that tilt, another arm beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from arms import TILT_X, TILT_Y, TURN, Array
from sites import BEGIN, Bend, Session, carrying, floor_of, sprung, turned
from works import GRAVITY, OTHER, Exact, Planted, Row, other_torque, with_other_arm

from modcal_core.measurements.recording import SignalTrack

Rng = np.random.Generator
PAUSE = 600.0  # s between two recordings
CARRIED = {"ur10": (0.5, 8.0), "panda": (0.2, 2.5), "xarm7": (0.2, 3.0)}  # kg
SPRINGS = ("compliance", "payload")
ACROSS = slice(TILT_X, TILT_Y + 1)


def pulled(works: Exact, rng: Rng) -> Array:
    """Weight pulls at 10° to 180° from straight down from now on: that unit vector in the base."""
    angle, way = rng.uniform(np.radians(10.0), np.pi), rng.uniform(0.0, 2.0 * np.pi)
    down = np.array([np.sin(angle) * np.cos(way), np.sin(angle) * np.sin(way), -np.cos(angle)])
    works.arm.model.opt.gravity[:] = GRAVITY * down
    return down


def off_centre(rng: Rng, i: int) -> Bend:
    """An encoder that is off its centre."""
    size, phase = rng.uniform(2e-4, 4e-4), rng.uniform(0.0, 2.0 * np.pi)
    return turned(i, lambda s: size * np.sin(s.q[:, i] + phase))


def sagging(works: Exact, share: float = 1.0, sag: float = 3e-4, payload: float = 0.0) -> Bend:
    """Joints, some of them, that deflect by about ``sag`` [rad] under the arm's weight."""
    soft = works.rng.random(works.arm.n) < share if share < 1.0 else True
    return sprung(np.s_[:, TURN], np.where(soft, works.springs(sag), np.inf), 0.0, payload)


def torque(works: Exact, kind: Any) -> float:
    """RMS of gravity's torque on the first joint over sixty random postures [N m]."""
    load = works.arm.loads(works.rng.uniform(*works.arm.range, (60, works.arm.n)))[:, :1, kind]
    return float(np.sqrt(np.mean(np.sum(load.reshape(60, -1) ** 2, axis=1))))


def single(session: Session, named: Any = None, **told: Any) -> Planted:
    return Planted((session.recording(),), session.floor_mm, named, **told)


def wall(works: Exact, rng: Rng) -> Planted:
    """An arm on a wall, a slope or a ceiling, of which nobody said so; some of its joints are elastic."""
    down = pulled(works, rng)
    return single(works.clean(140, sagging(works, 0.8, 4e-4)), (SPRINGS, works.names), down=down)


def wall_stiff(works: Exact, rng: Rng) -> Planted:
    """The same, stiff: nothing shows which way weight pulls, and nothing may be said of it."""
    pulled(works, rng)
    return single(works.clean(140), never=("*",))


def upright(works: Exact, rng: Rng) -> Planted:
    """An arm on the floor with elastic joints and an encoder off its centre: weight pulls straight down."""
    off = off_centre(rng, works.any_joint(1, 4))
    return single(works.clean(140, sagging(works, 0.8), off), (SPRINGS, works.names))


def eccentric(works: Exact, rng: Rng) -> Planted:
    """A stiff arm on the floor, two encoders off their centres: the error of a joint, not a load of another way."""
    off = [off_centre(rng, int(i)) for i in rng.choice(np.arange(1, 5), 2, replace=False)]
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
    sessions = several(works, masses, 70, partial(carrying, sagging(works)))
    for k, (kg, s) in enumerate(zip(masses, sessions, strict=True)):
        track = SignalTrack("signal:/payload_kg", BEGIN + s.t, np.full((len(s), 1), kg), "/payload_kg")
        sessions[k] = replace(s, signals=(track,)) if told else s
    recordings = tuple(s.recording() for s in sessions)
    return Planted(recordings, floor_of(sessions), (SPRINGS, works.names), carried=() if told else masses)


def payload_unknown(works: Exact, rng: Rng) -> Planted:
    """One recording with a payload that nobody stated; elastic joints."""
    low, high = CARRIED[works.robot]
    kg = float(rng.uniform(low + 0.4 * (high - low), high))
    return single(works.clean(160, sagging(works, payload=kg)), (SPRINGS, works.names), carried=(kg,))


def clean_recordings(works: Exact, rng: Rng) -> Planted:
    """Three recordings of a stiff arm: nothing is wrong."""
    sessions = several(works, (0.0, 1.0, 2.0), 60, lambda _: sprung(np.s_[:, TURN], np.inf * works.springs(3e-4)))
    return Planted(tuple(s.recording() for s in sessions), floor_of(sessions), never=("*",))


def column(works: Exact, rng: Rng) -> Planted:
    """A lifting column that tilts under the moment of the arm that it carries."""
    stiffness = torque(works, ACROSS) / rng.uniform(2e-4, 6e-4)
    return single(works.clean(140, sprung((0, ACROSS), stiffness)), (SPRINGS, ("lift", "lift_link")))


def other_arm(works: Exact, rng: Rng) -> Planted:
    """An elastic torso that carries another arm as well, whose joints are recorded beside the measured arm's."""
    turns = rng.uniform(-1.5, 1.5, (140, 2))
    stiffness = torque(works, TURN) / rng.uniform(4e-4, 9e-4)
    pull = turned(0, lambda s: other_torque(s.q[:, 0], turns) / stiffness)
    session = works.clean(140, sprung((0, TURN), stiffness), pull)
    more = {name: turns[:, i] for i, (name, *_) in enumerate(OTHER)}
    return single(replace(session, urdf=with_other_arm(session.urdf), more=more), (SPRINGS, ("torso", "torso_link")))


ROWS = {
    "other_arm": Row(other_arm, ("torso",)),
    "payload_unknown": Row(payload_unknown),
    "payloads_unknown": Row(partial(payloads, told=False)),
    "payloads_topic": Row(partial(payloads, told=True)),
    "column": Row(column, ("lifted",)),
    "wall": Row(wall),
    "wall_stiff": Row(wall_stiff),
    "clean_recordings": Row(clean_recordings),
    "upright": Row(upright),
    "eccentric": Row(eccentric),
}
