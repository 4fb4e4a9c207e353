"""Columns beside joints and a pose: what is proposed for them, and what a mapping makes of them.

bench/imports draws whole exports with them; here is what each is decided by.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgs.exported import CHAIN, MIDDLE, joints, named, postures, seen, written

from modcal_core.geometry import se3
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.tables import import_tables, read_tables
from modcal_msgs_py.tables.labels import Label
from modcal_msgs_py.tables.propose import Proposal, find


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


def test_commanded_joints_in_another_unit(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    wanted = q + 1e-3 * rng.standard_normal(q.shape)
    made, entry = proposed(
        tmp_path, {**joints(q), **points(seen(q, rng)), **named("cmd1 cmd2 cmd3 cmd4 cmd5 cmd6", np.degrees(wanted))}
    )
    assert entry["joints"]["commanded"]["unit"] == "deg"
    commanded = read_tables(dict(made.mapping), tmp_path, "m").commanded
    assert commanded is not None
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
    assert stated is not None
    assert np.allclose(stated[:, 0], np.linalg.norm(s, axis=1), rtol=1e-3)


def test_targets_on_one_tool_are_its_pose_and_a_nest_is_none(tmp_path: Path, rng: np.random.Generator) -> None:
    q = postures(rng)
    T = seen(q, rng)
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
    stated = {k: entry["bearing"].get(k) for k in ("unit", "clockwise", "azimuth", "zenith")}
    assert stated == {"unit": "gon", "clockwise": True, "azimuth": "Hz", "zenith": "V"}
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
