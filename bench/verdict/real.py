"""Recordings of real arms, spoiled; and as they are, where what is left is known to be more than noise.

They lie in ../shared/data beside the checkout; without them this group is empty.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from case import Case, calibrated, frozen, kind
from conventions import ORIENTATION, QUATERNION, UNIT
from regimes import BASE, LEFT_OUT, TOOL, shifted
from scipy.spatial.transform import Rotation
from workcell import Session, Works

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
UR10_MM = 0.2  # what the second recording is known to be explained to
SOCKETS_MM = 0.31
Maker = Callable[[Works, np.random.Generator], Case]


def real(maker: Maker) -> Maker:
    """Registers a maker if its data are there."""
    return kind("real")(maker) if DATA.is_dir() else maker


@lru_cache(maxsize=1)
def cubes() -> tuple[Session, np.ndarray, Rotation]:
    """The UR10's cubes of ISO 9283, 632 poses, and what its controller says of them: goals (N, 3) [m] and turns."""
    with (DATA / "ipa_ur10" / "series_d_iso_cubes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter=";"))

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])

    names = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
    angles = columns("measurement_rx", "measurement_ry", "measurement_rz")
    session = Session(
        names,
        (ROOT / "examples" / "robots" / "ur10.urdf").read_text(encoding="utf-8"),
        10.0 * np.arange(len(rows)),
        columns(*names),
        1e-3 * columns("measurement_x", "measurement_y", "measurement_z"),
        Rotation.from_euler("XYZ", angles, degrees=True),
        UR10_MM,
        np.zeros(len(rows), bool),
    )
    goal = columns("Goal x", "Goal y", "Goal z")
    return session, goal, Rotation.from_euler("xyz", columns("Goal roll", "Goal pitch", "Goal yaw"))


@real
def cubes_other_sequence(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's angles read as extrinsic."""
    session = cubes()[0]
    return calibrated(replace(session, R=Rotation.from_euler("xyz", session.R.as_euler("XYZ"))), ORIENTATION)


@real
def cubes_reversed_sequence(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's angles read as ZYX."""
    session = cubes()[0]
    return calibrated(replace(session, R=Rotation.from_euler("ZYX", session.R.as_euler("XYZ"))), ORIENTATION)


@real
def cubes_w_first(w: Works, rng: np.random.Generator) -> Case:
    """Quaternions written w x y z."""
    session = cubes()[0]
    values = session.raw().copy()
    values[:, 3:] = values[:, [6, 3, 4, 5]]
    return calibrated(replace(session, values=values), QUATERNION)


@real
def cubes_tool_turned(w: Works, rng: np.random.Generator) -> Case:
    """The tool is turned by 0.1 rad about its mount after 80 stations."""
    return calibrated(_retooled(cubes()[0], w, np.arange(632) >= 80, 0.03, 0.1), TOOL)


@real
def cubes_first_with_another_tool(w: Works, rng: np.random.Generator) -> Case:
    """Another tool at the first twelve stations."""
    return calibrated(_retooled(cubes()[0], w, np.arange(632) < 12, 0.02, 0.2), TOOL)


def _retooled(session: Session, w: Works, rows: np.ndarray, shift: float, turn: float) -> Session:
    """Readings of a target that sits elsewhere on the tool at some stations."""
    moved = session.p + session.R.apply(w.way(shift))
    turned = (session.R * Rotation.from_rotvec(w.way(turn))).as_quat()
    quaternions = np.where(rows[:, None], turned, session.R.as_quat())
    return replace(session, p=np.where(rows[:, None], moved, session.p), R=Rotation.from_quat(quaternions))


@real
def cubes_base_moved(w: Works, rng: np.random.Generator) -> Case:
    """The tracker stands a few centimetres aside from the middle on."""
    session, rows = cubes()[0], np.arange(632) >= 300
    turn = Rotation.from_rotvec(w.way(0.02))
    p = np.where(rows[:, None], turn.apply(session.p) + w.way(0.03), session.p)
    quaternions = np.where(rows[:, None], (turn * session.R).as_quat(), session.R.as_quat())
    return calibrated(replace(session, p=p, R=Rotation.from_quat(quaternions)), BASE)


@real
def cubes_in_millimetres_at_the_end(w: Works, rng: np.random.Generator) -> Case:
    """The last hundred positions in millimetres."""
    session = cubes()[0]
    return calibrated(replace(session, p=session.p * np.where(np.arange(632) >= 532, 1e3, 1.0)[:, None]), UNIT)


@real
def cubes_half_shifted_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A calibration on the first 400 stations, used where 45 % is shifted by 5 mm."""
    session = cubes()[0]
    second = shifted(session.only(np.arange(400, 632)), 0.45, 5e-3, rng)
    return frozen(session.only(np.arange(400)), second, LEFT_OUT)


@real
def goals_for_readings(w: Works, rng: np.random.Generator) -> Case:
    """The controller's own goal poses in place of readings; the joints missed them by a little."""
    session, goal, turn = cubes()
    return calibrated(replace(session, p=goal, R=turn))


@real
def cubes_geometry_only(w: Works, rng: np.random.Generator) -> Case:
    """Gears that err, and --geometry-only."""
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist", "geometry-only", "geometry only", "not looked for")
    return calibrated(cubes()[0], joints, "--geometry-only")


@real
def cubes_readings_shuffled(w: Works, rng: np.random.Generator) -> Case:
    """Readings beside other postures than their own."""
    session, rows = cubes()[0], rng.permutation(632)
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]))


def _sockets(arm: str, distance: float | None, must_name: tuple[str, ...], shown: bool | str) -> Case:
    """A ball in sockets of a plate, with the distance of its sockets as it is or as somebody wrote it down."""
    here = ROOT / "examples" / "import"
    steps = [("import", str(here / f"mukca_{arm}.yaml"), "--data", str(DATA), "--out", "{bag}")]
    calibrate = ("calibrate", "{bag}", "--tip", "ball_link", "--cell", "{cell.yaml}")
    text = (here / f"mukca_{arm}_cell.yaml").read_text(encoding="utf-8")
    if distance is not None:
        text = text.replace("distance_m: 0.05,", f"distance_m: {distance},")
    files = {"cell.yaml": text}
    return Case({}, (*steps, calibrate), True, must_name, False, shown, files, floor_mm=SOCKETS_MM)


@real
def sockets_two_millimetres_wrong(w: Works, rng: np.random.Generator) -> Case:
    """The distance of the sockets is written down two millimetres too large."""
    return _sockets("panda_3", 0.052, ("distance", "apart"), True)


@real
def sockets_half_a_millimetre_wrong(w: Works, rng: np.random.Generator) -> Case:
    """The same, by ten times what is stated for it."""
    return _sockets("panda_4", 0.0505, ("distance", "apart"), True)


@real
def sockets_with_their_distance(w: Works, rng: np.random.Generator) -> Case:
    """Sockets in more than three placements, as they are: 0.28 to 0.31 mm can be reached."""
    return _sockets("panda_3", None, ("distance", "apart"), "if missed")
