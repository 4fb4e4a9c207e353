"""The third group, the arm and where it stands: surroundings, robot, description, data, use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen
from conventions import QUATERNION, UNIT
from fresh_third import ROW, _joints, _near, _origins, _with_origin, third
from physics import LOAD
from regimes import BASE, LEFT_OUT, TOOL
from scipy.signal import lfilter
from workcell import BEGIN, Array, Works, from_

from modcal_core.measurements.recording import SignalTrack

# --- surroundings ----------------------------------------------------------------------------------------------------


@third
def hall_warms_the_stand(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's stand leans with the temperature of the hall, which is recorded."""
    clock = np.arange(-10.0, 650.0, 5.0)
    warm = 22.0 + 4.0 * np.sin(2.0 * np.pi * clock / rng.uniform(260.0, 330.0) + 1.0) + 0.004 * clock
    v = np.concatenate([w.way(1.2e-4), w.way(5e-5)])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tracker += np.outer(np.interp(stations.t, clock, warm) - 22.0, v)

    seen = (warm + rng.normal(0, 0.05, len(warm)))[:, None]
    signal = SignalTrack("temperature:hall", BEGIN + clock, seen, "/hall/temperature")
    return calibrated(replace(w.clean(150, bend), signals=(signal,)), ("temperature", "hall", *BASE))


@third
def tripod_kicked_many_times(w: Works, rng: np.random.Generator) -> Case:
    """People walk past: the tripod is moved by some tenths of a millimetre at eight moments."""
    at = np.sort(rng.choice(np.arange(8, 150), 8, replace=False))
    steps = np.concatenate([rng.normal(0, 2e-4, (8, 3)), rng.normal(0, 1e-4, (8, 3))], axis=1)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        rows = np.arange(len(stations.t))[:, None] >= at
        deviation.tracker += rows @ steps

    return calibrated(w.clean(160, bend), (*BASE, r"\btime\b", r"\border\b"))


@third
def weight_pulled_by_the_hose(w: Works, rng: np.random.Generator) -> Case:
    """A hose from the ceiling turns the tool in its seat, the more the lower the tool is."""
    q, again = w.postures(150)
    p, _ = w.arm.frames(w.arm.coordinates(q))
    low = p[:, -1, 2].max() - p[:, -1, 2]
    turn = np.outer(low, w.way(8e-4))

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, 3:] += turn
        deviation.tool[:, :3] += 0.1 * turn[:, [1, 2, 0]]

    return calibrated(w.observe(q, again, bend), (*TOOL, *w.arm.hand, *w.names[-3:], *LOAD))


# --- the robot -------------------------------------------------------------------------------------------------------


