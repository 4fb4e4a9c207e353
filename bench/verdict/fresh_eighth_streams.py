"""The eighth group: streams of joint states and readings, their clocks, filters and dropouts, and healthy cells.

Joint states at 50 Hz and readings at 20 Hz while the arm goes from station to station and waits there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from case import Case, calibrated, frozen, kind
from eighth_cell import (
    EACH,
    EPOCH,
    POSE,
    JointTrack,
    ReadingTrack,
    Recording,
    Take,
    World,
    Wrong,
    described,
    joint_track,
)
from fresh_eighth import ROWS, Array, eighth, joints_with
from fresh_eighth_arm import elastic
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

healthy = kind("good_eighth")
CLOCK = ("clock", "stamp", "time", "late", "lag", "offset", "belong", "synchron")
STILL = ("same", "frozen", "repeat", "stand", "still", "identical", "stale", *ROWS)
WAITS = 3.0  # s, of the EACH from one station to the next
RATE, READS = 50.0, 20.0
Spoil = Callable[[Array, Array], tuple[Array, Array]]  # stamps and values of readings (m,), (m, 7)


def flow(t: Array, stations: Array, rest: Array) -> Array:
    """Joints at times t (m,), between stations (N, n) that are reached at rest[k] and left WAITS later."""
    before = np.concatenate([stations[:1], stations[:-1]])
    k = np.clip(np.searchsorted(rest + WAITS, t), 0, len(rest) - 1)
    u = np.clip((t - (rest[k] - (EACH - WAITS))) / (EACH - WAITS), 0.0, 1.0)[:, None]
    return before[k] + (u**3 * (10 - 15 * u + 6 * u**2)) * (stations[k] - before[k])


def speak(
    w: World,
    take: Take,
    spoil: Spoil | None = None,
    noise_mm: float = 0.04,
    noise_mrad: float = 0.05,
    more: Callable[[Array, Array], tuple[JointTrack, ...]] | None = None,
    seed: int = 3,
) -> Recording:
    """A recording of the whole way. more: joint states of other publishers, of stamps and joints."""
    rng = np.random.default_rng([seed, len(take)])
    slip = rng.normal(0, 8e-6, take.q.shape)
    ends = take.t[0] - 2.0, take.t[-1] + WAITS + 0.5
    tj, tr = np.arange(*ends, 1 / RATE), np.arange(ends[0] + 0.013, ends[1], 1 / READS)
    p, R = w.sees(flow(tr, take.q + slip, take.t), Wrong())
    p = p + rng.normal(0, 1e-3 * noise_mm, p.shape)
    R = R * Rotation.from_rotvec(rng.normal(0, 1e-3 * noise_mrad, p.shape))
    values = np.column_stack([p, R.as_quat()])
    stamps, values = (tr, values) if spoil is None else spoil(tr, values)
    stamps = EPOCH + np.round(stamps, 6)
    q = flow(tj, take.q, take.t)
    tracks = (joint_track(w.names, EPOCH + tj, q), *(more(EPOCH + tj, q) if more else ()))
    return Recording(tracks, (ReadingTrack(POSE, "tracker", stamps, values, stamps),), take.signals, w.urdf)


def streamed(w: World, count: int, spoil: Spoil | None = None, **options: object) -> Take:
    """Stations that are recorded with all that lies between."""
    take = w.plain(count, noise_mm=0.0, noise_mrad=0.0)
    k, root = WAITS * READS, np.sqrt(3.0)
    mm, deg, _, _ = take.stated
    stated = (mm, deg, root * 0.04 / np.sqrt(k), float(np.degrees(root * 5e-5)) / np.sqrt(k))
    floor = float(np.hypot(mm, stated[2]))
    return replace(take, floor_mm=floor, stated=stated, spoken=partial(speak, w, spoil=spoil, **options))


def smoothed(seconds: float) -> Spoil:
    """A first-order filter on everything that is read."""

    def spoil(t: Array, values: Array) -> tuple[Array, Array]:
        a = np.exp(-1 / (READS * seconds))
        signs = np.cumprod(np.r_[1.0, np.sign(np.sum(values[1:, 3:] * values[:-1, 3:], axis=1))])
        flat = np.column_stack([values[:, :3], values[:, 3:] * signs[:, None]])
        out = lfilter([1 - a], [1, -a], flat - flat[0], axis=0) + flat[0]
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
        return t, out

    return spoil


# --- faults ----------------------------------------------------------------------------------------------------------


@eighth
def atomic_time_for_universal(w: World, rng: np.random.Generator) -> Case:
    """The tracker's computer keeps atomic time: its stamps are 37 s ahead of the joints'."""
    return calibrated(streamed(w, 80, lambda t, v: (t + 37.0, v)), CLOCK)


@eighth
def stamps_since_switched_on(w: World, rng: np.random.Generator) -> Case:
    """The tracker counts seconds since it was switched on."""
    return calibrated(streamed(w, 60, lambda t, v: (t + 812.0 - EPOCH, v)), (*CLOCK, "joint states"))


@eighth
def tracker_filters_heavily(w: World, rng: np.random.Generator) -> Case:
    """The tracker's filter settles within 1.5 s, half of a station's time."""
    return calibrated(streamed(w, 80, smoothed(1.5)), (*CLOCK, "filter", "settle", "smooth", "move", "direction"))


@eighth
def tracker_hangs_now_and_then(w: World, rng: np.random.Generator) -> Case:
    """Ten times the tracker's driver repeats its last reading for nine seconds, with new stamps."""

    def spoil(t: Array, values: Array) -> tuple[Array, Array]:
        out = values.copy()
        for start in np.linspace(0.07, 0.93, 10) * len(t):
            k = int(start)
            out[k : k + int(9 * READS)] = values[k]
        return t, out

    return calibrated(streamed(w, 90, spoil), STILL)


