"""Exports with more than joints and a pose: speeds, efforts, commanded joints, standard deviations, signals, several
targets, ranges, bearings, heights, several files, cells that hold no number. Drawn at random; nothing comes from modcal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from arms import ARMS, Recorded, holding, record
from scipy.spatial.transform import Rotation

SCENARIOS = ("log", "moving", "tracker", "targets", "ranges", "bearings", "polar", "height", "joined", "faults")
LENGTH = {"mm": 1e3, "m": 1.0, "in": 1.0 / 0.0254, "cm": 1e2}
ANGLE = {"deg": 180.0 / np.pi, "rad": 1.0, "gon": 200.0 / np.pi}


@dataclass
class Written:
    """Files, and what was written into them, in SI. readings: kind → list of values, one for each instrument. whole:
    rows in which all of the readings' cells hold numbers. signals: of columns that are signals or temperatures.
    """

    paths: list[Path]
    recorded: Recorded
    readings: dict[str, list[np.ndarray]]
    whole: np.ndarray
    velocity: np.ndarray | None = None
    effort: np.ndarray | None = None
    commanded: np.ndarray | None = None
    std: np.ndarray | None = None
    signals: list[np.ndarray] = field(default_factory=list)
    about: dict[str, object] = field(default_factory=dict)


class _Sheet:
    """Columns of one file."""

    def __init__(self, decimal: str) -> None:
        self.decimal = decimal
        self.labels: list[str] = []
        self.cells: list[list[str]] = []

    def add(self, label: str, values: np.ndarray, digits: int) -> list[str]:
        cells = [f"{v:.{digits}f}".replace(".", self.decimal) for v in values]
        self.labels.append(label)
        self.cells.append(cells)
        return cells

    def text(self, rng: np.random.Generator, order: np.ndarray, units: bool = False) -> str:
        separators = [";", "\t", "|"] + ([","] if self.decimal == "." else [])
        separator = str(rng.choice(separators))
        lines = ["Exported by the cell's logger", ""] if rng.random() < 0.3 else []
        lines.append(separator.join(self.labels))
        lines += [separator.join(column[i] for column in self.cells) for i in order]
        return str(rng.choice(["\n", "\r\n"])).join([*lines, ""])


def draw(seed: int, folder: Path) -> Written:
    """The files of one seed."""
    rng = np.random.default_rng([seed, 21])
    scenario = SCENARIOS[seed % len(SCENARIOS)]
    robot = str(rng.choice(list(ARMS)))
    rate = float(rng.choice([20.0, 50.0])) if scenario == "moving" else 0.0
    recorded = record(robot, rng, int(rng.integers(160, 300) if rate else rng.integers(45, 140)), 1.0, rate)
    sheet = _Sheet("," if rng.random() < 0.3 else ".")
    about: dict[str, object] = {"scenario": scenario, "robot": robot}
    written = Written([], recorded, {}, np.ones(len(recorded.q), bool), about=about)
    N = len(recorded.q)
    _time(rng, sheet, recorded, scenario == "moving" or rng.random() < 0.6, about)
    if scenario == "joined":
        return _joined(rng, sheet, written, seed, folder)
    readings = {"targets": _targets, "ranges": _ranges, "bearings": _bearings, "polar": _polar, "height": _height}
    extras = [_velocity, _effort, _commanded]
    if rng.random() < 0.5:
        mine = readings.get(scenario, _pose)(rng, sheet, written)
        _joints(rng, sheet, written)
    else:
        _joints(rng, sheet, written)
        mine = readings.get(scenario, _pose)(rng, sheet, written)
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


def _time(rng: np.random.Generator, sheet: _Sheet, recorded: Recorded, stated: bool, about: dict) -> None:  # type: ignore[type-arg]
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


def _joints(rng: np.random.Generator, sheet: _Sheet, written: Written) -> None:
    degrees = bool(rng.random() < 0.5)
    ways = ["{n}", "J{k}", "A{k}", "q_{z}", "Axis {k}", "joint_{k}", "joint_states/position/{n}", "actual_q_{z}"]
    labels = _families(rng, written, ways)
    written.about |= {"joints": labels[0], "degrees": degrees}
    q = np.degrees(written.recorded.q) if degrees else written.recorded.q
    order = rng.permutation(len(labels)) if rng.random() < 0.2 else np.arange(len(labels))
    for k in order:
        sheet.add(labels[k], q[:, k], 5 if degrees else 7)


def _velocity(rng: np.random.Generator, sheet: _Sheet, written: Written) -> None:
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


def _effort(rng: np.random.Generator, sheet: _Sheet, written: Written) -> None:
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


def _commanded(rng: np.random.Generator, sheet: _Sheet, written: Written) -> None:
    q = written.recorded.q + 3e-4 * rng.standard_normal(written.recorded.q.shape)
    degrees = bool(rng.random() < 0.5)
    ways = ["target_q_{z}", "cmd_{n}", "q_des_{k}", "Soll A{k}", "J{k} setpoint", "joint_{k}_ref", "commanded/{n}"]
    labels = _families(rng, written, ways)
    written.about |= {"commanded": labels[0], "commanded_degrees": degrees}
    written.commanded = q
    for k, label in enumerate(labels):
        sheet.add(label, np.degrees(q[:, k]) if degrees else q[:, k], 6)


def _pose(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    T = written.recorded.T
    unit = str(rng.choice(["mm", "m"]))
    digits = {"mm": 4, "m": 7}[unit]
    written.about["unit"] = unit
    stem = str(rng.choice(["", "tool ", "probe_", "SMR "]))
    cells = [sheet.add(f"{stem}{axis}", LENGTH[unit] * T[:, k, 3], digits) for k, axis in enumerate("xyz")]
    form = str(rng.choice(["quaternion", "matrix", "euler", "point"], p=[0.35, 0.3, 0.2, 0.15]))
    written.about["form"] = form
    R = Rotation.from_matrix(T[:, :3, :3])
    if form == "quaternion":
        cells += [sheet.add(f"{stem}q{axis}", R.as_quat()[:, k], 7) for k, axis in enumerate("xyzw")]
    elif form == "matrix":
        names = str(rng.choice(["{stem}r{i}{j}", "{stem}R{i}{j}", "{stem}rot_{i}_{j}"]))
        for i in range(3):
            for j in range(3):
                label = names.format(stem=stem, i=i + 1, j=j + 1)
                cells.append(sheet.add(label, T[:, i, j], 8))
    elif form == "euler":
        angles = R.as_euler("ZYX", degrees=True)
        cells += [sheet.add(f"{stem}{name}", angles[:, k], 5) for k, name in enumerate(("rz", "ry", "rx"))]
    written.readings["point" if form == "point" else "pose"] = [T]
    if written.about["scenario"] in ("tracker", "faults") or rng.random() < 0.2:
        _std(rng, sheet, written, unit, form)
    return cells


def _std(rng: np.random.Generator, sheet: _Sheet, written: Written, unit: str, form: str) -> None:
    """Standard deviations of positions, or expanded uncertainties, in the readings' unit or in one that is told."""
    N = len(written.recorded.q)
    s = rng.uniform(0.8, 1.25, (N, 3)) * rng.uniform(1.2e-5, 8e-5)
    told = bool(rng.random() < 0.5)
    if told:
        unit = str(rng.choice(["mm", "m"]))
    name = f" [{unit}]" if told else ""
    expanded = bool(rng.random() < 0.3)
    ways = ["U{a} (95%)", "u95_{a}", "{a} 2 sigma"] if expanded else [
        "std_{a}", "sigma_{a}", "s{a}", "{A} std", "{a}_stddev", "SD {A}"]  # fmt: skip
    way = str(rng.choice(ways))
    if rng.random() < 0.2 and not expanded:
        s = np.tile(s[:, :1], (1, 3))
        way = str(rng.choice(["pos_std", "std position", "sigma"]))
        sheet.add(f"{way}{name}", LENGTH[unit] * s[:, 0], 9 if unit == "m" else 6)
    else:
        for k, axis in enumerate("xyz"):
            factor = 2.0 if expanded else 1.0
            label = way.format(a=axis, A=axis.upper())
            sheet.add(f"{label}{name}", LENGTH[unit] * factor * s[:, k], 9 if unit == "m" else 6)
    written.about |= {"std": way + name, "expanded": expanded}
    written.std = np.linalg.norm(s, axis=1)


