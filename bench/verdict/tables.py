"""Tables of real arms as their users have them: joints, readings and the mapping that says what the columns are.

They lie in ../shared/data beside the checkout. A recording is parted into what is calibrated, ``c.session``, and what
is kept aside and never tampered with, ``c.aside``: the truth about a calibration is how far it misses there.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from typing import Any

import harness
import numpy as np
import recorded
import yaml
from case import Scene, export
from mechanisms import elsewhere
from scipy.spatial.transform import Rotation
from sites import POINT, POSE, Array, Session
from transforms import Of, described, put

DATA, IMPORTS, ROBOTS = harness.DATA, harness.ROOT / "examples" / "import", harness.ROOT / "examples" / "robots"
GOAL, XYZ = ("x", "y", "z", "roll", "pitch", "yaw"), ("x", "y", "z")
KNOWN = {  # the UR10's file, what is left on rows kept aside [mm], a tolerance [mm]
    "cubes": ("series_d_iso_cubes.csv", 0.24, 1.0),
    "grid": ("series_a_grid.csv", 0.28, 1.0),
    "ur5": ("", 0.07, 0.3),
    "wam7": ("", 1.75, 8.0),
}
REAL = "gear_harmonic", "compliance", "backlash", "thermal", "axis_wobble", "unknown"  # what is found in them untouched


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

    def files(self, name: str) -> dict[str, str]:
        """The table, its mapping and the arm, by file name."""
        columns: dict[str, Any] = {} if self.t is None else {"time": [f"{v:.3f}" for v in self.t]}
        columns |= {f"J{j + 1}": [f"{v:.9g}" for v in q] for j, q in enumerate(self.q.T)}
        columns |= {axis: [f"{v:.7g}" for v in p] for axis, p in zip(XYZ, 1e3 * self.p.T, strict=True)}
        reading: dict[str, Any] = {"frame": "tracker", "unit": "mm", "position": list(XYZ)}
        if self.kind == POSE:
            turned = self.R.as_euler("XYZ", degrees=True).T
            columns |= {axis: [f"{v:.8g}" for v in angles] for axis, angles in zip("abc", turned, strict=True)}
            reading["euler"] = {"columns": list("abc"), "sequence": "XYZ", "unit": "deg"}
        columns |= self.more
        heat = {"temperature": {"ambient": "temperature"}} if "temperature" in self.more else {}
        mapping = heat | {
            "files": f"{name}.csv",
            "delimiter": ";",
            "time": {"order": {"period_s": 10.0}} if self.t is None else {"seconds": "time", "unit": "s"},
            "joints": {"unit": "rad", "columns": {joint: f"J{j + 1}" for j, joint in enumerate(self.names)}},
            self.kind: reading,
        }
        rows = [";".join(columns), *(";".join(row) for row in zip(*columns.values(), strict=True)), ""]
        made = {f"{name}.csv": "\n".join(rows), f"{name}.yaml": yaml.safe_dump({"tables": [mapping]})}
        return made | {"arm.urdf" if self.urdf.startswith("<") else "arm.yaml": self.urdf}

    def imports(self, name: str) -> tuple[tuple[str, ...], ...]:
        """The import of the table ``name`` into the bag ``name``, with its arm."""
        lengths = () if self.urdf.startswith("<") else (("import", "{arm.yaml}", "--out", f"{{of_{name}.urdf}}"),)
        urdf = lengths[0][-1] if lengths else "{arm.urdf}"
        return (*lengths, ("import", f"{{{name}.yaml}}", "--urdf", urdf, "--out", f"{{{name}}}"))


@lru_cache(maxsize=4)
def published(name: str) -> Table:
    """The UR10's "cubes" or "grid", with a tracker's poses, or the grid of "ur5" or "wam7", with its points."""
    file, floor, tolerance = KNOWN[name]
    told: dict[str, Any] = {"tolerance_mm": tolerance}
    if file:
        table, q, read = recorded.ur10(file)
        R, goal = Rotation.from_quat(read[:, 3:]), table.columns(*(f"Goal {k}" for k in GOAL))
        heat = table.columns("measurement_temperature")[:, 0]
        told |= {"more": {"temperature": np.array([f"{v:.3f}" for v in heat])}, "goal": goal}
        t = [datetime.strptime(row["Timestamp"], "%Y%m%d%H%M%S").timestamp() for row in table.rows if name == "grid"]
        names, text = recorded.UR10_JOINTS, (ROBOTS / "ur10.urdf").read_text(encoding="utf-8")
    else:
        (q, read), t = recorded.grid(name), []
        goal = recorded.Table("serial_robots", recorded.GRIDS[name]).columns(*(f"{k}_t" for k in XYZ))
        R, told = Rotation.identity(len(q)), told | {"kind": POINT, "goal": 1e-3 * goal}
        names = tuple(f"joint_{j + 1}" for j in range(7)) if name == "wam7" else recorded.UR10_JOINTS
        text = (ROBOTS / f"{name}.yaml").read_text(encoding="utf-8")
    p, clock = read[:, :3], np.array(t) if t else None
    return Table(names, text, clock, q, p, R, floor, np.zeros(len(q), bool), **told)  # type: ignore[arg-type]


def recording(name: str) -> list[Table]:
    """What is calibrated and what is kept aside."""
    whole = published(name)
    i, mixed = np.arange(len(whole.q)), np.random.default_rng(5).permutation(len(whole.q))
    parts = {
        "grid": (i[::50], i[25::100]),
        "cubes": (i[(i // 10) % 3 == 0], i[(i // 10) % 3 == 1]),
        "ur5": (np.sort(mixed[:240]), np.sort(mixed[240:340])),
        "wam7": (np.sort(mixed[:150]), np.sort(mixed[150:])),
    }
    return [whole.only(rows) for rows in parts[name]]


def cubes(c: Scene) -> None:
    """All of the UR10's cubes, 632 poses, as a recording of rows ten seconds apart."""
    c.session, c.planted = replace(published("cubes"), t=10.0 * np.arange(632), more={}, floor_mm=0.2), REAL


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
    return np.sign(move)[np.maximum.accumulate(np.where(np.abs(move) > 1e-4, np.arange(len(x)), 0))]


