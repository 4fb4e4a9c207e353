"""A payload is hung on while the cell runs, see live_diagnosis.py: a file of its own, that runs beside the others.

Longer than 20 s, for stations take time: nowhere else does a running calibrator find a load by itself.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from nodes.live_diagnosis import diagnosed


@pytest.mark.dds
@pytest.mark.slow
def test_a_payload_while_running(tmp_path: Path) -> None:
    diagnosed("payload", tmp_path)
