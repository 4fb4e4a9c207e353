"""CSV files as people export them from laser trackers, motion capture and robot controllers, drawn at random.

What is drawn: separator, decimal sign, encoding, preamble, units row, labels, order of columns, gaps, form of the
orientation, units, direction of the pose, useless columns, names and order of the joints. Nothing comes from modcal.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from sheet import ARMS, DIGITS, LENGTH, Array, Recorded, Rng, Written, record

STYLES = ("generic", "spatial_analyzer", "faro", "vicon", "motive", "qualisys", "ndi", "rtde")
UNITS = {"vicon": ["mm"], "motive": ["m", "mm", "cm"], "qualisys": ["mm"], "ndi": ["mm"], "faro": ["mm", "in", "m"]}
UNITS |= {"rtde": ["m", "mm"]}
FORMS = {
    "spatial_analyzer": ["euler_fixed_xyz", "euler", "rotvec"],
    "faro": ["euler", "matrix"],
    "motive": ["quaternion"],
}
FORMS |= {"vicon": ["rotvec", "euler_xyz"], "qualisys": ["rpy_matrix"], "ndi": ["quaternion_ndi", "euler_ndi"]}
ANY_FORM = ["euler", "quaternion", "matrix", "rotvec", "matrix4"]
PLACES = {"vicon": ["TX", "TY", "TZ"], "ndi": ["Tx", "Ty", "Tz"], "rtde": ["tracker_x", "tracker_y", "tracker_z"]}
SEQUENCES = ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY"]
FIXED_SEQUENCES = {"euler_xyz": "XYZ", "euler_fixed_xyz": "xyz", "euler_ndi": "ZYX"}
ANGLES = [["A", "B", "C"], ["rx", "ry", "rz"], ["alpha", "beta", "gamma"], ["e1", "e2", "e3"]]
OWN_ANGLES = {"spatial_analyzer": ["Rx", "Ry", "Rz"], "vicon": ["RX", "RY", "RZ"]}
WORDS = ["base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3", "wrist4"]
CLOCKS = {"motive": ["frame_seconds"], "vicon": ["frames"], "qualisys": ["frame_seconds"], "ndi": ["frame"]}
ANY_CLOCK = ["epoch", "iso", "seconds", "ms", "none", "german", "us_date"]


@dataclass
class Column:
    label: str
    values: list[str]
    unit: str = ""
    above: tuple[str, ...] = ()


class Writer:
    """Draws the columns of one file: its style, its decimal sign, and what is noted about it."""

    def __init__(self, style: str, rng: Rng, decimal: str, about: dict[str, Any]) -> None:
        self.style, self.rng, self.decimal, self.about = style, rng, decimal, about

    def cells(self, values: Array, digits: int) -> list[str]:
        return [f"{float(v):.{digits}f}".replace(".", self.decimal) for v in values]

    def columns(
        self, labels: list[str], values: Array, digits: int, unit: str = "", above: tuple[str, ...] = ()
    ) -> list[Column]:
        return [Column(label, self.cells(v, digits), unit, above) for label, v in zip(labels, values.T, strict=True)]

    def position(self, p: Array, unit: str, pre: str) -> list[Column]:
        generic = [[f"{pre}{a}" for a in "xyz"], [f"{pre}{a} [{unit}]" for a in "XYZ"]]
        generic += [[f"{pre}pos_{a}" for a in "xyz"], [f"{pre}{a}_{unit}" for a in "xyz"]]
        names = generic if self.style == "generic" else [PLACES.get(self.style, ["X", "Y", "Z"])]
        above = ("Rigid Body", "tool", "", "Position") if self.style == "motive" else ()
        return self.columns(names[int(self.rng.integers(len(names)))], p, DIGITS[unit], unit, above)

    def pose(self, T: Array, p: Array, unit: str, stem: str) -> tuple[list[Column], list[Column]]:
        """Columns of the position, and of the orientation."""
        rng, style, about, R = self.rng, self.style, self.about, Rotation.from_matrix(T[:, :3, :3])
        dot = str(rng.choice([" ", "_", "."]))
        pre = f"{stem}{dot}" if stem else ""
        position = self.position(p, unit, pre)
        about["form"] = form = str(rng.choice(FORMS.get(style, ANY_FORM)))
        degrees = bool(rng.random() < 0.6) if style not in ("spatial_analyzer", "qualisys", "ndi") else True
        above = ("Rigid Body", "tool", "", "Position") if style == "motive" else ()

        def angles(values: Array, labels: list[str]) -> list[Column]:
            scaled, digits = (np.degrees(values), 5) if degrees else (values, 7)
            return self.columns(labels, scaled, digits, "deg" if degrees else "rad", above)

        if form.startswith("euler"):
            drawn = str(rng.choice(SEQUENCES + [s.lower() for s in SEQUENCES]))
            about["sequence"], about["degrees"] = FIXED_SEQUENCES.get(form, drawn), degrees
            label = OWN_ANGLES.get(style, ANGLES[int(rng.integers(len(ANGLES)))])
            label = ["Rz", "Ry", "Rx"] if form == "euler_ndi" else label
            return position, angles(R.as_euler(about["sequence"]), [f"{pre}{a}" for a in label])
        if form == "rotvec":
            about["degrees"] = degrees
            label = OWN_ANGLES["vicon"] if style == "vicon" else [f"{pre}r{a}" for a in "xyz"]
            return position, angles(R.as_rotvec(), label)
        if form.startswith("quaternion"):
            return position, self.quaternion(R.as_quat(), form, pre)
        M = T[:, :3, :3]
        if form == "rpy_matrix":
            out = angles(R.as_euler("xyz"), ["Roll", "Pitch", "Yaw"])
            out.append(Column("Residual", self.cells(rng.uniform(0.1, 0.6, len(p)), 3)))
            return position, out + self.columns([f"Rot[{k}]" for k in range(9)], M.transpose(0, 2, 1).reshape(-1, 9), 6)
        if form == "matrix4":
            flat = np.concatenate([M, (LENGTH[unit] * T[:, :3, 3:])], axis=2).reshape(-1, 12)
            label = [f"T{r}{c}" for r in range(1, 4) for c in range(1, 5)]
            digits = [DIGITS[unit] if k % 4 == 3 else 7 for k in range(12)]
            return [], [Column(label[k], self.cells(flat[:, k], digits[k])) for k in range(12)]
        about["column_major"] = column_major = rng.random() < 0.4
        flat = (M.transpose(0, 2, 1) if column_major else M).reshape(-1, 9)
        counted = column_major or rng.random() < 0.3
        label = [f"{pre}r{k}" for k in range(9)] if counted else [f"{pre}r{r}{c}" for r in "123" for c in "123"]
        return position, self.columns(label, flat, 7)

    def quaternion(self, q: Array, form: str, pre: str) -> list[Column]:
        rng, motive = self.rng, self.style == "motive"
        if rng.random() < 0.5:
            q = q * np.sign(q[:, 3:] + 1e-12)
        self.about["w_first"] = w_first = form == "quaternion_ndi" or (not motive and rng.random() < 0.5)
        q = q[:, [3, 0, 1, 2]] if w_first else q
        if form == "quaternion_ndi":
            label = ["Q0", "Qx", "Qy", "Qz"]
        elif rng.random() < 0.6:
            label = ["qw", "qx", "qy", "qz"] if w_first else ["qx", "qy", "qz", "qw"]
        else:
            label = [f"q{k}" for k in (range(4) if rng.random() < 0.5 else range(1, 5))]
        if motive:
            return self.columns(["X", "Y", "Z", "W"], q, 7, "", ("Rigid Body", "tool", "", "Rotation"))
        return self.columns([f"{pre}{name}" for name in label], q, 7)

    def joints(self, recorded: Recorded) -> list[Column]:
        rng, rtde, n = self.rng, self.style == "rtde", len(recorded.names)
        degrees = bool(rng.random() < 0.5) and not rtde
        unit, k, N = "deg" if degrees else "rad", range(n), len(recorded.q)
        ways = {"urdf": list(recorded.names), "prefixed": [f"joint_states/position/{name}" for name in recorded.names]}
        ways |= {"J": [f"J{i + 1}" for i in k], "A": [f"A{i + 1}" for i in k]}
        ways |= {"axis": [f"Axis {i + 1} [{unit}]" for i in k], "q": [f"q_{i}" for i in k]}
        ways |= {"joint": [f"joint_{i + 1}_{unit}" for i in k], "words": WORDS[:n], "letters": list("SLURBTE")[:n]}
        ways |= {"none": [f"Channel {name}" for name in "ABCDEFG"[:n]]}
        way = "rtde" if rtde else str(rng.choice(list(ways)))
        order = rng.permutation(n) if rng.random() < 0.4 else np.arange(n)
        self.about |= {"joints": way, "joint_degrees": degrees, "joint_order": order.tolist()}
        labels = [f"actual_q_{i}" for i in k] if rtde else ways[way]
        q = (180.0 / np.pi if degrees else 1.0) * recorded.q[:, order]
        out = self.columns([labels[i] for i in order], q, 5 if degrees else 7, unit)
        if rtde:
            out += self.columns([f"target_q_{i}" for i in order], recorded.commanded[:, order], 7, unit)
            for name, size, digits, of in (("actual_current", 2, 4, "A"), ("actual_qd", 1e-4, 6, "rad/s")):
                out += [Column(f"{name}_{i}", self.cells(rng.normal(0, size, N), digits), of) for i in order]
        return out

    def useless(self, N: int) -> list[Column]:
        rng = self.rng
        every = [
            Column("Temperature", self.cells(21.0 + np.cumsum(0.02 * rng.standard_normal(N)), 2), "°C"),
            Column("Intensity", self.cells(rng.uniform(40, 90, N), 1), "%"),
            Column("rms error", self.cells(rng.uniform(0.01, 0.04, N), 3), "mm"),
            Column("Operator", [str(rng.choice(["Müller", "Perez", "Weiß"]))] * N),
            Column("pressure", self.cells(1013.0 + rng.standard_normal(N), 1)),
            Column("u1", self.cells(rng.uniform(-1, 1, N), 4)),
            Column("status", ["OK"] * N),
        ]
        return [every[k] for k in rng.permutation(len(every))[: int(rng.integers(0, 4))]]

    def time(self, stamps: Array) -> list[Column]:
        way, N = str(self.rng.choice(CLOCKS.get(self.style, ANY_CLOCK))), len(stamps)
        self.about["clock"] = way in ("frame_seconds", "epoch", "iso", "seconds", "ms", "us_date")
        since, moments = stamps - stamps[0], [datetime.fromtimestamp(float(s), UTC) for s in stamps]

        def said(label: str, form: str) -> Column:
            return Column(label, [m.strftime(form) for m in moments])

        frame, motive = Column("Frame", [str(k) for k in range(1, N + 1)]), self.style == "motive"
        seconds = Column("Time (Seconds)" if motive else "Time", self.cells(since, 4), "" if motive else "s")
        return {
            "frame_seconds": [frame, seconds],
            "frames": [frame, Column("Sub Frame", ["0"] * N)],
            "frame": [frame],
            "epoch": [Column("timestamp", self.cells(stamps, 4), "s")],
            "iso": [said("Time", "%Y-%m-%dT%H:%M:%S.%f")],
            "seconds": [Column("t", self.cells(since, 3), "s")],
            "ms": [Column("time [ms]", self.cells(1e3 * since, 0), "ms")],
            "german": [said("Datum", "%d.%m.%Y"), said("Uhrzeit", "%H:%M:%S")],
            "us_date": [said("Date Time", "%m/%d/%Y %H:%M:%S")],
            "none": [],
        }[way]

    def write(self, path: Path, columns: list[Column]) -> None:
        rng, style, about = self.rng, self.style, self.about
        separator = str(rng.choice([";", "\t", "|"] + ([","] if self.decimal == "." else []) + [" "]))
        if separator == " " and any(" " in c.label or any(" " in v or not v for v in c.values) for c in columns):
            separator = ";"
        separator = {"motive": ",", "qualisys": "\t"}.get(style, separator)
        encoding = str(rng.choice(["utf-8", "utf-8-sig", "utf-16", "latin-1"], p=[0.45, 0.25, 0.15, 0.15]))
        lines, header, units = [], True, style == "vicon"
        if style == "vicon":
            lines = ["Trajectories", "100"]
        elif style == "motive":
            take = ["Format Version", "1.23", "Take Name", "Take 2024-03-01", "Capture Frame Rate", "120.0"]
            lines = [separator.join(take), ""]
        elif style == "qualisys":
            about_it = (("NO_OF_FRAMES", len(columns[0].values)), ("FREQUENCY", 100), ("DATA_INCLUDED", "6D"))
            lines = [f"{name}{separator}{value}" for name, value in (*about_it, ("BODY_NAMES", "tool"))]
        elif style == "spatial_analyzer" and rng.random() < 0.6:
            lines = ["// SpatialAnalyzer export", "// Units: see header; Temperature: °C", ""]
            units = rng.random() < 0.5
        elif style == "faro" and rng.random() < 0.6:
            lines = [f"FARO CAM2 Measure{separator}10.7", "Operator: Müller", ""]
        elif style == "generic":
            if rng.random() < 0.4:
                lines = [f"# line {k} of a preamble, with a comma" for k in range(int(rng.integers(1, 9)))]
            units = rng.random() < 0.3
            header = rng.random() > 0.1 or about.get("shuffled", False)
        if style == "motive":
            lines += [separator.join(c.above[k] if k < len(c.above) else "" for c in columns) for k in range(4)]
        if header:
            comment = "# " if style == "generic" and separator != " " and rng.random() < 0.15 else ""
            lines.append(comment + separator.join(f'"{c.label}"' if separator in c.label else c.label for c in columns))
            if units:
                bracket = rng.random() < 0.5
                lines.append(separator.join(f"[{c.unit}]" if bracket and c.unit else c.unit for c in columns))
        lines += [separator.join(c.values[i] for c in columns) for i in range(len(columns[0].values))]
        end = str(rng.choice(["\n", "\r\n"]))
        about |= {
            "separator": separator,
            "decimal": self.decimal,
            "encoding": encoding,
            "header": header,
            "units": units,
        }
        path.write_bytes((end.join(lines) + end).encode(encoding, errors="replace"))


def draw(seed: int, folder: Path) -> Written:
    """One file."""
    rng = np.random.default_rng([seed, 2])
    robot = str(rng.choice(list(ARMS)))
    recorded = record(robot, rng, int(rng.integers(40, 140)))
    style, N = STYLES[seed % len(STYLES)], len(recorded.q)
    point_only = style in ("faro", "spatial_analyzer") and rng.random() < 0.3
    unit = str(rng.choice(UNITS.get(style, ["mm", "m", "in"])))
    inverse = not point_only and style in ("generic", "ndi", "rtde") and rng.random() < 0.35
    about: dict[str, Any] = {"robot": robot, "style": style, "unit": unit, "inverse": inverse, "point": point_only}
    T = np.linalg.inv(recorded.T) if inverse else recorded.T
    writer = Writer(style, rng, "," if rng.random() < 0.35 and style != "motive" else ".", about)
    stem = str(rng.choice(["", "tool", "SMR", "Target 1", "measured", "probe"])) if style == "generic" else ""
    position, turned = writer.pose(T, LENGTH[unit] * T[:, :3, 3], unit, stem)
    joints, useless, time = writer.joints(recorded), writer.useless(N), writer.time(recorded.stamps)
    turned = [] if point_only else turned
    readings = turned + position if style == "generic" and rng.random() < 0.4 else position + turned
    groups = [time, *([readings, joints] if rng.random() < 0.5 else [joints, readings]), useless]
    columns = [c for group in groups for c in group]
    if rng.random() < 0.15 and all(c.label for c in columns) and about["joints"] != "none" and style != "motive":
        rng.shuffle(columns)
        about["shuffled"] = True
    whole = np.ones(N, bool)
    if rng.random() < 0.4:
        about["missing"] = token = str(
            rng.choice(["", "nan", "NaN", "N/A", "-", "MISSING" if style == "ndi" else "null"])
        )
        whole = ~(rng.random(N) < rng.uniform(0.02, 0.15))
        for c in readings:
            for i in np.flatnonzero(~whole):
                c.values[i] = token
    path = folder / f"export_{seed:04d}{rng.choice(['.csv', '.txt', '.tsv'])}"
    writer.write(path, columns)
    readings = {"point" if point_only else "pose": [recorded.T]}
    return Written([path], recorded, readings, whole, about=about)