def knocked(c: Scene, part: str, shift: float, turn: float, when: Of) -> None:
    """The target on the tool, or the tracker, was moved at the rows that ``when`` says."""
    v, by = c.way(shift), Rotation.from_rotvec(c.way(turn))
    centre, on_tool = c.p.mean(axis=0), part == "tool"
    p = c.p + c.R.apply(v) if on_tool else by.apply(c.p - centre) + centre + v
    elsewhere(c, when, p, c.R * by if on_tool else by * c.R, "quat")


def calibrated(c: Scene, *options: str) -> None:
    """The table is imported and calibrated; the truth is how far the arm misses on what was kept aside."""
    judged = ("evaluate", "{made}", "{aside}", "--refit-base", "--refit-tool", "--out", "{aside_out}")
    c.truth, c.planted = {"aside": (*c.aside.imports("aside"), judged)}, REAL
    c.command, c.imports = ("calibrate", "{bag}", "--out", "{made}"), c.session.imports("bag")
    _told(c, c.aside.files("aside") | c.session.files("bag"), *options)


def evaluated(c: Scene, *options: str) -> None:
    """The table is calibrated, and the calibration judged on the one that was kept aside."""
    imports = *c.session.imports("first"), *c.aside.imports("second")
    c.command, c.imports = ("evaluate", "{made}", "{second}"), (*imports, ("calibrate", "{first}", "--out", "{made}"))
    _told(c, c.session.files("first") | c.aside.files("second"), *options, "--out", "{judged}")


def _told(c: Scene, files: dict[str, str], *options: str) -> None:
    c.truth |= {"floor_mm": c.floor_mm, "files": files}
    c.options, c.names, c.session = ("--tolerance-mm", str(c.tolerance_mm), *options), c.names, None


def _mukca(arm: str, part: str = "") -> str:
    return (IMPORTS / f"mukca_{arm}{part}.yaml").read_text(encoding="utf-8")


def sockets(c: Scene) -> None:
    """One of three arms: joints ``told`` (N, 7) [rad] by the name of the socket, and the cell file ``plate``."""
    c.mukca = str(c.rng.choice(["panda_3", "panda_4", "kuka_14"]))
    found = sorted((DATA / "mukca" / c.mukca).glob("*/hole_?.csv"))
    c.told = {f"{path.parent.name}_{path.stem}": np.loadtxt(path, delimiter=",") for path in found}
    c.plate, c.names = yaml.safe_load(_mukca(c.mukca, "_cell")), _joints(c.mukca)


def in_sockets(c: Scene) -> None:
    """The tables of the sockets are imported and calibrated, with the distances of the cell file."""
    every = {"joints": {"unit": "rad", "columns": {name: j for j, name in enumerate(c.names)}}, "header": False}
    every["time"] = {"order": {"period_s": 10.0}}
    tables = [deepcopy(every) | {"files": f"{s}.csv", "same_point": {"frame": s}} for s in c.told]
    files = {f"{s}.csv": "".join(",".join(f"{v:.9g}" for v in row) + "\n" for row in q) for s, q in c.told.items()}
    arm = DATA / "mukca" / "urdf" / f"{'iiwa14' if c.mukca.startswith('kuka') else 'panda'}.urdf"
    files |= {"arm.urdf": arm.read_text(encoding="utf-8"), "bag.yaml": yaml.safe_dump({"tables": tables})}
    _at_plates(c, 0.25, files | {"cell.yaml": yaml.safe_dump(c.plate)}, "--tolerance-mm", "0.8")
    c.imports = (("import", "{bag.yaml}", "--urdf", "{arm.urdf}", "--out", "{bag}"),)


def each(c: Scene, change: Callable[[Scene, str, Array], Array]) -> None:
    """The joints at each socket are others, by a function of the scene, the socket and of them."""
    c.told = {socket: change(c, socket, q) for socket, q in c.told.items()}


def on_plates(c: Scene, arm: str, distance: str = "0.05") -> None:
    """A ball in sockets of a plate, with their distance as it is or as somebody wrote it down."""
    cell = _mukca(arm, "_cell").replace("distance_m: 0.05,", f"distance_m: {distance},")
    _at_plates(c, 0.31, {"cell.yaml": cell})
    c.names = _joints(arm)
    c.imports = (("import", str(IMPORTS / f"mukca_{arm}.yaml"), "--data", str(DATA), "--out", "{bag}"),)


def _joints(arm: str) -> tuple[str, ...]:
    return tuple(yaml.safe_load(_mukca(arm))["tables"][0]["joints"]["columns"])


def _at_plates(c: Scene, floor_mm: float, files: dict[str, str], *options: str) -> None:
    c.truth, c.planted = {"floor_mm": floor_mm, "files": files}, REAL
    c.options = ("--tip", "ball_link", "--cell", "{cell.yaml}", *options)


export(globals(), {})
