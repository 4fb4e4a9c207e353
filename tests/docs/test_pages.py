"""The README, the tutorial and the how-to pages work: every block of commands runs, in order, as a reader would type it.

Blocks marked ``console`` need what is not here (the ``ros2`` command, a real arm): what they name must exist.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from modcal_nodes.cli.main import VERBS
from modcal_nodes.ros import parameters
from modcal_nodes.ros.launch_files import LAUNCHES

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
FORKED = Path(__file__).with_name("forked.py")
RUNS, MUST_EXIST, SHOWN = "bash", "console", ("yaml", "python", "bibtex", "csv")
NODES = ROOT / "ros2_ws" / "src" / "modcal_nodes"
ADDS = "add_an_effect"  # the page that puts a file into modcal_core


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def with_own_core(folder: Path) -> str:
    """Give a page a modcal_core to write into; what its commands are to begin with, so that `modcal` and python use it."""
    core = folder / "ros2_ws" / "src" / "modcal_core"
    shutil.copytree(
        ROOT / "ros2_ws" / "src" / "modcal_core", core, ignore=shutil.ignore_patterns("__pycache__", "build")
    )
    run = "python -c 'from modcal_nodes.cli.main import main; main()'"
    return f"export PYTHONPATH='{core}'${{PYTHONPATH:+:$PYTHONPATH}}\nmodcal() {{ {run} \"$@\"; }}\n"


@pytest.fixture(scope="module")
def modcal(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """What a page's commands are to begin with, so that its verbs need no interpreter of their own each."""
    place = tmp_path_factory.mktemp("forked") / "socket"
    serve = f"source '{ROOT}/env.bash'; exec python '{FORKED}' '{place}'"
    with subprocess.Popen(["bash", "-c", serve]) as server:
        while not place.exists():
            assert server.poll() is None
            time.sleep(0.05)
        yield f"modcal() {{ '{sys.executable}' -I -S '{FORKED}' '{place}' \"$@\"; }}\n"
        server.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_runs(page: Path, tmp_path: Path, modcal: str) -> None:
    """On the page that asks for least `modcal` is the executable itself."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    if page.stem == ADDS:
        modcal = with_own_core(tmp_path)
    else:
        (tmp_path / "ros2_ws").symlink_to(ROOT / "ros2_ws")
    program = "\n".join(blocks(page, RUNS))
    assert program
    begin = "" if page.stem == "delta_printer" else modcal
    done = subprocess.run(
        ["bash", "-c", f"source '{ROOT}/env.bash'; set -euo pipefail\n{begin}{program}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    if page.stem == ADDS:
        (effect,) = json.loads((tmp_path / "windup_calibration" / "report.json").read_text())["effects"]
        assert (effect["family"], effect["place"]) == ("friction_windup", "elbow_joint")
        windup = effect["parameters"]["windup"]
        assert abs(windup["value"] - 6e-6) < 3.0 * windup["std"] < 6e-7  # what measure.py plants, rad per N m


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_block_is_of_a_kind_that_nobody_looks_at(page: Path) -> None:
    fences = re.findall(r"^```(\S*)$", page.read_text(), re.MULTILINE)
    assert len(fences) % 2 == 0
    assert set(fences[::2]) <= {RUNS, MUST_EXIST, *SHOWN}
    assert not any(fences[1::2])
    for text in blocks(page, "yaml"):
        yaml.safe_load(text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_commands_for_ros_name_exists(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    lines = []
    for block in blocks(page, MUST_EXIST):
        asked = [line for line in block.splitlines() if line.startswith("$ ")]  # the others are what comes back
        lines += asked or block.splitlines()
    for line in lines:
        command = line.partition("#")[0].replace("$ ", "").split()
        if not command or command[:2] in (["source", "env.bash"], ["ros2", "bag"]):
            continue
        if command[0] == "xacro":  # of other packages' descriptions
            continue
        if command[:2] == ["pip", "install"]:
            assert command[2] in ("modcal-*.whl", "."), line
        elif command[0] == "make":
            assert re.search(rf"^{command[1]}:", makefile, re.MULTILINE), line
        elif command[:3] == ["ros2", "run", "modcal_nodes"]:
            declared = getattr(parameters, command[3].upper())
            for name, _ in re.findall(r"-p (\w+):=(\S+)", line):
                assert name in declared, line
        elif command[:3] == ["ros2", "launch", "modcal_nodes"]:
            assert (NODES / "launch" / command[3]).is_file(), line
            known = {argument.name for argument in LAUNCHES[command[3].partition(".")[0]].arguments}
            assert set(re.findall(r"(\w+):=", line)) <= known, line
        elif command[0] == "modcal":
            assert command[1] in VERBS, line
        else:
            kinds = "service call|topic pub --once|action send_goal(?: --feedback)?"
            named = re.match(rf"ros2 ({kinds}) (\S+) (\w+)/(srv|msg|action)/(\w+)", line)
            assert named, line
            leaf = named[2].rpartition("/")[2]
            said = [f'"~/{leaf}"', f'"{leaf}"', f'"{named[5]}"']  # an action is named by its type
            assert any(s in source.read_text() for source in NODES.rglob("*.py") for s in said), line
