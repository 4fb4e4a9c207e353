"""The calibrator in a real cell: what it hears and what it refuses. See test_calibrator_learns.py, test_calibrator_topics.py."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import START, URDF
from nodes.beside_a_cell import HEARING, MODEL, PANDA, SAMPLES, STATIONS, beside_a_cell, part, stations
from nodes.cell import PlayedCell, Said, Wait, call
from nodes.processes import Process, fresh_domain, listener, running
from rclpy.node import Node

from modcal_core.measurements.dropouts import ALONE, BEYOND, ELSEWHEN, IMPLAUSIBLE

pytestmark = pytest.mark.dds


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
    assert (shared.out / "report.html").is_file()


def test_silence_is_said_by_topic(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, silence_timeout_s=1.0)
    with running(calibrator), listener(domain) as (node, wait):
        said = Said(node)
        wait(lambda: said.level(HEARING) == 2, 60.0)
        assert "/joint_states: no node publishes it" in said.text(HEARING)
        assert "/robot_description: no node publishes it" in said.text(HEARING)
        cell = PlayedCell(node)
        cell.describe(URDF.read_text())
        wait(cell.heard, 60.0)
        one = stations(2)
        wait(lambda: cell.play(one, lambda _, m: m if hasattr(m, "name") else None) or said.level(HEARING) == 1, 30.0)
        assert "no message from the tracker" in said.text(HEARING)
        wait(lambda: cell.play(one) or said.level(HEARING) == 0, 30.0)
        wait(lambda: said.level(HEARING) == 1, 30.0)  # the joints fell silent again
        assert "/joint_states: silent for" in said.text(HEARING)
        assert calibrator.stop() == 0


def test_a_clock_set_back_begins_a_new_stretch(shared: Shared) -> None:
    begin = shared.again()
    whole, before = stations(60, begin=begin), shared.counted("clock set back")
    shared.cell.play(part(whole, slice(0, 30)))
    # the second half at stamps an hour before the first
    later = part(whole, slice(30, 60))
    joints, reading = later.joints[0], later.readings[0]
    back = replace(joints, stamps=joints.stamps - 3600.0), replace(reading, stamps=reading.stamps - 3600.0)
    shared.cell.play(replace(later, joints=(back[0],), readings=(back[1],)))
    shared.wait(shared.cell.taken, 60.0)
    shared.wait(lambda: shared.counted("clock set back") == before + 1, 20.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    # readings overtake the joint state that says that the clock was set back, and are not lost
    assert json.loads((shared.out / "report.json").read_text())["recording"]["stations"] == 60


def test_messages_without_a_station_are_left_out_when_they_grow_old(tmp_path: Path) -> None:
    """Half a minute of joint states without a tracker, and then a cell as it should be."""
    with beside_a_cell(tmp_path, effects=False, buffer_s=20.0) as (calibrator, node, wait, cell, _):
        cell.play(stations(30), lambda _, m: m if hasattr(m, "name") else None)
        wait(lambda: "some minutes of messages are left out" in calibrator.output, 60.0)
        cell.play(stations(begin=START + 100.0))
        wait(cell.taken, 60.0)
        answer = call(node, wait, "calibrator/solve")
        assert answer.success, answer.message


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
        if fault == "cannot be":
            _cannot_be(message, i, joints)
        if fault == "millimetres" and not joints:
            at = message.pose.position
            at.x, at.y, at.z = 1e3 * at.x, 1e3 * at.y, 1e3 * at.z
        if fault == "degrees" and joints:
            message.position = [float(np.degrees(p)) for p in message.position]
        return message

    return spoiled


def _cannot_be(message: Any, i: int, joints: bool) -> None:
    """One of each."""
    if joints and i == 9:
        message.position[2] = 1e9
    elif joints and i == 14:
        message.header.stamp.sec = 0
    elif not joints and i == 20:
        message.pose.position.y = 1e16
    elif not joints and i == 25:
        message.pose.orientation.x, message.pose.orientation.w = 0.3, 0.0
        message.pose.orientation.y = message.pose.orientation.z = 0.0
    elif not joints and i == 31:
        message.header.stamp.sec = 2**31 - 1


def assert_refused(node: Node, wait: Wait, said: str, out: Path) -> None:
    answer = call(node, wait, "calibrator/solve")
    assert not answer.success
    assert said in answer.message
    assert "\n" not in answer.message
    assert not out.exists()


def test_a_reading_that_is_not_finite_is_left_out_and_said(shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()), spoiling("nan"))
    shared.wait(shared.cell.taken, 60.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    report = json.loads((shared.out / "report.json").read_text())
    assert report["recording"]["stations"] == STATIONS - 1
    assert any("finite" in note and "1 of 48" in note for note in report["notes"]), report["notes"]
    assert report["recording"]["dropped"] == {"readings that are not finite": 1}


def test_messages_that_cannot_be_are_left_out_counted_and_said_as_of_a_bag(shared: Shared) -> None:
    begin = shared.again()
    refused = int(shared.said.value(SAMPLES, "messages refused") or 0)
    shared.cell.play(stations(begin=begin), spoiling("cannot be"))
    shared.wait(shared.cell.taken, 60.0)
    assert call(shared.node, shared.wait, "calibrator/solve").success
    report = json.loads((shared.out / "report.json").read_text())
    assert report["recording"]["stations"] == STATIONS - 5
    assert report["recording"]["dropped"] == {
        BEYOND: 1,
        f"joint states {ELSEWHEN}": 1,
        f"readings {ELSEWHEN}": 1,
        IMPLAUSIBLE: 2,
        ALONE: 2,  # whose joint states were left out
    }
    assert sum("left out" in note for note in report["notes"]) == 4
    shared.wait(lambda: int(shared.said.value(SAMPLES, "messages refused")) == refused + 5, 10.0)


@pytest.mark.parametrize(("fault", "said"), [("millimetres", "millimetres"), ("degrees", "degrees")])
def test_what_cannot_be_calibrated_is_refused_in_one_line(fault: str, said: str, shared: Shared) -> None:
    shared.cell.play(stations(begin=shared.again()), spoiling(fault))
    shared.wait(shared.cell.taken, 60.0)
    assert_refused(shared.node, shared.wait, said, shared.out)


def test_joints_of_another_robot_are_refused_in_one_line(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path, urdf=PANDA, effects=False, out=tmp_path / "out") as (_, node, wait, cell, _):
        cell.play(stations())
        wait(cell.taken, 60.0)
        assert_refused(node, wait, "does not name panda_joint1", tmp_path / "out")


def test_reset_forgets_what_was_heard_and_keeps_what_is_trusted(shared: Shared) -> None:
    node, wait = shared.node, shared.wait
    shared.cell.play(stations(begin=shared.again()))
    wait(shared.cell.taken, 60.0)
    assert call(node, wait, "calibrator/solve").success
    assert not call(node, wait, "calibrator/save").success  # there is no folder to save in
    assert call(node, wait, "calibrator/reset").success
    answer = call(node, wait, "calibrator/solve")
    assert not answer.success
    assert "no message was received" in answer.message
    wait(lambda: shared.said.value(MODEL, "state") == "trusted", 10.0)


def test_an_unwritable_folder_is_said(shared: Shared) -> None:
    begin = shared.again()
    shared.out.write_text("in the way")
    shared.cell.play(stations(begin=begin))
    shared.wait(shared.cell.taken, 60.0)
    answer = call(shared.node, shared.wait, "calibrator/solve")
    shared.out.unlink()
    assert not answer.success
    assert "out: is a file" in answer.message
