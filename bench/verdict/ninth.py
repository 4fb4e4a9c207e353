"""The ninth group: recordings of real arms, tampered with as their users might, from the table to the verdict.

The list was drawn up before anything of it was run. Calm and wrong is a calibration that is said to be at the floor,
whose rest is called noise, or that meets its tolerance, while the untouched rows kept aside are missed by more than
that; *cannot tell* without a word where the data show what was done is counted apart. Each kind has words of which the
grounds must hold one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from case import Case, kind
from ninth_data import DATA, Table, calibration, recording
from scipy.spatial.transform import Rotation
from workcell import Works

Array = np.ndarray
Maker = Callable[[Works, np.random.Generator], Case]
UNIT = (r"\bunits?\b", "millimet", "degree", "inch", "times as long", "another scale")
SWAPPED = ("swapped", "exchanged", "order", "mixed")
LATE = ("late by", "early by", "row", "other stations", "stand in")
PAIRING = ("other stations", "belong to", "reverse order", "swapped two and two", "late by", "does not follow")
TOOL = (r"\btool\b",)
BASE = (r"\bbase\b", "tracker's zero")
ROUNDED = ("round", "resolution", "step of")
COMPUTED = ("computed", "reproduces", "nominal model")
HELD = (
    "exactly the same",
    "does not follow",
    "constant",
    "never changes",
    "stale",
    "does not move",
    "same value",
    "stand",
)


def ninth(maker: Maker) -> Maker:
    """Registers a maker if its data are there."""
    return kind("ninth")(maker) if DATA.is_dir() else maker


def any_of(rng: np.random.Generator, *names: str) -> tuple[Table, Table]:
    """One of some recordings: to be calibrated, and to be kept aside."""
    return recording(str(rng.choice(names)))


def named(table: Table, *joints: int) -> tuple[str, ...]:
    """The names of joints, as words."""
    return tuple(rf"\b{table.names[j]}\b" for j in joints)


def after(table: Table, aside: Table) -> Table:
    """Rows kept aside as if measured after those of the table, so that of what changes in time the last state holds."""
    if table.t is None or aside.t is None:
        return aside
    return replace(aside, t=aside.t + table.t[-1] - aside.t[0] + 10.0)


def way(rng: np.random.Generator, size: float) -> Array:
    """A random vector of a length."""
    v = rng.normal(size=3)
    return size * v / np.linalg.norm(v)


POSES, POINTS = ("cubes", "grid"), ("ur5", "wam7")
ANY = POSES + POINTS


@ninth
def ninth_column_in_metres(w: Works, rng: np.random.Generator) -> Case:
    """One coordinate of the readings was exported in metres, the others in millimetres."""
    table, aside = any_of(rng, *ANY)
    axis = int(rng.integers(3))
    cells = {"xyz"[axis]: [f"{v:.7f}" for v in table.p[:, axis]]}
    return calibration(replace(table, cells=cells), (*UNIT, "xyz"[axis] + " of the", "scale"), aside)


@ninth
def ninth_joint_in_degrees(w: Works, rng: np.random.Generator) -> Case:
    """One joint's column in degrees, the others in radians."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(1, 5))
    cells = {f"J{j + 1}": [f"{v:.5f}" for v in np.degrees(table.q[:, j])]}
    return calibration(replace(table, cells=cells), (*UNIT, *named(table, j)), aside)


@ninth
def ninth_joints_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """Two neighbouring joint columns carry each other's label."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(0, 5))
    q = table.q.copy()
    q[:, [j, j + 1]] = q[:, [j + 1, j]]
    return calibration(replace(table, q=q), (*SWAPPED, rf"{table.names[j]}\b.*{table.names[j + 1]}\b"), aside)


@ninth
def ninth_joint_reversed(w: Works, rng: np.random.Generator) -> Case:
    """One joint counts the other way."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(0, 6))
    q = table.q.copy()
    q[:, j] *= -1.0
    return calibration(replace(table, q=q), named(table, j), aside)


@ninth
def ninth_joints_a_row_late(w: Works, rng: np.random.Generator) -> Case:
    """The joints of each row are those of the row before."""
    table, aside = any_of(rng, *ANY)
    return calibration(replace(table.only(np.arange(1, len(table))), q=table.q[:-1]), LATE, aside)


