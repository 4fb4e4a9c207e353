"""Tables of real arms as their users have them: joints, readings and the mapping that says what the columns are.

They lie in ../shared/data beside the checkout. A recording is parted into what is calibrated, ``c.session``, and what
is kept aside and never tampered with, ``c.aside``: the truth about a calibration is how far it misses there.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from case import Scene, export
from scipy.spatial.transform import Rotation
from streams import elsewhere
from transforms import Of, described, put
from workcell import POINT, POSE, Array, Session

ROOT = Path(__file__).resolve().parents[2]
DATA, IMPORTS, ROBOTS = ROOT.parent / "shared" / "data", ROOT / "examples" / "import", ROOT / "examples" / "robots"
GOAL = ("x", "y", "z", "roll", "pitch", "yaw")
UR = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))


@dataclass(frozen=True)
class Table(Session):
    """Rows of one recording, as true as they were published.

    t: None where only their order is known. urdf: a description, or a table of lengths. floor_mm: RMS that a
    calibration on the untouched rows leaves on those kept aside. tolerance_mm: what a job might ask of the 95th
    percentile, between that of the nominal arm and that of the calibrated one. more: cells by label, beside the numbers
    or in place of them. goal: where the controller meant to be [m], and how turned [rad], in a frame of its own.
    """

    tolerance_mm: float = 0.0
    goal: Array | None = None

    def only(self, rows: Array) -> Session:
        """These rows, in this order."""
        return replace(super().only(rows), goal=self.goal[rows])  # type: ignore[index]

    def columns(self) -> dict[str, Any]:
        """Label → cells."""
        out: dict[str, Any] = {} if self.t is None else {"time": [f"{v:.3f}" for v in self.t]}
        out |= {f"J{j + 1}": [f"{v:.9g}" for v in q] for j, q in enumerate(self.q.T)}
        out |= {axis: [f"{v:.7g}" for v in p] for axis, p in zip("xyz", 1e3 * self.p.T, strict=True)}
        if self.kind == POSE:
            turned = self.R.as_euler("XYZ", degrees=True).T
            out |= {axis: [f"{v:.8g}" for v in angles] for axis, angles in zip("abc", turned, strict=True)}
        return out | self.more

    def mapping(self, name: str) -> dict[str, Any]:
        """What the columns are."""
        reading: dict[str, Any] = {"frame": "tracker", "unit": "mm", "position": list("xyz")}
        if self.kind == POSE:
            reading["euler"] = {"columns": list("abc"), "sequence": "XYZ", "unit": "deg"}
        heat = {"temperature": {"ambient": "temperature"}} if "temperature" in self.more else {}
        return heat | {
            "files": f"{name}.csv",
            "delimiter": ";",
            "time": {"order": {"period_s": 10.0}} if self.t is None else {"seconds": "time", "unit": "s"},
            "joints": {"unit": "rad", "columns": {joint: f"J{j + 1}" for j, joint in enumerate(self.names)}},
            self.kind: reading,
        }

    def files(self, name: str) -> dict[str, str]:
        """The table, its mapping and the arm, by file name."""
        columns = self.columns()
        rows = [";".join(columns), *(";".join(row) for row in zip(*columns.values(), strict=True)), ""]
        mapping = yaml.safe_dump({"tables": [self.mapping(name)]})
        return {f"{name}.csv": "\n".join(rows), f"{name}.yaml": mapping, self.arm: self.urdf}

    @property
    def arm(self) -> str:
        """The file that describes the arm."""
        return "arm.urdf" if self.urdf.lstrip().startswith("<") else "arm.yaml"

    def imports(self, name: str) -> tuple[tuple[str, ...], ...]:
        """The import of the table ``name`` into the bag ``name``, with its arm."""
        urdf = "{arm.urdf}" if self.arm == "arm.urdf" else f"{{of_{name}.urdf}}"
        lengths = (("import", "{arm.yaml}", "--out", urdf),) if self.arm == "arm.yaml" else ()
        return (*lengths, ("import", f"{{{name}.yaml}}", "--urdf", urdf, "--out", f"{{{name}}}"))


def _numbers(path: Path, delimiter: str) -> tuple[list[dict[str, str]], Callable[..., Array]]:
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream, delimiter=delimiter))
    return rows, lambda *names: np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])


@lru_cache(maxsize=2)
def ur10(series: str) -> Table:
    """The UR10's cubes ("cubes") or its grid ("grid"), with a tracker's poses."""
    grid, table = series == "grid", DATA / "ipa_ur10" / f"series_{'a_grid' if series == 'grid' else 'd_iso_cubes'}.csv"
    rows, columns = _numbers(table, ";")
    t = np.array([datetime.strptime(r["Timestamp"], "%Y%m%d%H%M%S").timestamp() for r in rows]) if grid else None
    p, angles = (columns(*(f"measurement_{r}{a}" for a in "xyz")) for r in ("", "r"))
    heat = np.array([f"{v:.3f}" for v in columns("measurement_temperature")[:, 0]])
    R, urdf = Rotation.from_euler("XYZ", angles, degrees=True), (ROBOTS / "ur10.urdf").read_text(encoding="utf-8")
    told = {"more": {"temperature": heat}, "tolerance_mm": 1.0, "goal": columns(*(f"Goal {k}" for k in GOAL))}
    floor, once = 0.28 if grid else 0.24, np.zeros(len(rows), bool)
    return Table(UR, urdf, t, columns(*UR), 1e-3 * p, R, floor, once, **told)  # type: ignore[arg-type]


@lru_cache(maxsize=2)
def points_of(robot: str) -> Table:
    """The grid of the UR5 ("ur5") or of the WAM ("wam7"), with a tracker's points, rows in their order."""
    ur5 = robot == "ur5"
    rows, columns = _numbers(DATA / "serial_robots" / f"{'ur5' if ur5 else 'wam'}_grid.csv", ",")
    q = np.radians(columns(*(key for key in rows[0] if key.startswith("joint_"))))
    goal = 1e-3 * columns("x_t", "y_t", "z_t")
    p, names = (
        goal - 1e-3 * columns("x_dif", "y_dif", "z_dif"),
        UR if ur5 else tuple(f"joint_{j + 1}" for j in range(7)),
    )
    text, once = (ROBOTS / f"{robot}.yaml").read_text(encoding="utf-8"), np.zeros(len(q), bool)
    told = {"kind": POINT, "tolerance_mm": 0.3 if ur5 else 8.0, "goal": goal}
    R, floor = Rotation.identity(len(q)), 0.07 if ur5 else 1.75
    return Table(names, text, None, q, p, R, floor, once, **told)  # type: ignore[arg-type]


