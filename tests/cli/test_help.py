"""The list of verbs, which stands apart from the verbs so that asking for it is quick."""

from __future__ import annotations

import subprocess
import sys

import click
import pytest

from modcal_nodes.cli.main import VERBS, modcal, run


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    listed = capsys.readouterr().out
    for verb, (_, _, said) in VERBS.items():
        assert verb in listed
        assert said in " ".join(listed.split())


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_there_under_its_name(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = modcal.get_command(click.Context(modcal), verb)
    assert command is not None
    assert command.name == verb
    assert run([verb, "--help"]) == 0
    assert f" {verb} " in capsys.readouterr().out.splitlines()[0]


def test_asking_for_help_imports_no_mathematics() -> None:
    ask = "import sys; from modcal_nodes.cli.main import run; run(['--help']); print('\\n', *sys.modules)"
    out = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout
    assert not {"numpy", "scipy", "rclpy", "mcap"} & set(out.splitlines()[-1].split())


def test_looking_into_a_bag_imports_no_scipy() -> None:
    ask = "import sys, modcal_nodes.cli.info; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout
    assert not {"scipy", "rclpy"} & set(out.split())


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
