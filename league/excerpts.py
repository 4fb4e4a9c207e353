"""Public recordings as plain tables. `python -m league.excerpts FOLDER` writes those that stand in league/data.

All are MIT-licensed, by others, and named with their sources in league/README.md. Joints in rad, positions in m, turns
as quaternions x y z w. `block`: rows that a split keeps together. Of sockets only joints are known, and `frame` is one.
"""

from __future__ import annotations

import gzip
import io
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from league.arm import Array, quaternion, rotation

DATA = Path(__file__).resolve().parent / "data"
ROBOTS = DATA.parents[1] / "examples" / "robots"
UR10 = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
ROUND = 8  # digits behind the point: nanometres and tens of nanoradians


@dataclass(frozen=True)
class Table:
    """q (N, n), reading (N, 3), (N, 7) or (N, 0), block and frame (N,); urdf and tip of the arm.

    kinds: of tracks, the kind of each object where it is known.
    """

    q: Array
    reading: Array
    block: Array
    frame: Array
    urdf: str
    tip: str
    kinds: tuple[str, ...] = ()


def ur10(folder: Path, file: str, block: int, every: int = 1) -> Table:
    """A series of the UR10 of Fraunhofer IPA with a six-dimensional target."""
    rows = _columns(folder / "ipa_ur10" / file, ";")[::every]
    p, turns = (np.stack([rows[f"measurement_{r}{a}"] for a in "xyz"], axis=1) for r in ("", "r"))
    x, y, z = (rotation(np.deg2rad(turns[:, k, None]) * np.eye(3)[k]) for k in range(3))
    q = np.stack([rows[name] for name in UR10], axis=1)
    reading = np.concatenate([1e-3 * p, quaternion(x @ y @ z)], axis=1)
    return _table(q, reading, block, (ROBOTS / "ur10.urdf").read_text(), "tool0")


def _columns(file: Path, delimiter: str) -> Array:
    """The columns of a table by name; with semicolons, commas are decimal."""
    text = file.read_text(encoding="utf-8-sig")
    text = text.replace(",", ".") if delimiter == ";" else text
    return np.genfromtxt(io.StringIO(text), delimiter=delimiter, names=True)


def grid(folder: Path, file: str, block: int) -> Table:
    """Commanded joints and measured positions of a UR5 or a WAM: what was aimed at less the difference to it.

    The descriptions in league/data are the tables of DH that the makers publish.
    """
    rows = _columns(folder / "serial_robots" / file, ",")
    q = np.deg2rad(np.stack([rows[name] for name in rows.dtype.names if name.startswith("joint_")], axis=1))
    p = np.stack([rows[f"{a}_t"] - rows[f"{a}_dif"] for a in "xyz"], axis=1)
    return _table(q, 1e-3 * p, block, (DATA / file.replace(".csv", ".urdf")).read_text(), "tip")


def sockets(folder: Path, robot: str, urdf: str, block: int) -> Table:
    """Joints with a ball in sockets: two of each placement of a plate, neighbours in number."""
    parts = [np.loadtxt(file, delimiter=",") for file in sorted((folder / "mukca" / robot).glob("*/hole_[01].csv"))]
    q, frame = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    text = (folder / "mukca" / "urdf" / urdf).read_text()
    inside = np.concatenate([np.arange(len(part)) for part in parts])  # a block ends with its socket
    numbers = 1000 * frame + inside // block
    return replace(_table(q, np.empty((len(q), 0)), block, text, "ball_link"), block=numbers, frame=frame)


