"""The tracked pages of docs/reference say what the code says, and all of it; the others can be built."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from modcal_nodes.cli.main import VERBS, run

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "reference"
NODES = ROOT / "ros2_ws" / "src" / "modcal_nodes"


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


def test_every_node_has_a_section_on_both_pages_and_in_the_explanation() -> None:
    setup = (NODES / "setup.py").read_text()
    nodes = re.findall(r'f"(\w+) = \{PACKAGE\}\.(?!cli)', setup)
    assert len(nodes) > 5
    explained = re.findall(r"^## (\w+)$", (ROOT / "docs" / "nodes.md").read_text(), re.MULTILINE)
    for page in (sections("topics.md"), sections("parameters.md")):
        assert set(page) == set(nodes) == set(explained)
