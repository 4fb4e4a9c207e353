"""One state folder, one calibrator: a second one is refused, and a killed one leaves nothing that stands in the way."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from nodes.in_process import spun

from modcal_core.errors import BadTable
from modcal_nodes.calibrating.state import StateLock, read_state
from modcal_nodes.nodes.calibrator import Calibrator

HOLD = """
import sys, time
from pathlib import Path
from modcal_nodes.calibrating.state import StateLock
lock = StateLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


def test_a_folder_is_held_by_one_process_and_a_kill_frees_it(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    with holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(BadTable, match=f"is in use by process {holder.pid}: give each"):
            StateLock(folder)
        holder.kill()
    lock = StateLock(folder)
    assert read_state(folder).calibration is None  # the lock itself is no state
    lock.release()
    StateLock(folder).release()


@pytest.mark.dds
def test_a_second_calibrator_on_the_folder_does_not_start(tmp_path: Path) -> None:
    used = pytest.raises(BadTable, match=f"in use by process {os.getpid()}")
    with spun(Calibrator, state=tmp_path / "state"), used:
        Calibrator()
    with spun(Calibrator, state=tmp_path / "state"):
        pass


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadTable, match="cannot be made"):
        StateLock(tmp_path / "file" / "state")
