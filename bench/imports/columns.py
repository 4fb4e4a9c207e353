"""Exports with more than joints and a pose: speeds, efforts, commanded joints, standard deviations, signals, several
targets, ranges, bearings, heights, several files, cells that hold no number. Drawn at random; nothing comes from modcal.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from arms import ARMS, Recorded, holding, record
from reading_columns import bearings, height, polar, pose, ranges, targets
from sheet import Sheet, Written

SCENARIOS = ("log", "moving", "tracker", "targets", "ranges", "bearings", "polar", "height", "joined", "faults")


def draw(seed: int, folder: Path) -> Written:
    """The files of one seed."""
    rng = np.random.default_rng([seed, 21])
    scenario = SCENARIOS[seed % len(SCENARIOS)]
    robot = str(rng.choice(list(ARMS)))
    rate = float(rng.choice([20.0, 50.0])) if scenario == "moving" else 0.0
    recorded = record(robot, rng, int(rng.integers(160, 300) if rate else rng.integers(45, 140)), 1.0, rate)
    sheet = Sheet("," if rng.random() < 0.3 else ".")
    about: dict[str, object] = {"scenario": scenario, "robot": robot}
    written = Written([], recorded, {}, np.ones(len(recorded.q), bool), about=about)
    N = len(recorded.q)
    _time(rng, sheet, recorded, scenario == "moving" or rng.random() < 0.6, about)
    if scenario == "joined":
        return _joined(rng, sheet, written, seed, folder)
    readings = {"targets": targets, "ranges": ranges, "bearings": bearings, "polar": polar, "height": height}
    extras = [_velocity, _effort, _commanded]
    if rng.random() < 0.5:
        mine = readings.get(scenario, pose)(rng, sheet, written)
        _joints(rng, sheet, written)
    else:
        _joints(rng, sheet, written)
        mine = readings.get(scenario, pose)(rng, sheet, written)
    for extra in extras:
        if scenario in ("log", "moving") or rng.random() < 0.25:
            if scenario == "moving" and extra is not _velocity and rng.random() < 0.5:
                continue
            extra(rng, sheet, written)
    if scenario in ("tracker", "faults") or (scenario in ("log", "targets") and rng.random() < 0.3):
        _signals(rng, sheet, written)
    if rng.random() < 0.3:
        sheet.add("RMS residual", rng.uniform(0.01, 0.06, N), 3)
    if scenario == "faults":
        _faults(rng, sheet, written, mine)
    path = folder / f"columns_{seed:04d}.csv"
    path.write_bytes(sheet.text(rng, np.arange(N)).encode(str(rng.choice(["utf-8", "utf-8-sig", "utf-16"]))))
    written.paths.append(path)
    return written


def _time(rng: np.random.Generator, sheet: Sheet, recorded: Recorded, stated: bool, about: dict) -> None:  # type: ignore[type-arg]
    about["clock"] = stated
    if stated:
        t = recorded.stamps - recorded.stamps[0]
        way = str(rng.choice(["t", "epoch", "ms"]))
        if way == "t":
            sheet.add(str(rng.choice(["t", "time [s]", "Time"])), t, 4)
        elif way == "epoch":
            sheet.add("timestamp", recorded.stamps, 4)
        else:
            sheet.add("time_ms", 1e3 * t, 1)
    elif rng.random() < 0.5:
        sheet.add("Point", np.arange(1.0, len(recorded.q) + 1), 0)


def _families(rng: np.random.Generator, written: Written, ways: list[str]) -> list[str]:
    """Labels of one column a joint; {n}: the joint's name, {k}: its number."""
    way = str(rng.choice(ways))
    first = int("{z}" in way)
    return [way.format(n=name, k=k + 1, z=k) for k, name in enumerate(written.recorded.names)] if not first else [
        way.format(n=name, z=k) for k, name in enumerate(written.recorded.names)
    ]  # fmt: skip


def _joints(rng: np.random.Generator, sheet: Sheet, written: Written) -> None:
    degrees = bool(rng.random() < 0.5)
    ways = ["{n}", "J{k}", "A{k}", "q_{z}", "Axis {k}", "joint_{k}", "joint_states/position/{n}", "actual_q_{z}"]
    labels = _families(rng, written, ways)
    written.about |= {"joints": labels[0], "degrees": degrees}
    q = np.degrees(written.recorded.q) if degrees else written.recorded.q
    order = rng.permutation(len(labels)) if rng.random() < 0.2 else np.arange(len(labels))
    for k in order:
        sheet.add(labels[k], q[:, k], 5 if degrees else 7)


def _velocity(rng: np.random.Generator, sheet: Sheet, written: Written) -> None:
    recorded = written.recorded
    if written.about["scenario"] == "moving":
        v = np.gradient(recorded.q, recorded.stamps, axis=0) + 1e-4 * rng.standard_normal(recorded.q.shape)
    else:
        v = 1e-4 * rng.standard_normal(recorded.q.shape)
    degrees = bool(rng.random() < 0.5)
    told = ["Velocity J{k} [deg/s]", "{n}_vel (deg/s)", "dq{k}_deg_s"] if degrees else [
        "J{k} speed (rad/s)", "joint_states/velocity/{n} [rad/s]", "qd_{z}_rad_s"]  # fmt: skip
    bare = ["actual_qd_{z}", "dq_{k}", "joint_states/velocity/{n}", "vel_{k}", "{n} velocity"]
    is_told = bool(rng.random() < 0.5)
    labels = _families(rng, written, told if is_told else bare)
    written.about |= {"velocity": labels[0], "velocity_degrees": degrees, "velocity_told": is_told}
    written.velocity = v
    for k, label in enumerate(labels):
        sheet.add(label, np.degrees(v[:, k]) if degrees else v[:, k], 5)


