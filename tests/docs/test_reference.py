"""The tracked pages say what the code says; pages and sentences are short; pictures show what the pages state."""

from __future__ import annotations

import re
import runpy
import xml.etree.ElementTree as ET
from itertools import chain
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


PAGES = sorted(chain((ROOT / "docs").glob("*.md"), (ROOT / "docs" / "howto").glob("*.md")))
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
LONG = 40  # words of a sentence that has to be read twice
# most words of a page; and of all pages together
MOST = {"README.md": 900, "CONTRIBUTING.md": 1000, "architecture.md": 700}
ALTOGETHER = 50_000
MEAN, SHARE = 19.0, 0.04  # largest mean length of a sentence, and share of long ones


def sentences(text: str) -> list[str]:
    """Sentences of a page's prose: no code, headings, pictures or tables; an item of a list begins a sentence."""
    text = re.sub(r"^```.*?^```|<!--.*?-->|^(?: {4}|\t)(?! *[-*\d]).*?$", "", text, flags=re.DOTALL | re.MULTILINE)
    found: list[str] = []
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*●○–]|\d+\.) )|\n(?=[#|])", text):
        line = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(block.split()))
        if line and not line.startswith(("#", "|", "![")):
            found += re.split(r"(?<=[.!?:])[*_)”’]*\s+(?=[A-Z0-9`*_“(])", line)
    return [sentence for sentence in found if words(sentence) > 1]


def words(text: str) -> int:
    return len(re.findall(r"\S*\w\S*", text))


def test_sentences_are_cut_where_a_reader_pauses() -> None:
    text = "# Title here\n\nOne two. Three [four](five.md) six:\n\n* seven eight\n* `a` nine. Ten!\n\n```sh\na b c\n```\n\n| x y |\n"
    assert [words(s) for s in sentences(text)] == [2, 3, 2, 2]


@pytest.mark.parametrize("page", [README, CONTRIBUTING, ROOT / "docs" / "architecture.md"], ids=lambda page: page.stem)
def test_a_page_that_everybody_reads_is_short(page: Path) -> None:
    assert len(page.read_text().split()) <= MOST[page.name]


def test_all_pages_together_are_short() -> None:
    assert len(PAGES) > 40
    assert sum(len(page.read_text().split()) for page in PAGES) <= ALTOGETHER


def test_sentences_are_short() -> None:
    lengths = {page: [words(s) for s in sentences(page.read_text())] for page in (README, CONTRIBUTING, *PAGES)}
    every = [n for page in lengths.values() for n in page]
    assert len(every) > 1000
    worst = sorted(lengths, key=lambda page: -sum(n > LONG for n in lengths[page]))[:5]
    assert sum(every) / len(every) <= MEAN, worst
    assert sum(n > LONG for n in every) / len(every) <= SHARE, worst


MOVING, BARS = ROOT / "docs" / "before_after.svg", ROOT / "docs" / "real_arms.svg"


@pytest.mark.parametrize("picture", [MOVING, BARS], ids=lambda p: p.stem)
def test_a_picture_is_small_and_whole(picture: Path) -> None:
    """No script, nothing fetched, a title for who cannot see it, both colour schemes."""
    text = picture.read_text()
    assert len(text) < 40_000
    tags = {element.tag.rpartition("}")[2] for element in ET.fromstring(text).iter()}
    assert "title" in tags
    assert not tags & {"script", "image", "foreignObject"}
    assert not re.findall(r"(?:href|src)=|url\((?!#)|@import", text)
    assert "prefers-color-scheme: dark" in text


def test_the_bars_are_the_table() -> None:
    bars = runpy.run_path(str(ROOT / "scripts" / "bars.py"))
    table = bars["rows"]((ROOT / "docs" / "results.md").read_text())
    assert len(table) == 6
    assert BARS.read_text() == bars["svg"](table)
    widths = [
        float(v)
        for v in re.findall(
            r'class="(?:nominal|geometry|final)" x="\d+" y="\d+" width="([\d.]+)" height="11"', BARS.read_text()
        )
    ]
    shown = [mm for row in table for mm in row.mm]
    assert len(widths) == len(shown)
    assert all(abs(w / widths[0] - mm / shown[0]) < 0.01 for w, mm in zip(widths, shown, strict=True))


def test_the_readme_states_what_the_table_has() -> None:
    readme = (ROOT / "README.md").read_text()
    alt = next(line for line in readme.splitlines() if "docs/real_arms.svg" in line)
    table = (ROOT / "docs" / "results.md").read_text()
    figures = re.findall(r"\d\.\d\d", alt)
    assert len(figures) == 8
    assert all(f"| {figure}" in table for figure in figures)


def test_the_moving_picture_says_what_the_readme_says() -> None:
    """Both from one calibration of bags/ur10_cell; `make demo` prints the same figures."""
    title = re.search(r"<title[^>]*>(.*?)</title>", MOVING.read_text())
    assert title
    drawn = re.findall(r"([\d.]+) mm", title[1])
    readme = (ROOT / "README.md").read_text()
    assert drawn == re.findall(r"([\d.]+) mm", next(line for line in readme.splitlines() if "before_after.svg" in line))
    assert re.findall(r'class="rms"[^>]*>([\d.]+) mm', MOVING.read_text()) == drawn
    assert "<animate" in MOVING.read_text()
    assert "prefers-reduced-motion: reduce" in MOVING.read_text()
