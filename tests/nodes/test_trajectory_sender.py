"""What was planned is sent once, from where the arm stands, and the arm of the simulated cell arrives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from nodes.processes import ROOT, Process, fresh_domain, running

from modcal_core.errors import BadCommand, BadTable
from modcal_core.planning.station_files import trajectory_from_data
from modcal_core.robots.urdf import read_chain

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
NAMES = list(read_chain(URDF.read_text()).names)


def planned(*postures: tuple[float, list[float]]) -> dict[str, Any]:
    points = [
        {"positions": q, "velocities": [0.0] * len(q), "time_from_start": {"sec": int(t), "nanosec": int(t % 1 * 1e9)}}
        for t, q in postures
    ]
    return {"joint_names": NAMES, "points": points}


GOOD = planned((0.0, [0.02] * 6), (0.5, [0.02] * 6), (1.5, [0.3, -0.2, 0.1, 0.2, -0.1, 0.4]))


def test_a_trajectory_is_led_up_to() -> None:
    trajectory = trajectory_from_data(GOOD, "t")
    led = trajectory.led_up_to(np.zeros(6), 0.2, 0.1)
    assert led.t.tolist() == [0.5, 1.0, 2.0]
    far = trajectory.led_up_to(np.full(6, -0.5), 0.2, 1.0)
    assert far.t[0] == pytest.approx(1.5 * 0.52 / 0.2)  # a cubic's peak is half as much again as its mean
    with pytest.raises(BadCommand, match="0.1 is the limit: bring the arm to the first point"):
        trajectory.led_up_to(np.full(6, 0.5), 0.2, 0.1)
    with pytest.raises(BadCommand):
        trajectory.led_up_to(np.full(6, np.nan), 0.2, 0.1)


@pytest.mark.parametrize(
    "data",
    [
        None, [], "x", {}, {"joint_names": NAMES}, {"joint_names": NAMES, "points": []},
        {"joint_names": 3, "points": GOOD["points"]}, {"joint_names": NAMES[:5], "points": GOOD["points"]},
        {"joint_names": [*NAMES[:5], NAMES[0]], "points": GOOD["points"]},
        planned((0.0, [0.0] * 6), (0.0, [0.1] * 6)), planned((0.0, [0.0] * 5 + [float("nan")])),
        {"joint_names": NAMES, "points": [{"positions": [0.0] * 6}]},
        {"joint_names": NAMES, "points": [{"positions": "abcdef", "time_from_start": 3}]},
    ],
)  # fmt: skip
def test_what_is_no_trajectory_is_refused(data: Any) -> None:
    with pytest.raises(BadTable, match="t: "):
        trajectory_from_data(data, "t")


@pytest.mark.dds
def test_the_simulated_arm_goes_where_the_plan_says(tmp_path: Path) -> None:
    """One is sent and arrives; one that begins elsewhere, and one that nobody listens to, are refused."""
    domain = fresh_domain()
    (tmp_path / "good.yaml").write_text(yaml.safe_dump(GOOD))
    (tmp_path / "far.yaml").write_text(yaml.safe_dump(planned((0.0, [1.0] * 6), (1.0, [1.1] * 6))))
    remap = ("-r", "~/joint_trajectory:=joint_trajectory")
    cell = Process("simulated_cell", domain, tmp_path, urdf=URDF, joint_rate_hz=100.0, tracker_rate_hz=10.0)
    with running(cell):
        deaf = Process("trajectory_sender", domain, tmp_path, trajectory="good.yaml", patience_s=4.0)
        far = Process("trajectory_sender", domain, tmp_path, *remap, trajectory="far.yaml")
        with running(deaf, far):
            assert far.popen.wait(60.0) == 2
            assert deaf.popen.wait(60.0) == 2
        assert "from the first point, 0.1 is the limit" in far.output
        assert "no node subscribes to /trajectory_sender/joint_trajectory" in deaf.output
        good = Process("trajectory_sender", domain, tmp_path, *remap, trajectory="good.yaml")
        with running(good):
            assert good.popen.wait(60.0) == 0, good.output
        assert "3 points sent to /joint_trajectory" in good.output
        assert "arrived" in good.output
        assert cell.stop() == 0
