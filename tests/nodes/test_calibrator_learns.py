"""The calibrator in a real cell: what it keeps over a restart, learns of a change, and does while its solver works."""

from __future__ import annotations

import json
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import START, URDF
from nodes.beside_a_cell import HEARING, MODEL, alive, beside_a_cell, children, latched, part, stations
from nodes.cell import PlayedCell, call
from nodes.processes import SLOWER, Process, fresh_domain, listener, running
from nodes.talking import LATCHED, Diagnostics
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import Trigger

from modcal_core.geometry import se3
from modcal_core.robots.urdf import read_chain
from modcal_nodes.io.inputs import read_calibration

pytestmark = pytest.mark.dds


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state of a calibrator that has solved 48 stations, heard 8 more, and ended; tests take a copy of it."""
    folder = tmp_path_factory.mktemp("saved")
    domain, whole = fresh_domain(), stations(64)
    first = Process("calibrator", domain, folder, effects=False, state=folder / "state")
    with running(first), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(part(whole, slice(0, 48)))
        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: said.value(MODEL, "state") == "trusted", 10.0)
        cell.play(part(whole, slice(48, 56)))
        wait(cell.taken, 60.0)
        assert first.stop() == 0
    return folder / "state"


def test_a_solve_is_published_kept_and_gone_on_with_after_a_restart(saved: Path, tmp_path: Path) -> None:
    shutil.copytree(saved, tmp_path / "state")
    domain, whole = fresh_domain(), stations(64)
    kept = read_calibration(tmp_path / "state")

    second = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(second), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        models, trusted = latched(node, "calibrator/calibration"), latched(node, "calibrator/trusted", Bool)
        names, estimates = latched(node, "calibrator/estimate_names"), list[Any]()
        node.create_subscription(Float64MultiArray, "calibrator/estimate", estimates.append, 10)
        wait(cell.heard, 60.0)
        cell.describe(URDF.read_text())
        cell.play(part(whole, slice(56, 64)))
        wait(lambda: models and trusted and trusted[-1], 20.0)  # it says no until it knows the arm
        assert said.value(MODEL, "state") == "trusted" or wait(lambda: said.value(MODEL, "state") == "trusted", 10.0)
        status = json.loads((tmp_path / "state" / "report.json").read_text())["status"]
        wait(lambda: said.value(MODEL, "status") == status, 10.0)
        assert (said.level(MODEL) == 0) == (status == "at_floor")
        # the stations from before the restart are there, too
        assert call(node, wait, "calibrator/solve").success
        report = json.loads((tmp_path / "state" / "report.json").read_text())
        # what follows makes the running estimate surer
        wait(lambda: estimates and names, 10.0)
        std = np.array(estimates[-1].data).reshape(2, -1)[1]
        assert len(names[-1].split("\n")) == len(std)
        assert any(name.startswith(read_chain(URDF.read_text()).names[2]) for name in names[-1].split("\n"))
        cell.play(stations(200, begin=START + 500.0))
        wait(lambda: np.array(estimates[-1].data).reshape(2, -1)[1].max() < 0.8 * std.max(), 20.0)
        assert second.stop() == 0
    assert f"robot: {kept.robot}" in models[0]
    assert report["recording"]["stations"] == 48


def test_ten_stations_say_what_has_changed_since_the_saved_model(saved: Path, tmp_path: Path) -> None:
    shutil.copytree(saved, tmp_path / "state")
    domain = fresh_domain()
    bump = se3.exp(np.array([5e-4, -4e-4, 3e-4, 0.0, 0.0, 0.0]))
    # a change is not followed up by itself, so that the worker is free for the check
    again = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state", after_change=0)
    with running(again), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        checked = latched(node, "calibrator/checked")
        wait(cell.heard, 60.0)
        refused = call(node, wait, "calibrator/check")
        assert not refused.success
        assert "no model is trusted yet" in refused.message
        cell.describe(URDF.read_text())
        cell.play(stations(10, begin=START + 1000.0))
        wait(cell.taken, 60.0)
        wait(lambda: said.value(MODEL, "state") == "trusted", 20.0)
        answer = call(node, wait, "calibrator/check")
        assert answer.success
        assert answer.message.startswith("Nothing has changed, by 10 stations.")
        cell.play(stations(12, begin=START + 2000.0, bump=bump))
        wait(cell.taken, 60.0)
        answer = call(node, wait, "calibrator/check")
        assert answer.success
        assert answer.message.startswith("The tool or the target has moved: 0.7")
        wait(lambda: len(checked) == 2, 10.0)
        assert [c["kind"] for c in json.loads(checked[-1])["changes"]] == ["tool"]
        assert again.stop() == 0


def test_a_saved_model_of_another_robot_is_neither_used_nor_overwritten(saved: Path, tmp_path: Path) -> None:
    shutil.copytree(saved, tmp_path / "state")
    domain = fresh_domain()
    before = {p.name: p.read_bytes() for p in (tmp_path / "state").iterdir()}
    longer = URDF.read_text().replace("0.612", "0.622")
    assert longer != URDF.read_text()
    second = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(second), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        models = latched(node, "calibrator/calibration")
        wait(cell.heard, 60.0)
        cell.describe(longer)
        cell.play(stations(4))
        wait(lambda: said.level(MODEL) == 2, 20.0)
        assert "other nominal kinematics" in said.text(MODEL)
        assert second.stop() == 0
    assert not models
    assert {p.name: p.read_bytes() for p in (tmp_path / "state").iterdir()} == before


def test_a_killed_calibrator_leaves_no_process_behind(tmp_path: Path) -> None:
    calibrator = Process("calibrator", fresh_domain(), tmp_path)
    with running(calibrator):
        workers = _eventually(lambda: children(calibrator.popen.pid), 60.0)
        calibrator.popen.send_signal(signal.SIGKILL)
        calibrator.popen.wait()
        _eventually(lambda: not any(alive(child) for child in workers), 20.0)


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
        assert not any(trusted)
        assert call(node, wait, "calibrator/accept").success
        wait(lambda: models and any(trusted), 10.0)
        assert not call(node, wait, "calibrator/accept").success  # there is nothing more
        results = len(after)
        cell.play(stations(96, begin=START + 1000.0, bump=bump))
        wait(lambda: len(after) > results, 60.0)
        wait(lambda: not trusted[-1] and said.level(MODEL) == 1, 20.0)
        wait(lambda: "place" in json.loads(changes[-1]), 20.0)  # a topic of its own, in no order with the others
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
        sizes = [found[0]["parameters"][d]["value"] for d in "xyz"]
        assert np.linalg.norm(sizes) == pytest.approx(np.linalg.norm(bump[:3, 3]), rel=0.05)


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


def _eventually(condition: Any, seconds: float) -> Any:
    end = time.monotonic() + SLOWER * seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds} s in vain")
