"""Something happens to the cell while it runs: it is noticed, named, learned, and the error before and after is told.

The cell runs on simulated time, faster than the wall's, and MuJoCo says where the tool is.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from nodes.cell import LATCHED, Said, call
from nodes.processes import ROOT, Process, fresh_domain, listener, running
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import Bool, Float64, String

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
MODEL, SAMPLES = "/calibrator: model", "/calibrator: samples"


def switch_on(what: str) -> Parameter:
    """The cell's parameter that makes it happen."""
    name, value = {"warm-up": ("warm_up_m", 4e-4), "payload": ("payload_kg", 6.0)}[what]
    return Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))


CELL: dict[str, dict[str, Any]] = {
    "warm-up": {"warm_up_link": "forearm_link", "warm_up_s": 15.0},
    "payload": {"joint_compliance_rad_per_nm": "[4e-6]"},
}


def diagnosed(what: str, folder: Path) -> None:
    """Play it, and assert what the calibrator makes of it."""
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, folder, after_change=36, use_sim_time="true")
    with running(calibrator), listener(domain) as (node, wait):
        said = Said(node)
        heard: dict[str, list[Any]] = {}
        for topic, kind in {
            "residual": Float64, "residual_before": Float64, "change": String, "report": String, "trusted": Bool,
            "robot_description": String,
        }.items():  # fmt: skip
            heard[topic] = []
            node.create_subscription(kind, f"calibrator/{topic}", lambda m, t=topic: heard[t].append(m.data), LATCHED)
        wait(lambda: said.level(SAMPLES) >= 0, 60.0)
        cell = Process(
            "simulated_cell", domain, folder, urdf=URDF, seed=5, start_delay_s=12.0, stations=60, repeat="true",
            dwell_s=0.75, travel_s=0.2, joint_rate_hz=40.0, tracker_rate_hz=20.0, publish_clock="true",
            clock_rate_hz=40.0, time_factor=6.0, **CELL[what],  # each tick wakes every node
        )  # fmt: skip
        with running(cell):
            wait(lambda: int(said.text(SAMPLES).split()[0]) >= 50, 120.0)
            assert call(node, wait, "calibrator/solve", 120.0).success
            wait(lambda: said.value(MODEL, "state") == "trusted" and heard["residual"], 20.0)
            client = node.create_client(SetParameters, "simulated_cell/set_parameters")
            wait(client.service_is_ready, 30.0)
            answer = client.call_async(SetParameters.Request(parameters=[switch_on(what)]))
            wait(answer.done, 30.0)
            assert answer.result().results[0].successful, answer.result().results[0].reason

            # noticed, and the model that stands is marked
            wait(lambda: any(change != "{}" for change in heard["change"]) and heard["trusted"][-1] is False, 120.0)
            wait(lambda: said.value(MODEL, "state") == "suspected" and said.level(MODEL) == 1, 20.0)
            assert "the last trusted model is still published" in said.text(MODEL)
            models = len(heard["robot_description"])

            # the diagnosis is opened again by itself, and its result trusted
            wait(lambda: heard["trusted"][-1] is True, 240.0)
            wait(lambda: len(heard["robot_description"]) > models and said.value(MODEL, "state") == "trusted", 20.0)
            wait(lambda: len(heard["residual"]) == len(heard["residual_before"]) >= 2, 20.0)
            assert cell.stop() == 0
        assert calibrator.stop() == 0

    report = json.loads(heard["report"][-1])
    found = {(e["family"], e["place"]): e for e in report["effects"]}
    before, after = heard["residual_before"][-1], heard["residual"][-1]
    suspected = json.loads([change for change in heard["change"] if change != "{}"][-1])
    if what == "warm-up":
        # the link before this joint grows with what the thermometer says
        assert ("thermal", "wrist_1_joint") in found
        assert found["thermal", "wrist_1_joint"]["driver"] == "temperature:forearm_link"
        assert suspected["place"] == "wrist_1_joint"
    if what == "payload":
        assert ("payload", "shoulder_lift_joint") in found
        assert suspected["driver"].startswith("load:")
    # to the noise of the readings from an error that many times as large
    assert before > 8e-5
    assert after < 0.25 * before
    limit = 2.5e-5
    if what == "payload":  # joints whose share of it is not sure yet are left out: at most a tenth in all
        noise = 1e-3 * report["noise_floor_mm"]
        assert noise < 2e-5
        limit = max(limit, np.hypot(0.1 * before, 1.5 * noise))
    assert after < limit
