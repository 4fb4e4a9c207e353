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
from action_msgs.msg import GoalStatus
from cli.recordings import START, URDF, part
from modcal_interfaces.action import Check, Solve
from modcal_interfaces.msg import Calibration, Change, Checked, Estimate, Verdict
from nodes.beside_a_cell import HEARING, MODEL, alive, beside_a_cell, children, latched, stations
from nodes.cell import PlayedCell, call
from nodes.processes import SLOWER, Goal, Process, beside, fresh_domain, listener, running
from nodes.talking import Diagnostics
from std_msgs.msg import Bool, Float64

from modcal_core.calibration import Calibration as Kept
from modcal_core.geometry import se3
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.typed import calibration_data

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
    kept = Kept.load(tmp_path / "state")

    second = Process("calibrator", domain, tmp_path, effects=False, state=tmp_path / "state")
    with running(second), listener(domain) as (node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        models, trusted = (
            latched(node, "calibrator/calibration", Calibration),
            latched(node, "calibrator/trusted", Bool),
        )
        estimates: list[Estimate] = []
        node.create_subscription(Estimate, "calibrator/estimate", estimates.append, 10)
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
        wait(lambda: estimates, 10.0)
        std, names = np.array(estimates[-1].stds), list(estimates[-1].names)
        assert len(names) == len(std) == len(estimates[-1].values)
        assert any(name.startswith(read_chain(URDF.read_text()).names[2]) for name in names)
        cell.play(stations(200, begin=START + 500.0))
        wait(lambda: max(estimates[-1].stds) < 0.8 * std.max(), 20.0)
        assert second.stop() == 0
    assert models[0].robot == kept.robot
    assert report["recording"]["stations"] == 48


def test_ten_stations_say_what_has_changed_since_the_saved_model(saved: Path, tmp_path: Path) -> None:
    shutil.copytree(saved, tmp_path / "state")
    bump = se3.exp(np.array([5e-4, -4e-4, 3e-4, 0.0, 0.0, 0.0]))
    # a change is not followed up by itself, so that the worker is free for the check
    with beside(tmp_path, "calibrator", effects=False, state=tmp_path / "state", after_change=0) as (again, node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        checked = latched(node, "calibrator/checked", Checked)
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
        _, result = Goal(node, wait, Check, "calibrator/check").result()
        assert result.outcome == Check.Result.CHECKED
        assert result.message.startswith("The tool or the target has moved: 0.7")
        wait(lambda: len(checked) == 2, 10.0)
        assert result.checked == checked[-1]
        assert (checked[-1].status, [c.place for c in checked[-1].changes]) == (Checked.CHANGED, ["tool"])
        assert 5e-4 < checked[-1].changes[0].size_m < 1e-3
        assert again.stop() == 0


def test_a_saved_model_of_another_robot_is_neither_used_nor_overwritten(saved: Path, tmp_path: Path) -> None:
    shutil.copytree(saved, tmp_path / "state")
    before = {p.name: p.read_bytes() for p in (tmp_path / "state").iterdir()}
    longer = URDF.read_text().replace("0.612", "0.622")
    assert longer != URDF.read_text()
    with beside(tmp_path, "calibrator", effects=False, state=tmp_path / "state") as (second, node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        models = latched(node, "calibrator/calibration", Calibration)
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
        models, trusted = (
            latched(node, "calibrator/calibration", Calibration),
            latched(node, "calibrator/trusted", Bool),
        )
        changes, before = (
            latched(node, "calibrator/change", Change),
            latched(node, "calibrator/residual_before", Float64),
        )
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
        wait(lambda: changes[-1].changed, 20.0)  # a topic of its own, in no order with the others
        assert changes[-1].place == "tool"
        assert changes[-1].size_m == pytest.approx(np.linalg.norm(bump[:3, 3]), rel=0.2)
        assert len(models) == 1
        assert before[-1] > 5e-4 > 2e-4 > after[-1]
        assert call(node, wait, "calibrator/accept").success
        wait(lambda: len(models) == 2 and trusted[-1], 10.0)
        report = latched(node, "calibrator/report", Verdict)
        wait(lambda: report, 10.0)
        assert report[-1].effects == ["step at tool"]
        assert report[-1].residuals.rms_m == pytest.approx(after[-1])
        (effect,) = calibration_data(models[-1])["calibrated"]["effects"]
        assert np.linalg.norm(effect["values"][:3]) == pytest.approx(np.linalg.norm(bump[:3, 3]), rel=0.05)


def test_callbacks_keep_up_while_a_solve_runs(tmp_path: Path) -> None:
    with beside_a_cell(tmp_path) as (_, node, wait, cell, said):
        cell.play(stations(150))
        wait(cell.taken, 60.0)
        goal = Goal(node, wait, Solve, "calibrator/solve")
        again = call(node, wait, "calibrator/solve")
        if not goal.done:
            assert again.message == "a solve is running already"
        heard = 150
        extra = stations(40, seed=1, begin=START + 1000.0)
        while not goal.done:
            cell.play(extra, lambda _, m: m if hasattr(m, "name") else None)
            heard += 40
            wait(lambda: said.value(HEARING, "messages of /joint_states") == str(heard), 10.0)  # noqa: B023
            extra = stations(40, seed=1, begin=START + 1000.0 + 100.0 * heard)
        status, result = goal.result()
        assert (status, result.outcome) == (GoalStatus.STATUS_SUCCEEDED, Solve.Result.SOLVED)
        assert result.verdict.status != 0
        assert result.verdict.sentence in result.message
        assert {f.phase for f in goal.heard} == {"solving"}
        assert [f.elapsed_s for f in goal.heard] == sorted(f.elapsed_s for f in goal.heard)
        # one that is cancelled leaves what is trusted, and the solver is free for the next
        state = said.value(MODEL, "state")
        goal = Goal(node, wait, Solve, "calibrator/solve")
        assert goal.cancel()
        status, result = goal.result()
        assert (status, result.outcome) == (GoalStatus.STATUS_CANCELED, Solve.Result.CANCELLED)
        assert said.value(MODEL, "state") == state
        goal = Goal(node, wait, Check, "calibrator/check")
        assert goal.result()[1].outcome == Check.Result.CHECKED


def _eventually(condition: Any, seconds: float) -> Any:
    end = time.monotonic() + SLOWER * seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds} s in vain")
