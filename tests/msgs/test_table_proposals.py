"""A mapping that is found out: what was written is found again, and what the data cannot tell is asked.

bench/imports has a hundred exports drawn by a generator that knows nothing of modcal; here are the parts, and a few whole ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgs.exported import BASE, CHAIN, TOOL, joints, named, postures, seen, written
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.robots.mechanism import forward
from modcal_msgs_py.tables import import_tables
from modcal_msgs_py.tables.labels import Label, grouped
from modcal_msgs_py.tables.propose import Proposal, find
from modcal_msgs_py.tables.sheet import sniff


def poses(rng: np.random.Generator, rows: int = 40, spread: float = 1.3) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions, and poses that a nominal arm misses by two millimetres."""
    q = postures(rng, rows, spread)
    return q, seen(q, rng)


def same(made: Proposal, folder: Path, q: np.ndarray, T: np.ndarray) -> None:
    """The recording that a proposed mapping makes is what was written, but for a transform at the tool."""
    assert not made.open
    recording = import_tables(dict(made.mapping), folder, "m")
    joints, reading = recording.joints[0], recording.readings[0]
    assert joints.names == CHAIN.names
    assert np.abs(joints.position - q).max() < 1e-6
    tool = se3.inverse(T) @ se3.from_pose(reading.values)
    assert np.abs(tool - tool[0]).max() < 1e-5


