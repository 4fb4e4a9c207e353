"""Charts by Lets-Plot for pages: one look, numbers on logarithmic axes, and SVG in the page's colours.

Lets-Plot is imported only when a chart is drawn. It loads and draws a chart in 20 ms each, which matters where a whole
calibration takes a second; Matplotlib takes a third of a second to load.
"""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from collections.abc import Mapping
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.report.page import INK, LIGHT, Chart, framed
from modcal_core.report.panel import round_numbers

if TYPE_CHECKING:
    from lets_plot.plot.core import PlotSpec

LARGE, SMALL = 12, 11  # px of the page; print of names and of ticks
_LINE = 2.2  # px; the width of a line of size 1, and the diameter of a dot
SQUARE, CIRCLE, TRIANGLE, CROSS, DOT = 0, 1, 2, 4, 16  # marks, all but the dot hollow
_MAX_DECADES = 7  # with a number on an axis
_STEPS: tuple[tuple[float, ...], ...] = (  # of a decade, tried in turn until two numbers stand on the axis
    (1.0,),
    (1.0, 3.0),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
)
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_FONT = "DejaVu Sans, Bitstream Vera Sans, Verdana, Geneva, Arial, Helvetica, sans-serif"


def plot(width: float, height: float, x: str, y: str, legend: str = "none", **data: Any) -> PlotSpec:
    """An empty chart of this size [px of the page], to which layers are added. x, y: what the axes show, with units.

    legend: where it stands: none, top, right. data: columns that all layers can use, each (N,).
    """
    import lets_plot as lp

    ink = LIGHT[INK]
    look = lp.theme(
        text=lp.element_text(family="DejaVu Sans", color=ink, size=SMALL),
        axis_title=lp.element_text(size=LARGE),
        axis_line=lp.element_line(color=ink, size=1.2),
        axis_ticks=lp.element_line(color=ink, size=1.2),
        axis_ticks_length=5,
        legend_position=legend,
        legend_direction="horizontal" if legend == "top" else None,
        legend_title=lp.element_blank(),
        legend_key_size=14,
        legend_margin=[0, 0, 2, 0],
        legend_background=lp.element_blank(),
        legend_box_spacing=2,
        plot_background=lp.element_blank(),
        panel_background=lp.element_blank(),
        plot_margin=[2, 6, 2, 2],
    )
    return lp.ggplot(columns(data)) + lp.theme_classic() + look + lp.labs(x=x, y=y) + lp.ggsize(width, height)


