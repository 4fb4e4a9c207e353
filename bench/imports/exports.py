"""CSV files as people export them from laser trackers, motion capture and robot controllers, drawn at random.

What is drawn: separator, decimal sign, encoding, preamble, units row, labels, order of columns, gaps, form of the
orientation, units, direction of the pose, useless columns, names and order of the joints. Nothing here comes from modcal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from arms import ARMS, Recorded, record
from scipy.spatial.transform import Rotation

STYLES = ("generic", "spatial_analyzer", "faro", "vicon", "motive", "qualisys", "ndi", "rtde")
LENGTH = {"mm": 1e3, "m": 1.0, "in": 1.0 / 0.0254, "cm": 1e2}


@dataclass
class Column:
    label: str
    values: list[str]
    unit: str = ""
    above: tuple[str, ...] = ()


@dataclass
class Export:
    """A file, and what was written into it. whole: rows in which nothing is missing."""

    path: Path
    recorded: Recorded
    whole: np.ndarray
    style: str
    about: dict[str, object] = field(default_factory=dict)


def draw(seed: int, folder: Path) -> Export:
    """One file."""
    rng = np.random.default_rng([seed, 2])
    robot = str(rng.choice(list(ARMS)))
    recorded = record(robot, rng, int(rng.integers(40, 140)))
    style = STYLES[seed % len(STYLES)]
    about: dict[str, object] = {"robot": robot, "style": style}
    point_only = style in ("faro", "spatial_analyzer") and rng.random() < 0.3
    unit = str(rng.choice({"vicon": ["mm"], "motive": ["m", "mm", "cm"], "qualisys": ["mm"], "ndi": ["mm"],
                           "faro": ["mm", "in", "m"], "rtde": ["m", "mm"]}.get(style, ["mm", "m", "in"])))  # fmt: skip
    inverse = not point_only and style in ("generic", "ndi", "rtde") and rng.random() < 0.35
    about |= {"unit": unit, "inverse": inverse, "point": point_only}
    T = np.linalg.inv(recorded.T) if inverse else recorded.T
    digits = {"mm": 4, "m": 7, "in": 5, "cm": 5}[unit]
    p = LENGTH[unit] * T[:, :3, 3]
    decimal = "," if rng.random() < 0.35 and style != "motive" else "."
    number = _writer(decimal)
    stem = str(rng.choice(["", "tool", "SMR", "Target 1", "measured", "probe"])) if style == "generic" else ""
    position, turned = _pose_columns(style, rng, T, p, unit, digits, number, stem, about)
    joints = _joint_columns(style, rng, recorded, number, about)
    useless = _useless(rng, len(p), number)
    time, clock = _time(style, rng, recorded, number)
    about["clock"] = clock
    readings = position + ([] if point_only else turned)
    if style == "generic" and rng.random() < 0.4:
        readings = ([] if point_only else turned) + position
    groups = [time, *([readings, joints] if rng.random() < 0.5 else [joints, readings]), useless]
    columns = [c for group in groups for c in group]
    if rng.random() < 0.15 and all(c.label for c in columns) and about["joints"] != "none" and style != "motive":
        rng.shuffle(columns)
        about["shuffled"] = True
    whole = np.ones(len(p), bool)
    if rng.random() < 0.4:
        token = str(rng.choice(["", "nan", "NaN", "N/A", "-", "MISSING" if style == "ndi" else "null"]))
        gone = rng.random(len(p)) < rng.uniform(0.02, 0.15)
        for c in readings:
            for i in np.flatnonzero(gone):
                c.values[i] = token
        whole &= ~gone
        about["missing"] = token
    path = folder / f"export_{seed:04d}{rng.choice(['.csv', '.txt', '.tsv'])}"
    _write(path, style, rng, columns, decimal, about)
    return Export(path, recorded, whole, style, about)


def _writer(decimal: str) -> Callable[[float, int], str]:
    return lambda value, digits: f"{value:.{digits}f}".replace(".", decimal)


def _cells(values: np.ndarray, digits: int, number: Callable[[float, int], str]) -> list[str]:
    return [number(float(v), digits) for v in values]


def _pose_columns(style, rng, T, p, unit, digits, number, stem, about):  # type: ignore[no-untyped-def]
    """Columns of the position, and of the orientation."""
    R = Rotation.from_matrix(T[:, :3, :3])
    dot = str(rng.choice([" ", "_", "."]))
    pre = f"{stem}{dot}" if stem else ""
    names = {
        "generic": [[f"{pre}x", f"{pre}y", f"{pre}z"], [f"{pre}X [{unit}]", f"{pre}Y [{unit}]", f"{pre}Z [{unit}]"],
                    [f"{pre}pos_x", f"{pre}pos_y", f"{pre}pos_z"], [f"{pre}x_{unit}", f"{pre}y_{unit}", f"{pre}z_{unit}"]],
        "vicon": [["TX", "TY", "TZ"]], "motive": [["X", "Y", "Z"]], "ndi": [["Tx", "Ty", "Tz"]],
        "rtde": [["tracker_x", "tracker_y", "tracker_z"]],
    }.get(style, [["X", "Y", "Z"]])  # fmt: skip
    xyz = names[int(rng.integers(len(names)))]
    above = ("Rigid Body", "tool", "", "Position") if style == "motive" else ()
    position = [Column(xyz[k], _cells(p[:, k], digits, number), unit, above) for k in range(3)]
    form = {
        "spatial_analyzer": ["euler_fixed_xyz", "euler", "rotvec"], "faro": ["euler", "matrix"], "vicon": ["rotvec", "euler_xyz"],
        "motive": ["quaternion"], "qualisys": ["rpy_matrix"], "ndi": ["quaternion_ndi", "euler_ndi"],
    }.get(style, ["euler", "quaternion", "matrix", "rotvec", "matrix4"])  # fmt: skip
    form = str(rng.choice(form))
    about["form"] = form
    degrees = bool(rng.random() < 0.6) if style not in ("spatial_analyzer", "qualisys", "ndi") else True
    du = "deg" if degrees else "rad"
    ad = 5 if degrees else 7

    def angles(values: np.ndarray, labels: list[str]) -> list[Column]:
        scaled = np.degrees(values) if degrees else values
        return [Column(labels[k], _cells(scaled[:, k], ad, number), du, above) for k in range(values.shape[1])]

    if form in ("euler", "euler_xyz", "euler_fixed_xyz", "euler_ndi"):
        every = ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY"]
        sequence = str(rng.choice(every + [s.lower() for s in every]))
        sequence = {"euler_xyz": "XYZ", "euler_fixed_xyz": "xyz", "euler_ndi": "ZYX"}.get(form, sequence)
        about["sequence"], about["degrees"] = sequence, degrees
        values = R.as_euler(sequence)
        labels = [["A", "B", "C"], ["rx", "ry", "rz"], ["alpha", "beta", "gamma"], ["e1", "e2", "e3"]]
        label = labels[int(rng.integers(len(labels)))]
        if style in ("spatial_analyzer", "vicon"):
            label = ["Rx", "Ry", "Rz"] if style == "spatial_analyzer" else ["RX", "RY", "RZ"]
        if form == "euler_ndi":
            label = ["Rz", "Ry", "Rx"]
        return position, angles(values, [f"{pre}{a}" for a in label])
    if form == "rotvec":
        about["degrees"] = degrees
        return position, angles(
            R.as_rotvec(), ["RX", "RY", "RZ"] if style == "vicon" else [f"{pre}rx", f"{pre}ry", f"{pre}rz"]
        )
    if form.startswith("quaternion"):
        q = R.as_quat()
        if rng.random() < 0.5:
            q = q * np.sign(q[:, 3:] + 1e-12)
        w_first = form == "quaternion_ndi" or (style != "motive" and rng.random() < 0.5)
        about["w_first"] = w_first
        q = q[:, [3, 0, 1, 2]] if w_first else q
        label = ["Q0", "Qx", "Qy", "Qz"] if form == "quaternion_ndi" else None
        if label is None:
            bare = ["qw", "qx", "qy", "qz"] if w_first else ["qx", "qy", "qz", "qw"]
            label = (
                bare
                if rng.random() < 0.6
                else [f"q{k}" for k in range(4)]
                if rng.random() < 0.5
                else [f"q{k}" for k in range(1, 5)]
            )
        if style == "motive":
            label, above2 = ["X", "Y", "Z", "W"], ("Rigid Body", "tool", "", "Rotation")
            return position, [Column(label[k], _cells(q[:, k], 7, number), "", above2) for k in range(4)]
        return position, [Column(f"{pre}{label[k]}", _cells(q[:, k], 7, number)) for k in range(4)]
    M = T[:, :3, :3]
    if form == "rpy_matrix":
        e = R.as_euler("xyz")
        column_major = M.transpose(0, 2, 1).reshape(-1, 9)
        out = angles(e, ["Roll", "Pitch", "Yaw"]) + [
            Column("Residual", _cells(rng.uniform(0.1, 0.6, len(p)), 3, number))
        ]
        return position, out + [Column(f"Rot[{k}]", _cells(column_major[:, k], 6, number)) for k in range(9)]
    if form == "matrix4":
        flat = np.concatenate([M, (LENGTH[unit] * T[:, :3, 3:])], axis=2).reshape(-1, 12)
        label = [f"T{r}{c}" for r in range(1, 4) for c in range(1, 5)]
        cells = [Column(label[k], _cells(flat[:, k], digits if k % 4 == 3 else 7, number)) for k in range(12)]
        return [], cells
    column_major = rng.random() < 0.4
    about["column_major"] = column_major
    flat = (M.transpose(0, 2, 1) if column_major else M).reshape(-1, 9)
    label = (
        [f"{pre}r{k}" for k in range(9)]
        if column_major or rng.random() < 0.3
        else [f"{pre}r{r}{c}" for r in "123" for c in "123"]
    )
    return position, [Column(label[k], _cells(flat[:, k], 7, number)) for k in range(9)]


def _joint_columns(style, rng, recorded, number, about):  # type: ignore[no-untyped-def]
    degrees = bool(rng.random() < 0.5) and style != "rtde"
    n = len(recorded.names)
    words = ["base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3", "wrist4"]
    ways = {
        "urdf": list(recorded.names),
        "prefixed": [f"joint_states/position/{name}" for name in recorded.names],
        "J": [f"J{k + 1}" for k in range(n)],
        "A": [f"A{k + 1}" for k in range(n)],
        "axis": [f"Axis {k + 1} [{'deg' if degrees else 'rad'}]" for k in range(n)],
        "q": [f"q_{k}" for k in range(n)],
        "joint": [f"joint_{k + 1}_{'deg' if degrees else 'rad'}" for k in range(n)],
        "words": words[:n],
        "letters": list("SLURBTE")[:n],
        "none": [f"Channel {name}" for name in "ABCDEFG"[:n]],
        "rtde": [f"actual_q_{k}" for k in range(n)],
    }
    way = "rtde" if style == "rtde" else str(rng.choice([w for w in ways if w != "rtde"]))
    order = rng.permutation(n) if rng.random() < 0.4 else np.arange(n)
    about |= {"joints": way, "joint_degrees": degrees, "joint_order": order.tolist()}
    scale = 180.0 / np.pi if degrees else 1.0
    digits = 5 if degrees else 7
    unit = "deg" if degrees else "rad"
    out = [Column(ways[way][k], _cells(scale * recorded.q[:, k], digits, number), unit) for k in order]
    if style == "rtde":
        out += [Column(f"target_q_{k}", _cells(recorded.commanded[:, k], 7, number), unit) for k in order]
        out += [Column(f"actual_current_{k}", _cells(rng.normal(0, 2, len(recorded.q)), 4, number), "A") for k in order]
        out += [
            Column(f"actual_qd_{k}", _cells(rng.normal(0, 1e-4, len(recorded.q)), 6, number), "rad/s") for k in order
        ]
    return out


def _useless(rng, N, number):  # type: ignore[no-untyped-def]
    every = [
        Column("Temperature", _cells(21.0 + np.cumsum(0.02 * rng.standard_normal(N)), 2, number), "°C"),
        Column("Intensity", _cells(rng.uniform(40, 90, N), 1, number), "%"),
        Column("rms error", _cells(rng.uniform(0.01, 0.04, N), 3, number), "mm"),
        Column("Operator", [str(rng.choice(["Müller", "Perez", "Weiß"]))] * N),
        Column("pressure", _cells(1013.0 + rng.standard_normal(N), 1, number)),
        Column("u1", _cells(rng.uniform(-1, 1, N), 4, number)),
        Column("status", ["OK"] * N),
    ]
    return [every[k] for k in rng.permutation(len(every))[: int(rng.integers(0, 4))]]


def _time(style, rng, recorded, number):  # type: ignore[no-untyped-def]
    N = len(recorded.stamps)
    ways = {"motive": ["frame_seconds"], "vicon": ["frames"], "qualisys": ["frame_seconds"], "ndi": ["frame"]}
    way = str(rng.choice(ways.get(style, ["epoch", "iso", "seconds", "ms", "none", "german", "us_date"])))
    frame = Column("Frame", [str(k) for k in range(1, N + 1)])
    since = recorded.stamps - recorded.stamps[0]
    moments = [datetime.fromtimestamp(float(s), UTC) for s in recorded.stamps]
    if way == "frame_seconds":
        label = "Time (Seconds)" if style == "motive" else "Time"
        return [frame, Column(label, _cells(since, 4, number), "s" if style != "motive" else "")], True
    if way == "frames":
        return [frame, Column("Sub Frame", ["0"] * N)], False
    if way == "frame":
        return [frame], False
    if way == "epoch":
        return [Column("timestamp", _cells(recorded.stamps, 4, number), "s")], True
    if way == "iso":
        return [Column("Time", [m.strftime("%Y-%m-%dT%H:%M:%S.%f") for m in moments])], True
    if way == "seconds":
        return [Column("t", _cells(since, 3, number), "s")], True
    if way == "ms":
        return [Column("time [ms]", _cells(1e3 * since, 0, number), "ms")], True
    if way == "german":
        return [Column("Datum", [m.strftime("%d.%m.%Y") for m in moments]),
                Column("Uhrzeit", [m.strftime("%H:%M:%S") for m in moments])], False  # fmt: skip
    if way == "us_date":
        return [Column("Date Time", [m.strftime("%m/%d/%Y %H:%M:%S") for m in moments])], True
    return [], False


def _write(path: Path, style: str, rng: np.random.Generator, columns: list[Column], decimal: str, about: dict) -> None:
    separators = [";", "\t", "|"] + ([","] if decimal == "." else []) + [" "]
    separator = str(rng.choice(separators, p=None))
    if separator == " " and any(" " in c.label or any(" " in v or not v for v in c.values) for c in columns):
        separator = ";"
    if style in ("motive",):
        separator = ","
    if style in ("qualisys",):
        separator = "\t"
    encoding = str(rng.choice(["utf-8", "utf-8-sig", "utf-16", "latin-1"], p=[0.45, 0.25, 0.15, 0.15]))
    lines: list[str] = []
    header, units = True, False
    if style == "vicon":
        lines += ["Trajectories", "100"]
        units = True
    elif style == "motive":
        lines += [
            separator.join(["Format Version", "1.23", "Take Name", "Take 2024-03-01", "Capture Frame Rate", "120.0"]),
            "",
        ]
    elif style == "qualisys":
        lines += [f"NO_OF_FRAMES{separator}{len(columns[0].values)}", f"FREQUENCY{separator}100", f"DATA_INCLUDED{separator}6D",
                  f"BODY_NAMES{separator}tool"]  # fmt: skip
    elif style == "spatial_analyzer" and rng.random() < 0.6:
        lines += ["// SpatialAnalyzer export", "// Units: see header; Temperature: °C", ""]
        units = rng.random() < 0.5
    elif style == "faro" and rng.random() < 0.6:
        lines += [f"FARO CAM2 Measure{separator}10.7", "Operator: Müller", ""]
    elif style == "generic":
        if rng.random() < 0.4:
            lines += [f"# line {k} of a preamble, with a comma" for k in range(int(rng.integers(1, 9)))]
        units = rng.random() < 0.3
        header = rng.random() > 0.1 or about.get("shuffled", False)
    labels = [c.label for c in columns]
    if style == "motive":
        for row in range(4):
            lines.append(separator.join(c.above[row] if row < len(c.above) else "" for c in columns))
    if header:
        comment = "# " if style == "generic" and separator != " " and rng.random() < 0.15 else ""
        quoted = [f'"{label}"' if separator in label else label for label in labels]
        lines.append(comment + separator.join(quoted))
        if units:
            bracket = rng.random() < 0.5
            lines.append(separator.join(f"[{c.unit}]" if bracket and c.unit else c.unit for c in columns))
    for i in range(len(columns[0].values)):
        lines.append(separator.join(c.values[i] for c in columns))
    end = str(rng.choice(["\n", "\r\n"]))
    about |= {"separator": separator, "decimal": decimal, "encoding": encoding, "header": header, "units": units}
    path.write_bytes((end.join(lines) + end).encode(encoding, errors="replace"))
