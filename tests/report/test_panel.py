"""Small charts that are written as SVG directly: what Matplotlib would draw, and points where they belong."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
from matplotlib.ticker import MaxNLocator

from modcal_core.report.panel import Panel, round_numbers


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
    dots = [(float(a), float(b)) for a, b in re.findall(r"M([\d.]+) ([\d.]+)h0", drawn)]
    # beside the tick of the same number: its text stands in the middle below, or 2.85 points below its line
    assert [a for a, _ in dots] == [float(texts["−1"].get("x", "")), float(texts["1"].get("x", ""))]
    assert abs(dots[0][1] + 2.85 - float(texts["0.5"].get("y", ""))) < 0.011
    assert abs(dots[1][1] + 2.85 - float(texts["−0.5"].get("y", ""))) < 0.011
