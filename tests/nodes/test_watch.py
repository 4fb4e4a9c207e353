"""``modcal watch`` beside real nodes: what they say, in JSON, in a table, and in a terminal that is left as it was."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from nodes.cell import Said
from nodes.processes import EXECUTABLES, SLOWER, Process, environment, fresh_domain, listener, running

COMMAND = str(EXECUTABLES / "modcal")
pytestmark = pytest.mark.dds


def run(domain: int, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """``modcal watch`` in a domain, its output in pipes."""
    return subprocess.run(
        [COMMAND, "watch", *options], env=environment(domain), cwd=folder, capture_output=True, text=True,
        timeout=SLOWER * 60.0,
    )  # fmt: skip


def watched(domain: int, folder: Path, *options: str) -> Any:
    """The data of the last line."""
    done = run(domain, folder, *options)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_what_nodes_say_is_shown(tmp_path: Path) -> None:
    domain = fresh_domain()
    corrector = Process("corrector", domain, tmp_path, "-r", "__ns:=/left")
    with running(corrector), listener(domain) as (node, wait):
        said = Said(node)
        wait(lambda: "/left/corrector: calibration" in said.last, 60.0)
        elsewhere = run(domain, tmp_path, "--once", "--namespace", "right", "--for", "2")
        assert elsewhere.returncode == 2
        assert len(elsewhere.stderr.splitlines()) == 1
        assert "no message from a modcal node in 2 s" in elsewhere.stderr

        lines = run(domain, tmp_path, "--json", "--for", "6", "--every", "0.5", "--namespace", "/left/")
        assert lines.returncode == 0
        snapshots = [json.loads(line) for line in lines.stdout.splitlines()]
        assert len(snapshots) > 1
        (found,) = snapshots[-1]["nodes"]
        assert found["name"] == "/left/corrector"
        assert found["level"] == snapshots[-1]["level"] == "error"
        for part in found["parts"]:
            name = f"/left/corrector: {part['part']}"
            wait(lambda name=name, part=part: said.text(name) == part["message"], 20.0)
            assert part["level"] == ("ok", "warn", "error")[said.level(name)]
        assert {part["part"] for part in found["parts"]} == {
            "hearing",
            "calibration",
            "correction",
            "commands",
            "faults",
        }

        # whoever reads may go when it has enough
        piped = f"set -o pipefail; {COMMAND} watch --json --every 0.2 | head -1"
        done = subprocess.run(
            ["bash", "-c", piped], env=environment(domain), capture_output=True, text=True, timeout=SLOWER * 60.0
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["modcal_watch"] == 1

        # in a pipe only what gets better or worse is written, and a node that ends is silent
        log = subprocess.Popen(
            [COMMAND, "watch"], env=environment(domain), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert log.stdout is not None
        first = [log.stdout.readline() for _ in range(5)]
        assert any(line.startswith("error: /left/corrector calibration: no calibration yet") for line in first)
        assert corrector.stop() == 0
        rest = [log.stdout.readline() for _ in range(5)]
        assert all(line.startswith("silent: /left/corrector") for line in rest)
        log.send_signal(signal.SIGINT)
        assert log.communicate(timeout=SLOWER * 15.0) == ("", "")
        assert log.returncode == 0


def test_a_terminal_is_given_back_as_it_was(tmp_path: Path) -> None:
    """On Ctrl-C, and when it is told to end: the cursor is there again, and the screen is the one before."""
    domain = fresh_domain()
    corrector = Process("corrector", domain, tmp_path)
    with running(corrector):
        for number in (signal.SIGINT, signal.SIGTERM):
            here, there = pty.openpty()
            variables = {**environment(domain), "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}
            watch = subprocess.Popen([COMMAND, "watch"], env=variables, stdin=there, stdout=there, stderr=there)
            os.close(there)
            shown = _read_until(here, b"/corrector")
            watch.send_signal(number)
            shown += _rest(here)
            assert watch.wait(SLOWER * 15.0) == 0
            os.close(here)
            assert b"\x1b[?1049h" in shown
            assert b"no calibration yet" in shown
            assert shown.rfind(b"\x1b[?1049l") > shown.rfind(b"\x1b[?1049h")
            assert shown.rfind(b"\x1b[?25h") > shown.rfind(b"\x1b[?25l")
            assert b"Traceback" not in shown


def _read_until(terminal: int, words: bytes) -> bytes:
    shown, end = b"", time.monotonic() + SLOWER * 30.0
    while words not in shown and time.monotonic() < end:
        shown += os.read(terminal, 65536)
    assert words in shown
    return shown


def _rest(terminal: int) -> bytes:
    shown = b""
    try:
        while piece := os.read(terminal, 65536):
            shown += piece
    except OSError:  # the other end is closed
        pass
    return shown


def test_nobody_there_is_said_in_one_line(tmp_path: Path) -> None:
    done = run(fresh_domain(), tmp_path, "--once", "--for", "1")
    assert done.returncode == 2
    assert not done.stdout
    assert done.stderr.startswith("modcal: /diagnostics of domain")
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE" in done.stderr
