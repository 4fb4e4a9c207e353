"""Reports and the scene of an object in a real browser: no complaint, both themes, keys, a phone, paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from report.browser import Page
from report.test_page import page

from modcal_core.articulation.choice import choose
from modcal_core.articulation.track import Track
from modcal_core.report.articulation import Articulation, articulation_data, articulation_report, object_scene
from modcal_core.report.blocks import Scene3D

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


def found(kind: str) -> tuple[Seen, Articulation]:
    """A handle 0.4 m from its axis, or one that slides, seen with noise."""
    rng = np.random.default_rng(4)
    a = np.linspace(0.0, 0.4 if kind == "prismatic" else 1.2, 80)
    seen = noisy(ideal(kind, a, rng), rng, 5e-4, 2e-3)
    track = Track(seen.positions, seen.rotations)
    return seen, Articulation("door.txt", "cell", track, choose(track, np.random.default_rng(0)))


def drawn(about: Articulation) -> Scene3D:
    fit = about.choice.fit
    joint = articulation_data(about)["joint"]
    return object_scene(fit, (fit.configurations, about.track.positions), joint, 1.0, "cell")


def test_the_axis_and_the_lever_of_a_door() -> None:
    seen, about = found("revolute")
    scene = drawn(about)
    ((_, axis),) = scene.lines
    along = np.diff(axis, axis=0)[0]
    assert np.linalg.norm(np.cross(along, seen.axis)) < 0.01 * np.linalg.norm(along)
    feet = np.array([strokes[0][0] for strokes in scene.arms])
    assert np.linalg.norm(scene.points - feet, axis=1) == pytest.approx(0.4, abs=5e-3)
    off = feet - seen.point
    assert np.linalg.norm(off - np.outer(off @ seen.axis, seen.axis), axis=1).max() < 5e-3
    assert scene.cloud is not None
    nearest = np.linalg.norm(scene.points[:, None] - scene.cloud[None], axis=2).min(axis=0)
    assert nearest.max() < 0.01  # the path goes where the handle was seen
    assert len(scene.said) == len(scene.points)
    assert "cell" in scene.to_data()["base"]


def test_a_drawer_has_no_axis_to_turn_about() -> None:
    seen, about = found("prismatic")
    scene = drawn(about)
    assert scene.to_data()["lines"] == []
    along = scene.points[-1] - scene.points[0]
    assert np.linalg.norm(np.cross(along, seen.axis)) < 0.01 * np.linalg.norm(along)


def test_the_slider_opens_the_door(tab: Page, tmp_path: Path) -> None:
    (tmp_path / "door.html").write_text(articulation_report(found("revolute")[1]).files["report.html"])
    tab.open(tmp_path / "door.html", 1000, 900)
    picture = "document.getElementById('scene').toDataURL()"
    said = "document.getElementById('scene-said').textContent"
    closed, words = tab.run(picture), tab.run(said)
    tab.run(
        "(() => { const s = document.getElementById('scene-posture'); s.value = s.max; s.dispatchEvent(new Event('input')); })()"
    )
    assert tab.run(picture) != closed
    assert tab.run(said) != words
    assert "handle at x" in tab.run(said)
    assert not tab.complaints()
