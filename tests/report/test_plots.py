"""Charts that Lets-Plot draws: marks where the numbers of the axes say, the page's colours, the same bytes anywhere."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
import pytest

from modcal_core.report.page import AFTER, LIGHT, Chart
from modcal_core.report.plots import chart, columns, in_decades, in_numbers, line_size, plot, svg

X, Y = np.array([0.02, 0.3, 4.0]), np.array([1e-3, 1e-1, 10.0])


def _plotted() -> object:
    import lets_plot as lp

    drawn = plot(400, 300, "force <1>, N", "error, mm", at=X, miss=Y)
    drawn += lp.geom_point(lp.aes("at", "miss"), color=LIGHT[AFTER], size=line_size(4.0))
    drawn += lp.scale_x_log10(limits=[0.008, 12.0], expand=[0, 0], **in_numbers(0.008, 12.0))
    return drawn + lp.scale_y_log10(limits=[8e-5, 120.0], expand=[0, 0], **in_decades(8e-5, 120.0))


def _drawn() -> Chart:
    return chart(_plotted(), "one", "Three points.", "three points")  # type: ignore[arg-type]


def _placed(
    element: ElementTree.Element, x: float = 0.0, y: float = 0.0
) -> Iterator[tuple[ElementTree.Element, float, float]]:
    """Every element with where its group has been moved to."""
    if moved := re.search(r"translate\(([-\d.]+) ([-\d.]+)", element.get("transform", "")):
        x, y = x + float(moved[1]), y + float(moved[2])
    yield element, x, y
    for child in element:
        yield from _placed(child, x, y)


def test_points_stand_where_the_numbers_of_the_axes_say() -> None:
    every = list(_placed(ElementTree.fromstring(_drawn().drawn)))
    texts = {e.text: (x, y) for e, x, y in every if e.tag == "text"}
    assert {"force <1>, N", "error, mm", "0.01", "0.1", "1", "10", "10⁻⁴", "10⁰", "10²"} <= set(texts)
    points = [(x + float(e.get("cx", "")), y + float(e.get("cy", ""))) for e, x, y in every if e.tag == "circle"]
    assert len(points) == len(X)
    across = np.interp(np.log10(X), [-2.0, 1.0], [texts["0.01"][0], texts["10"][0]])
    along = np.interp(np.log10(Y), [-4.0, 2.0], [texts["10⁻⁴"][1], texts["10²"][1]])
    np.testing.assert_allclose(points, np.c_[across, along], atol=0.06)  # written to a hundredth, moved a few times


def test_a_chart_has_the_colours_of_the_page_and_names_of_its_own() -> None:
    drawn = _drawn().drawn
    assert f"var(--{AFTER})" in drawn
    assert LIGHT[AFTER] not in drawn
    assert not re.search(r"rgb\(|class=\"(?!chart)|://", drawn)
    assert set(re.findall(r' id="([^"]+)"', drawn)) == {"one-0"} == set(re.findall(r"url\(#([^)]+)\)", drawn))


def test_a_file_has_colours_of_its_own() -> None:
    drawn = svg(_plotted(), "one")  # type: ignore[arg-type]
    assert drawn.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert LIGHT[AFTER] in drawn
    assert "var(" not in drawn
    assert ElementTree.fromstring(drawn).tag.endswith("svg")


def test_columns_are_arrays_and_drawn_as_lists_are(monkeypatch: pytest.MonkeyPatch) -> None:
    data = {"a": np.array([1, 2]), "b": ["x", "y"]}
    assert {name: column.tolist() for name, column in columns(data).items()} == {"a": [1, 2], "b": ["x", "y"]}
    drawn = svg(_plotted(), "one")  # type: ignore[arg-type]
    monkeypatch.setattr("modcal_core.report.plots.columns", lambda data: {k: list(v) for k, v in data.items()})
    assert svg(_plotted(), "one") == drawn  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_process_that_was_forked_draws_the_same() -> None:
    """Lets-Plot's threads stay behind with the process that has drawn before; whoever waits for them waits for ever."""
    drawn = _drawn()
    assert _drawn() == drawn
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        os._exit(0 if _drawn() == drawn else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
