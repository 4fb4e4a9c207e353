"""Verbs speak to people and to programs, leave nothing half written, and help; ``modcal repair`` as a person meets it."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.recordings import stations
from click.shell_completion import BashComplete
from mcap.reader import make_reader

from modcal_core.measurements.recording import SignalTrack
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import VERBS, modcal, run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
MODCAL = ROOT / ".venv" / "bin" / "modcal"
BAG = ROOT / "bags" / "ur10_cell"


def test_a_program_gets_the_report_and_nothing_else(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["calibrate", str(folder / "bag"), "--geometry-only", "--out", str(out), "--json"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == json.loads((out / "report.json").read_text())
    assert said.err == ""
    assert run(["evaluate", str(out), str(folder / "bag"), "--out", str(tmp_path / "again"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == json.loads((tmp_path / "again" / "report.json").read_text())
    assert run(["info", str(folder / "bag"), "--json"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["robot"]["tip"] == "tool0"
    assert {t["topic"]: t["count"] for t in seen["topics"]} == {"/joint_states": 80, "/tracker/pose": 80}


def test_every_stage_is_said_when_it_is_asked_for(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(folder / "bag"), "--geometry-only", "--out", str(tmp_path / "out"), "-v"]) == 0
    lines = capfd.readouterr().err.splitlines()
    stages = [re.fullmatch(r"(.*): \d+\.\d s", line)[1] for line in lines]  # type: ignore[index]
    assert stages == ["reading bag", "fitting the geometry", "writing the report"]


def test_a_terminal_sees_progress_and_is_left_clean(folder: Path, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    done = subprocess.Popen(
        [MODCAL, "calibrate", folder / "bag", "--geometry-only", "--out", tmp_path / "out"],
        stdout=subprocess.PIPE, stderr=theirs, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    )  # fmt: skip
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    result, _ = done.communicate(timeout=60)
    os.close(ours)
    assert done.returncode == 0
    assert b"the geometry" in seen
    assert b"Report: " in result
    assert b"the geometry" not in result
    assert seen.rstrip().endswith((b"\x1b[2K", b"\x1b[?25h"))  # wiped, and the cursor is back


def test_an_interrupted_calibration_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with subprocess.Popen([MODCAL, "calibrate", BAG, "--out", out, "-v"], stderr=subprocess.PIPE, text=True) as done:
        assert done.stderr.readline().startswith("reading ur10_cell: ")  # it is fitting now
        time.sleep(0.3)
        done.send_signal(signal.SIGINT)
        assert done.wait(60) == 130
        assert "Traceback" not in done.stderr.read()
    assert not list(tmp_path.iterdir())


def test_tables_are_whole_where_there_is_no_terminal(folder: Path) -> None:
    """A log of 80 columns would cut names and numbers short."""
    plain = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    table = subprocess.run(
        [MODCAL, "info", folder / "bag"], capture_output=True, text=True, check=True, env=plain
    ).stdout
    assert "shoulder_pan_joint, shoulder_lift_joint, elbow_joint" in table
    narrow = subprocess.run(
        [MODCAL, "info", folder / "bag"], capture_output=True, text=True, check=True, env={**plain, "COLUMNS": "60"}
    ).stdout
    assert max(map(len, narrow.splitlines())) <= 60


def said_by(capfd: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    """The JSON object that a verb prints; it says nothing else, and with -v its stages, on stderr."""
    capfd.readouterr()
    assert run([*(str(a) for a in arguments), "--json", "-v"]) == 0
    said = capfd.readouterr()
    assert all(re.fullmatch(r".*: \d+\.\d s", line) for line in said.err.splitlines())
    data = json.loads(said.out)
    assert isinstance(data, dict)
    return data


def test_the_other_verbs_speak_to_programs_too(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = ROOT / "examples" / "robots" / "ur10.urdf"
    few = ("-p", "stations=4", "-p", "joint_rate_hz=50", "-p", "tracker_rate_hz=25")
    simulated = said_by(capfd, "simulate", robot, "--out", "made", *few)
    recording = read_recording(Path(simulated["bag"]))
    assert simulated["stations"] == 4
    assert simulated["joint_states"] == len(recording.joints[0].stamps)
    assert simulated["readings"] == len(recording.readings[0].stamps)
    table = said_by(capfd, "export", robot, "--to", "mdh")
    assert Path(table["file"]).is_file()
    assert table["off_m"] < 1e-9
    again = said_by(capfd, "import", table["file"])
    assert again["joints"] == table["joints"] == list(read_chain(robot.read_text()).names)
    (tmp_path / "t.csv").write_text("t,q,x,y,z\n0,0,1,2,3\n1,1,1,2,3\n2,0,1,2,3\n")
    (tmp_path / "m.yaml").write_text(
        "tables: [{files: t.csv, time: {seconds: t}, joints: {unit: rad, columns: {one: q}}, "
        "point: {frame: laser, unit: m, position: [x, y, z]}}]"
    )
    assert said_by(capfd, "import", "m.yaml", "--out", "rows") == {
        "bag": "rows",
        "stations": 3,
        "frames": ["laser"],
        "left_out": [],
    }
    whole = said_by(capfd, "repair", folder / "bag")
    assert whole["repaired"] is None
    (tmp_path / "cut.mcap").write_bytes((folder / "bag" / "bag_0.mcap").read_bytes()[:-2000])
    cut = said_by(capfd, "repair", "cut.mcap")
    assert cut["messages"].keys() == whole["messages"].keys()
    assert (Path(cut["repaired"]) / "metadata.yaml").is_file()
    assert len(cut["reasons"]) == 1
    spec = ROOT / "examples" / "modules" / "five_joints.yaml"
    robot_of_modules = said_by(capfd, "assemble", spec, "--out", "arm")
    assert robot_of_modules["joints"] == list(read_chain(Path(robot_of_modules["robot"]).read_text()).names)
    limits = said_by(capfd, "limits", robot, "--payload", "2", "--out", "limits")
    assert limits == json.loads((tmp_path / "limits" / "limits.json").read_text())


def test_info_counts_signals_that_are_many(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recording = stations(20)
    t = recording.joints[0].stamps
    signals = [SignalTrack(f"signal:/motor_{i}", t, np.c_[np.sin(t)], f"/motor_{i}") for i in range(12)]
    write_recording(replace(recording, signals=tuple(signals)), tmp_path / "bag")
    assert run(["info", str(tmp_path / "bag")]) == 0
    said = capfd.readouterr().out
    assert "12 numbers of 12 other topics" in said
    assert "/motor_3" not in said
    assert run(["info", str(tmp_path / "bag"), "--verbose"]) == 0
    assert "/motor_3" in capfd.readouterr().out


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    listed = capsys.readouterr().out
    for verb, (_, said) in VERBS.items():
        assert verb in listed
        assert said in " ".join(listed.split())


def test_a_shell_completes_verbs_options_and_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Click's script for bash asks for it: of a process, and of the command in this one."""
    asked = {"COMP_WORDS": "modcal cali", "COMP_CWORD": "1", "_MODCAL_COMPLETE": "bash_complete"}
    ask = "from modcal_nodes.cli.main import main; main()"
    how: dict[str, Any] = {"capture_output": True, "text": True, "check": True}
    out = subprocess.run([sys.executable, "-c", ask], env={**os.environ, **asked}, **how).stdout
    assert out.split() == ["plain,calibrate"]
    for words, offered in (
        ("calibrate --tol", {"--tolerance-mm", "--tolerance-of"}),
        ("calibrate --tolerance-of p", {"p95"}),
    ):
        monkeypatch.setenv("COMP_WORDS", f"modcal {words}")
        monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
        said = BashComplete(modcal, {}, "modcal", "_MODCAL_COMPLETE").complete()
        assert {line.partition(",")[2] for line in said.splitlines()} == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell(shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["completion", shell]) == 0
    said = capsys.readouterr().out
    assert f"_MODCAL_COMPLETE={shell}_complete" in said
    monkeypatch.setenv("SHELL", f"/usr/bin/{shell}")
    assert run(["completion"]) == 0
    assert capsys.readouterr().out == said
    monkeypatch.setenv("SHELL", "/bin/tcsh")
    assert run(["completion"]) == 2
    assert "shell 'tcsh': has no completion script: give one of bash" in capsys.readouterr().err


