"""Drivers as people record them: commands beside joints, payloads on a topic, efforts in places, short standstills."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import sites
from arms import Array
from scipy.spatial.transform import Rotation
from sites import BEGIN, PERIOD, Session, Stations, carrying, flow, joint_track, poses, reading, turn_noise, turned
from works import Exact, Planted, Row

from modcal_core.measurements.recording import JointTrack, Recording, SignalTrack

Rng = np.random.Generator
SERVO = 1e-5  # rad; what a joint that has arrived differs from its command, besides what is planted
LATE, LEVELS = ("joint_lag",), {"ur10": (0.0, 1.0, 2.5, 4.0), "panda": (0.0, 0.5, 1.0, 2.0)}  # kg
IN_MOTION = 2e-2 * np.sqrt(3.0)  # mm; noise of the readings on a course


COMMANDS = "/joint_commands"


def commanded(session: Session, told: Array) -> Recording:
    """The recording with commanded joints (N, n) on a topic of their own, at the stamps of the stations."""
    track = joint_track(session.names, BEGIN + session.t, told, topic=COMMANDS)
    return replace(session.recording(), commands=(track,))


def lagging(works: Exact, count: int, share: float, effects: bool = False) -> tuple[Session, Array, int]:
    """Stations at which one joint's logged value has yet to come to its command; the arm is nearer to it, by a share.

    Session with the logged joints, commanded joints (N, n), and which joint it is. effects: springs and a gear besides.
    """
    rng = works.rng
    j = works.any_joint(0, 4)
    q, again = works.postures(count)
    bends = [works.elastic(3e-4)] if effects else []
    if effects:
        k = works.any_joint(0, 3)
        cycles = float(rng.integers(20, 80))
        bends.append(turned(k, lambda s: 2e-4 * np.sin(cycles * s.q[:, k])))
    session = works.observe(q, again, *bends)
    before = np.concatenate([works.arm.range.mean(axis=0)[None], q[:-1]])
    short = np.clip(q - before, -1.0, 1.0)[:, j] * rng.uniform(5e-4, 1.5e-3) * rng.uniform(0.3, 1.0, count)
    logged = q.copy()
    logged[:, j] = q[:, j] - share * short
    told = q + SERVO * rng.standard_normal(q.shape)
    told[:, j] = logged[:, j] + short
    return replace(session, q=logged), told, j


def late(count: int, share: Callable[[Rng], float], effects: bool = False) -> Row:
    """Station by station, one joint's logged value is stale by a share of commanded − measured."""

    def make(works: Exact, rng: Rng) -> Planted:
        session, told, j = lagging(works, count, share(rng), effects)
        return Planted((commanded(session, told),), session.floor_mm, (LATE, (session.names[j],)))

    return Row(make)


def late_at_times(works: Exact, rng: Rng) -> Planted:
    """At one station in seven the log was written long before the joint had arrived; elsewhere it is right."""
    j = works.any_joint(0, 4)
    q, again = works.postures(130)
    session = works.observe(q, again)
    short = np.where(rng.random(130) < 1.0 / 7.0, rng.uniform(2e-3, 1e-2, 130) * rng.choice([-1.0, 1.0], 130), 0.0)
    logged = q.copy()
    logged[:, j] -= short
    told = q + SERVO * rng.standard_normal(q.shape)
    return Planted((commanded(replace(session, q=logged), told),), session.floor_mm, (LATE, (session.names[j],)))


def commanded_as_measured(works: Exact, rng: Rng) -> Planted:
    """``late_among_others``, its commands given as joint states: the cleaner input must not end worse."""
    session, told, _ = lagging(works, 580, 1.0, effects=True)
    return Planted((replace(session, q=told).recording(),), session.floor_mm, never=LATE)


def followed_well(works: Exact, rng: Rng) -> Planted:
    """A sound log: joints differ from their commands, and say so truly. Nothing must be called late."""
    session = works.clean(130)
    told = session.q + 5e-4 * rng.standard_normal(session.q.shape)
    return Planted((commanded(session, told),), session.floor_mm, never=("joint_lag", "unknown"))


