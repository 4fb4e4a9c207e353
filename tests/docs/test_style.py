"""Hand-written pages stay short, and their sentences too."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
