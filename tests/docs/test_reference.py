"""The tracked pages of docs/reference say what the code says, and all of it; the others can be built."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import yaml

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
