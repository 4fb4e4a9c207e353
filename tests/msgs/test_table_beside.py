"""Columns beside joints and a pose: what is proposed for them, and what a mapping makes of them.

bench/imports draws whole exports with them; here is what each is decided by.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import slider_arm
from msgs.exported import BASE, CHAIN, MIDDLE, TOOL, joints, named, postures, seen, written
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.measurements.recording import Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import forward
from modcal_msgs_py.tables import import_tables
from modcal_msgs_py.tables.labels import Label, grouped
from modcal_msgs_py.tables.propose import Proposal, find
from modcal_msgs_py.tables.sheet import sniff


def points(T: np.ndarray) -> dict[str, np.ndarray]:
    return named("x y z", T[:, :3, 3])


def proposed(folder: Path, columns: dict[str, Any]) -> tuple[Proposal, dict[str, Any]]:
    made = find([written(folder, columns)], CHAIN)
    (entry,) = made.mapping["tables"]
    return made, entry


def read(made: Proposal, folder: Path) -> Recording:
    return import_tables(dict(made.mapping), folder, "m")


def moving(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, joints and their speeds of a smooth motion."""
    t = np.arange(0.0, 4.0, 0.02)
    phase = rng.uniform(0.0, 6.0, CHAIN.n)
    return t, MIDDLE + 0.6 * np.sin(t[:, None] + phase), 0.6 * np.cos(t[:, None] + phase)


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "rad/s"), (180.0 / np.pi, "deg/s")])
def test_the_unit_of_speeds_is_told_by_the_motion(
    scale: float, unit: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    t, q, v = moving(rng)
    columns = {"t": t, **joints(q), **points(seen(q, rng)), **named("qd1 qd2 qd3 qd4 qd5 qd6", scale * v)}
    made, entry = proposed(tmp_path, columns)
    assert not made.open
    assert entry["joints"]["velocity"]["unit"] == unit
    assert np.abs(read(made, tmp_path).joints[0].velocity - v).max() < 1e-6


@pytest.mark.parametrize("chain", [CHAIN, slider_arm()])
def test_commanded_joints_in_degrees(chain: Chain, tmp_path: Path, rng: np.random.Generator) -> None:
    """Of an arm that slides too, in millimetres, with its own turning joints in degrees."""
    turning, own = chain.revolute, np.where(chain.revolute, 1.0 if chain is CHAIN else 180.0 / np.pi, 1e3)
    q = rng.uniform(-1.2, 1.2, (40, chain.n)) * np.where(turning, 1.0, 0.3)
    wanted = q + 1e-3 * rng.standard_normal(q.shape)
    told = own * q, np.where(turning, 180.0 / np.pi, 1e3) * wanted
    columns = {f"{what}{k + 1}": x[:, k] for what, x in zip(("J", "cmd"), told, strict=True) for k in range(chain.n)}
    path = written(tmp_path, columns | points(BASE @ forward(chain, q + 1e-3 * rng.standard_normal(chain.n)) @ TOOL))
    (commanded,) = read(find([path], chain), tmp_path).commands
    assert np.abs(commanded.position - wanted).max() < 1e-6


def test_efforts_in_per_cent_are_signals_and_torques_are_efforts(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    torque = {f"Torque {k} [Nm]": rng.standard_normal(len(q)) for k in range(1, 7)}
    load = {f"motor load {k} [%]": rng.uniform(0.0, 90.0, len(q)) for k in range(1, 7)}
    made, entry = proposed(tmp_path, {**joints(q), **points(seen(q, rng)), **load, **torque})
    assert entry["joints"]["effort"]["columns"][CHAIN.names[0]] == "Torque 1 [Nm]"
    assert entry["signals"][f"motor_load/{CHAIN.names[0]}"] == "motor load 1 [%]"
    assert any("their sign does not show" in said for said in made.assumed)


def test_efforts_of_the_load_change_their_sign(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng, 12)
    tau = rng.standard_normal(q.shape)
    written(tmp_path, {**joints(q), **named("x y z", q[:, :3]), **named("a b c d e f", tau)})
    effort = {"of_load": True, "unit": "N mm", "columns": dict(zip(CHAIN.names, "abcdef", strict=True))}
    stated = {"unit": "rad", "columns": {n: n for n in CHAIN.names}, "effort": effort}
    point = {"frame": "t", "unit": "m", "position": ["x", "y", "z"]}
    entry = {"files": "cell.csv", "time": {"order": {"period_s": 1}}, "joints": stated, "point": point}
    recording = import_tables({"tables": [entry]}, tmp_path, "m")
    assert np.allclose(recording.joints[0].effort, -1e-3 * tau, atol=1e-10)


@pytest.mark.parametrize(
    ("labels", "factor", "coverage"),
    [("std_x std_y std_z", 1.0, None), ("sx sy sz", 1.0, None), ("u95_x u95_y u95_z", 2.0, 2.0)],
)
def test_standard_deviations(
    labels: str, factor: float, coverage: float | None, tmp_path: Path, rng: np.random.Generator
) -> None:
    q = postures(rng)
    s = rng.uniform(2e-5, 4e-5, (len(q), 3))
    made, entry = proposed(tmp_path, {**joints(q), **points(seen(q, rng)), **named(labels, 1e3 * factor * s)})
    assert entry["point"]["std"] == {
        "position": labels.split(), "unit": "mm", **({"coverage": coverage} if coverage else {})
    }  # fmt: skip
    stated = read(made, tmp_path).readings[0].stated
    assert np.allclose(stated[:, 0], np.linalg.norm(s, axis=1), rtol=1e-3)


def test_targets_on_one_tool_are_its_pose_and_a_nest_is_none(tmp_path: Path, rng: np.random.Generator) -> None:
    q, T = poses(rng)
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.12, 0.02], [0.05, 0.05, 0.1]])
    columns: dict[str, Any] = joints(q)
    for i, place in enumerate(places):
        p = T[:, :3, :3] @ place + T[:, :3, 3] + 2e-5 * rng.standard_normal((len(q), 3))
        columns |= named(f"SMR{i}_x SMR{i}_y SMR{i}_z", 1e3 * p)
    columns |= named("nest_x nest_y nest_z", 800.0 + 0.02 * rng.standard_normal((len(q), 3)))
    made, entry = proposed(tmp_path, columns)
    assert not made.open
    assert len(entry["targets"]["points"]) == 4
    tool = se3.inverse(T) @ se3.from_pose(read(made, tmp_path).readings[0].values)
    assert np.linalg.norm((tool - tool[0])[:, :3, 3], axis=1).max() < 3e-4


