"""The tracked pages of docs/reference say what the code says, and all of it; the others can be built."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import modcal
from modcal_nodes.cli.main import VERBS, run

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "reference"
NODES = ROOT / "ros2_ws" / "src" / "modcal_nodes"
# a call that opens something: which of its arguments is the name
OPENING = {
    "create_publisher": 1, "create_lifecycle_publisher": 1, "create_subscription": 1, "create_service": 1, "MonitoredSubscription": 2,
}  # fmt: skip


def sections(page: str) -> dict[str, str]:
    """Text below each heading of the second level."""
    parts = re.split(r"^## (.+)$", (FOLDER / page).read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def named(text: str) -> list[str]:
    """What stands in the first column of a section's tables."""
    return re.findall(r"^\| (?:`|<code>)([^`<]+)", text, re.MULTILINE)


def generate(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "reference"), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_pages_are_up_to_date_and_an_old_one_is_noticed(tmp_path: Path) -> None:
    folder = tmp_path / "reference"
    shutil.copytree(FOLDER, folder)
    old = folder / "parameters.md"
    old.write_text(old.read_text().replace("`patience_s`", "`patience`"))
    done = generate("--check", "--folder", str(folder))
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("out of date: parameters.md: run make docs"), done.stderr
    assert "`patience`" in old.read_text()


@pytest.mark.slow
def test_what_git_does_not_hold_is_built_whole(tmp_path: Path) -> None:
    """Every public name and every node has its heading; so have kinds of refusals and packages with constants."""
    done = generate("--folder", str(tmp_path / "tracked"), "--built", str(tmp_path / "built"))
    assert done.returncode == 0, done.stderr
    assert {file.name for file in (tmp_path / "tracked").iterdir()} == {file.name for file in FOLDER.iterdir()}
    api = "\n".join(file.read_text() for file in (tmp_path / "built" / "api").iterdir())
    public = {name for name in modcal.__all__ if not name.startswith("_")}
    assert public
    assert public <= set(re.findall(r"^## (\w+)$", api, re.MULTILINE))
    setup = (NODES / "setup.py").read_text()
    headings = {
        page: set(re.findall(r"^## (.+)$", (tmp_path / "built" / page).read_text(), re.MULTILINE))
        for page in ("messages.md", "refusals.md", "constants.md")
    }
    assert headings["messages.md"] == set(re.findall(r'f"(\w+) = \{PACKAGE\}\.(?!cli)', setup))
    assert any("BadRecording" in heading for heading in headings["refusals.md"])
    assert "calibration" in headings["constants.md"]


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_every_option_that_help_names_is_on_the_page(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([verb, "--help"]) == 0
    options = set(re.findall(r"^ +(?:-\w, )?(--[\w-]+)", capsys.readouterr().out, re.MULTILINE)) - {"--help"}
    text = sections("cli.md")[f"modcal {verb}"]
    assert options <= set(re.findall(r"--[\w-]+", "\n".join(named(text)))), verb


def test_every_parameter_of_a_config_file_is_on_the_page() -> None:
    pages = sections("parameters.md")
    files = sorted((NODES / "config").glob("*.yaml"))
    assert files
    for file in files:
        for node, content in yaml.safe_load(file.read_text()).items():
            assert set(content["ros__parameters"]) - {"use_sim_time"} <= set(
                named(pages[node.strip("/*") or file.stem])
            ), file.name


def test_every_topic_and_service_that_the_sources_name_is_on_the_page() -> None:
    """Also one that is opened only now and then, which the nodes that were started for the page may not have."""
    page = set(named((FOLDER / "topics.md").read_text()))
    literal = []
    for source in sorted((NODES / "modcal_nodes").rglob("*.py")):
        if source.parent.name == "watching":  # the command line, not a node
            continue
        for call in ast.walk(ast.parse(source.read_text())):
            if isinstance(call, ast.Call):
                name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
                if name in OPENING and isinstance(argument := call.args[OPENING[name]], ast.Constant):
                    literal.append(argument.value)
    assert len(literal) > 50
    assert set(literal) <= page


def test_every_node_has_a_section_on_both_pages_and_in_the_explanation() -> None:
    setup = (NODES / "setup.py").read_text()
    nodes = re.findall(r'f"(\w+) = \{PACKAGE\}\.(?!cli)', setup)
    assert len(nodes) > 5
    explained = re.findall(r"^## (\w+)$", (ROOT / "docs" / "nodes.md").read_text(), re.MULTILINE)
    for page in (sections("topics.md"), sections("parameters.md")):
        assert set(page) == set(nodes) == set(explained)
