"""``modcal watch`` beside real nodes, and what the calibrator says of the trusted model: OK only at the floor."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from nodes.processes import EXECUTABLES, SLOWER, Process, environment, fresh_domain, listener, running
from nodes.talking import Diagnostics
from report.judged import CANNOT, FLOOR, OPEN, WHY
from report.reports import points

from modcal_core.online.supervisor import Policy, Supervisor
from modcal_core.report.report import to_json_data
from modcal_core.report.tables import sentence
from modcal_core.verdict.verdict import Verdict
from modcal_nodes.calibrating.diagnostics import Standing, model_status, standing_of
from modcal_nodes.ros.subscriptions import ERROR, OK, WARN, Status
from modcal_nodes.watching import OURS, Changes, Heard

COMMAND = str(EXECUTABLES / "modcal")


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


@pytest.mark.dds
def test_what_nodes_say_is_shown(tmp_path: Path) -> None:
    domain = fresh_domain()
    corrector = Process("corrector", domain, tmp_path, "-r", "__ns:=/left")
    with running(corrector), listener(domain) as (node, wait):
        said = Diagnostics(node)
        wait(lambda: "/left/corrector: calibration" in said.last, 60.0)
        lines = run(domain, tmp_path, "--json", "--for", "4", "--every", "0.5", "--namespace", "/left/")
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
        parts = {part["part"] for part in found["parts"]}
        assert parts == {"hearing", "calibration", "correction", "commands", "lifecycle", "faults"}

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
        first = [log.stdout.readline() for _ in range(6)]
        assert any(line.startswith("error: /left/corrector calibration: no calibration yet") for line in first)
        assert corrector.stop() == 0
        rest = [log.stdout.readline() for _ in range(6)]
        assert all(line.startswith("silent: /left/corrector") for line in rest)
        log.send_signal(signal.SIGINT)
        assert log.communicate(timeout=SLOWER * 15.0) == ("", "")
        assert log.returncode == 0


@pytest.mark.dds
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


@pytest.mark.dds
def test_nobody_there_is_said_in_one_line(tmp_path: Path) -> None:
    done = run(fresh_domain(), tmp_path, "--once", "--for", "1")
    assert done.returncode == 2
    assert not done.stdout
    assert done.stderr.startswith("modcal: /diagnostics of domain")
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE" in done.stderr


def by_report(verdict: Verdict | None) -> Standing | None:
    """By the report of these points that is written with this verdict."""
    return standing_of(json.dumps(to_json_data(replace(points(), judged=verdict))))


def told(standing: Standing | None, verdict: str = "A result.", trouble: str = "") -> Status:
    return model_status(Supervisor(Policy()), verdict, standing, trouble, False, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "level", "words"),
    [
        (FLOOR, OK, "At the floor"),
        (OPEN, WARN, "Open: 48 of 160 stations were rejected."),
        (CANNOT, WARN, CANNOT.remedy),
        (None, WARN, "Cannot tell"),
    ],
)
def test_only_the_floor_is_ok(verdict: Verdict | None, level: bytes, words: str) -> None:
    report = replace(points(), judged=verdict)
    for said in ("continuing with the saved model", sentence(report)):
        status = told(by_report(verdict), said)
        assert status.level == level
        assert said.rstrip(".") in status.message
        assert status.message.count(words) == 1
        assert status.values["status"] == report.status
    if verdict is OPEN:
        assert status.values["because"] == " ".join(reason.sentence for reason in WHY)


def test_without_a_model_nothing_is_ok() -> None:
    assert told(None, "nothing solved yet").level == WARN
    assert told(by_report(FLOOR), trouble="different kinematics").level == ERROR


@pytest.mark.parametrize("verdict", [FLOOR, OPEN, CANNOT])
def test_the_claim_is_told(verdict: Verdict) -> None:
    claim = replace(points(), judged=verdict).claim
    said = "none" if claim is None else f"{claim.mm['p95'].ci95[1]:.4f}"
    assert told(by_report(verdict)).values["claim p95 [mm]"] == said


@pytest.mark.parametrize("old", [None, "", "{}", '{"status": "fine", "open_because": [], "remedy": null}', "[1]"])
def test_a_report_without_a_verdict_says_nothing(old: str | None) -> None:
    assert standing_of(old) is None


def test_watch_shows_it() -> None:
    heard, changes = Heard(), Changes()
    status = told(by_report(OPEN))
    level = int.from_bytes(status.level, "little")
    facts = {name: str(value) for name, value in status.values.items()}
    heard.status("/calibrator: model", OURS, level, status.message, facts, 0.0)
    (line,) = changes.lines(heard.snapshot(0.0))
    assert line.startswith("warn: /calibrator model: A result. Open: 48 of 160 stations were rejected.")
