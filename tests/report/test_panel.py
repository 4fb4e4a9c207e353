"""Small charts that are written as SVG directly: what Matplotlib would draw, and points where they belong."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.ticker import MaxNLocator

from modcal_core.report.figures import _few_waves
from modcal_core.report.plots import Panel, in_numbers, round_numbers


def test_ticks_stand_where_those_of_other_charts_do() -> None:
    rng = np.random.default_rng(0)
    usual = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10])
    for _ in range(500):
        low = rng.normal() * 10.0 ** rng.uniform(-3, 3)
        high = low + 10.0 ** rng.uniform(-3, 4)
        ticks, _ = round_numbers(low, high)
        known = usual.tick_values(low, high)
        np.testing.assert_allclose(ticks, known[(known >= low) & (known <= high)], atol=1e-9 * (high - low))
        assert 2 <= len(ticks) <= 5


def test_points_and_ticks_share_a_scale() -> None:
    panel = Panel((-2.0, 2.0), (-1.0, 1.0))
    panel.dashes(np.array([-1.0, 1.0]), np.array([0.5, -0.5]), "after", 0.0, 2.2)
    panel.hollow(np.array([0.0]), np.array([0.5]), "bad", "square")
    drawn = panel.chart("one", "joint <1>, rad", "residual, mm", "Two points.", "against it").drawn
    texts = {t.text: t for t in ElementTree.fromstring(drawn).iter("text")}
    assert {"joint <1>, rad", "residual, mm", "−1", "1"} <= set(texts)
    (places,) = re.findall(r'<path d="M([\d. ]+)" fill="none" marker-start="url\(#one-mark0\)"', drawn)
    dots = np.array(places.split(), float).reshape(-1, 2).tolist()
    # beside the tick of the same number: its text stands in the middle below, or 2.85 points below its line
    where = [float(texts[k].get("x", "")) for k in ("−1", "1")]
    np.testing.assert_allclose([a for a, _ in dots], where, atol=0.06)  # they are written to a tenth
    assert abs(dots[0][1] + 2.85 - float(texts["0.5"].get("y", ""))) < 0.06
    assert abs(dots[1][1] + 2.85 - float(texts["−0.5"].get("y", ""))) < 0.06


def test_a_simplified_line_stays_where_it_was() -> None:
    """Of a wave of many turns: no point of it is farther from what is drawn than the line is wide."""
    t = np.linspace(0.0, 1.0, 1600)
    panel = Panel((0.0, 1.0), (-1.2, 1.2))
    panel.line(t, np.sin(60.0 * t) * np.exp(-t), "after", 1.1)
    drawn = panel.chart("wave", "t, s", "y, mm", "A wave.", "a wave").drawn
    (corners,) = re.findall(r'<path d="(M[\d. L]+)" style="fill:none;stroke:var\(--after\)', drawn)
    kept = np.array([p.split() for p in corners[1:].split("L")], float)
    assert len(kept) < 600
    across = np.interp(t, [0.0, 1.0], kept[[0, -1], 0])
    low, high = (float(v) for v in (kept[:, 1].min(), kept[:, 1].max()))
    true = np.sin(60.0 * t) * np.exp(-t)
    along = np.interp(true, [true.min(), true.max()], [high, low])
    nearest = np.interp(across, kept[:, 0], kept[:, 1])
    slope = np.abs(np.gradient(along, across))
    assert (np.abs(nearest - along) / np.hypot(1.0, slope)).max() < 0.5


@pytest.mark.parametrize(
    "ends", [(0.003, 0.02), (0.01, 0.02), (0.5, 0.7), (1.01, 1.09), (0.0112, 0.0119), (1e-5, 10.0)]
)
def test_a_logarithmic_axis_has_at_least_two_numbers(ends: tuple[float, float]) -> None:
    axis = in_numbers(*ends)
    ticks = [t for t in axis["breaks"] if ends[0] * (1.0 - 1e-9) <= t <= ends[1] * (1.0 + 1e-9)]
    assert 2 <= len(ticks) == len(axis["breaks"]) <= 9
    assert len(set(axis["labels"])) == len(ticks)
    np.testing.assert_allclose([float(said) for said in axis["labels"]], ticks, rtol=1e-5)


def test_of_many_waves_a_few_are_drawn_and_of_few_all() -> None:
    t = np.linspace(0.0, 1.0, 1600)
    assert _few_waves(np.sin(2.0 * np.pi * 10.0 * t)) == slice(None)
    assert _few_waves(t) == slice(None)
    part = _few_waves(np.sin(2.0 * np.pi * 60.0 * t))
    assert t[part][-1] - t[part][0] == pytest.approx(6.0 / 60.0, rel=0.05)
    assert t[part].mean() == pytest.approx(0.5, abs=0.02)
