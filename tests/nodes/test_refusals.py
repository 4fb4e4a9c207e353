"""Nodes refuse as the command does: one line, exit code 2, and nothing that was there is touched."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from nodes.cell import call
from nodes.processes import Process, fresh_domain, listener, running


@pytest.mark.dds
def test_solving_nothing_is_refused_and_the_node_lives_on(tmp_path: Path) -> None:
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, out=tmp_path / "out")
    with running(calibrator), listener(domain) as (node, wait):
        for _ in range(2):
            answer = call(node, wait, "calibrator/solve")
            assert not answer.success
            assert "robot_description: not received yet" in answer.message
        assert calibrator.stop(signal.SIGINT) == 0
    assert not (tmp_path / "out").exists()


@pytest.mark.dds
@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("recorder", {"out": "taken"}, "taken: exists already"),
        ("simulated_cell", {"urdf": "no_such.urdf"}, "urdf 'no_such.urdf': is not a file"),
        ("simulated_cell", {"measurement": "smell"}, "measurement 'smell'"),
    ],
)
def test_wrong_parameters_end_the_process(name: str, parameters: dict[str, str], said: str, tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    process = Process(name, fresh_domain(), tmp_path, **parameters)
    with running(process):
        assert process.popen.wait(60.0) == 2
    lines = [line for line in process.output.splitlines() if line.startswith("modcal: ")]
    assert len(lines) == 1
    assert said in lines[0]
    assert not list((tmp_path / "taken").iterdir())


@pytest.mark.dds
def test_a_parameter_outside_its_bounds_is_refused(tmp_path: Path) -> None:
    process = Process("simulated_cell", fresh_domain(), tmp_path, joint_rate_hz=1e9)
    with running(process):
        assert process.popen.wait(60.0) == 2
    assert [line for line in process.output.splitlines() if line.startswith("modcal: ") and "joint_rate_hz" in line]
    assert "Traceback" not in process.output
