"""Kinds near those that were missed, continued: what scatters, instruments and tools, a second recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen
from conventions import ORIENTATION, UNIT
from fresh_again import CLOCK
from fresh_third import LEFT_OUT, _recorded, _stream
from nearby import FRAME, READ, ROWS, SCATTER, _block, _q, _rows, near
from physics import LOAD
from regimes import BASE, TOOL
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from workcell import BEGIN, Works, from_, joined

# --- scatter ---------------------------------------------------------------------------------------------------------


@near
def stand_wobbles(w: Works, rng: np.random.Generator) -> Case:
    """The arm's stand has come loose: it tilts by 0.3 mrad in any direction, anew at each station."""
    turns = rng.normal(0, 3e-4, (400, 3))

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tracker[:, 3:] += turns[: len(stations.t)]

    return calibrated(w.clean(160, bend), (*BASE, "stand"))


@near
def press_works_for_a_while(w: Works, rng: np.random.Generator) -> Case:
    """A press beside the cell shakes everything for a fifth of the stations; each shakes anew."""
    session = w.clean(160)
    shaken = (np.abs(np.arange(160) - 90) < 16)[:, None]
    return calibrated(
        replace(session, p=session.p + shaken * rng.normal(0, 2e-4, (160, 3))), (*SCATTER, r"stations \d")
    )


