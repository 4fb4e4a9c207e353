"""A report in a real browser: no complaint, both themes, the robot turns by key, a phone does not scroll sideways."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from report.browser import Page
from report.test_page import page

pytestmark = pytest.mark.slow

HIDDEN = "getComputedStyle(document.querySelector({0!r})).display === 'none'"


@pytest.fixture
def opened(tab: Page, tmp_path: Path) -> Iterator[Page]:
    """The page with everything on it, on a desk, in light colours."""
    (tmp_path / "report.html").write_text(page("warm"))
    tab.dark(False)
    tab.open(tmp_path / "report.html")
    yield tab
    assert not tab.complaints()


def test_a_complaint_would_be_heard(tab: Page, tmp_path: Path) -> None:
    text = page("points").replace("</main>", "<img src='missing.png'></main><script>undefinedName();</script>")
    (tmp_path / "broken.html").write_text(text)
    tab.open(tmp_path / "broken.html")
    assert len(tab.complaints()) >= 2


def test_the_theme_follows_the_system_and_the_switch(opened: Page) -> None:
    ground = "getComputedStyle(document.body).backgroundColor"
    choose = "(() => {{ const s = document.getElementById('theme'); s.value = '{}'; s.dispatchEvent(new Event('change')); }})()"
    light = opened.run(ground)
    opened.dark(True)
    dark = opened.run(ground)
    assert light == "rgb(255, 255, 255)" != dark
    opened.run(choose.format("light"))
    assert opened.run(ground) == light
    opened.dark(False)
    opened.run(choose.format("dark"))
    assert opened.run(ground) == dark
    line = "getComputedStyle(document.querySelector('svg.chart text')).fill"
    assert opened.run(line) == opened.run("getComputedStyle(document.body).color")
    opened.run(choose.format("system"))
    assert opened.run(ground) == light


def test_the_robot_is_reached_and_turned_by_keys(opened: Page) -> None:
    state = "({...document.getElementById('scene').dataset})"
    for _ in range(60):
        opened.press("Tab")
        if opened.run("document.activeElement.id") == "scene":
            break
    assert opened.run("document.activeElement.id") == "scene"
    before = opened.run(state)
    seen = opened.run("document.getElementById('scene').toDataURL()")
    for key in ("ArrowLeft", "ArrowUp"):
        opened.press(key)
    opened.press("+", "+")
    after = opened.run(state)
    assert float(after["yaw"]) == pytest.approx(float(before["yaw"]) - 0.1)
    assert float(after["pitch"]) == pytest.approx(float(before["pitch"]) + 0.1)
    assert float(after["zoom"]) == pytest.approx(1.2 * float(before["zoom"]))
    assert opened.run("document.getElementById('scene').toDataURL()") != seen
    opened.press("0", "0")
    assert opened.run(state) == before
    assert opened.run("document.getElementById('scene').toDataURL()") == seen


def test_before_and_after_are_one_choice_apart(opened: Page) -> None:
    said = "document.getElementById('scene-said').textContent"
    choose = "(() => {{ const s = document.getElementById('scene-stage'); s.selectedIndex = {}; s.dispatchEvent(new Event('change')); }})()"
    first, scale = opened.run(said), opened.run("Number(document.getElementById('scene').dataset.scale)")
    assert f"{scale:g} times as long" in first
    opened.run(choose.format(1))
    assert opened.run("Number(document.getElementById('scene').dataset.scale)") == scale
    assert opened.run(said) != first
    opened.run("document.getElementById('scene-own').click()")
    assert opened.run("Number(document.getElementById('scene').dataset.scale)") > scale


def test_commands_can_be_copied(opened: Page) -> None:
    buttons = opened.run("[...document.querySelectorAll('button[data-copy]')].length")
    assert buttons >= 4
    opened.run("document.querySelector('button[data-copy]').click()")
    for _ in range(100):
        words = opened.run("document.querySelector('button[data-copy]').textContent")
        if words != "Copy":
            break
    assert words in ("Copied", "Selected")


def test_paper_shows_everything_in_light_and_the_robot_too(opened: Page, tmp_path: Path) -> None:
    corner = "[...document.getElementById('scene').getContext('2d').getImageData(2, 2, 1, 1).data]"
    told = "new Promise((done) => setTimeout(done, 200))"  # until the page has heard of it
    drawn = "document.getElementById('scene').toDataURL()"
    light = opened.run(drawn)
    opened.dark(True)
    opened.run(told)
    assert opened.run(drawn) != light
    opened.send("Emulation.setEmulatedMedia", media="print")
    opened.run(told)
    assert opened.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert opened.run("document.getElementById('scene').clientHeight") > 200
    assert opened.run(corner) == [255, 255, 255, 255]
    assert opened.run(HIDDEN.format(".controls"))
    opened.print(tmp_path / "report.pdf")
    opened.send("Emulation.setEmulatedMedia", media="")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
