"""Exports with more than joints and a pose: speeds, efforts, commanded joints, standard deviations, signals, several
targets, ranges, bearings, heights, several files, cells that hold no number. Nothing here comes from modcal.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from sheet import ANGLE, ARMS, DIGITS, LENGTH, Array, Rng, Sheet, Written, holding, record

Cells = list[list[str]]
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
    read = READ.get(scenario, pose)
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
    pose(rng, files["tracker"], written)
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


def unit_of(rng: Rng, written: Written, units: tuple[str, ...] = ("mm", "m"), p: list[float] | None = None) -> str:
    written.about["unit"] = unit = str(rng.choice(units, p=p))
    return unit


def pose(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    T = written.recorded.T
    unit = unit_of(rng, written)
    stem = str(rng.choice(["", "tool ", "probe_", "SMR "]))
    cells = sheet.add_all([f"{stem}{axis}" for axis in "xyz"], LENGTH[unit] * T[:, :3, 3], DIGITS[unit])
    form = str(rng.choice(["quaternion", "matrix", "euler", "point"], p=[0.35, 0.3, 0.2, 0.15]))
    written.about["form"] = form
    R = Rotation.from_matrix(T[:, :3, :3])
    if form == "quaternion":
        cells += sheet.add_all([f"{stem}q{axis}" for axis in "xyzw"], R.as_quat(), 7)
    elif form == "matrix":
        names = str(rng.choice(["{stem}r{i}{j}", "{stem}R{i}{j}", "{stem}rot_{i}_{j}"]))
        labels = [names.format(stem=stem, i=i, j=j) for i in (1, 2, 3) for j in (1, 2, 3)]
        cells += sheet.add_all(labels, T[:, :3, :3].reshape(-1, 9), 8)
    elif form == "euler":
        cells += sheet.add_all([f"{stem}{name}" for name in ("rz", "ry", "rx")], R.as_euler("ZYX", degrees=True), 5)
    written.readings["point" if form == "point" else "pose"] = [T]
    if written.about["scenario"] in ("tracker", "faults") or rng.random() < 0.2:
        _std(rng, sheet, written, unit, form)
    return cells


def _std(rng: Rng, sheet: Sheet, written: Written, unit: str, form: str) -> None:
    """Standard deviations of positions, or expanded uncertainties, in the readings' unit or in one that is told."""
    s = rng.uniform(0.8, 1.25, (len(written.recorded.q), 3)) * rng.uniform(1.2e-5, 8e-5)
    told = bool(rng.random() < 0.5)
    unit = str(rng.choice(["mm", "m"])) if told else unit
    name, expanded = f" [{unit}]" if told else "", bool(rng.random() < 0.3)
    single = ["std_{a}", "sigma_{a}", "s{a}", "{A} std", "{a}_stddev", "SD {A}"]
    way = str(rng.choice(["U{a} (95%)", "u95_{a}", "{a} 2 sigma"] if expanded else single))
    digits, labels = 9 if unit == "m" else 6, [f"{way.format(a=a, A=a.upper())}{name}" for a in "xyz"]
    if rng.random() < 0.2 and not expanded:
        s = np.tile(s[:, :1], (1, 3))
        way = str(rng.choice(["pos_std", "std position", "sigma"]))
        labels = [f"{way}{name}"]
    sheet.add_all(labels, (2.0 if expanded else 1.0) * LENGTH[unit] * s[:, : len(labels)], digits)
    written.about |= {"std": way + name, "expanded": expanded}
    written.std = np.linalg.norm(s, axis=1)


