"""The list of verbs, which stands apart from the verbs so that asking for it is quick."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.shell_completion import BashComplete

from modcal_nodes.cli.main import VERBS, modcal, run


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    listed = capsys.readouterr().out
    for verb, (_, said) in VERBS.items():
        assert verb in listed
        assert said in " ".join(listed.split())


@pytest.mark.slow
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