@pytest.mark.slow
def test_two_targets_are_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    T = seen(q, rng)
    columns = {**joints(q), **named("a_x a_y a_z", T[:, :3, 3])}
    columns |= named("b_x b_y b_z", (T @ se3.transform(p=[0.1, 0.0, 0.0]))[:, :3, 3])
    made, _ = proposed(tmp_path, columns)
    assert any("both move with the tool" in question for question in made.open)


@pytest.mark.parametrize("token", ["ERR", "-9999.0", "0.00000000"])
def test_what_stands_where_nothing_was_read(token: str, tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    cells = {name: [f"{v:.8f}" for v in column] for name, column in points(seen(q, rng)).items()}
    for column in cells.values():
        for i in (3, 9):
            column[i] = token
    made, _ = proposed(tmp_path, {**joints(q), **cells})
    assert not made.open
    recording = read(made, tmp_path)
    assert len(recording.readings[0].stamps) == len(q) - 2
    assert any("2 rows were left out" in note for note in recording.warnings)


def test_signals_are_what_changes_and_is_said_of_no_reading(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    extra = {
        "payload_kg": rng.choice([0.0, 5.0], len(q)), "Load [kg]": rng.choice([0.0, 5.0], len(q)), "Pressure [hPa]": 1013.0 + rng.standard_normal(len(q)),
        "rms error": rng.uniform(0.0, 0.1, len(q)), "quality": rng.uniform(0.0, 1.0, len(q)),
        "shift": np.ones(len(q)), "Temp A [°C]": 20.0 + rng.standard_normal(len(q)),
    }  # fmt: skip
    _, entry = proposed(tmp_path, {**joints(q), **points(seen(q, rng)), **extra})
    assert entry["signals"] == {"payload_kg": "payload_kg", "load_kg": "Load [kg]", "pressure": "Pressure [hPa]"}
    assert list(entry["temperature"].values()) == ["Temp A [°C]"]


@pytest.mark.slow
def test_angles_of_a_total_station(tmp_path: Path, rng: np.random.Generator) -> None:
    """Gon, clockwise, from the zenith: as surveyors write them."""
    q = postures(rng)
    p = seen(q, rng)[:, :3, 3] - np.array([-1.0, 4.0, 0.3])
    u = p / np.linalg.norm(p, axis=1, keepdims=True)
    columns = {**joints(q), "Hz": -np.arctan2(u[:, 1], u[:, 0]) * 200.0 / np.pi % 400.0,
               "V": np.arccos(u[:, 2]) * 200.0 / np.pi}  # fmt: skip
    made, entry = proposed(tmp_path, columns)
    assert not made.open
    assert entry["bearing"].items() >= {"unit": "gon", "clockwise": True, "azimuth": "Hz", "zenith": "V"}.items()
    assert np.abs(read(made, tmp_path).readings[0].values - u).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("in", 1.0 / 0.0254)])
def test_distances_and_heights(unit: str, scale: float, tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    p = seen(q, rng)[:, :3, 3]
    d = np.linalg.norm(p - [3.0, 2.0, -1.0], axis=1)
    h = p @ np.array([0.6, 0.0, 0.8]) + 1.0
    made, entry = proposed(tmp_path, {**joints(q), "distance": scale * d, "gauge height": 1e3 * h})
    assert not made.open
    assert (entry["range"]["unit"], entry["plane"]["unit"]) == (unit, "mm")
    kinds = {track.kind: track.values[:, 0] for track in read(made, tmp_path).readings}
    assert np.abs(kinds["range"] - d).max() < 1e-6
    assert np.abs(kinds["touch"] - h).max() < 1e-6


@pytest.mark.parametrize(
    ("text", "coverage", "told"),
    [("Ux (95%)", "2", ""), ("x 2 sigma", "2", ""), ("z k=3 [mm]", "3", "mm"), ("std_x", "", ""),
     ("tau_1_Nm", "", "nm"), ("J1 speed (deg/s)", "", "deg/s"), ("J1 [N·m]", "", "nm"), ("A5", "", "")],
)  # fmt: skip
def test_labels_of_units_and_coverage(text: str, coverage: str, told: str) -> None:
    label = Label.of(text)
    assert (label.coverage, label.told) == (coverage, told)


def test_a_label_that_contradicts_the_motion_is_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    t, q, v = moving(rng)
    speeds = {f"velocity {k} [rad/s]": np.degrees(v[:, k - 1]) for k in range(1, 7)}
    made, _ = proposed(tmp_path, {"t": t, **joints(q), **points(seen(q, rng)), **speeds})
    assert any("the joints' own motion says deg/s" in question for question in made.open)


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
