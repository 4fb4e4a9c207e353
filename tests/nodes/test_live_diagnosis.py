"""A link warms up while the cell runs, see live_diagnosis.py; a payload: test_live_payload.py.

Longer than 20 s, for stations take time: nowhere else does a running calibrator open the diagnosis by itself. A tool that
is bumped: test_calibrator_learns.py, and in the running cell test_viewer.py.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from nodes.live_diagnosis import diagnosed


@pytest.mark.dds
@pytest.mark.slow
def test_a_link_warms_up_while_running(tmp_path: Path) -> None:
    diagnosed("warm-up", tmp_path)
