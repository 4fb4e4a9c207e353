"""Something happens to the cell while it runs, see live_diagnosis.py; a payload: test_live_payload.py.

Longer than 20 s each, for stations take time: nowhere else does a running calibrator open the diagnosis by itself.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from nodes.live_diagnosis import diagnosed


@pytest.mark.dds
@pytest.mark.slow
@pytest.mark.parametrize("what", ["bump", "warm-up"])
def test_what_happens_while_running(what: str, tmp_path: Path) -> None:
    diagnosed(what, tmp_path)
