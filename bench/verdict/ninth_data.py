"""Tables of real arms as their users have them: joints, readings and the mapping that says what the columns are.

They lie in ../shared/data beside the checkout. A recording is parted into what is calibrated and what is kept aside and
never tampered with: the truth about a calibration is how far it misses there.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from case import Case
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
UR = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
Array = np.ndarray


@dataclass(frozen=True)
class Table:
    """Rows of one recording, as true as they were published.

    q [rad] (N, n); p [m] (N, 3); R: None of points; t [s]: None where only the order of the rows is known. best_mm: RMS
    that a calibration on the untouched rows leaves on those kept aside. tolerance_mm: what a job might ask of the 95th
    percentile, between that of the nominal arm and that of the calibrated one. cells: columns written in place of the
    numbers, by label. stated: parts of the mapping in place of the true ones. robot_text: another description.
    goal: where the controller meant to be [m] (N, 3), in a frame of its own.
    """

    robot: Path
    names: tuple[str, ...]
    q: Array
    p: Array
    R: Rotation | None
    t: Array | None
    temperature: Array | None
    best_mm: float
    tolerance_mm: float
    goal: Array | None = None
    cells: dict[str, list[str]] = field(default_factory=dict)
    stated: dict[str, Any] = field(default_factory=dict)
    robot_text: str = ""

    def __len__(self) -> int:
        return len(self.q)

    def only(self, rows: Array) -> Table:
        """These rows, in this order."""
        return replace(
            self,
            q=self.q[rows],
            p=self.p[rows],
            R=None if self.R is None else self.R[rows],
            goal=None if self.goal is None else self.goal[rows],
            t=None if self.t is None else self.t[rows],
            temperature=None if self.temperature is None else self.temperature[rows],
        )

    def read(self, rows: Array) -> Table:
        """The same joints beside the readings of other rows."""
        return replace(self, p=self.p[rows], R=None if self.R is None else self.R[rows])

    def tool(self, rows: Array, shift: Array, turn: Array) -> Table:
        """Another target at some rows, (N,) of bool: moved on the tool by a twist."""
        assert self.R is not None
        p = np.where(rows[:, None], self.p + self.R.apply(shift), self.p)
        turned = (self.R * Rotation.from_rotvec(turn)).as_quat()
        return replace(self, p=p, R=Rotation.from_quat(np.where(rows[:, None], turned, self.R.as_quat())))

    def base(self, rows: Array, shift: Array, turn: Array) -> Table:
        """A tracker that stands elsewhere at some rows, (N,) of bool."""
        by = Rotation.from_rotvec(turn)
        middle = self.p.mean(axis=0)
        p = np.where(rows[:, None], by.apply(self.p - middle) + middle + shift, self.p)
        if self.R is None:
            return replace(self, p=p)
        turned = np.where(rows[:, None], (by * self.R).as_quat(), self.R.as_quat())
        return replace(self, p=p, R=Rotation.from_quat(turned))

    def joint(self, j: int, by: Array | float) -> Table:
        """One joint reports so much more than before [rad]."""
        q = self.q.copy()
        q[:, j] += by
        return replace(self, q=q)

    def columns(self) -> dict[str, list[str]]:
        """Label → cells."""
        out: dict[str, list[str]] = {}
        if self.t is not None:
            out["time"] = [f"{v:.3f}" for v in self.t]
        for j in range(self.q.shape[1]):
            out[f"J{j + 1}"] = [f"{v:.9g}" for v in self.q[:, j]]
        for k, axis in enumerate("xyz"):
            out[axis] = [f"{v:.7g}" for v in 1e3 * self.p[:, k]]
        if self.R is not None:
            angles = self.R.as_euler("XYZ", degrees=True)
            for k, axis in enumerate("abc"):
                out[axis] = [f"{v:.8g}" for v in angles[:, k]]
        if self.temperature is not None:
            out["temperature"] = [f"{v:.3f}" for v in self.temperature]
        return out | self.cells

    def mapping(self, name: str) -> dict[str, Any]:
        """What the columns are."""
        labels = {joint: f"J{j + 1}" for j, joint in enumerate(self.names)}
        reading: dict[str, Any] = {"frame": "tracker", "unit": "mm", "position": list("xyz")}
        if self.R is not None:
            reading["euler"] = {"columns": list("abc"), "sequence": "XYZ", "unit": "deg"}
        table: dict[str, Any] = {
            "files": f"{name}.csv",
            "delimiter": ";",
            "time": {"order": {"period_s": 10.0}} if self.t is None else {"seconds": "time", "unit": "s"},
            "joints": {"unit": "rad", "columns": labels},
            "point" if self.R is None else "pose": reading,
        }
        if self.temperature is not None:
            table["temperature"] = {"ambient": "temperature"}
        return table | self.stated

    def files(self, name: str) -> dict[str, str]:
        """The table and its mapping, by file name."""
        columns = self.columns()
        rows = [";".join(columns), *(";".join(row) for row in zip(*columns.values(), strict=True))]
        mapping: dict[str, Any] = {"tables": [self.mapping(name)]}
        made = {f"{name}.csv": "\n".join([*rows, ""]), f"{name}.yaml": yaml.safe_dump(mapping)}
        text = self.robot_text or self.robot.read_text(encoding="utf-8")
        made["arm.urdf" if self.robot.suffix == ".urdf" else "arm.yaml"] = text
        return made

    def asked(self, name: str) -> tuple[tuple[str, ...], ...]:
        """The import of the table ``name`` into the bag ``name``, with its arm."""
        table = ("import", f"{{{name}.yaml}}", "--urdf", "{arm.urdf}", "--out", f"{{{name}}}")
        if self.robot.suffix == ".urdf":
            return (table,)
        return (
            ("import", "{arm.yaml}", "--out", f"{{of_{name}.urdf}}"),
            (*table[:3], f"{{of_{name}.urdf}}", *table[4:]),
        )


def calibration(table: Table, must_name: tuple[str, ...], aside: Table, *options: str, **truth: Any) -> Case:
    """A tampered table is imported and calibrated; the truth is how far the arm misses on another table."""
    passes = ("--tolerance-mm", str(table.tolerance_mm))
    steps: tuple[tuple[str, ...], ...] = (
        *table.asked("bag"),
        ("calibrate", "{bag}", "--out", "{made}", *passes, *options),
    )
    told = {"floor": False, "floor_mm": table.best_mm, **truth}
    files = aside.files("aside") | table.files("bag")
    judged = ("evaluate", "{made}", "{aside}", "--refit-base", "--refit-tool", "--out", "{aside_out}")
    return Case({}, steps, True, must_name, files=files, aside=(*aside.asked("aside"), judged), **told)


def evaluation(
    first: Table, second: Table, must_name: tuple[str, ...], *options: str, verb: str = "evaluate", **truth: Any
) -> Case:
    """An untouched table is calibrated, and the calibration is judged on a tampered one."""
    passes = ("--tolerance-mm", str(first.tolerance_mm))
    steps = (*first.asked("first"), *second.asked("second"), ("calibrate", "{first}", "--out", "{made}"))
    steps = (*steps, (verb, "{made}", "{second}", *passes, *options, "--out", "{judged}"))
    told = {"floor": False, "floor_mm": first.best_mm, **truth}
    return Case({}, steps, True, must_name, files=first.files("first") | second.files("second"), **told)


def _numbers(path: Path, delimiter: str) -> tuple[list[dict[str, str]], Any]:
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream, delimiter=delimiter))

    def columns(*names: str) -> Array:
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])

    return rows, columns


@lru_cache(maxsize=2)
def ur10(series: str) -> tuple[Table, Table]:
    """The UR10's cubes ("cubes") or its grid ("grid"), with a tracker's poses: what is calibrated, and kept aside."""
    grid = series == "grid"
    rows, columns = _numbers(DATA / "ipa_ur10" / ("series_a_grid.csv" if grid else "series_d_iso_cubes.csv"), ";")
    t = None
    if grid:
        t = np.array([datetime.strptime(row["Timestamp"], "%Y%m%d%H%M%S").timestamp() for row in rows])
    R = Rotation.from_euler("XYZ", columns(*(f"measurement_r{a}" for a in "xyz")), degrees=True)
    p = 1e-3 * columns(*(f"measurement_{a}" for a in "xyz"))
    temperature = columns("measurement_temperature")[:, 0]
    robot = ROOT / "examples" / "robots" / "ur10.urdf"
    whole = Table(
        robot,
        UR,
        columns(*UR),
        p,
        R,
        t,
        temperature,
        0.28 if grid else 0.24,
        1.0,
        columns("Goal x", "Goal y", "Goal z"),
    )
    i = np.arange(len(whole))
    if grid:
        return whole.only(i[::50]), whole.only(i[25::100])
    return whole.only(i[(i // 10) % 3 == 0]), whole.only(i[(i // 10) % 3 == 1])


@lru_cache(maxsize=2)
def points(robot: str) -> tuple[Table, Table]:
    """The grid of the UR5 ("ur5") or of the WAM ("wam7"), with a tracker's points, rows in their order."""
    rows, columns = _numbers(DATA / "serial_robots" / ("ur5_grid.csv" if robot == "ur5" else "wam_grid.csv"), ",")
    q = np.radians(columns(*(key for key in rows[0] if key.startswith("joint_"))))
    goal = 1e-3 * columns("x_t", "y_t", "z_t")
    p = goal - 1e-3 * columns("x_dif", "y_dif", "z_dif")
    names = UR if robot == "ur5" else tuple(f"joint_{j + 1}" for j in range(7))
    best, tolerance = (0.07, 0.3) if robot == "ur5" else (1.75, 8.0)
    whole = Table(ROOT / "examples" / "robots" / f"{robot}.yaml", names, q, p, None, None, None, best, tolerance, goal)
    chosen = np.random.default_rng(5).permutation(len(whole))
    train, aside = (chosen[:240], chosen[240:340]) if robot == "ur5" else (chosen[:150], chosen[150:])
    return whole.only(np.sort(train)), whole.only(np.sort(aside))


def recording(name: str) -> tuple[Table, Table]:
    """What is calibrated and what is kept aside, of "cubes", "grid", "ur5" or "wam7"."""
    return ur10(name) if name in ("cubes", "grid") else points(name)
