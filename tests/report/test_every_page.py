"""Every page that modcal writes, in a real browser on a phone, light and dark: nothing fetched, read by everybody."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from cli.recordings import stations
from cli.test_check import BUMP, later
from report.browser import CONTRASTS, MIN, Page
from report.judged import FLOOR
from report.reports import page_of, points
from report.test_certificate import full, report
from report.test_page import Elements, page

from modcal_core.report.certificates import certificate
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
ROBOT = str(ROOT / "examples" / "robots" / "ur10.urdf")
DOOR = str(ROOT / "examples" / "tables" / "door.txt")
BODY = ROOT / "examples" / "body"
VERBS: dict[str, list[str]] = {
    "plan": ["plan", ROBOT, "--stations", "26", "--candidates", "60"],
    "sensitivity": ["sensitivity", ROBOT],
    "limits": ["limits", ROBOT, "--payload", "2", "--workspace", "20"],
    "articulate": ["articulate", DOOR],
    "camera": [
        *("calibrate", "--images", str(BODY / "corners.csv"), "--joints", str(BODY / "joints.csv")),
        *("--target", str(BODY / "target.yaml"), "--urdf", str(ROOT / "examples" / "robots" / "panda.urdf")),
    ],
    "check": [],  # of a bag and a calibration
}
MADE: dict[str, Callable[[], str]] = {
    "calibrate": lambda: page("warm"),
    "evaluate": lambda: page_of(replace(points(), searched=None), calibration="cell_3"),
    "certificate": lambda: certificate(report(FLOOR)).html(),
    "certificate_full": lambda: full().html(),
}
OPEN_ALL = """(async () => { document.querySelectorAll("details").forEach((d) => { d.open = true; });
  await new Promise((done) => setTimeout(done, 50)); })()"""  # until the page has heard of it
# what scrolls sideways by itself and cannot be reached with the keyboard
UNREACHED = (
    "[...document.querySelectorAll('.wide')].filter((e) => e.scrollWidth > e.clientWidth + 1 && e.tabIndex < 0).length"
)
# letters on charts, as high as they come out on the phone
LETTERS = """[...document.querySelectorAll("svg.chart text")].filter((t) => t.getClientRects().length)
  .map((t) => parseFloat(getComputedStyle(t).fontSize) * t.ownerSVGElement.clientWidth / t.ownerSVGElement.viewBox.baseVal.width)"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """The page of a name, made once."""

    @cache
    def make(name: str) -> str:
        if name in MADE:
            return MADE[name]()
        folder = tmp_path_factory.mktemp(name)
        if name == "check":
            write_recording(stations(60), folder / "bag")
            assert run(["calibrate", str(folder / "bag"), "--geometry-only", "--out", str(folder / "a")]) == 0
            bag = later(folder / "later", BUMP)
            assert run(["check", str(folder / "a"), str(bag), "--tolerance-mm", "1", "--out", str(folder / "out")]) == 0
            return (folder / "out" / "check.html").read_text()
        assert run([*VERBS[name], "--out", str(folder)]) == 0
        return (folder / "report.html").read_text()

    return make


@pytest.mark.parametrize("name", [*MADE, *VERBS])
def test_on_a_phone_in_both_colours(tab: Page, tmp_path: Path, written: Callable[[str], str], name: str) -> None:
    text = written(name)
    assert len(text.encode()) < 1_000_000
    file = tmp_path / "page.html"
    file.write_text(text)
    for dark in (False, True):
        tab.dark(dark)
        tab.open(file, 400, 800, mobile=True)
        tab.run(OPEN_ALL)
        assert not tab.complaints()
        assert [r for r in tab.requests() if not r.startswith("data:")] == [file.resolve().as_uri()]
        assert tab.run("document.documentElement.scrollWidth") == 400
        assert tab.run(UNREACHED) == 0
        assert min(tab.run(LETTERS), default=9.0) > 6.0
        read = tab.run(CONTRASTS)
        assert len(read) > 30
        assert not [said for said, contrast in read if contrast < MIN]


@pytest.mark.parametrize("name", [*MADE, *VERBS])
def test_on_paper_three_sheets_and_a_certificate_one(
    tab: Page, tmp_path: Path, written: Callable[[str], str], name: str
) -> None:
    (tmp_path / "page.html").write_text(written(name))
    tab.open(tmp_path / "page.html")
    tab.print(tmp_path / "page.pdf")
    sheets = re.findall(rb"/Type /Page\b(?!s)", (tmp_path / "page.pdf").read_bytes())
    assert 1 <= len(sheets) <= (1 if "certificate" in name else 3)


def test_faint_letters_would_be_seen(tab: Page, tmp_path: Path) -> None:
    file = tmp_path / "faint.html"
    file.write_text("<body style='background:#fff'><p style='color:#999'>faint</p><p>plain</p></body>")
    tab.dark(False)
    tab.open(file)
    assert [said for said, contrast in tab.run(CONTRASTS) if contrast < MIN] == ["faint"]


@pytest.mark.parametrize("name", [*MADE, *VERBS])
def test_words_for_who_cannot_see_and_the_answer_first(written: Callable[[str], str], name: str) -> None:
    text = written(name)
    found = Elements(text)
    assert not found.unclosed
    assert found.of("html")[0]["lang"] == "en"
    assert all(len(a["aria-label"]) > 10 and a["role"] == "img" for a in (*found.of("svg"), *found.of("canvas")))
    assert all("scope" in a for a in found.of("th"))
    assert all(a.get("href", "#").startswith("#") for _, a in found.all)
    ids = [a["id"] for _, a in found.all if "id" in a]
    assert len(ids) == len(set(ids))
    named = {target for _, a in found.all for key in ("href", "aria-labelledby", "aria-describedby")
             for target in a.get(key, "").replace("#", "").split()}  # fmt: skip
    assert named | set(re.findall(r"url\(#([^)]+)\)", text)) <= set(ids)
    main = text[text.index("<main") :]
    assert re.match(r'<main id="content">\s*<p class="verdict \w+"><strong>[^<]+</strong>\S', main)
    for head in re.findall(r"<thead>(.*?)</thead>", text, re.DOTALL):
        units = set(re.findall(r", (mm|mrad|°|rad|m|cm)\b|, (°)", re.sub(r"<[^>]+>", ";", head)))
        assert len(units) <= 1, head
