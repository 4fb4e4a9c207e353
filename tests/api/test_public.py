"""The public API: what it names, what importing it loads, what its values promise; and samples from arrays."""

from __future__ import annotations

import ast
import inspect
import json
import os
import pkgutil
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cells import record, ur10

import modcal
import modcal_core
from modcal_core.errors import BadRecording, BadRobot, BadTable, MissingDriver, ModcalError, NotEnoughData, NotPlannable
from modcal_core.geometry.read_only import arrays_in
from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "ur10_cell"
URDF = ROOT / "examples" / "robots" / "ur10.urdf"


@pytest.fixture(scope="module")
def made() -> modcal.Result:
    """A calibration from arrays, whose truth is MuJoCo's."""
    cell = record(seed=11, count=60, kind="pose")
    samples = modcal.Samples.from_arrays(cell.samples.q, poses=_matrices(cell.samples), names=ur10().names)
    return modcal.calibrate(modcal.Robot.from_urdf(URDF, tip="tool0"), samples, geometry_only=True)


def _matrices(samples: modcal.Samples) -> np.ndarray:
    T = np.tile(np.eye(4), (len(samples), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = samples.R, samples.reading
    return T


# names


def test_every_public_name_is_there_and_documented() -> None:
    assert set(modcal_core.__all__) < set(modcal.__all__) <= set(dir(modcal))
    for name in modcal.__all__:
        one = getattr(modcal, name)
        if name != "__version__":
            assert inspect.getdoc(one), name
            assert getattr(modcal_core, name, one) is one


def test_type_checkers_see_the_names_that_are_imported_late() -> None:
    source = ast.parse(inspect.getsource(modcal_core))
    (only,) = [n for n in source.body if isinstance(n, ast.If)]
    seen = {alias.name for n in only.body if isinstance(n, ast.ImportFrom) for alias in n.names}
    assert seen == set(modcal_core.__all__)


def test_no_public_name_is_that_of_a_module() -> None:
    """Importing the module would put it in the place of the public name."""
    modules = {module.name for module in pkgutil.iter_modules(modcal_core.__path__)}
    assert not modules & set(modcal_core.__all__)


@pytest.mark.parametrize("module", ["modcal", "modcal_core"])
def test_importing_is_quick_and_loads_neither_scipy_nor_ros(module: str) -> None:
    program = (
        f"import sys; import numpy; before = set(sys.modules); import {module}; "
        "print(*sorted({m.partition('.')[0] for m in set(sys.modules) - before}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert module in loaded
    assert not {m for m in loaded - set(sys.stdlib_module_names) if not m.startswith("modcal")}


@pytest.mark.slow
def test_calibrating_arrays_needs_numpy_and_scipy_only() -> None:
    """A Delta has no URDF, so that not even what reads one is loaded."""
    program = """
import sys
for name in ("lxml", "yaml", "jinja2", "matplotlib", "click", "rich", "mcap", "rosbags", "rclpy"):
    sys.modules[name] = None
import numpy as np
import modcal_core as modcal
robot = modcal.Robot.delta(["a", "b", "c"], 0.12, 0.2, 0.46)
q = np.random.default_rng(0).uniform(0.0, 0.9, (60, 3))
p = robot.forward(q + 1e-3)[:, :3, 3]
result = modcal.calibrate(robot, modcal.Samples.from_arrays(q, points=p), geometry_only=True)
print(result.report.size_mm("final").rms)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 0.05


# values


@pytest.mark.slow
def test_arrays_of_public_values_are_read_only(made: modcal.Result) -> None:
    door = np.c_[np.cos(np.linspace(0, 1, 30)), np.sin(np.linspace(0, 1, 30)), np.zeros(30)]
    track = modcal.Track.from_arrays(points=door)
    values = {
        "result": made,
        "report": modcal.evaluate(made.calibration, made.samples),
        "robot": made.robot,
        "delta": modcal.Robot.delta(["a", "b", "c"], 0.12, 0.2, 0.46),
        "samples": made.samples.select(np.arange(5)),
        "joined": made.samples.join(made.samples),
        "track": track,
        "choice": modcal.articulate(track),
        "plan": modcal.plan(made.robot, stations=14, reading="pose"),
        "bag": modcal.read_bag(BAG).samples(made.robot),
    }
    for name, value in values.items():
        found = arrays_in(value)
        assert found, name
        assert not [a.shape for a in found if a.flags.writeable], name


def test_what_is_given_is_copied() -> None:
    q, p = np.random.default_rng(0).uniform(-1, 1, (20, 6)), np.ones((20, 3))
    samples = modcal.Samples.from_arrays(q, points=p)
    q[:], p[:] = 0.0, 0.0
    assert samples.q.any()
    assert samples.reading.all()
    assert q.flags.writeable


def test_public_values_are_frozen(made: modcal.Result) -> None:
    for value in (made, made.report, made.calibration, made.robot, made.samples):
        assert is_dataclass(value)
        with pytest.raises(AttributeError):
            setattr(value, fields(value)[0].name, None)


def test_the_report_prints_what_the_command_shows(made: modcal.Result) -> None:
    text = str(made.report)
    assert f"{made.report.size_mm('final').rms:.3f}" in text
    assert made.report.verdict in text
    assert "account of the squared error" in text


def test_a_calibration_predicts_what_mujoco_does(made: modcal.Result, tmp_path: Path) -> None:
    cell = record(seed=11, count=60, kind="pose")
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 6))
    truth = cell.world.tool_in_tracker(q)
    nominal = made.calibration.nominal.predict(q)
    again = modcal.Calibration.load(made.calibration.save(tmp_path / "c.yaml"))
    off = np.linalg.norm(again.predict(q)[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(off**2)) < 5e-5
    assert np.sqrt(np.mean(off**2)) < 0.05 * np.sqrt(np.mean(np.sum((nominal - truth)[:, :3, 3] ** 2, axis=1)))
    assert np.array_equal(again.predict(q), made.calibration.predict(q))
    assert set(again.T_frame_base) == set(again.frames) == {"tracker"}


def test_a_prediction_names_the_driver_that_it_lacks(made: modcal.Result) -> None:
    from dataclasses import replace

    from modcal_core.effects.effect import Effect
    from modcal_core.effects.shapes import Shape

    warm = Effect("thermal", "elbow_joint", "axis", "temperature:elbow", Shape("linear")).started(np.ones(1))
    model = made.calibration.calibrated.with_effects((warm,))
    heated = replace(made.calibration, calibrated=model)
    with pytest.raises(MissingDriver, match="temperature:elbow"):
        heated.predict(made.samples.q)
    kept = modcal.Samples.from_arrays(
        made.samples.q,
        points=np.zeros((len(made.samples), 3)),
        temperatures={"elbow": np.full(len(made.samples), 0.001)},
    )
    assert heated.predict(kept).shape == (len(kept), 4, 4)


# one way for library and command


@pytest.mark.slow
def test_the_report_is_that_of_the_command(tmp_path: Path) -> None:
    assert run(["calibrate", str(BAG), "--seed", "3", "--geometry-only", "--out", str(tmp_path / "verb")]) == 0
    bag = modcal.read_bag(BAG)
    robot = bag.robot()
    result = modcal.calibrate(robot, bag.samples(robot), seed=3, geometry_only=True)
    folder = result.save(tmp_path / "api")
    names = sorted(path.name for path in (tmp_path / "verb").iterdir())
    assert names == sorted(path.name for path in folder.iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / "verb" / name).read_bytes(), name
    assert json.loads((folder / "report.json").read_text()) == result.report.to_data()


@pytest.mark.slow
def test_the_evaluation_is_that_of_the_command(tmp_path: Path) -> None:
    bag = modcal.read_bag(BAG)
    robot = bag.robot()
    bag.samples(robot)
    result = modcal.calibrate(robot, bag.samples(robot), geometry_only=True)  # a bag may be read again
    result.save(tmp_path / "made", page=False)
    arguments = ["evaluate", str(tmp_path / "made"), str(BAG), "--refit-tool", "--out", str(tmp_path / "verb")]
    assert run(arguments) == 0
    report = modcal.evaluate(modcal.Calibration.load(tmp_path / "made"), bag.samples(robot), refit_tool=True)
    report.save(tmp_path / "api", page=False)
    assert (tmp_path / "api" / "report.json").read_bytes() == (tmp_path / "verb" / "report.json").read_bytes()


# robots


def test_robots_of_all_kinds(tmp_path: Path) -> None:
    urdf = modcal.Robot.from_urdf(URDF, tip="tool0")
    assert urdf.n == 6
    assert urdf.inertias is not None
    text = modcal.Robot.from_urdf(URDF.read_text(), tip="tool0")
    assert text.names == urdf.names
    table = modcal.Robot.from_dh(ROOT / "examples" / "robots" / "ur5.yaml")
    delta = modcal.Robot.from_delta(ROOT / "examples" / "robots" / "delta.yaml")
    from modcal_core.robots.tables import to_table

    cpc = modcal.Robot.from_cpc(to_table(urdf.chain, "cpc"))
    q = np.random.default_rng(0).uniform(-1, 1, (7, 6))
    assert np.allclose(cpc.forward(q), urdf.forward(q), atol=1e-9)
    assert table.description is not None
    assert np.allclose(modcal.Robot.from_urdf(table.description).forward(q), table.forward(q), atol=1e-9)
    for robot in (urdf, table, cpc, delta):
        low, high = np.maximum(robot.limits[0], -2), np.minimum(robot.limits[1], 2)
        posture = low + np.linspace(0.4, 0.55, robot.n) * (high - low)
        T = robot.forward(posture)
        assert np.allclose(robot.forward(robot.inverse(T, near=posture)), T, atol=1e-8)


@pytest.mark.slow
def test_a_robot_refuses_what_it_cannot_be_asked() -> None:
    robot = modcal.Robot.from_urdf(URDF, tip="tool0")
    with pytest.raises(BadRobot, match=r"shape \(3,\)"):
        robot.forward([0.0, 1.0, 2.0])
    with pytest.raises(BadRobot, match="4, 4"):
        robot.inverse(np.eye(3))
    delta = modcal.Robot.delta(["a", "b", "c"], 0.12, 0.2, 0.46)
    with pytest.raises(BadRobot, match="is a Delta"):
        _ = delta.chain
    with pytest.raises(NotPlannable, match="needs at least"):
        modcal.plan(delta, stations=5)


def test_tolerances_are_checked_before_anything_is_computed(made: modcal.Result) -> None:
    with pytest.raises(BadTable, match="p99"):
        modcal.calibrate(made.robot, made.samples, tolerance_mm=0.1, tolerance_of="p99")
    report = modcal.evaluate(made.calibration, made.samples, tolerance_mm=50.0)
    assert report.tolerance.result == "CANNOT TELL"  # these samples are what it was fitted to


def test_refusals_of_samples(made: modcal.Result) -> None:
    q, p = np.array(made.samples.q), np.array(made.samples.reading)
    with pytest.raises(BadRecording, match="degrees"):
        modcal.calibrate(made.robot, modcal.Samples.from_arrays(np.degrees(q), points=p))
    with pytest.raises(BadRecording, match="millimetres"):
        modcal.calibrate(made.robot, modcal.Samples.from_arrays(q, points=1e3 * p))
    with pytest.raises(BadRecording, match="6 joints"):
        modcal.calibrate(made.robot, modcal.Samples.from_arrays(q[:, :5], points=p))
    with pytest.raises(BadRecording, match="shoulder_pan_joint"):
        modcal.calibrate(made.robot, modcal.Samples.from_arrays(q, points=p, names=list("abcdef")))
    with pytest.raises(NotEnoughData):
        modcal.calibrate(made.robot, modcal.Samples.from_arrays(q[:8], points=p[:8]))


def test_columns_go_by_name(made: modcal.Result) -> None:
    order = [3, 1, 5, 0, 2, 4]
    T = _matrices(made.samples)
    names = [made.robot.names[i] for i in order]
    samples = modcal.Samples.from_arrays(made.samples.q[:, order], poses=T, names=names)
    again = modcal.calibrate(made.robot, samples, geometry_only=True)
    assert again.samples.names == made.robot.names
    for stage, size in made.report.to_data()["error_mm"].items():
        assert again.report.to_data()["error_mm"][stage]["rms"] == pytest.approx(size["rms"], rel=1e-6), stage


@pytest.mark.slow
def test_no_ros_is_asked_for(tmp_path: Path) -> None:
    """The five lines, and verbs, with ROS barred; a verb that needs it says so in one line."""
    program = """
import sys
for name in ("rclpy", "rcl_interfaces", "sensor_msgs", "std_msgs", "ament_index_python"):
    sys.modules[name] = None
from modcal_nodes.cli.main import run
assert run(["info", sys.argv[1]]) == 0
assert run(["simulate", sys.argv[2], "--out", "cell", "-p", "stations=8"]) == 0
sys.exit(run(["watch"]))
"""
    command = [sys.executable, "-c", program, str(BAG), str(URDF)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 2, done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith("modcal: watch: needs rclpy")
    assert "ROS 2" in line


N = 20
Q = np.linspace(-1.0, 1.0, N * 3).reshape(N, 3)
P = np.linspace(0.0, 1.0, N * 3).reshape(N, 3)


def test_rows_without_stamps_are_stations_in_order() -> None:
    samples = modcal.Samples.from_arrays(Q, points=P, sigma=2e-5)
    assert len(samples) == samples.stations == N
    assert samples.names == ()
    assert not samples.clock
    assert np.array_equal(samples.q, Q)
    assert np.array_equal(samples.reading, P)
    assert (samples.sigma_position == 2e-5).all()
    assert np.array_equal(samples.approach[1:], np.ones((N - 1, 3)))  # from the row before
    assert not samples.moving.any()


def test_a_log_of_a_moving_arm_is_cut_into_dwells() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    course = np.interp(t % 5.0 + 5.0 * (t // 5.0), [0, 3, 5, 8, 10, 13, 15, 18, 20], [0, 0, 1, 1, 2, 2, 3, 3, 3])
    q = course[:, None] * np.ones(3)
    samples = modcal.Samples.from_arrays(q, points=q + 1.0, stamps=t)
    assert samples.stations == 4
    assert np.allclose(samples.q[:, 0], [0, 1, 2, 3], atol=1e-3)
    assert samples.clock


def test_poses_in_either_form() -> None:
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(P)
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
    one = modcal.Samples.from_arrays(Q, poses=T)
    two = modcal.Samples.from_arrays(Q, poses=np.c_[P, R.as_quat()])
    assert np.allclose(one.R, two.R, atol=1e-12)
    assert np.allclose(one.R, R.as_matrix(), atol=1e-12)
    assert one.kinds == two.kinds == ("pose",)


class Frame(dict[str, np.ndarray]):
    """As much of a DataFrame as is asked for; pandas is not needed."""

    columns = property(lambda self: list(self))

    def __getitem__(self, key: str | list[str]) -> Any:
        values = (
            dict.__getitem__(self, key) if isinstance(key, str) else np.stack([self[k].values for k in key], axis=1)
        )
        return SimpleNamespace(values=values, to_numpy=lambda kind: values.astype(kind))


def test_a_frame_there_and_back(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = np.tile([0.0, 0.6, 0.0, 0.8], (N, 1))
    table = Frame(
        zip(
            ["a", "b", "c", "x", "y", "z", "i", "j", "k", "r", "t", "s"],
            np.c_[Q, P, turns, 10.0 * np.arange(N), np.full(N, 3e-5)].T,
            strict=True,
        )
    )
    joints, pose = ["a", "b", "c"], ["x", "y", "z", "i", "j", "k", "r"]
    samples = modcal.Samples.from_frame(table, joints, pose, stamps="t", sigma="s", frame="left")
    assert (samples.names, samples.frames, samples.clock) == (("a", "b", "c"), ("left",), True)
    assert (samples.sigma_position == 3e-5).all()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    again = samples.to_frame()
    assert list(again) == [*joints, "stamp", "station", "frame", "kind", "x", "y", "z", "qx", "qy", "qz", "qw"]
    assert np.array_equal(np.stack([again[k] for k in joints], axis=1), Q)
    assert np.allclose(np.abs(again["qy"]), 0.6, atol=1e-12)
    with pytest.raises(BadRecording, match="column 'd': is not in the frame: choose among a, b"):
        modcal.Samples.from_frame(table, ["d"], pose)


def test_ranges_to_anchors_with_gaps() -> None:
    near = np.linspace(1.0, 2.0, N)
    near[3] = np.nan
    samples = modcal.Samples.from_arrays(Q, ranges={"a": near, "b": np.linspace(2.0, 3.0, N)})
    assert samples.frames == ("a", "b")
    assert [(samples.frame == f).sum() for f in (0, 1)] == [N - 1, N]
    assert samples.stations == N
    assert samples.kinds == ("range",)


def test_drivers_travel_along() -> None:
    samples = modcal.Samples.from_arrays(
        Q, points=P, stamps=100.0 + 10.0 * np.arange(N), temperatures={"elbow": np.arange(N)},
        signals={"pressure": np.ones(N)}, efforts=2.0 * Q, frame="laser",
    )  # fmt: skip
    assert [track.name for track in samples.signals] == ["temperature:elbow", "signal:pressure"]
    assert np.allclose(samples.effort, 2.0 * Q, atol=1e-12)
    assert samples.frames == ("laser",)
    assert samples.origin.began == 100.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({}, "none of points, poses and ranges"),
        ({"points": P, "poses": np.tile(np.eye(4), (N, 1, 1))}, "points and poses are given"),
        ({"points": P[:5]}, "points"),
        ({"points": P[:, :2]}, r"not \(20, 3\)"),
        ({"poses": np.ones((N, 7))}, "quaternion of row 0"),
        ({"poses": np.ones((N, 4, 4))}, "not a rotation matrix"),
        ({"points": P, "names": ["a", "b"]}, "2 names for 3 columns"),
        ({"points": P, "names": ["a", "b", "b"]}, "2 names for 3 columns"),
        ({"points": P, "stamps": np.zeros(N)}, "do not increase at row 1"),
        ({"points": P, "sigma": -1.0}, "sigma"),
        ({"points": P, "sigma": np.ones(3)}, "sigma"),
        ({"points": P, "efforts": np.ones((N, 2))}, "efforts"),
        ({"points": P, "temperatures": {"x": np.full(N, np.nan)}}, "temperature x, row 0"),
        ({"points": P, "q": np.where(np.arange(N)[:, None] == 7, np.nan, Q)}, "q, row 7"),
        ({"points": P, "q": "abc"}, "not an array of numbers"),
        ({"points": np.full((N, 3), np.nan)}, "no reading that is finite"),
        ({"q": np.empty((0, 3)), "points": np.empty((0, 3))}, "hold no row"),
    ],
)
def test_what_does_not_fit_together_is_refused(arguments: dict[str, object], said: str) -> None:
    with pytest.raises(ModcalError, match=said):
        modcal.Samples.from_arrays(**{"q": Q, **arguments})  # type: ignore[arg-type]


def test_a_track_takes_matrices_and_refuses_both() -> None:
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, 3] = P
    assert np.array_equal(modcal.Track.from_arrays(poses=T).positions, P)
    with pytest.raises(BadRecording, match="points and poses"):
        modcal.Track.from_arrays(points=P, poses=T)
    with pytest.raises(BadRecording, match="neither"):
        modcal.Track.from_arrays()
