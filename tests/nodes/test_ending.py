"""A node that is told to end does so once, however often it is told; a bag is whole then."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
import yaml
from nodes.processes import Process, fresh_domain, listener, running
from nodes.talking import Talker, numbers_on_disk

pytestmark = pytest.mark.dds
# s from the first SIGINT to the second: as ros2 launch sends them to a group, and as an impatient hand does
PAUSES = (0.0, 0.0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.1, 0.13, 0.15)


def test_a_second_interrupt_does_not_cut_the_closing_short(tmp_path: Path) -> None:
    """Twelve recorders, started three at a time; each leaves a whole bag and exit code 0."""
    domain = fresh_domain()
    with listener(domain) as (node, wait), Talker(node, rate=400.0):
        for first in range(0, len(PAUSES), 3):
            pauses = PAUSES[first : first + 3]
            folders = [tmp_path / f"bag{first + k}" for k in range(len(pauses))]
            made = [Process("recorder", domain, tmp_path, out=folder) for folder in folders]
            with running(*made):
                wait(lambda made=made: all("recording /joint_states" in one.output for one in made), 20.0)
                mark = time.monotonic() + 0.2
                wait(lambda mark=mark: time.monotonic() > mark, 5.0)
                for process, pause in zip(made, pauses, strict=True):
                    process.popen.send_signal(signal.SIGINT)
                    time.sleep(pause)
                    process.popen.send_signal(signal.SIGINT)
                assert [process.stop(signal.SIGINT) for process in made] == [0] * len(made)
            for process, folder in zip(made, folders, strict=True):
                about = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
                numbers = numbers_on_disk(folder)
                assert about["message_count"] >= len(numbers) > 0
                assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
                assert "Traceback" not in process.output
                assert f"closed {folder} with" in process.output