def payload(told: bool) -> Row:
    """Elastic joints and a payload that changes between stations, which /payload_kg states.

    told: it is another for some stations at a time, and is told once, two seconds before it changes.
    """

    def make(works: Exact, rng: Rng, every: int = 1) -> Planted:
        q, again = works.postures(140)
        elastic, levels = works.elastic(4e-4), np.array(LEVELS[works.robot])
        carried = np.repeat(levels[rng.integers(len(levels), size=-(-len(q) // every))], every)[: len(q)]
        parts, t = [], PERIOD * np.arange(len(q))
        for kg in levels:
            rows = np.flatnonzero(carried == kg)
            if len(rows):  # of a few changes some levels are never drawn
                parts.append(replace(works.observe(q[rows], again[rows], carrying(elastic, kg)), t=t[rows]))
                works.exact[-1] = replace(works.exact[-1], t=t[rows])
        when, what = t, carried
        if told:
            changed = np.r_[True, np.diff(carried) != 0.0]
            when, what = t[changed] - 2.0, carried[changed]
        track = SignalTrack("signal:/payload_kg", BEGIN + when, what[:, None], "/payload_kg")
        whole = replace(sites.joined(*parts), signals=(track,))
        return Planted((whole.recording(),), whole.floor_mm, (("compliance",), whole.names))

    return Row(make, ("ur10", "panda"), (lambda rng: int(rng.integers(3, 36))) if told else None)


def effort_in_places(works: Exact, rng: Rng) -> Planted:
    """Elastic joints; the joint states of every third station, and of the last tenth, carry no effort."""
    session = works.clean(140, works.elastic(4e-4), effort=True)
    effort = np.array(session.effort)
    effort[::3] = np.nan
    effort[-14:] = np.nan
    recording = replace(session, effort=effort).recording()
    return Planted((recording,), session.floor_mm, (("compliance",), session.names))


def standing(session: Session, rng: Rng, track: JointTrack, at: Array, each: int, kept: float) -> Planted:
    """Joint states, and ``each`` readings a station at times ``at``, which scatter; of these a share is kept."""
    scatter = 6e-5  # m, rad
    p = np.repeat(session.p, each, axis=0) + rng.normal(0, scatter, (len(at), 3))
    R = Rotation.from_quat(np.repeat(session.R.as_quat(), each, axis=0)) * turn_noise(rng, scatter, len(at))
    recording = Recording((track,), (reading(BEGIN + at + 1.7e-3, poses(p, R)),), (), session.urdf)
    mean = 1e3 * scatter * np.sqrt(3.0 / (each * kept))
    return Planted((recording,), float(np.hypot(session.floor_mm, mean)), stations=False)


def short_stands(works: Exact, rng: Rng) -> Planted:
    """Standstills of 0.4 s, nothing recorded between; readings scatter by more than a station's mean."""
    session, when = works.clean(130, noise_mm=1e-3, noise_mrad=1e-3), np.arange(0.0, 0.4, 1.0 / 25.0)
    t = (PERIOD * np.arange(len(session))[:, None] + when).ravel()
    q = np.repeat(session.q, len(when), axis=0) + 2e-6 * rng.standard_normal((len(t), works.arm.n))
    return standing(session, rng, joint_track(works.names, BEGIN + t, q), t, len(when), 1.0)


def short_pauses(works: Exact, rng: Rng) -> Planted:
    """An arm that goes from posture to posture, recorded all the time, and pauses for 0.4 s at each."""
    session, stand, leg = works.clean(130, noise_mm=1e-3, noise_mrad=1e-3), 0.4, 1.6
    reached, when = leg + (stand + leg) * np.arange(len(session)), np.arange(0.0, stand, 0.02)
    t = np.arange(0.0, (stand + leg) * len(session), 0.01)
    track = joint_track(works.names, BEGIN + t, flow(t, session.q, reached, leg, stand, 0.1))
    # what is left after settling, and before it leaves
    return standing(session, rng, track, (reached[:, None] + when).ravel(), len(when), 0.4)


def moving(
    works: Exact, rng: Rng, rate: float, late: Array | float = 0.0, clock: float = 0.0, ahead: float | None = None
) -> tuple[Recording]:
    """An arm that never stops. rate: of joint states [Hz]. late: by which each joint's log lags (n,) [s]. clock: by
    which the tracker's stamps are late [s]. ahead: by which commands precede the joints [s]; None: none are recorded.
    """
    middle, half = works.arm.range.mean(axis=0), 0.4 * np.ptp(works.arm.range, axis=0)
    speed, phase = rng.uniform(0.25, 0.5, (2, works.arm.n)), rng.uniform(0.0, 2.0 * np.pi, (2, works.arm.n))

    def goes(t: Array) -> Array:
        return middle + 0.5 * half * np.sin(t[:, None, None] * speed + phase).sum(axis=1)

    t = np.arange(0.0, 90.0, 1.0 / rate)
    t = t + rng.uniform(-0.1, 0.1, len(t)) / rate
    at = np.arange(1.0, 89.0, 0.02)
    exact = works.poses(Stations(goes(at), at, np.ones((len(at), works.arm.n))))
    p = exact.p + rng.normal(0, 2e-5, exact.p.shape)
    seen = reading(BEGIN + at + clock, poses(p, exact.R * turn_noise(rng, 2e-5, len(p))))
    lag = np.broadcast_to(late, works.arm.n)
    q = np.stack([goes(t - lag[j])[:, j] for j in range(works.arm.n)], axis=1)
    told = () if ahead is None else (joint_track(works.names, BEGIN + t, goes(t + ahead), topic=COMMANDS),)
    return (Recording((joint_track(works.names, BEGIN + t, q),), (seen,), (), works.arm.urdf, commands=told),)


def on_a_course(named: Any = None, never: tuple[str, ...] = (), **how: Callable[[Exact, Rng], Any]) -> Row:
    """An arm that never stops. how: arguments of ``moving``, drawn in this order."""

    def make(works: Exact, rng: Rng) -> Planted:
        drawn = {name: draw(works, rng) for name, draw in how.items()}
        places = tuple(np.array(works.names)[np.atleast_1d(drawn["late"]) > 0.0]) if "late" in drawn else ("tracker",)
        return Planted(moving(works, rng, **drawn), IN_MOTION, named and (named, places), never, stations=False)

    return Row(make)


def one_joint_late(works: Exact, rng: Rng) -> Array:
    """A joint's log is some milliseconds old."""
    j = works.any_joint(0, 4)
    return rng.uniform(5e-3, 15e-3) * (np.arange(works.arm.n) == j)


FOLLOWING = {"rate": lambda *_: 100.0, "ahead": lambda *_: 0.01}  # Hz, and s that commands are ahead
ROWS = {
    "late_joint": late(130, lambda rng: 1.0),
    "late_in_part": late(130, lambda rng: rng.uniform(0.4, 0.9)),
    "late_among_others": late(580, lambda rng: 1.0, effects=True),
    "commanded_as_measured": Row(commanded_as_measured),
    "followed_well": Row(followed_well),
    "payload_topic": payload(told=False),
    "payload_told": payload(told=True),
    "effort_in_places": Row(effort_in_places),
    "short_stands": Row(short_stands),
    "short_pauses": Row(short_pauses),
    "slow_joint_states": on_a_course(rate=lambda works, rng: float(rng.choice([8.0, 20.0, 50.0]))),
    "late_at_times": Row(late_at_times),
    "late_joint_in_motion": on_a_course(LATE, late=one_joint_late, **FOLLOWING),
    "late_tracker_with_commands": on_a_course(
        ("latency",), LATE, clock=lambda works, rng: rng.uniform(3e-3, 10e-3), **FOLLOWING
    ),
}
