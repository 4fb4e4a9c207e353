"""Exports with more than joints and a pose: speeds, efforts, commanded joints, standard deviations, signals, several
targets, ranges, bearings, heights, several files, cells that hold no number. Nothing here comes from modcal.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import readings
from sheet import ARMS, Sheet, Written, holding, record

Rng = np.random.Generator
SCENARIOS = ("log", "moving", "tracker", "targets", "ranges", "bearings", "polar", "height", "joined", "faults")
# Labels of one column a joint; {n}: the joint's name, {k} and {z}: its number, from one and from zero
JOINTS = ["{n}", "J{k}", "A{k}", "q_{z}", "Axis {k}", "joint_{k}", "joint_states/position/{n}", "actual_q_{z}"]
SPEEDS_DEG = ["Velocity J{k} [deg/s]", "{n}_vel (deg/s)", "dq{k}_deg_s"]
SPEEDS_RAD = ["J{k} speed (rad/s)", "joint_states/velocity/{n} [rad/s]", "qd_{z}_rad_s"]
SPEEDS_BARE = ["actual_qd_{z}", "dq_{k}", "joint_states/velocity/{n}", "vel_{k}", "{n} velocity"]
LOADS = ["J{k} load [%]", "Motor load {k} (%)", "actual_current_{z}", "I{k} current [A]"]
TORQUES = ["Torque J{k} [Nm]", "Motor torque A{k} (N·m)", "tau_{k}_Nm", "joint_states/effort/{n} [N m]"]
TORQUES_BARE = ["tau_{k}", "joint_states/effort/{n}", "{n}_effort", "joint_torque_{z}"]
COMMANDS = ["target_q_{z}", "cmd_{n}", "q_des_{k}", "Soll A{k}", "J{k} setpoint", "joint_{k}_ref", "commanded/{n}"]
TOKENS = ["ERR", "LOST", "-9999", "999999.0000", "zeros", "", "NaN", "no line of sight"]
KEYS = [["station", "pose_id"], ["Point", "point"], ["id", "ID"], ["nr", "station"]]


def draw(seed: int, folder: Path) -> Written:
    """The files of one seed."""
    rng = np.random.default_rng([seed, 21])
    scenario, robot = SCENARIOS[seed % len(SCENARIOS)], str(rng.choice(list(ARMS)))
    rate = float(rng.choice([20.0, 50.0])) if scenario == "moving" else 0.0
    recorded = record(robot, rng, int(rng.integers(160, 300) if rate else rng.integers(45, 140)), rate)
    sheet, N = Sheet("," if rng.random() < 0.3 else "."), len(recorded.q)
    written = Written([], recorded, {}, np.ones(N, bool), about={"scenario": scenario, "robot": robot})
    _time(rng, sheet, written, scenario == "moving" or rng.random() < 0.6)
    if scenario == "joined":
        return _joined(rng, sheet, written, seed, folder)
    read = getattr(readings, scenario, readings.pose)
    if rng.random() < 0.5:
        mine = read(rng, sheet, written)
        _joints(rng, sheet, written)
    else:
        _joints(rng, sheet, written)
        mine = read(rng, sheet, written)
    for extra in (_velocity, _effort, _commanded):
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


def _time(rng: Rng, sheet: Sheet, written: Written, stated: bool) -> None:
    written.about["clock"], stamps = stated, written.recorded.stamps
    if stated:
        way = str(rng.choice(["t", "epoch", "ms"]))
        if way == "t":
            sheet.add(str(rng.choice(["t", "time [s]", "Time"])), stamps - stamps[0], 4)
        elif way == "epoch":
            sheet.add("timestamp", stamps, 4)
        else:
            sheet.add("time_ms", 1e3 * (stamps - stamps[0]), 1)
    elif rng.random() < 0.5:
        sheet.add("Point", np.arange(1.0, len(stamps) + 1), 0)


def _family(rng: Rng, written: Written, what: str, ways: list[str]) -> list[str]:
    """Labels of one column a joint."""
    way = str(rng.choice(ways))
    labels = [way.format(n=name, k=z + 1, z=z) for z, name in enumerate(written.recorded.names)]
    written.about[what] = labels[0]
    return labels


def _joints(rng: Rng, sheet: Sheet, written: Written) -> None:
    degrees = bool(rng.random() < 0.5)
    labels = _family(rng, written, "joints", JOINTS)
    written.about["degrees"] = degrees
    q = np.degrees(written.recorded.q) if degrees else written.recorded.q
    order = rng.permutation(len(labels)) if rng.random() < 0.2 else np.arange(len(labels))
    sheet.add_all([labels[k] for k in order], q[:, order], 5 if degrees else 7)


def _velocity(rng: Rng, sheet: Sheet, written: Written) -> None:
    recorded = written.recorded
    v = np.gradient(recorded.q, recorded.stamps, axis=0) if written.about["scenario"] == "moving" else 0.0
    written.velocity = v = v + 1e-4 * rng.standard_normal(recorded.q.shape)
    degrees, told = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    labels = _family(rng, written, "velocity", (SPEEDS_DEG if degrees else SPEEDS_RAD) if told else SPEEDS_BARE)
    written.about |= {"velocity_degrees": degrees, "velocity_told": told}
    sheet.add_all(labels, np.degrees(v) if degrees else v, 5)


def _effort(rng: Rng, sheet: Sheet, written: Written) -> None:
    tau = holding(written.recorded.robot, written.recorded.q)
    tau = tau * rng.uniform(0.9, 1.1, tau.shape[1]) + rng.uniform(0.5, 2.0) * rng.standard_normal(tau.shape)
    of_load = bool(rng.random() < 0.3)
    if rng.random() < 0.2:  # no torque at all
        written.signals += list(tau.T)
        sheet.add_all(_family(rng, written, "load", LOADS), tau, 3)
        return
    labels = _family(rng, written, "effort", TORQUES if rng.random() < 0.5 else TORQUES_BARE)
    written.about["of_load"], written.effort = of_load, tau
    sheet.add_all(labels, -tau if of_load else tau, 3)


def _commanded(rng: Rng, sheet: Sheet, written: Written) -> None:
    written.commanded = q = written.recorded.q + 3e-4 * rng.standard_normal(written.recorded.q.shape)
    written.about["commanded_degrees"] = degrees = bool(rng.random() < 0.5)
    sheet.add_all(_family(rng, written, "commanded", COMMANDS), np.degrees(q) if degrees else q, 6)


def _signals(rng: Rng, sheet: Sheet, written: Written) -> None:
    N = len(written.recorded.q)
    every = {"payload_kg": rng.choice([0.0, 2.5, 5.0], N), "Ambient pressure [hPa]": 1013 + rng.standard_normal(N)}
    every["humidity"] = 40 + np.cumsum(0.1 * rng.standard_normal(N))
    every["supply voltage [V]"] = 48 + 0.2 * rng.standard_normal(N)
    every["gripper_opening_mm"] = rng.uniform(0, 80, N)
    every["Temperature [°C]"] = 22 + np.cumsum(0.02 * rng.standard_normal(N))
    every["spindle force [N]"] = rng.uniform(0, 200, N)
    every["T_base temp"] = 25 + np.cumsum(0.03 * rng.standard_normal(N))
    chosen = [str(label) for label in rng.permutation(list(every))[: int(rng.integers(1, 4))]]
    for label in chosen:
        written.signals.append(np.round(every[label], 3))
        sheet.add(label, written.signals[-1], 3)
    written.about["signals"] = chosen


def _faults(rng: Rng, sheet: Sheet, written: Written, cells: list[list[str]]) -> None:
    """Rows in which nothing was read, as loggers write it."""
    N = len(written.recorded.q)
    gone = rng.random(N) < rng.uniform(0.04, 0.15)
    gone[:2], gone[5] = False, True
    written.about["token"] = token = str(rng.choice(TOKENS))
    for column in cells:
        zero = f"{0.0:.{len(column[0].split(sheet.decimal)[-1])}f}".replace(".", sheet.decimal)
        for i in np.flatnonzero(gone):
            column[i] = zero if token == "zeros" else token.replace(".", sheet.decimal)
    written.whole = ~gone


def _joined(rng: Rng, tracker: Sheet, written: Written, seed: int, folder: Path) -> Written:
    """The readings in one file and the joints in another, now and then a third; rows by station number or by time."""
    recorded, N, by_time = written.recorded, len(written.recorded.q), bool(rng.random() < 0.4)
    files = {"tracker": Sheet(tracker.decimal), "robot": Sheet("," if rng.random() < 0.3 else ".")}
    if rng.random() < 0.4:
        files["room"] = Sheet(".")
    t = recorded.stamps - recorded.stamps[0]
    names = [str(n) for n in rng.choice([["time", "t"], ["timestamp", "time"]] if by_time else KEYS)]
    for (what, sheet), name in zip(files.items(), (*names, names[0]), strict=False):
        if by_time:
            sheet.add(name, t + (0.0 if what == "tracker" else rng.uniform(-0.02, 0.02, N)), 3)
        else:
            sheet.add(name, np.arange(1.0, N + 1), 0)
    written.about |= {"by_time": by_time, "names": names, "third": "room" in files, "clock": by_time}
    readings.pose(rng, files["tracker"], written)
    _joints(rng, files["robot"], written)
    if rng.random() < 0.4:
        _effort(rng, files["robot"], written)
    if "room" in files:
        _signals(rng, files["room"], written)
    for what, sheet in files.items():
        order = np.arange(N) if by_time or what == "tracker" else rng.permutation(N)
        path = folder / f"columns_{seed:04d}_{what}.csv"
        path.write_bytes(sheet.text(rng, order).encode("utf-8"))
        written.paths.append(path)
    return written