def test_asking_for_help_imports_no_mathematics() -> None:
    ask = "import sys; from modcal_nodes.cli.main import run; run(['--help']); print('\\n', *sys.modules)"
    out = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout
    assert not {"numpy", "scipy", "rclpy", "mcap"} & set(out.splitlines()[-1].split())


def test_looking_into_a_bag_imports_no_scipy() -> None:
    """Nor what else takes longer to load than the bag does: random numbers bring OpenSSL along."""
    bag = Path(__file__).resolve().parents[2] / "bags" / "ur10_cell"
    ask = f"import sys; from modcal_nodes.cli.main import run; run(['info', {str(bag)!r}]); print('\\n', *sys.modules)"
    out = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout
    assert "can be used for calibration" in out
    assert not {"scipy", "rclpy", "numpy.random", "matplotlib", "rich.progress"} & set(out.splitlines()[-1].split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["calibrat", "bag"], "No such command 'calibrat'. Did you mean calibrate? See: modcal --help"),
        (["xyzzy"], "No such command 'xyzzy'. See: modcal --help"),
        (["calibrate"], "Missing argument 'BAG'. See: modcal calibrate --help"),
        (["modules", "learn", "--nothing"], "No such option"),
    ],
)
def test_who_mistypes_is_told_where_to_look(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    heard = capsys.readouterr()
    assert heard.out == ""
    assert heard.err.startswith(f"modcal: {said}")
    assert heard.err.count("\n") == 1


def said(capfd: pytest.CaptureFixture[str]) -> tuple[str, str]:
    out, err = capfd.readouterr()
    return " ".join(out.split()), err


def test_a_cut_bag_is_repaired_beside_itself(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_recording(stations(40), tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    (tmp_path / "bag" / "metadata.yaml").unlink()
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    assert run(["repair", str(tmp_path / "bag")]) == 0
    with (tmp_path / "bag_repaired" / "bag_repaired_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        saved: dict[str, int] = {}
        for _, channel, _ in reader.iter_messages():
            saved[channel.topic] = saved.get(channel.topic, 0) + 1
    assert saved["/joint_states"] > 10
    text, err = said(capfd)
    assert err == ""
    for topic, count in saved.items():
        assert f"{topic} {count}" in text
    assert "metadata.yaml is missing" in text
    assert "bytes at the end are an unfinished record" in text
    assert f"{sum(saved.values())} messages saved" in text
    # the new bag is one that calibrate takes, without a word about a cut
    assert run(["info", str(tmp_path / "bag_repaired")]) == 0
    assert "read up to" not in said(capfd)[0]