@eighth
def computed_pose_forty_milliseconds_late(w: World, rng: np.random.Generator) -> Case:
    """The pose comes from a driver that computes it of the joints by the URDF, 40 ms late, to a micrometre."""
    take = streamed(w, 70)
    nominal = World(w.robot, rng)
    nominal.built = np.tile(np.eye(4), (w.n, 1, 1))
    nominal.target, nominal.eye = (np.zeros(3), Rotation.identity()), (np.zeros(3), Rotation.identity())

    def spoil(t: Array, values: Array) -> tuple[Array, Array]:
        p, R = nominal.sees(flow(t - 0.04, take.q, take.t), Wrong())
        return t, np.column_stack([np.round(p, 6), np.round(R.as_quat(), 6)])

    return calibrated(replace(take, spoken=partial(speak, w, spoil=spoil)), ("comput", "calculat", "nominal"))


@eighth
def goals_published_beside_the_joints(w: World, rng: np.random.Generator) -> Case:
    """A second publisher sends the goals as joint states, to the same names: 0.6 mrad from where the joints stand."""
    off = rng.normal(0, 6e-4, w.n)

    def more(t: Array, q: Array) -> tuple[JointTrack, ...]:
        return (joint_track(w.names, t[::5] + 0.004, q[::5] + off * np.sign(np.sin(q[::5] * 9))),)

    return calibrated(streamed(w, 80, more=more), ("joint states", "joint_states", "publish", *w.names))


@eighth
def old_simulation_left_running(w: World, rng: np.random.Generator) -> Case:
    """A simulation that was left running publishes joint states of another way, under the same names."""
    other = w.postures(80)[0]

    def more(t: Array, q: Array) -> tuple[JointTrack, ...]:
        t0 = t[::4] + 0.007
        return (joint_track(w.names, t0, flow(t0 - EPOCH, other, EACH * np.arange(80) + 1.7)),)

    return calibrated(streamed(w, 80, more=more), ("joint states", "joint_states", "publish", *ROWS))


@eighth
def clock_jumps_by_half_a_second(w: World, rng: np.random.Generator) -> Case:
    """The network sets the tracker's clock back by 4.5 s in the middle of the recording."""
    return calibrated(streamed(w, 90, lambda t, v: (t - 4.5 * (t > 260.0), v)), CLOCK)


