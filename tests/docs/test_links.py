"""Every link of every page leads somewhere: in the sources, as GitHub shows them, and in the site that mkdocs makes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from lxml import html
from report.browser import CONTRASTS, MIN, browser

import modcal

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "docs" / "reference"
SOURCES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "QUALITY_DECLARATION.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("README.md")),
    *sorted((ROOT / "bench").rglob("README.md")),
]
# elements that fetch what they name while a page is shown
FETCHING = {"src", "srcset", "data", "poster"}


def prose(source: Path) -> str:
    """The text without blocks of code, where brackets are no links and number signs no headings."""
    return re.sub(r"^```.*?^```|^(?: {4}|\t).*?$", "", source.read_text(), flags=re.DOTALL | re.MULTILINE)


@cache
def anchors(source: Path) -> frozenset[str]:
    """What a link may name behind #: the headings, in small letters, spaces as hyphens, other signs dropped."""
    found: list[str] = []
    for heading in re.findall(r"^#+ +(.+?) *#*$", prose(source), re.MULTILINE):
        shown = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        slug = re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")
        again = found.count(slug)
        found += [slug] if not again else [slug, f"{slug}-{again}"]
    return frozenset(found)


def broken(source: Path) -> list[str]:
    """Links of a source that lead to no file or to no heading."""
    said = []
    text = prose(source)
    links = re.findall(r"\]\((\S+?)(?: \"[^\"]*\")?\)", text) + re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
    for link in links:
        parts = urlsplit(link)
        if parts.scheme:
            continue
        target = (source.parent / unquote(parts.path)).resolve() if parts.path else source
        if not target.exists() or not target.is_relative_to(ROOT):
            said.append(f"{link}: no such file")
        elif parts.fragment and (target.suffix != ".md" or parts.fragment not in anchors(target)):
            said.append(f"{link}: no such heading")
    return said


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: str(source.relative_to(ROOT)))
def test_links_of_the_sources_lead_somewhere(source: Path) -> None:
    assert not broken(source)


