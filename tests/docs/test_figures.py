"""The pictures of the README: small, self-contained, moving, and of the figures that the pages state."""

from __future__ import annotations

import re
import runpy
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