def _targets(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    T = written.recorded.T
    count = int(rng.integers(3, 6))
    while True:
        places = rng.uniform(-0.12, 0.12, (count, 3))
        if np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 0.05:
            break
    unit = str(rng.choice(["mm", "m"]))
    way = str(rng.choice(["SMR{i} {a}", "P{i}_{a}", "target {i} {a}", "m{i}{a}", "Marker{i}:{A}"]))
    written.about |= {"targets": way, "count": count, "unit": unit}
    cells = []
    for i, place in enumerate(places):
        p = T[:, :3, :3] @ place + T[:, :3, 3] + 3e-5 * rng.standard_normal((len(T), 3))
        for k, axis in enumerate("xyz"):
            label = way.format(i=i + 1, a=axis, A=axis.upper())
            cells.append(sheet.add(label, LENGTH[unit] * p[:, k], {"mm": 4, "m": 7}[unit]))
    if rng.random() < 0.3:  # a nest that stands
        nest = rng.uniform(-1, 1, 3) + 2e-5 * rng.standard_normal((len(T), 3))
        for k, axis in enumerate("xyz"):
            sheet.add(f"reference {axis}", LENGTH[unit] * nest[:, k], {"mm": 4, "m": 7}[unit])
    written.readings["body"] = [T]
    return cells


def _seen(rng: np.random.Generator, written: Written) -> np.ndarray:
    """The tool's point (N, 3) in the tracker's frame, whose origin is some metres away."""
    return np.asarray(written.recorded.T[:, :3, 3])


def _ranges(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    p = _seen(rng, written)
    middle = p.mean(axis=0)
    count = int(rng.integers(1, 4))
    unit = str(rng.choice(["mm", "m", "in"], p=[0.5, 0.4, 0.1]))
    ways = ["range_{i}", "distance {i}", f"Dist {{i}} [{unit}]", f"wire_{{i}}_{unit}", "d{i}", "range to anchor {i}"]
    way = str(rng.choice(ways))
    written.about |= {"ranges": way, "count": count, "unit": unit}
    written.readings["range"] = []
    cells = []
    for i in range(count):
        away = rng.standard_normal(3)
        anchor = middle + rng.uniform(1.2, 3.0) * away / np.linalg.norm(away)
        d = np.linalg.norm(p - anchor, axis=1) + 5e-5 * rng.standard_normal(len(p))
        written.readings["range"].append(d)
        cells.append(sheet.add(way.format(i=i + 1), LENGTH[unit] * d, {"mm": 4, "m": 7, "in": 5}[unit]))
    return cells


def _station(rng: np.random.Generator, p: np.ndarray) -> np.ndarray:
    """The point in the frame of a station that stands upright some metres away, turned anyhow about its axis."""
    away = rng.standard_normal(3) * [1, 1, 0.3]
    place = p.mean(axis=0) + rng.uniform(1.5, 3.5) * away / np.linalg.norm(away)
    turn = Rotation.random(random_state=rng)
    return np.asarray(turn.apply(p - place))


def _angles(
    rng: np.random.Generator, sheet: _Sheet, written: Written, u: np.ndarray, way: str
) -> tuple[list[list[str]], np.ndarray]:
    unit = str(rng.choice(["deg", "rad", "gon"], p=[0.45, 0.25, 0.3]))
    clockwise, zenith = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    up = np.arcsin(u[:, 2]) + 4e-5 * rng.standard_normal(len(u))
    azimuth = np.arctan2(u[:, 1], u[:, 0]) + 4e-5 * rng.standard_normal(len(u))
    true = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    azimuth = (-azimuth if clockwise else azimuth) % (2 * np.pi) if rng.random() < 0.6 else (
        -azimuth if clockwise else azimuth)  # fmt: skip
    second = np.pi / 2 - up if zenith else up
    pairs = [("zenith" if zenith else "elevation"), ("Zen" if zenith else "El"), "V" if zenith else "vertical angle"]
    one, two = {"words": ("azimuth", pairs[0]), "short": ("az", pairs[1]), "survey": ("Hz", pairs[2])}[way]
    told = f" [{unit}]" if rng.random() < 0.5 else ""
    written.about |= {"angles": (one, two, told), "unit": unit, "clockwise": clockwise, "zenith": zenith}
    digits = {"deg": 6, "rad": 8, "gon": 6}[unit]
    cells = [sheet.add(f"{one}{told}", ANGLE[unit] * azimuth, digits)]
    cells.append(sheet.add(f"{two}{told}", ANGLE[unit] * second, digits))
    return cells, true


def _bearings(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    seen = _station(rng, _seen(rng, written))
    u = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    if rng.random() < 0.3:
        u = u + 4e-5 * rng.standard_normal(u.shape)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        names = str(rng.choice(["u{a}", "dir_{a}", "bearing.{a}"]))
        written.about["vector"] = names
        written.readings["bearing"] = [u]
        return [sheet.add(names.format(a=a), u[:, k], 8) for k, a in enumerate("xyz")]
    cells, true = _angles(rng, sheet, written, u, str(rng.choice(["words", "short", "survey"])))
    written.readings["bearing"] = [true]
    return cells


def _polar(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    seen = _station(rng, _seen(rng, written))
    d = np.linalg.norm(seen, axis=1)
    cells, true = _angles(rng, sheet, written, seen / d[:, None], str(rng.choice(["words", "short", "survey"])))
    unit = str(rng.choice(["mm", "m"]))
    d = d + 2e-5 * rng.standard_normal(len(d))
    cells.append(sheet.add(str(rng.choice(["distance", "D", "Slope distance"])), LENGTH[unit] * d, 6))
    written.readings |= {"bearing": [true], "range": [d]}
    return cells


def _height(rng: np.random.Generator, sheet: _Sheet, written: Written) -> list[list[str]]:
    p = _seen(rng, written)
    n = rng.standard_normal(3)
    n /= np.linalg.norm(n)
    h = (p - p.mean(axis=0)) @ n + 1.5 + 3e-5 * rng.standard_normal(len(p))
    unit = str(rng.choice(["mm", "m"]))
    label = str(rng.choice(["height", f"height [{unit}]", "dial indicator", "probe height", f"gap_{unit}"]))
    written.about |= {"height": label, "unit": unit}
    written.readings["plane"] = [h]
    return [sheet.add(label, LENGTH[unit] * h, {"mm": 4, "m": 7}[unit])]


def _signals(rng: np.random.Generator, sheet: _Sheet, written: Written) -> None:
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


def _faults(rng: np.random.Generator, sheet: _Sheet, written: Written, cells: list[list[str]]) -> None:
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


def _joined(rng: np.random.Generator, tracker: _Sheet, written: Written, seed: int, folder: Path) -> Written:
    """The readings in one file and the joints in another, now and then a third; rows by station number or by time."""
    recorded, N = written.recorded, len(written.recorded.q)
    by_time = bool(rng.random() < 0.4)
    robot = _Sheet("," if rng.random() < 0.3 else ".")
    third = _Sheet(".") if rng.random() < 0.4 else None
    t = recorded.stamps - recorded.stamps[0]
    tracker = _Sheet(tracker.decimal)
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
    _pose(rng, tracker, written)
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