def test_names_units_and_an_inverse_pose(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    back = se3.inverse(T)
    columns = {
        **{f"{name} [deg]": np.degrees(q[:, k]) for k, name in enumerate(CHAIN.names)},
        **named("X Y Z", 1e3 * back[:, :3, 3]),
        **named("A B C", Rotation.from_matrix(back[:, :3, :3]).as_euler("ZYX", degrees=True)),
    }
    path = written(tmp_path, columns, head="Measured by us\nToday\n", marks=(";", ","))
    made = find([path], CHAIN)
    same(made, tmp_path, q, T)
    (entry,) = made.mapping["tables"]
    assert (entry["delimiter"], entry["decimal"], entry["preamble_rows"]) == (";", ",", 2)
    assert entry["joints"]["unit"] == "deg"
    assert entry["pose"]["inverse"] is True
    assert entry["pose"]["euler"]["sequence"] == "ZYX"
    assert any("second best" in said for said in made.proved)


@pytest.mark.slow
def test_joints_without_names_in_another_order(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    shuffled = q[:, [3, 0, 5, 1, 4, 2]]
    columns = {
        **named("oak elm ash fir yew box", shuffled), "pressure": 1013.0 + rng.standard_normal(len(q)),
        **named("x y z", T[:, :3, 3]), **named("q0 q1 q2 q3", quaternion),
    }  # fmt: skip
    same(find([written(tmp_path, columns)], CHAIN), tmp_path, q, T)


@pytest.mark.slow
def test_a_homogeneous_matrix_without_labels(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    cells = T[:, :3].reshape(-1, 12) * np.array([1.0, 1.0, 1.0, 1e3] * 3)
    path = tmp_path / "cell.csv"
    path.write_text("\n".join(";".join(f"{v:.7f}" for v in row) for row in np.c_[q, cells]))
    same(find([path], CHAIN), tmp_path, q, T)


@pytest.mark.slow
def test_two_files_joined_by_a_station(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    order = rng.permutation(len(q))
    station = np.arange(1.0, len(q) + 1)
    tracker = {
        "station": station,
        **named("x y z", T[:, :3, 3]),
        **named("rx ry rz", Rotation.from_matrix(T[:, :3, :3]).as_rotvec()),
    }
    written(tmp_path, tracker, "tracker.csv")
    robot = {"pose": station[order], **named("J1 J2 J3 J4 J5 J6", q[order])}
    written(tmp_path, robot, "robot.csv", marks=(";", ","))
    same(find([tmp_path / "tracker.csv", tmp_path / "robot.csv"], CHAIN), tmp_path, q, T)


def test_joints_alone_are_a_bag_whose_unit_is_asked_where_no_label_tells(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """As an arm's encoders while it opens a door: every other verb says that readings are missing."""
    q = poses(rng)[0]
    for unit, factor, questions in (("", 1.0, 1), (" [rad]", 1.0, 0), (" [deg]", 180.0 / np.pi, 0)):
        columns = {f"{name}{unit}": factor * q[:, k] for k, name in enumerate(CHAIN.names)}
        made = find([written(tmp_path, {"t": 0.1 * np.arange(len(q)), **columns})], CHAIN)
        assert [("unit of the joints" in question) for question in made.open] == [True] * questions
        assert any("joints alone" in said for said in made.assumed)
        if not made.open:
            recording = import_tables(dict(made.mapping), tmp_path, "m")
            assert not recording.readings
            path = written(tmp_path, {"t": 0.1 * np.arange(len(q)), **columns, "speck": rng.standard_normal(len(q))})
            assert any("speck change and are read as no measurement" in said for said in find([path], CHAIN).open)
            assert np.abs(recording.joints[0].position - q).max() < 1e-6


def test_a_pose_that_was_computed_from_the_joints_is_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    q, _ = poses(rng)
    T = BASE @ forward(CHAIN, q) @ TOOL
    columns = {
        **joints(q),
        **named("x y z", T[:, :3, 3]), **named("qx qy qz qw", Rotation.from_matrix(T[:, :3, :3]).as_quat()),
    }  # fmt: skip
    made = find([written(tmp_path, columns)], CHAIN)
    assert any("computed from the joints" in question for question in made.open)


@pytest.mark.slow
def goals(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Joints, places that were reached [mm], goals as a controller rounds them [mm], and the joints' columns."""
    q, T = poses(rng)
    reached = 1e3 * T[:, :3, 3]
    goal = np.round(1e3 * (BASE @ forward(CHAIN, q) @ TOOL)[:, :3, 3], 1)
    return q, reached, goal, joints(q)


@pytest.mark.parametrize(("names", "key"), [("x_dif y_dif z_dif", "minus"), ("dX dY dZ", "plus")])
def test_a_goal_and_a_deviation_are_a_reading_whose_sign_is_asked(
    names: str, key: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    q, reached, goal, joints = goals(rng)
    sign = 1.0 if key == "plus" else -1.0
    columns = {**named("x_t y_t z_t", goal), **named(names, sign * (reached - goal)), **joints}
    made = find([written(tmp_path, columns)], CHAIN)
    (asked,) = made.open
    assert f"what was reached is x_t, y_t, z_t minus {', '.join(names.split())}, or plus it" in asked
    mapping = {name: value for name, value in made.mapping.items() if name != "undecided"}
    point = mapping["tables"][0]["point"]
    point[key] = point.pop("minus")
    recording = import_tables(mapping, tmp_path, "m")
    assert np.abs(recording.joints[0].position - q).max() < 1e-6
    assert 1e3 * recording.readings[0].values == pytest.approx(reached, abs=1e-4)


def test_a_deviation_beside_what_was_reached_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    _, reached, goal, joints = goals(rng)
    columns = {**named("X Y Z", reached), **named("err_x err_y err_z", reached - goal), **joints}
    made = find([written(tmp_path, columns)], CHAIN)
    assert not made.open
    (entry,) = made.mapping["tables"]
    assert entry["point"]["position"] == ["X", "Y", "Z"]
    assert not {"plus", "minus"} & set(entry["point"])
    assert any("not used: err_x, err_y, err_z" in said for said in made.assumed)


def test_labels_that_contradict_the_arm_are_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    columns = {
        **named("J1 J2 J3 J5 J4 J6", q),
        **named("x y z", T[:, :3, 3]), **named("qx qy qz qw", Rotation.from_matrix(T[:, :3, :3]).as_quat()),
    }  # fmt: skip
    made = find([written(tmp_path, columns)], CHAIN)
    assert any("labels say that the joints are" in question for question in made.open)


def test_a_table_of_something_else_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    path = written(tmp_path, named("a b c d e f g h i j", rng.standard_normal((40, 10))))
    with pytest.raises(BadTable, match="no columns are found that could be the joints of this arm"):
        find([path], CHAIN)
    (tmp_path / "prose.txt").write_text("nothing\nbut words\n")
    with pytest.raises(BadTable, match="no block of rows with numbers"):
        find([tmp_path / "prose.txt"], CHAIN)


@pytest.mark.parametrize(
    ("encoding", "separator", "decimal"),
    [
        ("utf-8", ",", "."),
        ("utf-8-sig", ";", ","),
        ("utf-16", "\t", ","),
        ("utf-16-le", " ", "."),
        ("latin-1", "|", "."),
    ],
)
def test_how_a_file_is_written(encoding: str, separator: str, decimal: str, tmp_path: Path) -> None:
    rows = [[f"{i + k + 0.25:.2f}".replace(".", decimal) for k in range(4)] for i in range(5)]
    rows[2][1] = "nan"
    lines = ["Bediener: Müller", "", separator.join(["t", "größe", "b", "c"]), separator.join(["s", "mm", "mm", "deg"])]
    text = "\r\n".join([*lines, *(separator.join(row) for row in rows)])
    (tmp_path / "t.csv").write_bytes(text.encode(encoding))
    found = sniff(tmp_path / "t.csv")
    assert (found.form.delimiter, found.form.decimal) == (separator, decimal)
    assert (found.form.preamble_rows, found.form.units_rows, found.form.header) == (2, 1, True)
    assert found.header == ("t", "größe", "b", "c")
    assert found.units == ("s", "mm", "mm", "deg")
    assert len(found.rows) == 5


def test_labels_in_several_rows(tmp_path: Path) -> None:
    text = "Format,1.2\n\n,,Rigid Body,Rigid Body,Rigid Body\n,,tool,tool,tool\n,,Position,Position,Position\n"
    (tmp_path / "m.csv").write_text(text + "Frame,Time (Seconds),X,Y,Z\n0,0.0,1.0,2.0,3.0\n1,0.1,1.0,2.0,3.5\n")
    found = sniff(tmp_path / "m.csv")
    assert found.header == ("Frame", "Time (Seconds)", "X", "Y", "Z")
    assert found.full[2] == "Rigid Body tool Position X"


def labelled(*texts: str) -> dict[int, Label]:
    return {k: Label.of(text) for k, text in enumerate(texts)}


def test_labels_of_orientations() -> None:
    assert grouped(labelled("Q0", "Qx", "Qy", "Qz"), "quaternion") == [(1, 2, 3, 0)]
    assert grouped(labelled("tool.qw", "tool.qx", "tool.qy", "tool.qz"), "quaternion") == [(1, 2, 3, 0)]
    assert grouped(labelled("q1", "q2", "q3", "q4"), "quaternion") == [(0, 1, 2, 3)]
    assert grouped(labelled("Yaw", "Pitch", "Roll"), "angles") == [(2, 1, 0)]
    assert grouped(labelled(*(f"r{i}{j}" for i in "123" for j in "123")), "matrix") == [tuple(range(9))]
    assert grouped(labelled(*(f"Rot[{k}]" for k in range(9))), "matrix") == [tuple(range(9))]
    whole = labelled(*(f"T{i}{j}" for i in "123" for j in "1234"))
    assert grouped(whole, "homogeneous") == [(3, 7, 11, 0, 1, 2, 4, 5, 6, 8, 9, 10)]


def test_orientations_that_hardly_vary_are_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    """All sequences say nearly the same of angles this small: every one fits, and none is chosen in silence."""
    q, T = poses(rng, 20, 1e-3)
    columns = {
        **{name: q[:, k] for k, name in enumerate(CHAIN.names)},
        **named("x y z", T[:, :3, 3]), **named("a b c", Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz")),
    }  # fmt: skip
    made = find([written(tmp_path, columns)], CHAIN)
    assert any("cannot tell" in question for question in made.open)
    with pytest.raises(BadTable, match="undecided"):
        import_tables(dict(made.mapping), tmp_path, "m")