@ninth
def ninth_half_shuffled(w: Works, rng: np.random.Generator) -> Case:
    """Half of the readings stand beside the joints of other rows."""
    table, aside = any_of(rng, *ANY)
    rows = np.arange(len(table))
    half = np.sort(rng.choice(len(table), len(table) // 2, replace=False))
    rows[half] = rng.permutation(half)
    return calibration(table.read(rows), (*PAIRING, "rejected"), aside)


@ninth
def ninth_one_half_of_the_space(w: Works, rng: np.random.Generator) -> Case:
    """Readings of one side of the working space only; the other side is missed by more than is said."""
    table, aside = any_of(rng, *ANY)
    middle = np.median(table.p, axis=0)
    along = way(rng, 1.0)
    rows = np.flatnonzero((table.p - middle) @ along > 0.0)
    return calibration(table.only(rows), (), aside, shown=False)


@ninth
def ninth_another_tool_after_a_third(w: Works, rng: np.random.Generator) -> Case:
    """After a third of the rows another target was used."""
    table, aside = any_of(rng, *POSES)
    rows = np.arange(len(table)) >= len(table) // 3
    return calibration(table.tool(rows, way(rng, 0.012), way(rng, 0.03)), TOOL, after(table, aside))


@ninth
def ninth_target_reseated(w: Works, rng: np.random.Generator) -> Case:
    """The target was put back into its nest a millimetre aside."""
    table, aside = any_of(rng, *POSES)
    rows = np.arange(len(table)) >= int(rng.uniform(0.3, 0.7) * len(table))
    return calibration(table.tool(rows, way(rng, 1.5e-3), way(rng, 2e-3)), TOOL, after(table, aside))


@ninth
def ninth_tracker_nudged(w: Works, rng: np.random.Generator) -> Case:
    """Somebody bumped into the tracker in the middle: by two millimetres."""
    table, aside = any_of(rng, *POSES, "ur5")
    rows = np.arange(len(table)) >= len(table) // 2
    return calibration(table.base(rows, way(rng, 2e-3), way(rng, 1.5e-3)), BASE, after(table, aside))


@ninth
def ninth_tracker_creeps(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's tripod sinks all the time, by a millimetre in the end."""
    table, aside = any_of(rng, *POSES, "ur5")
    share = np.linspace(0.0, 1.0, len(table))[:, None]
    moved = replace(table, p=table.p + share * way(rng, 1e-3))
    return calibration(moved, (*BASE, "drift", "time", "order of the stations", "tracker"), after(table, aside))


@ninth
def ninth_joint_zero_changed(w: Works, rng: np.random.Generator) -> Case:
    """One joint was mastered anew after half of the rows, 3 mrad away; kept aside is the arm as it is since."""
    table, aside = any_of(rng, "cubes", "grid", "ur5")
    j = int(rng.integers(1, 5))
    rows = np.arange(len(table)) >= len(table) // 2
    return calibration(table.joint(j, 3e-3 * rows), named(table, j), after(table, aside).joint(j, 3e-3))


@ninth
def ninth_wrong_readings_in_a_corner(w: Works, rng: np.random.Generator) -> Case:
    """Reflections: in one corner of the space readings are off by 5 mm, each its own way."""
    table, aside = any_of(rng, *POSES, "ur5")
    away = np.linalg.norm(table.p - table.p[rng.integers(len(table))], axis=1)
    rows = away < np.quantile(away, 0.12)
    p = table.p + rows[:, None] * rng.normal(0.0, 5e-3 / np.sqrt(3.0), table.p.shape)
    return calibration(replace(table, p=p), ("rejected",), aside)


@ninth
def ninth_arm_of_another_maker(w: Works, rng: np.random.Generator) -> Case:
    """The description of a similar arm: of the same build, its links some centimetres longer."""
    table, aside = any_of(rng, "cubes", "grid")
    text = table.robot.read_text(encoding="utf-8").replace("-0.612", "-0.6127").replace("-0.5723", "-0.57155")
    text = text.replace("0.1639", "0.17415").replace("0.1157", "0.11985").replace("0.1273", "0.1807")
    assert text != table.robot.read_text(encoding="utf-8")
    words = ("URDF", "lengths?", "links?", "description", "another arm", "nominal")
    return calibration(replace(table, robot_text=text), words, aside, shown="if missed")


@ninth
def ninth_smaller_arm_of_the_maker(w: Works, rng: np.random.Generator) -> Case:
    """The UR5e's lengths for a UR5."""
    table, aside = recording("ur5")
    text = table.robot.read_text(encoding="utf-8")
    for old, new in (("0.089159", "0.1625"), ("0.10915", "0.1333"), ("0.09465", "0.0997"), ("0.0823", "0.0996")):
        assert old in text
        text = text.replace(old, new)
    words = ("URDF", "lengths?", "links?", "description", "another arm", "nominal")
    return calibration(replace(table, robot_text=text), words, aside, shown="if missed")


@ninth
def ninth_modified_for_standard(w: Works, rng: np.random.Generator) -> Case:
    """A table in the standard convention of Denavit and Hartenberg that somebody called modified."""
    table, aside = any_of(rng, *POINTS)
    text = table.robot.read_text(encoding="utf-8").replace("convention: dh", "convention: mdh")
    words = ("URDF", "description", "another arm", "DH", "origin", "convention", "joint")
    return calibration(replace(table, robot_text=text), words, aside)


@ninth
def ninth_stamps_in_milliseconds(w: Works, rng: np.random.Generator) -> Case:
    """Time in milliseconds that is called seconds."""
    table, aside = recording("grid")
    assert table.t is not None
    slow = replace(table, cells={"time": [f"{1e3 * (v - table.t[0]):.0f}" for v in table.t]})
    return calibration(slow, ("stamp", "clock", "time", "millisecond", r"\bunits?\b"), aside, shown="if missed")


@ninth
def ninth_joint_column_stands(w: Works, rng: np.random.Generator) -> Case:
    """A joint's column holds its first value all the way down."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(1, 5))
    q = table.q.copy()
    q[:, j] = q[0, j]
    return calibration(replace(table, q=q), (*named(table, j), *HELD), aside)


@ninth
def ninth_coordinate_stands(w: Works, rng: np.random.Generator) -> Case:
    """A coordinate of the readings was filled down."""
    table, aside = any_of(rng, *ANY)
    p = table.p.copy()
    p[:, int(rng.integers(3))] = p[0, 0]
    return calibration(replace(table, p=p), HELD, aside)


@ninth
def ninth_readings_of_whole_millimetres(w: Works, rng: np.random.Generator) -> Case:
    """The export wrote whole millimetres."""
    table, aside = any_of(rng, "cubes", "grid", "ur5")
    return calibration(replace(table, p=np.round(table.p, 3)), ROUNDED, aside)


@ninth
def ninth_joints_of_one_decimal(w: Works, rng: np.random.Generator) -> Case:
    """Joints in degrees with one decimal."""
    table, aside = any_of(rng, "cubes", "grid", "ur5")
    return calibration(replace(table, q=np.radians(np.round(np.degrees(table.q), 1))), ROUNDED, aside)


@ninth
def ninth_comma_taken_for_thousands(w: Works, rng: np.random.Generator) -> Case:
    """A spreadsheet took the decimal comma of some cells for one of thousands: 97,123 became 97123."""
    table, aside = any_of(rng, *ANY)
    axis = int(rng.integers(3))
    cells = [f"{v:.3f}" for v in 1e3 * table.p[:, axis]]
    cells = [c.replace(".", "") if len(c.split(".")[0].strip("-")) <= 3 else c for c in cells]
    words = (*UNIT, "xyz"[axis] + r"\b", "thousand", "rejected", "too far", "scale", "decimal")
    return calibration(replace(table, cells={"xyz"[axis]: cells}), words, aside, shown="if missed")


@ninth
def ninth_readings_smoothed(w: Works, rng: np.random.Generator) -> Case:
    """A filter of the tracker's program: each reading is the mean of three rows."""
    table, aside = any_of(rng, *ANY)
    p = table.p.copy()
    p[1:-1] = (table.p[:-2] + table.p[1:-1] + table.p[2:]) / 3.0
    return calibration(replace(table, p=p), ("position", "mean", "filter", "neighbour", "rows?", "late"), aside)


@ninth
def ninth_mirrored(w: Works, rng: np.random.Generator) -> Case:
    """One axis of the readings points the other way: a frame of the left hand."""
    table, aside = any_of(rng, *ANY)
    p = table.p * np.array([1.0, -1.0, 1.0])
    return calibration(replace(table, p=p), ("left", "mirror", "sign", "handed", "axis", "column"), aside)


@ninth
def ninth_rows_written_twice(w: Works, rng: np.random.Generator) -> Case:
    """Each row stands twice: the returns that are no returns."""
    table, aside = any_of(rng, *POINTS)
    twice = np.concatenate([np.arange(len(table))] * 2)
    return calibration(table.only(twice), ("copies", "copy", "twice", "the same", "repeated"), aside, shown="if missed")


@ninth
def ninth_two_recordings_in_one(w: Works, rng: np.random.Generator) -> Case:
    """The cubes below the grid: another tool, another place of the tracker."""
    (first, _), (second, aside) = recording("grid"), recording("cubes")
    i = np.arange(100)
    a, b = first.only(i), second.only(i)
    assert a.R is not None
    assert b.R is not None
    both = replace(
        b,
        q=np.concatenate([a.q, b.q]),
        p=np.concatenate([a.p, b.p]),
        R=Rotation.concatenate([a.R, b.R]),
        temperature=None,
    )
    return calibration(both, (*BASE, *TOOL), aside)


@ninth
def ninth_tolerance_of_a_smaller_part(w: Works, rng: np.random.Generator) -> Case:
    """The long grid by its first tenth, where the arm hardly moves; used all over the grid."""
    table, aside = recording("grid")
    return calibration(table.only(np.arange(40)), (), aside, shown=False)


@ninth
def ninth_readings_from_the_controller(w: Works, rng: np.random.Generator) -> Case:
    """Where the controller meant its tool to be, to a hundredth of a millimetre, in place of the tracker's readings."""
    table, aside = any_of(rng, *ANY)
    assert table.goal is not None
    return calibration(replace(table, p=np.round(table.goal, 5), R=None), COMPUTED, replace(aside, R=None))