@eighth
def every_reading_four_seconds_old(w: World, rng: np.random.Generator) -> Case:
    """A buffer that was never emptied: all readings are 4 s old when they are stamped."""
    return calibrated(streamed(w, 80, lambda t, v: (t + 4.0, v)), CLOCK)


# --- healthy cells ---------------------------------------------------------------------------------------------------


def good(take: Take, *options: str) -> Case:
    """A calibration of which nothing bad is to be said."""
    return Case({"bag": take}, (("calibrate", "{bag}", *options),), False)


@healthy
def tracker_clock_drifts_while_it_waits(w: World, rng: np.random.Generator) -> Case:
    """80 ppm and a fifth of a second, of stations."""
    return good(streamed(w, 70, lambda t, v: (t * (1 + 8e-5) + 0.2, v)))


@healthy
def gripper_and_mobile_base_beside_it(w: World, rng: np.random.Generator) -> Case:
    """Another publisher sends a gripper that opens and closes, and wheels that stand."""

    def more(t: Array, q: Array) -> tuple[JointTrack, ...]:
        hand = 0.02 + 0.02 * np.sign(np.sin(t / 17.0))
        still = np.zeros_like(t)
        return (joint_track(("finger_joint", "wheel_left", "wheel_right"), t, np.column_stack([hand, still, still])),)

    return good(streamed(w, 70, more=more))


@healthy
def every_packet_twice(w: World, rng: np.random.Generator) -> Case:
    """The network delivers every reading twice, with the same stamp."""
    return good(streamed(w, 70, lambda t, v: (np.repeat(t, 2), np.repeat(v, 2, axis=0))))


@healthy
def angles_within_half_a_turn(w: World, rng: np.random.Generator) -> Case:
    """Joints of more than a turn, written within ±π."""
    w = World("ur5e", rng)
    w.low[[0, 3, 4, 5]], w.high[[0, 3, 4, 5]] = -5.5, 5.5
    take = w.plain(130)
    return good(replace(take, q=(take.q + np.pi) % (2 * np.pi) - np.pi))


@healthy
def whole_turn_more_since(w: World, rng: np.random.Generator) -> Case:
    """The last joint counts one turn more than when the arm was calibrated; its limits allow that."""
    w.urdf = described(tuple(replace(j, low=j.low - 3.0, high=j.high + 3.0) for j in w.joints))
    second = w.plain(70, begin=86400.0)
    second = joints_with(second, w.n - 1, second.q[:, -1] + 2 * np.pi)
    return replace(frozen(w.plain(130), second), fault=False)


@healthy
def readings_in_the_base_by_a_hand_eye(w: World, rng: np.random.Generator) -> Case:
    """The tracker's software was aligned with the arm's base, to a millimetre."""
    w.eye = rng.normal(0, 1e-3, 3), Rotation.from_rotvec(rng.normal(0, 1e-3, 3))
    return good(w.plain(130))


@healthy
def survey_coordinates(w: World, rng: np.random.Generator) -> Case:
    """The tracker's frame has its origin 40 m away."""
    w.eye = np.array([31.0, -24.0, 4.0]), Rotation.random(rng=rng)
    return good(w.plain(130))


@healthy
def elastic_arm(w: World, rng: np.random.Generator) -> Case:
    """Joints that deflect by 20 urad/Nm."""
    return good(w.plain(150, elastic(w, 2e-5)))


@healthy
def on_a_rail(w: World, rng: np.random.Generator) -> Case:
    """A UR5e on a rail of one metre and a half."""
    return good(World("rail", rng).plain(140))


@healthy
def scara(w: World, rng: np.random.Generator) -> Case:
    """Four joints with upright axes."""
    return good(World("scara", rng).plain(110))


@healthy
def smoothed_a_little(w: World, rng: np.random.Generator) -> Case:
    """A filter of 60 ms, which has long settled where the arm waits."""
    return good(streamed(w, 70, smoothed(0.06)))


@healthy
def points_of_a_coarse_camera(w: World, rng: np.random.Generator) -> Case:
    """Points with 0.3 mm of noise."""
    return good(w.plain(200, kind="point", noise_mm=0.3))
