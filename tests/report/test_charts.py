"""Charts: ticks where Matplotlib would put them, marks where the numbers of the axes say, the page's colours."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.ticker import MaxNLocator

from modcal_core.report.charts import AFTER, BAD, Axis, Chart, Panel, round_numbers


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
    panel = Panel(Axis("joint <1>, rad", -2.0, 2.0), Axis("residual, mm", -1.0, 1.0))
    panel.marks(np.array([-1.0, 1.0]), np.array([0.5, -0.5]), AFTER, "dot", 2.2)
    panel.marks(np.array([0.0]), np.array([0.5]), BAD, "square")
    drawn = panel.chart("one", "Two points.", "against it").drawn
    texts = {t.text: t for t in ElementTree.fromstring(drawn).iter("text")}
    assert {"joint <1>, rad", "residual, mm", "−1", "1"} <= set(texts)
    (places,) = re.findall(r'<path d="M([\d. ]+)" fill="none" marker-start="url\(#one-mark0\)"', drawn)
    dots = np.array(places.split(), float).reshape(-1, 2).tolist()
    # beside the tick of the same number: its text stands in the middle below, or 2.85 points below its line
    where = [float(texts[k].get("x", "")) for k in ("−1", "1")]
    np.testing.assert_allclose([a for a, _ in dots], where, atol=0.06)  # they are written to a tenth
    assert abs(dots[0][1] + 2.85 - float(texts["0.5"].get("y", ""))) < 0.06
    assert abs(dots[1][1] + 2.85 - float(texts["−0.5"].get("y", ""))) < 0.06


@pytest.mark.parametrize(
    "ends", [(0.003, 0.02), (0.01, 0.02), (0.5, 0.7), (1.01, 1.09), (0.0112, 0.0119), (1e-5, 10.0)]
)
def test_a_logarithmic_axis_has_at_least_two_numbers(ends: tuple[float, float]) -> None:
    axis = Axis("force, N", *ends, log=True)
    ticks = [value for value, _ in axis.ticks()]
    assert 2 <= len(ticks) <= 9
    assert all(ends[0] * (1.0 - 1e-9) <= t <= ends[1] * (1.0 + 1e-9) for t in ticks)
    assert len({said for _, said in axis.ticks()}) == len(ticks)
    raised = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    said = [f"1e{s[2:].translate(raised)}" if set(s) & set("⁰¹²³⁴⁵⁶⁷⁸⁹") else s for _, s in axis.ticks()]
    np.testing.assert_allclose([float(one) for one in said], ticks, rtol=1e-5)


def _logarithmic() -> Chart:
    panel = Panel(Axis("force <1>, N", 0.008, 12.0, log=True), Axis("error, mm", 8e-5, 120.0, log=True))
    panel.marks(np.array([0.02, 0.3, 4.0]), np.array([1e-3, 1e-1, 10.0]), AFTER, "dot", 3.0)
    return panel.chart("one", "Three points.", "three points")


def test_on_logarithmic_axes_points_stand_where_the_numbers_say() -> None:
    drawn = _logarithmic().drawn
    texts = {t.text: (float(t.get("x", "")), float(t.get("y", ""))) for t in ElementTree.fromstring(drawn).iter("text")}
    assert {"force <1>, N", "error, mm", "0.01", "0.1", "1", "10", "10⁻⁴", "10⁰", "10²"} <= set(texts)
    (places,) = re.findall(r'<path d="M([\d. ]+)" fill="none" marker-start="url\(#one-mark0\)"', drawn)
    dots = np.array(places.split(), float).reshape(-1, 2)
    across = np.interp(np.log10([0.02, 0.3, 4.0]), [-2.0, 1.0], [texts["0.01"][0], texts["10"][0]])
    along = np.interp([-3.0, -1.0, 1.0], [-4.0, 2.0], [texts["10⁻⁴"][1] - 2.85, texts["10²"][1] - 2.85])
    np.testing.assert_allclose(dots, np.c_[across, along], atol=0.06)