def _effort(rng: np.random.Generator, sheet: Sheet, written: Written) -> None:
    tau = holding(written.recorded.robot, written.recorded.q)
    tau = tau * rng.uniform(0.9, 1.1, tau.shape[1]) + rng.uniform(0.5, 2.0) * rng.standard_normal(tau.shape)
    of_load = bool(rng.random() < 0.3)
    if rng.random() < 0.2:  # no torque at all
        labels = _families(
            rng, written, ["J{k} load [%]", "Motor load {k} (%)", "actual_current_{z}", "I{k} current [A]"]
        )
        written.about["load"] = labels[0]
        written.signals += list(tau.T)
        for k, label in enumerate(labels):
            sheet.add(label, tau[:, k], 3)
        return
    told = ["Torque J{k} [Nm]", "Motor torque A{k} (N·m)", "tau_{k}_Nm", "joint_states/effort/{n} [N m]"]
    bare = ["tau_{k}", "joint_states/effort/{n}", "{n}_effort", "joint_torque_{z}"]
    labels = _families(rng, written, told if rng.random() < 0.5 else bare)
    written.about |= {"effort": labels[0], "of_load": of_load}
    written.effort = tau
    for k, label in enumerate(labels):
        sheet.add(label, -tau[:, k] if of_load else tau[:, k], 3)


def _commanded(rng: np.random.Generator, sheet: Sheet, written: Written) -> None:
    q = written.recorded.q + 3e-4 * rng.standard_normal(written.recorded.q.shape)
    degrees = bool(rng.random() < 0.5)
    ways = ["target_q_{z}", "cmd_{n}", "q_des_{k}", "Soll A{k}", "J{k} setpoint", "joint_{k}_ref", "commanded/{n}"]
    labels = _families(rng, written, ways)
    written.about |= {"commanded": labels[0], "commanded_degrees": degrees}
    written.commanded = q
    for k, label in enumerate(labels):
        sheet.add(label, np.degrees(q[:, k]) if degrees else q[:, k], 6)


def _signals(rng: np.random.Generator, sheet: Sheet, written: Written) -> None:
    N = len(written.recorded.q)
    every = {
        "payload_kg": rng.choice([0.0, 2.5, 5.0], N), "Ambient pressure [hPa]": 1013 + rng.standard_normal(N),
        "humidity": 40 + np.cumsum(0.1 * rng.standard_normal(N)), "supply voltage [V]": 48 + 0.2 * rng.standard_normal(N),
        "gripper_opening_mm": rng.uniform(0, 80, N), "Temperature [°C]": 22 + np.cumsum(0.02 * rng.standard_normal(N)),
        "spindle force [N]": rng.uniform(0, 200, N), "T_base temp": 25 + np.cumsum(0.03 * rng.standard_normal(N)),
    }  # fmt: skip
    for label in rng.permutation(list(every))[: int(rng.integers(1, 4))]:
        values = np.round(every[label], 3)
        sheet.add(str(label), values, 3)
        written.signals.append(values)
        written.about.setdefault("signals", []).append(str(label))  # type: ignore[union-attr, attr-defined]


def _faults(rng: np.random.Generator, sheet: Sheet, written: Written, cells: list[list[str]]) -> None:
    """Rows in which nothing was read, as loggers write it."""
    N = len(written.recorded.q)
    gone = rng.random(N) < rng.uniform(0.04, 0.15)
    gone[:2] = False
    gone[5] = True
    token = str(rng.choice(["ERR", "LOST", "-9999", "999999.0000", "zeros", "", "NaN", "no line of sight"]))
    written.about["token"] = token
    for column in cells:
        zero = f"{0.0:.{len(column[0].split(sheet.decimal)[-1])}f}".replace(".", sheet.decimal)
        for i in np.flatnonzero(gone):
            column[i] = zero if token == "zeros" else token.replace(".", sheet.decimal)
    written.whole = ~gone


def _joined(rng: np.random.Generator, tracker: Sheet, written: Written, seed: int, folder: Path) -> Written:
    """The readings in one file and the joints in another, now and then a third; rows by station number or by time."""
    recorded, N = written.recorded, len(written.recorded.q)
    by_time = bool(rng.random() < 0.4)
    robot = Sheet("," if rng.random() < 0.3 else ".")
    third = Sheet(".") if rng.random() < 0.4 else None
    t = recorded.stamps - recorded.stamps[0]
    tracker = Sheet(tracker.decimal)
    names = [str(n) for n in rng.choice([["time", "t"], ["timestamp", "time"]] if by_time else
             [["station", "pose_id"], ["Point", "point"], ["id", "ID"], ["nr", "station"]])]  # fmt: skip
    for sheet, name in zip((tracker, robot, third), (*names, names[0]), strict=True):
        if sheet is None:
            continue
        if by_time:
            sheet.add(name, t + (0.0 if sheet is tracker else rng.uniform(-0.02, 0.02, N)), 3)
        else:
            sheet.add(name, np.arange(1.0, N + 1), 0)
    written.about |= {"by_time": by_time, "names": names, "third": third is not None, "clock": by_time}
    pose(rng, tracker, written)
    _joints(rng, robot, written)
    if rng.random() < 0.4:
        _effort(rng, robot, written)
    if third is not None:
        _signals(rng, third, written)
    for k, sheet in enumerate((tracker, robot, third)):
        if sheet is None:
            continue
        order = np.arange(N) if by_time or k == 0 else rng.permutation(N)
        path = folder / f"columns_{seed:04d}_{('tracker', 'robot', 'room')[k]}.csv"
        path.write_bytes(sheet.text(rng, order).encode("utf-8"))
        written.paths.append(path)
    return written
