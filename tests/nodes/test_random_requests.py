"""Illegal transitions and parameters at random while it pulls; bench/control_tick.py asks for hundreds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from impedance.toy import PANDA
from nodes.processes import Process, fresh_domain, listener, running
from nodes.pulled_arm import PulledArm
from nodes.random_requests import RandomRequests

pytestmark = pytest.mark.dds


def test_limits_are_kept_and_the_hand_lets_go_whatever_it_is_asked(tmp_path: Path, rng: np.random.Generator) -> None:
    """Some seconds a pull: the arm's own time goes on when the node has answered."""
    domain = fresh_domain()
    process = Process(
        "impedance_setpoint", domain, tmp_path, direction="[-1.0, 0.0, 0.0]", tip=PANDA.tip, use_sim_time=True
    )
    with running(process), listener(domain) as (node, wait):
        arm = PulledArm(node)
        arm.ready(wait)
        asked = RandomRequests(arm, wait, rng)
        asked.run(12)
        assert asked.count["pulls"] >= 2
        assert asked.witness.count > 100
        assert process.popen.poll() is None
        assert process.stop() == 0
        assert "Traceback" not in process.output