@third
def offsets_after_each_restart(w: Works, rng: np.random.Generator) -> Case:
    """The controller was restarted twice; each time every joint finds its zero anew, to half a milliradian."""
    zeros = np.concatenate([np.zeros((1, w.arm.n)), rng.normal(0, 5e-4, (2, w.arm.n))])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[..., 3] += zeros[np.minimum(np.arange(len(stations.t)) // 55, 2)]

    return calibrated(w.clean(165, bend), (*w.names, r"\border\b", r"\btime\b", r"stations \d"))


@third
def ratio_of_another_gear(w: Works, rng: np.random.Generator) -> Case:
    """A joint's gear of 101 is set as one of 100."""
    session, i = w.clean(130), w.any_joint(0, w.arm.n - 1)
    q = session.q.copy()
    q[:, i] *= 1.01
    return calibrated(_joints(session, q), (w.names[i],))


@third
def encoder_tape_spliced(w: Works, rng: np.random.Generator) -> Case:
    """The tape of a joint's encoder has a splice: beyond it the joint is a milliradian farther."""
    i = w.any_joint(0, w.arm.n - 1)
    low, high = w.arm.range[:, i]
    splice = low + rng.uniform(0.3, 0.7) * (high - low)
    return calibrated(w.clean(160, w.joint(i, lambda s: 1e-3 * (s.q[:, i] > splice))), (w.names[i],))


@third
def motor_warms_with_its_work(w: Works, rng: np.random.Generator) -> Case:
    """A joint's offset grows with the work of the last minutes, of which there is a lot now and then."""
    i = w.any_joint(0, 4)
    q, again = w.postures(160)
    move = np.abs(np.diff(q[:, i], prepend=q[0, i])) * (np.sin(np.arange(160) / 9.0) > -0.2)
    heat = lfilter([0.1], [1.0, -0.9], move)
    heat *= 1.2e-3 / heat.max()
    words = (w.names[i], w.names[max(i - 1, 0)], w.names[i + 1], r"\btime\b", r"\border\b", *(BASE if i == 0 else ()))
    return calibrated(w.observe(q, again, w.joint(i, lambda s: heat)), words)


@third
def gear_and_tool_kept_level(w: Works, rng: np.random.Generator) -> Case:
    """Of two neighbouring joints one makes up for the other, so that the tool stays level; a gear errs."""
    i = 2
    q, again = w.postures(160)
    q[:, i + 1] = -q[:, i] + 0.3
    bend = w.joint(i, lambda s: 6e-4 * np.sin(9.0 * s.q[:, i] + 0.4))
    return calibrated(w.observe(q, again, bend), (w.names[i], w.names[i + 1]))


@third
def waits_of_different_length(w: Works, rng: np.random.Generator) -> Case:
    """A belt creeps after each move; the operator reads now at once and now after a minute."""
    i = w.any_joint(0, 4)
    wait = rng.exponential(20.0, 160) + 1.0
    t = np.cumsum(wait + 3.0)

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        move = np.diff(stations.q[:, i], prepend=w.arm.range[:, i].mean())
        return -6e-4 * move * np.exp(-wait / 12.0)

    return calibrated(replace(w.clean(160, w.joint(i, off)), t=t), (w.names[i],))


# --- descriptions ----------------------------------------------------------------------------------------------------


@third
def one_link_in_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """One joint's origin in the URDF is in millimetres."""
    session = w.clean(130)
    names = _origins(session, w.names[1:], 0.05)
    name = names[int(rng.integers(len(names)))]
    return calibrated(_with_origin(session, name, 1e3), (*UNIT, *_near(w, name), "reach", "metres"))


@third
def one_link_left_out(w: Works, rng: np.random.Generator) -> Case:
    """One joint's origin in the URDF is zero: a length was left out."""
    session = w.clean(130)
    names = _origins(session, w.names[1:], 0.05)
    name = names[int(rng.integers(len(names)))]
    return calibrated(_with_origin(session, name, 0.0), _near(w, name), shown="if left")


@third
def description_of_a_bigger_brother(w: Works, rng: np.random.Generator) -> Case:
    """The URDF is that of the next size: every length is a quarter more."""
    session = w.clean(140)
    for name in _origins(session, w.names, 1e-3):
        session = _with_origin(session, name, 1.25)
    return calibrated(session, ("URDF", "description", "scale", "length", *w.names), shown="if left")


# --- data ------------------------------------------------------------------------------------------------------------


@third
def thirty_stations_a_third_wrong(w: Works, rng: np.random.Generator) -> Case:
    """Thirty stations, ten of which are off by millimetres of their own."""
    session = w.clean(36)
    wrong = (rng.random(36) < 0.33)[:, None]
    return calibrated(replace(session, p=session.p + wrong * rng.normal(0, 2e-3, (36, 3))), LEFT_OUT)


@third
def two_targets_by_height(w: Works, rng: np.random.Generator) -> Case:
    """The tool has two reflectors; below some height the other one is in sight, and nobody wrote down which."""
    session = w.clean(150)
    up = w.cell.tracker[1].inv().apply([0.0, 0.0, 1.0])
    low = session.p @ up < np.quantile(session.p @ up, 0.4)
    p = session.p + np.where(low[:, None], session.R.apply(w.way(0.05)), 0.0)
    return calibrated(replace(session, p=p), (*TOOL, *LEFT_OUT, "target"))


# --- use -------------------------------------------------------------------------------------------------------------


@third
def restarted_since(w: Works, rng: np.random.Generator) -> Case:
    """The controller was restarted since: every joint has another zero. The base is found again."""
    zeros = rng.normal(0, 7e-4, w.arm.n)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[..., 3] += zeros

    words = (*w.names, "spread", "calibrated", "held-out", "floor")
    return frozen(w.clean(120), w.clean(80, bend, begin=86_400.0), words, "--refit-base")


@third
def quaternions_otherwise_today(w: Works, rng: np.random.Generator) -> Case:
    """The driver was updated since the calibration: quaternions are written w x y z."""
    second = w.clean(80, begin=86_400.0)
    values = second.raw().copy()
    values[:, 3:] = values[:, [6, 3, 4, 5]]
    return frozen(w.clean(120), replace(second, values=values), QUATERNION)


@third
def one_row_late_today(w: Works, rng: np.random.Generator) -> Case:
    """A frozen calibration, and today's table slipped by one row."""
    second = w.clean(80, begin=86_400.0)
    rows = np.maximum(np.arange(80) - 1, 0)
    return frozen(w.clean(120), replace(second, p=second.p[rows], R=second.R[rows]), ROW)


@third
def slower_today(w: Works, rng: np.random.Generator) -> Case:
    """The joint that lagged when the arm was calibrated lags by another share today."""
    i = w.any_joint(0, 4)

    def lag(share: float):  # type: ignore[no-untyped-def]
        return w.joint(i, lambda s: share * np.diff(s.q[:, i], prepend=w.arm.range[:, i].mean()))

    first, second = w.clean(140, w.joint(i, lambda s: 0.0 * s.t)), w.clean(80, lag(1e-3), begin=86_400.0)
    return frozen(first, second, (w.names[i], *ROW, "spread", "held-out"))


@third
def base_given_another_tool(w: Works, rng: np.random.Generator) -> Case:
    """The tool was bent by a knock since, and the command line asks for the base to be found again."""
    second = w.clean(80, w.tool(w.way(2e-3), w.way(0.01), from_(0)), begin=3600.0)
    return frozen(w.clean(120), second, TOOL, "--refit-base")
