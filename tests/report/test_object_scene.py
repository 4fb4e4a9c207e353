"""The picture of an articulated object in three dimensions: against trigonometry, and in a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from report.browser import Page

from modcal_core.articulation.choice import choose
from modcal_core.articulation.track import Track
from modcal_core.report.articulation import Articulation, articulation_data, articulation_report, object_scene
from modcal_core.report.blocks import Scene3D


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
