"""The calibrator in a real cell: what a user meets, one process and one domain a test."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import record, samples_of
from cli.recordings import START, URDF
from nodes.cell import BEST_EFFORT, LATCHED, PlayedCell, Said, Wait, call
from nodes.processes import SLOWER, Process, fresh_domain, listener, running
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import Trigger

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.robots.urdf import read_chain
from modcal_nodes.inputs import read_calibration

pytestmark = pytest.mark.dds
STATIONS = 48
HEARING, MODEL, SAMPLES = (f"/calibrator: {part}" for part in ("hearing", "model", "samples"))
PANDA = URDF.with_name("panda.urdf")


def stations(count: int = STATIONS, seed: int = 1, begin: float = START, bump: Array | None = None) -> Recording:
    """Finished stations of one displaced arm: a joint state and a pose of the same stamp, two seconds apart."""
    cell = record(seed, count)
    T = se3.transform(cell.samples.R, cell.samples.position)
    made = samples_of(cell.world.nominal, cell.samples.q, T if bump is None else T @ bump)
    t = begin + 2.0 * np.arange(count)
    unknown = np.full_like(made.q, np.nan)
    poses = se3.to_pose(se3.transform(made.R, made.position))
    return Recording(
        (JointTrack(made.names, t, made.q, unknown, unknown, t),), (ReadingTrack("pose", "tracker", t, poses, t),)
    )


def part(recording: Recording, rows: slice) -> Recording:
    joints, reading = recording.joints[0], recording.readings[0]
    joints = replace(
        joints, **{k: getattr(joints, k)[rows] for k in ("stamps", "position", "velocity", "effort", "received")}
    )
    reading = replace(reading, **{k: getattr(reading, k)[rows] for k in ("stamps", "values", "received")})
    return replace(recording, joints=(joints,), readings=(reading,))


@contextlib.contextmanager
def beside_a_cell(
    folder: Path, urdf: Path = URDF, **parameters: Any
) -> Iterator[tuple[Process, Node, Wait, PlayedCell, Said]]:
    """A calibrator that has found a cell and heard its description; it must end well."""
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, folder, **parameters)
    with running(calibrator), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Said(node)
        wait(cell.heard, 60.0)
        cell.describe(urdf.read_text())
        yield calibrator, node, wait, cell, said
        assert calibrator.stop() == 0


class Shared:
    """One calibrator for the tests that need nothing special of it. Each begins with nothing heard, and later stamps."""

    def __init__(self, calibrator: Process, node: Node, wait: Wait, cell: PlayedCell, said: Said, out: Path) -> None:
        self.calibrator, self.node, self.wait, self.cell, self.said, self.out = calibrator, node, wait, cell, said, out
        self._begin = START

    def again(self) -> float:
        """The stamp [s] to begin at."""
        shutil.rmtree(self.out, ignore_errors=True)
        assert call(self.node, self.wait, "calibrator/reset").success
        self._begin += 10_000.0
        return self._begin

    def counted(self, what: str) -> int:
        """A count that the calibrator keeps of its samples."""
        return int(self.said.value(SAMPLES, what) or 0)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    folder = tmp_path_factory.mktemp("shared")
    # what the model of one test makes of the next one's stations must not start a solve by itself
    with beside_a_cell(folder, effects=False, after_change=0, out=folder / "out") as made:
        yield Shared(*made, folder / "out")


def latched(node: Any, topic: str, kind: type = String) -> list[Any]:
    heard: list[Any] = []
    node.create_subscription(kind, topic, lambda m: heard.append(m.data), LATCHED)
    return heard


def test_a_solve_is_published_kept_and_gone_on_with_after_a_restart(tmp_path: Path) -> None:
    domain, whole = fresh_domain(), stations(64)
    first = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(first), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Said(node)
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(part(whole, slice(0, 48)))
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: said.value(MODEL, "state") == "trusted", 10.0)
        cell.play(part(whole, slice(48, 56)))
        wait(cell.taken, 60.0)
        assert first.stop() == 0
    kept = read_calibration(tmp_path / "state")

    second = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(second), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Said(node)
        models, trusted = latched(node, "calibrator/calibration"), latched(node, "calibrator/trusted", Bool)
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(part(whole, slice(56, 64)))
        wait(lambda: models and trusted, 20.0)
        assert trusted[-1]
        assert said.value(MODEL, "state") == "trusted" or wait(lambda: said.value(MODEL, "state") == "trusted", 10.0)
        status = json.loads((tmp_path / "state" / "report.json").read_text())["status"]
        wait(lambda: said.value(MODEL, "status") == status, 10.0)
        assert (said.level(MODEL) == 0) == (status == "at_floor")
        # the stations from before the restart are there, too
        assert call(node, wait, "calibrator/solve").success
        assert second.stop() == 0
    assert f"robot: {kept.robot}" in models[0]
    report = json.loads((tmp_path / "state" / "report.json").read_text())
    assert report["recording"]["stations"] == 48


def test_a_saved_model_of_another_robot_is_neither_used_nor_overwritten(tmp_path: Path) -> None:
    domain = fresh_domain()
    first = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(first), listener(domain) as (node, wait):
        cell = PlayedCell(node)
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        assert first.stop() == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "state").iterdir()}
    longer = URDF.read_text().replace("0.612", "0.622")
    assert longer != URDF.read_text()
    second = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(second), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Said(node)
        models = latched(node, "calibrator/calibration")
        wait(cell.heard, 60.0)
        cell.describe(longer)
        cell.play(stations(4))
        wait(lambda: said.level(MODEL) == 2, 20.0)
        assert "other nominal kinematics" in said.text(MODEL)
        assert second.stop() == 0
    assert not models
    assert {p.name: p.read_bytes() for p in (tmp_path / "state").iterdir()} == before


def test_a_bumped_tool_is_noticed_named_and_learned(tmp_path: Path) -> None:
    """By asking: until somebody accepts, the old model stands, marked as one that does not hold."""
    bump = se3.exp(np.array([5e-4, -4e-4, 3e-4, 0.0, 0.0, 0.0]))
    with beside_a_cell(tmp_path, accept="asked", after_change=24) as (_, node, wait, cell, said):
        models, trusted = latched(node, "calibrator/calibration"), latched(node, "calibrator/trusted", Bool)
        changes, before = latched(node, "calibrator/change"), latched(node, "calibrator/residual_before", Float64)
        after = latched(node, "calibrator/residual", Float64)
        cell.play(stations(64))
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        assert not models
        assert not trusted
        assert call(node, wait, "calibrator/accept").success
        wait(lambda: models and trusted, 10.0)
        assert not call(node, wait, "calibrator/accept").success  # there is nothing more
        results = len(after)
        cell.play(stations(96, begin=START + 1000.0, bump=bump))
        wait(lambda: len(after) > results, 60.0)
        wait(lambda: not trusted[-1] and said.level(MODEL) == 1, 20.0)
        change = json.loads(changes[-1])
        assert change["place"] == "tool"
        assert change["size_mm"] == pytest.approx(1e3 * np.linalg.norm(bump[:3, 3]), rel=0.2)
        assert len(models) == 1
        assert before[-1] > 5e-4 > 2e-4 > after[-1]
        assert call(node, wait, "calibrator/accept").success
        wait(lambda: len(models) == 2 and trusted[-1], 10.0)
        report: list[str] = []
        node.create_subscription(String, "calibrator/report", lambda m: report.append(m.data), LATCHED)
        wait(lambda: report, 10.0)
        found = json.loads(report[-1])["effects"]
        assert [(e["family"], e["place"]) for e in found] == [("step", "tool")]


def test_joints_in_any_order_with_others_between_them(shared: Shared) -> None:
    begin = shared.again()

    def shuffled(i: int, message: Any) -> Any:
        if hasattr(message, "name"):
            order = np.random.default_rng(i % 3).permutation(7)
            names, positions = [*message.name, "gripper"], [*message.position, 0.01]
            message.name, message.position = [names[k] for k in order], [positions[k] for k in order]
        return message

    shared.cell.play(stations(begin=begin), shuffled)
    shared.wait(shared.cell.taken, 60.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    report = json.loads((shared.out / "report.json").read_text())
    assert report["recording"]["stations"] == STATIONS
    assert report["error_mm"]["final"]["rms"] < 0.2


def test_any_quality_of_service_is_heard_and_a_mismatch_is_said(tmp_path: Path) -> None:
    """A description that is not latched, a tracker of best effort."""
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, effects=False)
    volatile = QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE)
    with running(calibrator), listener(domain) as (node, wait):
        said = Said(node)
        cell = PlayedCell(node, description=volatile, tracker=BEST_EFFORT)
        wait(
            lambda: (
                "durability does not match" in calibrator.output and "reliability does not match" in calibrator.output
            ),
            60.0,
        )
        wait(cell.heard, 60.0)
        for _ in range(5):
            cell.describe(URDF.read_text())
        cell.play(stations())
        wait(lambda: said.counted("/tracker/pose") >= 40, 30.0)  # some may have been lost
        assert call(node, wait, "calibrator/solve").success
        assert calibrator.stop() == 0


def test_silence_is_said_by_topic(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, silent_s=1.0)
    with running(calibrator), listener(domain) as (node, wait):
        said = Said(node)
        wait(lambda: said.level(HEARING) == 2, 60.0)
        assert "/joint_states: nobody publishes it" in said.text(HEARING)
        assert "/robot_description: nobody publishes it" in said.text(HEARING)
        cell = PlayedCell(node)
        cell.describe(URDF.read_text())
        wait(cell.heard, 60.0)
        one = stations(2)
        wait(lambda: cell.play(one, lambda _, m: m if hasattr(m, "name") else None) or said.level(HEARING) == 1, 30.0)
        assert "nothing heard of the tracker" in said.text(HEARING)
        wait(lambda: cell.play(one) or said.level(HEARING) == 0, 30.0)
        wait(lambda: said.level(HEARING) == 1, 30.0)  # the joints fell silent again
        assert "/joint_states: silent for" in said.text(HEARING)
        assert calibrator.stop() == 0


def test_two_publishers_of_one_arms_joints_are_said(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, effects=False)
    with running(calibrator), listener(domain) as (node, wait):
        said, cells = Said(node), (PlayedCell(node), PlayedCell(node))
        wait(cells[0].heard, 60.0)
        wait(lambda: "/joint_states: 2 publishers at once" in said.text(HEARING), 30.0)
        assert said.level(HEARING) >= 1
        assert calibrator.stop() == 0


def test_a_clock_set_back_begins_a_new_stretch(tmp_path: Path) -> None:
    whole = stations(60)
    with beside_a_cell(tmp_path, effects=False, out=tmp_path / "out") as (_, node, wait, cell, said):
        cell.play(part(whole, slice(0, 30)))
        # the second half at stamps an hour before the first
        later = part(whole, slice(30, 60))
        joints, reading = later.joints[0], later.readings[0]
        back = replace(joints, stamps=joints.stamps - 3600.0), replace(reading, stamps=reading.stamps - 3600.0)
        cell.play(replace(later, joints=(back[0],), readings=(back[1],)))
        wait(cell.taken, 60.0)
        wait(lambda: said.value(SAMPLES, "clock set back") == "1", 20.0)
        assert call(node, wait, "calibrator/solve").success
    # readings overtake the joint state that says that the clock was set back, and are not lost
    assert json.loads((tmp_path / "out" / "report.json").read_text())["recording"]["stations"] == 60


def test_messages_without_a_station_are_left_out_when_they_grow_old(tmp_path: Path) -> None:
    """Half a minute of joint states without a tracker, and then a cell as it should be."""
    with beside_a_cell(tmp_path, effects=False, memory_s=20.0) as (calibrator, node, wait, cell, _):
        cell.play(stations(30), lambda _, m: m if hasattr(m, "name") else None)
        wait(lambda: "some minutes of messages are left out" in calibrator.output, 60.0)
        cell.play(stations(begin=START + 100.0))
        wait(cell.taken, 60.0)
        answer = call(node, wait, "calibrator/solve")
        assert answer.success, answer.message


def test_topics_are_remapped(tmp_path: Path) -> None:
    domain = fresh_domain()
    topics = ("joint_states", "tracker/pose", "robot_description")
    remapped = [word for topic in topics for word in ("-r", f"{topic}:=/hall_3/{topic}")]
    calibrator = Process("calibrator", domain, tmp_path, *remapped, effects=False)
    with running(calibrator), listener(domain) as (node, wait):
        cell = PlayedCell(node, "/hall_3")
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        assert calibrator.stop() == 0


def test_two_robots_in_one_domain(tmp_path: Path) -> None:
    domain = fresh_domain()
    sides = ("left", "right")
    nodes = [
        Process("calibrator", domain, tmp_path, "-r", f"__ns:=/{s}", out=tmp_path / s, effects=False) for s in sides
    ]
    with running(*nodes), listener(domain) as (node, wait):
        cells = [PlayedCell(node, f"/{side}") for side in sides]
        wait(lambda: all(cell.heard() for cell in cells), 60.0)
        for seed, cell in enumerate(cells):
            cell.describe(URDF.read_text())
            cell.play(stations(seed=21 + seed))
            wait(cell.taken, 60.0)
        for side in sides:
            assert call(node, wait, f"/{side}/calibrator/solve").success
        assert [process.stop() for process in nodes] == [0, 0]
    models = [read_calibration(tmp_path / side) for side in sides]
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 6))
    for seed, model in enumerate(models):
        truth = record(21 + seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - truth[:, :3, 3]).max() < 3e-4
        other = record(21 + 1 - seed, 2).world.tool_in_tracker(q)
        assert np.abs(model.calibrated.predict(q)[:, :3, 3] - other[:, :3, 3]).max() > 1e-2


def test_spoiled_messages_are_refused_counted_and_harm_nothing(shared: Shared) -> None:
    begin = shared.again()
    before = shared.counted("messages refused")

    def spoiled(i: int, message: Any) -> Any:
        if hasattr(message, "name") and i % 10 == 3:
            message.position = message.position[:4]  # fewer positions than names
        elif not hasattr(message, "name") and i % 10 == 7:
            return None  # the beam was broken
        return message

    shared.cell.play(stations(60, begin=begin), spoiled)
    shared.wait(shared.cell.taken, 60.0)
    shared.wait(lambda: shared.counted("messages refused") == before + 6, 20.0)
    assert shared.said.level(SAMPLES) == 1
    assert call(shared.node, shared.wait, "calibrator/solve").success
    assert "4 positions for 6 names" in shared.calibrator.output
    assert json.loads((shared.out / "report.json").read_text())["recording"]["stations"] == 48


def spoiling(fault: str) -> Callable[[int, Any], Any]:
    """What makes every message, or one, of a recording useless."""

    def spoiled(i: int, message: Any) -> Any:
        joints = hasattr(message, "name")
        if fault == "nan" and not joints and i == 5:
            message.pose.position.x = float("nan")
        if fault == "millimetres" and not joints:
            at = message.pose.position
            at.x, at.y, at.z = 1e3 * at.x, 1e3 * at.y, 1e3 * at.z
        if fault == "degrees" and joints:
            message.position = [float(np.degrees(p)) for p in message.position]
        return message

    return spoiled


def assert_refused(node: Node, wait: Wait, said: str, out: Path) -> None:
    answer = call(node, wait, "calibrator/solve")
    assert not answer.success
    assert said in answer.message
    assert "\n" not in answer.message
    assert not out.exists()


@pytest.mark.parametrize(
    ("fault", "said"), [("nan", "not a number"), ("millimetres", "millimetres"), ("degrees", "degrees")]
)
def test_what_cannot_be_calibrated_is_refused_in_one_line(fault: str, said: str, shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()), spoiling(fault))
    shared.wait(shared.cell.taken, 60.0)
    assert_refused(shared.node, shared.wait, said, shared.out)


def test_joints_of_another_robot_are_refused_in_one_line(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path, urdf=PANDA, effects=False, out=tmp_path / "out") as (_, node, wait, cell, _):
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert_refused(node, wait, "does not name panda_joint1", tmp_path / "out")


def test_callbacks_keep_up_while_a_solve_runs(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path) as (_, node, wait, cell, said):
        cell.play(stations(150))
        wait(cell.taken, 60.0)
        done: list[Any] = []
        client = node.create_client(Trigger, "calibrator/solve")
        wait(client.service_is_ready, 30.0)
        answer = client.call_async(Trigger.Request())
        answer.add_done_callback(done.append)
        again = client.call_async(Trigger.Request())
        wait(again.done, 10.0)
        if not done:
            assert again.result().message == "a solve is running already"
        heard = 150
        extra = stations(40, seed=1, begin=START + 1000.0)
        while not done:
            cell.play(extra, lambda _, m: m if hasattr(m, "name") else None)
            heard += 40
            wait(lambda: said.value(HEARING, "messages of /joint_states") == str(heard), 10.0)  # noqa: B023
            extra = stations(40, seed=1, begin=START + 1000.0 + 100.0 * heard)
        assert done[0].result().success


def test_a_killed_calibrator_leaves_no_process_behind(tmp_path: Path) -> None:
    calibrator = Process("calibrator", fresh_domain(), tmp_path)
    with running(calibrator):
        children = _eventually(lambda: _children(calibrator.popen.pid), 60.0)
        calibrator.popen.send_signal(signal.SIGKILL)
        calibrator.popen.wait()
        _eventually(lambda: not any(_alive(child) for child in children), 20.0)


def test_a_killed_solver_is_replaced(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path) as (calibrator, node, wait, cell, _):
        cell.play(stations())
        wait(cell.taken, 60.0)
        for child in _children(calibrator.popen.pid):
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                os.kill(child, signal.SIGKILL)
                wait(lambda: not _alive(child), 20.0)  # noqa: B023
        answer = call(node, wait, "calibrator/solve")
        if not answer.success:  # the node had not noticed yet
            answer = call(node, wait, "calibrator/solve")
        assert answer.success, answer.message


def test_reset_forgets_what_was_heard_and_keeps_what_is_trusted(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path, effects=False) as (_, node, wait, cell, said):
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        assert not call(node, wait, "calibrator/save").success  # there is no folder to save in
        assert call(node, wait, "calibrator/reset").success
        answer = call(node, wait, "calibrator/solve")
        assert not answer.success
        assert "nothing was heard" in answer.message
        wait(lambda: said.value(MODEL, "state") == "trusted", 10.0)


def test_an_unwritable_folder_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with beside_a_cell(tmp_path, effects=False, out=tmp_path / "file") as (_, node, wait, cell, _):
        cell.play(stations())
        wait(cell.taken, 60.0)
        answer = call(node, wait, "calibrator/solve")
        assert not answer.success
        assert "file: is a file" in answer.message


def test_the_running_estimate_is_published(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path, effects=False) as (_, node, wait, cell, _):
        estimates: list[Any] = []
        node.create_subscription(Float64MultiArray, "calibrator/estimate", estimates.append, 10)
        names = latched(node, "calibrator/estimate_names")
        cell.play(stations(60))
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: estimates and names, 10.0)
        std = np.array(estimates[-1].data).reshape(2, -1)[1]
        cell.play(stations(200, begin=START + 500.0, seed=1))
        wait(lambda: np.array(estimates[-1].data).reshape(2, -1)[1].max() < 0.8 * std.max(), 20.0)
        assert len(names[-1].split("\n")) == len(std)
    chain = read_chain(URDF.read_text())
    assert any(name.startswith(chain.names[2]) for name in names[-1].split("\n"))


def _children(pid: int) -> list[int]:
    """Processes of the workshop: those a process has started, resource trackers included."""
    try:
        return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _eventually(condition: Any, seconds: float) -> Any:
    end = time.monotonic() + SLOWER * seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds} s in vain")