def recording(name: str) -> tuple[Table, Table]:
    """What is calibrated and what is kept aside, of "cubes", "grid", "ur5" or "wam7"."""
    whole = ur10(name) if name in ("cubes", "grid") else points_of(name)
    i, mixed = np.arange(len(whole.q)), np.random.default_rng(5).permutation(len(whole.q))
    cubes = (i // 10) % 3
    parts = {
        "grid": (i[::50], i[25::100]),
        "cubes": (i[cubes == 0], i[cubes == 1]),
        "ur5": (np.sort(mixed[:240]), np.sort(mixed[240:340])),
        "wam7": (np.sort(mixed[:150]), np.sort(mixed[150:])),
    }
    return tuple(whole.only(rows) for rows in parts[name])  # type: ignore[return-value]


def cubes(c: Scene) -> None:
    """All of the UR10's cubes, 632 poses, as a recording of rows ten seconds apart."""
    c.session = replace(ur10("cubes"), t=10.0 * np.arange(632), more={}, floor_mm=0.2)


# --- steps -----------------------------------------------------------------------------------------------------------


def table(c: Scene, *names: str) -> None:
    """One of some recordings."""
    c.session, c.aside = recording(names[0] if len(names) == 1 else str(c.rng.choice(names)))


def aside(c: Scene, *steps: Callable[[Scene], None]) -> None:
    """Steps on what is kept aside."""
    c.session, c.aside = c.aside, c.session
    for change in steps:
        change(c)
    c.session, c.aside = c.aside, c.session


def both(c: Scene, *steps: Callable[[Scene], None]) -> None:
    """Steps on what is calibrated, and then on what is kept aside."""
    for change in steps:
        change(c)
    aside(c, *steps)


def later(c: Scene) -> None:
    """What is kept aside was measured afterwards, so that of what changes in time the last state holds."""
    if c.t is not None:
        c.aside = replace(c.aside, t=c.aside.t + c.t[-1] - c.aside.t[0] + 10.0)


def cells(c: Scene, label: Of, values: Of) -> None:
    """A column holds other cells than the numbers."""
    put(c, more=c.more | {c.of(label): c.of(values)})


def exchanged(c: Scene, other: dict[str, str]) -> None:
    """Another description, in which texts are others."""
    described(c, lambda c, text: re.sub("|".join(map(re.escape, other)), lambda found: other[found[0]], text))


def side(x: Array) -> Array:
    """From which side a joint came to its values, the last side where it did not move (N,)."""
    move = np.diff(x, prepend=x[:1])
    moved = np.where(np.abs(move) > 1e-4, np.arange(len(x)), 0)
    return np.sign(move)[np.maximum.accumulate(moved)]


def knocked(c: Scene, part: str, shift: float, turn: float, when: Of) -> None:
    """The target on the tool, or the tracker, was moved at the rows that ``when`` says."""
    v, by = c.way(shift), Rotation.from_rotvec(c.way(turn))
    centre, on_tool = c.p.mean(axis=0), part == "tool"
    p = c.p + c.R.apply(v) if on_tool else by.apply(c.p - centre) + centre + v
    elsewhere(c, when, p, c.R * by if on_tool else by * c.R, "quat")


def calibrated(c: Scene, *options: str) -> None:
    """The table is imported and calibrated; the truth is how far the arm misses on what was kept aside."""
    judged = ("evaluate", "{made}", "{aside}", "--refit-base", "--refit-tool", "--out", "{aside_out}")
    c.truth |= {"aside": (*c.aside.imports("aside"), judged)}
    c.command, c.imports = ("calibrate", "{bag}", "--out", "{made}"), c.session.imports("bag")
    _told(c, c.aside.files("aside") | c.session.files("bag"), *options)


def evaluated(c: Scene, *options: str) -> None:
    """The table is calibrated, and the calibration judged on the one that was kept aside."""
    made = ("calibrate", "{first}", "--out", "{made}")
    c.command, c.imports = (
        ("evaluate", "{made}", "{second}"),
        (*c.session.imports("first"), *c.aside.imports("second"), made),
    )
    _told(c, c.session.files("first") | c.aside.files("second"), *options, "--out", "{judged}")


def _told(c: Scene, files: dict[str, str], *options: str) -> None:
    c.truth |= {"floor": False, "floor_mm": c.floor_mm, "files": files}
    c.options, c.names, c.session = ("--tolerance-mm", str(c.tolerance_mm), *options), c.names, None


# --- balls in sockets of plates --------------------------------------------------------------------------------------


def sockets(c: Scene) -> None:
    """One of three arms: joints ``told`` (N, 7) [rad] by the name of the socket, and the cell file ``plate``."""
    c.mukca = str(c.rng.choice(["panda_3", "panda_4", "kuka_14"]))
    found = sorted((DATA / "mukca" / c.mukca).glob("*/hole_?.csv"))
    c.told = {f"{path.parent.name}_{path.stem}": np.loadtxt(path, delimiter=",") for path in found}
    mapping, c.plate = (
        yaml.safe_load((IMPORTS / f"mukca_{c.mukca}{part}.yaml").read_text(encoding="utf-8")) for part in ("", "_cell")
    )
    c.names = tuple(mapping["tables"][0]["joints"]["columns"])


def in_sockets(c: Scene) -> None:
    """The tables of the sockets are imported and calibrated, with the distances of the cell file."""
    tables = [
        {
            "files": f"{socket}.csv",
            "header": False,
            "time": {"order": {"period_s": 10.0}},
            "joints": {"unit": "rad", "columns": {name: j for j, name in enumerate(c.names)}},
            "same_point": {"frame": socket},
        }
        for socket in c.told
    ]
    files = {f"{s}.csv": "\n".join(",".join(f"{v:.9g}" for v in row) for row in q) + "\n" for s, q in c.told.items()}
    arm = DATA / "mukca" / "urdf" / f"{'iiwa14' if c.mukca.startswith('kuka') else 'panda'}.urdf"
    files |= {"arm.urdf": arm.read_text(encoding="utf-8"), "bag.yaml": yaml.safe_dump({"tables": tables})}
    c.truth |= {"floor": False, "floor_mm": 0.25, "files": files | {"cell.yaml": yaml.safe_dump(c.plate)}}
    c.imports = (("import", "{bag.yaml}", "--urdf", "{arm.urdf}", "--out", "{bag}"),)
    c.options = ("--tip", "ball_link", "--cell", "{cell.yaml}", "--tolerance-mm", "0.8")


def on_plates(c: Scene, arm: str, distance: str = "0.05") -> None:
    """A ball in sockets of a plate, with their distance as it is or as somebody wrote it down."""
    c.imports = (("import", str(IMPORTS / f"mukca_{arm}.yaml"), "--data", str(DATA), "--out", "{bag}"),)
    c.options = ("--tip", "ball_link", "--cell", "{cell.yaml}")
    text = (IMPORTS / f"mukca_{arm}_cell.yaml").read_text(encoding="utf-8")
    cell = text.replace("distance_m: 0.05,", f"distance_m: {distance},")
    c.truth |= {"floor": False, "floor_mm": 0.31, "files": {"cell.yaml": cell}}


export(globals(), {})