def targets(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    T, count = written.recorded.T, int(rng.integers(3, 6))
    while True:
        places = rng.uniform(-0.12, 0.12, (count, 3))
        if np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 0.05:
            break
    unit = unit_of(rng, written)
    way = str(rng.choice(["SMR{i} {a}", "P{i}_{a}", "target {i} {a}", "m{i}{a}", "Marker{i}:{A}"]))
    written.about |= {"targets": way, "count": count}
    cells = []
    for i, place in enumerate(places):
        p = T[:, :3, :3] @ place + T[:, :3, 3] + 3e-5 * rng.standard_normal((len(T), 3))
        labels = [way.format(i=i + 1, a=axis, A=axis.upper()) for axis in "xyz"]
        cells += sheet.add_all(labels, LENGTH[unit] * p, DIGITS[unit])
    if rng.random() < 0.3:  # a nest that stands
        nest = rng.uniform(-1, 1, 3) + 2e-5 * rng.standard_normal((len(T), 3))
        sheet.add_all([f"reference {axis}" for axis in "xyz"], LENGTH[unit] * nest, DIGITS[unit])
    written.readings["body"] = [T]
    return cells


def ranges(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    p, count = written.recorded.T[:, :3, 3], int(rng.integers(1, 4))
    unit = unit_of(rng, written, ("mm", "m", "in"), [0.5, 0.4, 0.1])
    ways = ["range_{i}", "distance {i}", f"Dist {{i}} [{unit}]", f"wire_{{i}}_{unit}", "d{i}", "range to anchor {i}"]
    way = str(rng.choice(ways))
    written.about |= {"ranges": way, "count": count}
    written.readings["range"], cells = [], []
    for i in range(count):
        away = rng.standard_normal(3)
        anchor = p.mean(axis=0) + rng.uniform(1.2, 3.0) * away / np.linalg.norm(away)
        d = np.linalg.norm(p - anchor, axis=1) + 5e-5 * rng.standard_normal(len(p))
        written.readings["range"].append(d)
        cells.append(sheet.add(way.format(i=i + 1), LENGTH[unit] * d, DIGITS[unit]))
    return cells


def _station(rng: Rng, written: Written) -> Array:
    """The tool's point in the frame of a station that stands upright some metres away, turned anyhow about its axis."""
    p, away = written.recorded.T[:, :3, 3], rng.standard_normal(3) * [1, 1, 0.3]
    place = p.mean(axis=0) + rng.uniform(1.5, 3.5) * away / np.linalg.norm(away)
    return Rotation.random(random_state=rng).apply(p - place)


def _angles(rng: Rng, sheet: Sheet, written: Written, u: Array) -> tuple[Cells, Array]:
    """Two angles of unit vectors u, and the vectors that they say."""
    way = str(rng.choice(["words", "short", "survey"]))
    unit = unit_of(rng, written, ("deg", "rad", "gon"), [0.45, 0.25, 0.3])
    clockwise, zenith = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    up = np.arcsin(u[:, 2]) + 4e-5 * rng.standard_normal(len(u))
    azimuth = np.arctan2(u[:, 1], u[:, 0]) + 4e-5 * rng.standard_normal(len(u))
    true = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    azimuth = -azimuth if clockwise else azimuth
    azimuth = azimuth % (2 * np.pi) if rng.random() < 0.6 else azimuth
    names = {"words": ("azimuth", "zenith", "elevation"), "short": ("az", "Zen", "El")}
    one, *two = names.get(way, ("Hz", "V", "vertical angle"))
    told = f" [{unit}]" if rng.random() < 0.5 else ""
    written.about |= {"angles": (one, two[not zenith], told), "clockwise": clockwise, "zenith": zenith}
    both = ANGLE[unit] * np.stack([azimuth, np.pi / 2 - up if zenith else up], axis=1)
    return sheet.add_all([f"{one}{told}", f"{two[not zenith]}{told}"], both, 8 if unit == "rad" else 6), true


def bearings(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    seen = _station(rng, written)
    u = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    if rng.random() < 0.3:
        u = u + 4e-5 * rng.standard_normal(u.shape)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        names = str(rng.choice(["u{a}", "dir_{a}", "bearing.{a}"]))
        written.about["vector"], written.readings["bearing"] = names, [u]
        return sheet.add_all([names.format(a=a) for a in "xyz"], u, 8)
    cells, true = _angles(rng, sheet, written, u)
    written.readings["bearing"] = [true]
    return cells


def polar(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    seen = _station(rng, written)
    d = np.linalg.norm(seen, axis=1)
    cells, true = _angles(rng, sheet, written, seen / d[:, None])
    unit, noisy = str(rng.choice(["mm", "m"])), d + 2e-5 * rng.standard_normal(len(d))
    cells.append(sheet.add(str(rng.choice(["distance", "D", "Slope distance"])), LENGTH[unit] * noisy, 6))
    written.readings |= {"bearing": [true], "range": [noisy]}
    return cells


def height(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    p, n = written.recorded.T[:, :3, 3], rng.standard_normal(3)
    n /= np.linalg.norm(n)
    h = (p - p.mean(axis=0)) @ n + 1.5 + 3e-5 * rng.standard_normal(len(p))
    unit = unit_of(rng, written)
    label = str(rng.choice(["height", f"height [{unit}]", "dial indicator", "probe height", f"gap_{unit}"]))
    written.about["height"], written.readings["plane"] = label, [h]
    return [sheet.add(label, LENGTH[unit] * h, DIGITS[unit])]


READ = {reader.__name__: reader for reader in (targets, ranges, bearings, polar, height)}