def test_a_broken_link_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    (tmp_path / "other.md").write_text("# A heading (`with` code)\n\n## Twice\n\n## Twice\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](other.md#a-heading-with-code) [b](other.md#twice-1) [c](https://no.example)\n\n    [d](code)\n"
    )
    assert not broken(page)
    page.write_text("[a](gone.md) [b](other.md#gone) [c](#gone) ![d](gone.svg) [e](../other.md)\n")
    assert [line.partition(":")[0] for line in broken(page)] == [
        "gone.md", "other.md#gone", "#gone", "gone.svg", "../other.md",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Folders of the tracked pages of docs/reference, one of which was old, and of the built ones; what was said."""
    tracked, built = tmp_path_factory.mktemp("tracked"), tmp_path_factory.mktemp("built")
    shutil.copytree(REFERENCE, tracked, dirs_exist_ok=True)
    old = tracked / "parameters.md"
    old.write_text(old.read_text().replace("`patience_s`", "`patience`"))
    command = [sys.executable, str(ROOT / "scripts" / "reference"), "--folder", str(tracked), "--built", str(built)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return tracked, built, done.stdout


@pytest.mark.slow
def test_the_tracked_pages_are_up_to_date_and_an_old_one_is_written_again(written: tuple[Path, Path, str]) -> None:
    tracked, _, said = written
    assert said == "written: parameters.md\n"
    assert {file.name for file in tracked.iterdir()} == {file.name for file in REFERENCE.iterdir()}
    assert (tracked / "parameters.md").read_text() == (REFERENCE / "parameters.md").read_text()


@pytest.mark.slow
def test_what_git_does_not_hold_is_built_whole(written: tuple[Path, Path, str]) -> None:
    """Every public name and every node has its heading; so have kinds of refusals and packages with constants."""
    _, built, _ = written
    api = "\n".join(file.read_text() for file in (built / "api").iterdir())
    public = {name for name in modcal.__all__ if not name.startswith("_")}
    assert public
    assert public <= set(re.findall(r"^## (\w+)$", api, re.MULTILINE))
    headings = {
        page: set(re.findall(r"^## (.+)$", (built / page).read_text(), re.MULTILINE))
        for page in ("messages.md", "refusals.md", "constants.md")
    }
    setup = (ROOT / "ros2_ws" / "src" / "modcal_nodes" / "setup.py").read_text()
    assert headings["messages.md"] == set(re.findall(r'f"(\w+) = \{PACKAGE\}\.(?!cli)', setup))
    assert any("BadRecording" in heading for heading in headings["refusals.md"])
    assert "calibration" in headings["constants.md"]


@pytest.fixture(scope="module")
def site(written: tuple[Path, Path, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does; what mkdocs warns of is an error (strict)."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    where = {**os.environ, "MODCAL_REFERENCE": str(written[1])}
    done = subprocess.run(command, cwd=ROOT, env=where, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.slow
def test_the_site_has_every_page(site: Path) -> None:
    pages = {p.relative_to(ROOT / "docs").with_suffix(".html").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    home = html.parse(site / "index.html").getroot()
    menu = {link.get("href") for link in home.iterfind(".//div[@id='navbar-collapse']//a[@href]")}
    assert pages
    assert pages <= menu
    assert {"reference/messages.html", "reference/refusals.html", "reference/api/calibrate.html"} <= menu
    assert "motion capture" in home.text_content()


@pytest.mark.slow
def test_links_of_the_site_lead_somewhere_and_nothing_is_fetched(site: Path) -> None:
    trees = {page.resolve(): html.parse(page).getroot() for page in site.rglob("*.html")}
    ids = {page: {e.get("id") for e in tree.iter() if e.get("id")} for page, tree in trees.items()}
    said, followed = [], 0
    for page, tree in trees.items():
        for element, attribute, link, _ in tree.iterlinks():
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if attribute in FETCHING or element.tag in ("link", "script", "style"):
                    said.append(f"{page.name}: {link} would be fetched")
                continue
            # the page of errors is served at any address, so its links begin at the site's root
            base = site if link.startswith("/") else page.parent
            target = (base / unquote(parts.path).lstrip("/")).resolve() if parts.path else page
            target = target / "index.html" if target.is_dir() else target
            followed += 1
            if not target.is_file():
                said.append(f"{page.name}: {link}: no such file")
            elif parts.fragment and target in ids and parts.fragment not in ids[target]:
                said.append(f"{page.name}: {link}: no such place")
    assert followed > 500
    assert not said


@pytest.mark.slow
def test_pages_complain_of_nothing_and_fit_a_phone(site: Path) -> None:
    with browser() as opened:
        for name in ("index.html", "tutorial.html", "reference/messages.html", "howto/use_the_result.html"):
            for dark in (False, True):
                opened.dark(dark)
                opened.open(site / name, width=400, mobile=True)
                assert not opened.complaints(), name
                assert opened.run("document.documentElement.dataset.bsTheme") == ("dark" if dark else "light")
                assert opened.run("document.documentElement.scrollWidth") <= 400, name
                assert not [said for said, contrast in opened.run(CONTRASTS) if contrast < MIN], name
                assert {request.partition(":")[0] for request in opened.requests()} <= {"file", "data"}
        opened.run("document.querySelector('[data-bs-theme-value=light]').click()")
        assert opened.run("document.documentElement.dataset.bsTheme") == "light"


@pytest.mark.slow
def test_search_works_from_disk(site: Path) -> None:
    """No server, no network: a word of a refusal, an option and a topic are found where they are explained."""
    wanted = {
        "nearest dh table": "howto/use_the_result.html",
        "no xacro expression": "reference/refusals.html",
        "tracker/pose orientation zeros": "reference/messages.html",
        "factory-kinematics": "reference/cli.html",
    }
    with browser() as page:
        page.open(site / "terms.html")
        for words, place in wanted.items():
            page.run(f"document.getElementById('mkdocs-search-query').value = {json.dumps(words)}")
            page.run("document.getElementById('mkdocs-search-query').dispatchEvent(new Event('input'))")
            script = "[...document.querySelectorAll('#mkdocs-search-results a')].map(a => a.href.split('#')[0])"
            deadline, found = time.monotonic() + 60.0, []
            while time.monotonic() < deadline and (site / place).as_uri() not in found[:8]:
                time.sleep(0.1)
                found = page.run(script)
            assert (site / place).as_uri() in found[:8], f"{words}: {found[:8]}"
            assert all((site / link.removeprefix(site.as_uri() + "/")).is_file() for link in found)
        assert not page.complaints()
        assert {request.partition(":")[0] for request in page.requests()} <= {"file", "data"}