@near
def target_loose_in_its_seat(w: Works, rng: np.random.Generator) -> Case:
    """The target's seat is loose about one axis, half a milliradian either way, 10 cm from its pivot."""
    turn = np.outer(rng.uniform(-1e-3, 1e-3, 400), w.way(1.0))
    arm = w.way(0.2)

    def bend(_, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        n = len(stations.t)
        deviation.tool[:, 3:] += turn[:n]
        deviation.tool[:, :3] += np.cross(turn[:n], arm)

    return calibrated(w.clean(160, bend), (*TOOL, "target"))


# --- others ----------------------------------------------------------------------------------------------------------


@near
def tracker_scale_drifts(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's scale drifts by 300 ppm."""
    session = w.clean(150)
    return calibrated(
        replace(session, p=session.p * (1.0 + 3e-4 * np.arange(150)[:, None] / 150)), ("tracker", "reading", *BASE)
    )


@near
def axis_not_square(w: Works, rng: np.random.Generator) -> Case:
    """The gantry scanner's y axis is not square to x by a milliradian; the arm hangs in it."""
    session = w.clean(150)
    p = session.p.copy()
    p[:, 0] += 1e-3 * p[:, 1]
    return calibrated(replace(session, p=p), ("tracker", "reading", r"\bx\b", *BASE), shown="if left")


@near
def orientation_steps_half_way(w: Works, rng: np.random.Generator) -> Case:
    """A marker map was refined half way: orientations jump by half a milliradian, positions do not."""
    session = w.clean(150)
    turn = np.outer(np.arange(150) >= 80, w.way(5e-4))
    return calibrated(replace(session, R=Rotation.from_rotvec(turn) * session.R), (*ORIENTATION, *BASE, *TOOL))


@near
def payload_on_a_third_of_the_stations(w: Works, rng: np.random.Generator) -> Case:
    """From two thirds on a part hangs in the gripper: springs give more."""
    session = w.clean(100, w.elastic())
    more = w.observe(w.postures(60)[0], None, w.elastic(payload=4.0), begin=500.0)
    return calibrated(joined(session, more), (*LOAD, r"stations \d", *TOOL, *w.names))


# --- streams ---------------------------------------------------------------------------------------------------------


@near
def tracker_holds_its_last_value(w: Works, rng: np.random.Generator) -> Case:
    """After each motion the tracker repeats what it read before for more than a second."""
    session, t, q, p, R = _stream(w, 80)
    k = len(t) // 80
    since = np.arange(len(t)) % k
    rows = np.maximum(np.arange(len(t)) - np.where((since >= k // 2) & (since < k - 18), k // 2, 0), 0)
    return calibrated(
        _recorded(w, session, t, q, p[rows], R[rows], BEGIN + t), (*CLOCK, *LEFT_OUT, *READ), shown="if left"
    )


@near
def tracker_smooths(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's positions follow with a time constant of six tenths of a second."""
    session, t, q, p, R = _stream(w, 80)
    share = 1.0 - np.exp(-0.04 / 0.6)
    slow = lfilter([share], [1.0, share - 1.0], p - p[0], axis=0) + p[0]
    words = (*CLOCK, *LEFT_OUT, *READ, "filter", "last move", "settl")
    return calibrated(_recorded(w, session, t, q, slow, R, BEGIN + t), words, shown="if left")


@near
def joint_states_delayed(w: Works, rng: np.random.Generator) -> Case:
    """Readings bear stamps of four tenths of a second before the joints' clock."""
    session, t, q, p, R = _stream(w, 80)
    return calibrated(_recorded(w, session, t, q, p, R, BEGIN + t - 0.4), CLOCK, shown="if left")


# --- more ------------------------------------------------------------------------------------------------------------


@near
def two_couplings_loose(w: Works, rng: np.random.Generator) -> Case:
    """Two joints' encoders are loose: they read anything within half a milliradian."""
    session = w.clean(160)
    some = np.sort(rng.choice(4, 2, replace=False))
    q = session.q.copy()
    q[:, some] += rng.normal(0, 4e-4, (160, 2))
    return calibrated(_q(session, q), tuple(w.names[i] for i in some))


@near
def drive_slips_by_a_tooth(w: Works, rng: np.random.Generator) -> Case:
    """A belt slips by a tooth half way: one joint's zero is another by 3.6 degrees; points."""
    session, i = w.clean(150, kind="point"), w.any_joint(0, 4)
    q = session.q.copy()
    q[70:, i] += np.radians(3.6)
    return calibrated(_q(session, q), (w.names[i],))


@near
def tool_and_base_at_different_times(w: Works, rng: np.random.Generator) -> Case:
    """The tool is bent after a third, and the tracker is moved after two thirds, both by millimetres."""
    tool, base = w.tool(w.way(2e-3), w.way(0.01), from_(55)), w.base(w.way(3e-3), w.way(2e-3), from_(110))
    return calibrated(w.clean(165, tool, base), (*TOOL, *BASE))


@near
def readings_stuck_for_a_while(w: Works, rng: np.random.Generator) -> Case:
    """The tracker repeats one reading at eight stations, with its noise."""
    session = w.clean(150)
    rows = _block(70, 78, 150, np.full(8, 69))
    stuck = _rows(session, rows)
    return calibrated(replace(stuck, p=stuck.p + rng.normal(0, 1e-5, (150, 3))), ("stations 7", "still", *ROWS))


@near
def every_third_with_a_second_target(w: Works, rng: np.random.Generator) -> Case:
    """Two targets on the tool, 3 mm apart and alike: every third reading is of the other one; points."""
    session = w.clean(150)
    other = (np.arange(150) % 3 == 2)[:, None]
    p = session.p + np.where(other, session.R.apply(w.way(3e-3)), 0.0)
    return calibrated(replace(session, p=p, kind="point"), (*TOOL, "target", "two"))


@near
def yaw_of_the_other_sign(w: Works, rng: np.random.Generator) -> Case:
    """The yaw of each orientation has the other sign."""
    session = w.clean(130)
    angles = session.R.as_euler("ZYX") * [-1.0, 1.0, 1.0]
    return calibrated(replace(session, R=Rotation.from_euler("ZYX", angles)), ORIENTATION)


# --- use -------------------------------------------------------------------------------------------------------------


@near
def joint_reversed_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today's driver counts one joint the other way."""
    second, i = w.clean(80, begin=86_400.0), w.any_joint(0, w.arm.n - 1)
    q = second.q.copy()
    q[:, i] *= -1.0
    return frozen(w.clean(120), _q(second, q), (w.names[i],))


@near
def halves_exchanged_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today's readings were joined the wrong way round."""
    rows = np.r_[np.arange(37, 80), np.arange(37)]
    return frozen(w.clean(120), _rows(w.clean(80, begin=86_400.0), rows), ROWS)


@near
def millimetres_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today's positions are in millimetres and points."""
    second = w.clean(80, begin=86_400.0)
    return frozen(w.clean(120), replace(second, p=1e3 * second.p), UNIT)


@near
def tool_axes_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today's positions are along the tool's axes."""
    second = w.clean(80, begin=86_400.0)
    return frozen(w.clean(120), replace(second, p=second.R.inv().apply(second.p)), FRAME)


@near
def two_joints_swapped_today_near(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration; today two joints stand under each other's names; the base is found again."""
    second, i = w.clean(80, begin=86_400.0), w.any_joint(0, w.arm.n - 1)
    q = second.q.copy()
    q[:, [i, i + 1]] = q[:, [i + 1, i]]
    return frozen(w.clean(120), _q(second, q), w.names[i : i + 2], "--refit-base")