def columns(data: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Columns (N,) as Lets-Plot takes them: arrays, for it looks at each number of a list."""
    return {name: np.asarray(column) for name, column in data.items()}


def line_size(px: float) -> float:
    """The size that gives a line of this width, or a dot of this diameter."""
    return px / _LINE


def in_numbers(low: float, high: float) -> dict[str, Any]:
    """Ticks of a logarithmic axis from low to high in plain numbers, at least two of them where it can be."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps in _STEPS:
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= low * (1.0 - 1e-9)) & (ticks <= high * (1.0 + 1e-9))]
        if len(ticks) > 1:
            break
    else:  # hardly a stretch of a decade: as a plain axis has them
        ticks = round_numbers(low, high)[0]
    ticks = ticks[:: -(-len(ticks) // _MAX_DECADES)]
    return {"breaks": ticks.tolist(), "labels": [f"{tick:g}" for tick in ticks]}


def in_decades(low: float, high: float) -> dict[str, Any]:
    """Ticks of a logarithmic axis from low to high as powers of ten."""
    powers = np.arange(np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9) + 1.0)
    powers = powers[:: -(-len(powers) // _MAX_DECADES) or 1]
    return {"breaks": (10.0**powers).tolist(), "labels": [f"10{f'{p:.0f}'.translate(_RAISED)}" for p in powers]}


def with_margin(low: float, high: float, share: float = 0.05) -> tuple[float, float]:
    """Ends of a logarithmic axis for numbers from low to high, with room for the marks of the outermost."""
    room = (high / low) ** share
    return low / room, high * room


def chart(drawn: PlotSpec, name: str, alt: str, caption: str) -> Chart:
    """The chart for a page. alt: what it shows, for those who do not see it. caption: how to read it."""
    body, width, height = _tidy(drawn, name)
    return Chart(name, framed(f"{body}</svg>", width, height, alt, px=1.0), caption)


def svg(drawn: PlotSpec, name: str) -> str:
    """The chart as a file of its own, SVG, in the colours of light pages; the same bytes for the same chart."""
    body, width, height = _tidy(drawn, name)
    body = re.sub(r"var\(--(\w+)\)", lambda found: LIGHT[found[1]], body)
    size = f'width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="{_FONT}" fill="{LIGHT[INK]}">{body}</svg>\n'


def limits_to_scale(x: Array, y: Array, ratio: float) -> tuple[list[float], list[float]]:
    """Ends of two axes of one scale that show all of these points (N,). ratio: width to height of the space."""
    half = 0.54 * max(float(np.ptp(x)), ratio * float(np.ptp(y)), 1e-9)
    across, along = (0.5 * (float(np.min(v)) + float(np.max(v))) for v in (x, y))
    return [across - half, across + half], [along - half / ratio, along + half / ratio]


# What Lets-Plot writes and a page does not need, and what stands there instead
_SHORTER: tuple[tuple[str, str], ...] = (
    (r"(?s)<style.*?</style>", ""),
    (r"\s*\n\s*", ""),
    (r"<tspan>(.*?)</tspan>", r"\1"),
    # charts side by side are pictures within the picture
    (r'<svg [^>]*\bx="([^"]*)" y="([^"]*)"[^>]*>', r'<g transform="translate(\1 \2)">'),
    (r"</svg>", "</g>"),
    (r"xlink:href", "href"),
    (r' (?:class|clip-bounds-jfx|buffered-rendering|pointer-events|fill-rule)="[^"]*"', ""),
    (r"(?:fill:#\w+;|font-family:[^;]*;)", ""),
    (r' (?:fill|stroke)-opacity="1\.0"| transform="(?:rotate\(0\.0 [^"]*)?"', ""),
    (r'fill="[^"]+" fill-opacity="0(?:\.0)?"', 'fill="none"'),
    (r' stroke="[^"]+" stroke-opacity="0(?:\.0)?"', ""),
    (r' stroke="[^"]+"([^>]*) stroke-width="0\.0"', r"\1"),
    (r'<path fill="none"(?! stroke)[^>]*></path>', ""),  # frames that are not seen
    (r"></(?:circle|rect|line|path)>", "/>"),
    (r"<path/>", ""),
    (r">-(\d)", r">−\1"),  # numbers of an axis
)


def _tidy(drawn: PlotSpec, name: str) -> tuple[str, float, float]:
    """(What stands in the SVG element of a chart, its width, its height), in the page's colours and no larger than it
    need be. name: of the chart, which its ids begin with; Lets-Plot's own differ from run to run.
    """
    whole = _drawn(drawn)
    width, height = (float(re.search(rf'<svg [^>]*\b{side}="([\d.]+)"', whole)[1]) for side in ("width", "height"))  # type: ignore[index]
    body = whole[whole.index(">") + 1 : whole.rindex("</svg>")]
    for pattern, instead in _SHORTER:
        body = re.sub(pattern, instead, body)
    for colour, light in LIGHT.items():
        parts = ",".join(str(int(light[k : k + 2], 16)) for k in (1, 3, 5))
        body = body.replace(light, f"var(--{colour})").replace(f"rgb({parts})", f"var(--{colour})")
    body = re.sub(r"<[^>]+>", lambda tag: re.sub(r"-?\d+\.\d+(?:E-?\d+)?", _short, tag[0]), body)
    body = re.sub(r"\s+(/?>)", r"\1", body)
    used = dict.fromkeys(re.findall(r"url\(#(\w+)\)", body))
    body = re.sub(r' id="(\w+)"', lambda one: one[0] if one[1] in used else "", body)
    for k, one in enumerate(used):
        body = body.replace(f"(#{one})", f"(#{name}-{k})").replace(f'id="{one}"', f'id="{name}-{k}"')
    body = re.sub(r"<defs>(?:<clipPath><rect[^>]*></clipPath>)*</defs>", "", body)
    while (fewer := re.sub(r"<g(?: [^>]*)?></g>", "", body)) != body:
        body = fewer
    body = re.sub(r"(?:<(?:circle|rect|path|line) [^>]*/>){3,}", lambda run: _grouped(run[0]), body)
    return body, width, height


def _grouped(marks: str) -> str:
    """Marks of which neighbours look alike, as SVG with shared attributes stated once."""
    looks = [
        ("".join(sorted(re.findall(r' (?:fill|stroke|stroke-width)="[^"]*"', mark))), mark)
        for mark in re.findall(r"<[^>]*>", marks)
    ]
    out = []
    for look, alike in groupby(looks, key=itemgetter(0)):
        bare = "".join(re.sub(r' (?:fill|stroke|stroke-width)="[^"]*"', "", mark) for _, mark in alike)
        out.append(f"<g{look}>{bare}</g>")
    return "".join(out)


_drawing: list[int] = []  # the process that has drawn first, this one or one that it was forked from


def _drawn(one: PlotSpec) -> str:
    """The chart as Lets-Plot draws it, in SVG.

    Its threads are not in a process that is forked from one that has drawn, which would wait for them without an end:
    there, a new process draws.
    """
    if not _drawing:
        _drawing.append(os.getpid())
    if os.getpid() in _drawing:
        return str(one.to_svg())
    draw = "import pickle, sys; sys.stdout.write(pickle.load(sys.stdin.buffer).to_svg())"
    done = subprocess.run([sys.executable, "-c", draw], input=pickle.dumps(one), capture_output=True, check=True)
    return done.stdout.decode()


def _short(number: re.Match[str]) -> str:
    """The number to a hundredth."""
    text = f"{float(number[0]):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
