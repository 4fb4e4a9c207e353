"""One command opens a simulated door."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from nodes.processes import Process, fresh_domain, running

pytestmark = pytest.mark.dds


@pytest.mark.slow
def test_one_command_opens_a_simulated_door(tmp_path: Path) -> None:
    """Some 20 s, most of which the arm takes to pull; nothing else runs the four as their user does."""
    demo = Process("door_demo", fresh_domain(), tmp_path, from_nothing=True, kind="door", seed=0)
    with running(demo):
        assert demo.popen.wait(200.0) == 0, demo.output
    opened = re.search(r"in truth it is open by ([0-9.]+) rad", demo.output)
    assert opened
    assert float(opened[1]) > 1.0
    assert "Traceback" not in demo.output