def positioner(folder: Path) -> Table:
    """A two-axis positioner before a camera: one pose an entry, two joints. Its drawing is that of its maintainers."""
    text = (folder / "industrial_calibration" / "positioner_measurements.yaml").read_text()
    q, poses = [], []
    for entry in text.split("camera_joints")[1:]:
        told = dict(re.findall(r"(q[xyzw]|[xyz]): (\S+)", entry))
        poses.append([float(told[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
        q.append([float(value) for value in re.findall(r"^  - (\S+)", entry, re.MULTILINE)])
    return _table(np.array(q), np.array(poses), 10, (DATA / "positioner.urdf").read_text(), "tip")


SLIDING = ("iros_drawer", "drawer_one")


def doors(folder: Path, what: str) -> Table:
    """Handles of furniture that people moved: positions by object and pull, or poses of which nobody told the kind."""
    files = sorted((folder / "articulation" / what).rglob("*.log"))
    parts = [np.loadtxt(file, ndmin=2) for file in files]
    frame = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    kinds = tuple("prismatic" if file.parent.name in SLIDING else "revolute" for file in files)
    made = _table(np.zeros((len(frame), 0)), np.concatenate(parts), 1, "", "")
    return replace(made, block=frame, frame=frame, kinds=kinds if what == "position" else ())


def _table(q: Array, reading: Array, block: int, urdf: str, tip: str) -> Table:
    zeros = np.zeros(len(q), int)
    return Table(np.round(q, ROUND), np.round(reading, ROUND), np.arange(len(q)) // block, zeros, urdf, tip)


SOURCES: dict[str, Callable[[Path], Table]] = {
    "ur10_cubes": lambda folder: ur10(folder, "series_d_iso_cubes.csv", 10),
    "ur5_grid": lambda folder: grid(folder, "ur5_grid.csv", 20),
    "wam_grid": lambda folder: grid(folder, "wam_grid.csv", 8),
    "kuka_sockets": lambda folder: sockets(folder, "kuka_14", "iiwa14.urdf", 5),
    "ur10_grid": lambda folder: ur10(folder, "series_a_grid.csv", 20, every=10),
    "panda_3_sockets": lambda folder: sockets(folder, "panda_3", "panda.urdf", 5),
    "panda_4_sockets": lambda folder: sockets(folder, "panda_4", "panda.urdf", 5),
    "positioner": positioner,
    "door_points": lambda folder: doors(folder, "position"),
    "door_poses": lambda folder: doors(folder, "pose"),
}
COMMITTED = tuple(SOURCES)[:4]


def table(name: str, folder: Path | None) -> Table:
    """A table of league/data, or else of a folder with the recordings; raises FileNotFoundError without one."""
    if name in COMMITTED:
        return read(name)
    if folder is None:
        raise FileNotFoundError(f"{name}: name a folder with the recordings of league/README.md by --data")
    return SOURCES[name](folder)


def write(table: Table, name: str) -> None:
    """A table as CSV, the same bytes each time, and its arm beside it."""
    n, m = table.q.shape[1], table.reading.shape[1]
    heads = [*(f"q{k + 1}" for k in range(n)), *("x", "y", "z", "qx", "qy", "qz", "qw")[:m], "block", "frame"]
    text = io.StringIO()
    values = np.column_stack([table.q, table.reading, table.block, table.frame])
    np.savetxt(text, values, fmt=[*["%.8g"] * (n + m), "%d", "%d"], delimiter=",", header=",".join(heads), comments="")
    with (DATA / f"{name}.csv.gz").open("wb") as raw, gzip.GzipFile("", "wb", mtime=0, fileobj=raw) as packed:
        packed.write(text.getvalue().encode())
    (DATA / f"{name}.urdf").write_text(table.urdf)


def read(name: str) -> Table:
    """A table of league/data."""
    with gzip.open(DATA / f"{name}.csv.gz", "rt") as stream:
        heads = stream.readline().strip().split(",")
        values = np.loadtxt(stream, delimiter=",")
    n = sum(head.startswith("q") and head[1:].isdigit() for head in heads)
    urdf = (DATA / f"{name}.urdf").read_text()
    tip = next(link for link in ("ball_link", "tool0", "tip") if link in urdf)
    return Table(values[:, :n], values[:, n:-2], values[:, -2].astype(int), values[:, -1].astype(int), urdf, tip)


if __name__ == "__main__":
    for name in COMMITTED:
        write(SOURCES[name](Path(sys.argv[1])), name)
        print(name, len(read(name).q))
