"""Charts of pages: many small ones, written as SVG directly, and a few by Lets-Plot.

A page has dozens of small ones, of points against one number, all alike: one pair of axes, a few ticks, a line at zero.
A plotting library takes some 10 to 30 ms for each, nearly all for ticks and the sizes of texts; as text they take one.
They look as those of Lets-Plot do, beside which they stand: the same sizes, strokes and letters.

Lets-Plot is imported only when a chart is drawn. It loads and draws a chart in 20 ms each, which matters where a whole
calibration takes a second; Matplotlib takes a third of a second to load.
"""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.report.page import INK, LIGHT, Chart, framed

if TYPE_CHECKING:
    from lets_plot.plot.core import PlotSpec


_WIDTH, _HEIGHT = 216.0, 126.0  # points
_LEFT, _RIGHT, _TOP = 44.64, 210.24, 8.64  # of the axes
_BELOW = 30.24  # points from the axis below to the edge
_TICK, _PAD = 3.5, 3.5
_SMALL, _LARGE = 7.5, 8.0  # print of ticks and of names
_WIDE = {"−": 0.838, ".": 0.318}  # widths of letters in units of their size; digits have another
_DIGIT = 0.636
_OFF = 0.15  # points, an eighth of a line's width: what a drawn curve may be off by
_TICKS = 4  # about as many
_ROOM = 1.08  # of the range of the points that are shown to scale
_FONT = "'DejaVu Sans','Bitstream Vera Sans',Verdana,Geneva,Arial,Helvetica,sans-serif"
_SHAPES = {  # around a point
    "circle": "M-1.4 0a1.4 1.4 0 1 0 2.8 0a1.4 1.4 0 1 0 -2.8 0z",
    "triangle": "M0 -1.4l-1.4 2.8h2.8z",
    "square": "M-1.4 -1.4h2.8v2.8h-2.8z",
}


@dataclass
class Panel:
    """A chart of this range, (low, high) along either axis, to which marks are added.

    Numbers along x are in the unit that its name says, those along y in that of its own name. Colours are names of the
    page's palette. height: of the chart [points].
    """

    x: tuple[float, float]
    y: tuple[float, float]
    height: float = _HEIGHT
    _drawn: list[str | tuple[str, int]] = field(default_factory=list)  # elements, or places of a mark and its number
    _marks: list[str] = field(default_factory=list)

    @classmethod
    def to_scale(cls, x: Array, y: Array, height: float) -> Panel:
        """A chart that shows these points (N,) with both axes to one scale."""
        wide, high = _RIGHT - _LEFT, height - _BELOW - _TOP
        scale = _ROOM * max(np.ptp(x) / wide, np.ptp(y) / high, 1e-9)  # units of a point of the chart
        across, along = (0.5 * (float(np.min(v)) + float(np.max(v))) for v in (x, y))
        half, tall = 0.5 * scale * wide, 0.5 * scale * high
        return cls((across - half, across + half), (along - tall, along + tall), height)

    @property
    def _bottom(self) -> float:
        return self.height - _BELOW

    def dashes(self, x: Array, y: Array, colour: str, half: float, wide: float) -> None:
        """A dash of this half length, in units of the width, at every point (N,); a dot where it has none."""
        length = half * (_RIGHT - _LEFT)
        drawn = f'<path d="M-{length:.3g} 0H{length:.3g}" style="stroke-linecap:round'
        self._mark(x, y, f'{drawn};stroke:var(--{colour});stroke-width:{wide:g}"/>')

    def hollow(self, x: Array, y: Array, colour: str, shape: str) -> None:
        """A hollow circle, triangle or square at every point (N,)."""
        self._mark(x, y, f'<path d="{_SHAPES[shape]}" style="fill:none;stroke:var(--{colour});stroke-width:0.7"/>')

    def _mark(self, x: Array, y: Array, mark: str) -> None:
        """The same mark at every point (N,): drawn once, and set at the corners of a line that is not."""
        places = _places(np.stack([self._across(x), self._along(y)], axis=1), " ")
        if places:
            self._marks.append(mark)
            self._drawn.append((places, len(self._marks) - 1))

    def line(self, x: Array, y: Array, colour: str, wide: float) -> None:
        """A line through points (N,) in order."""
        drawn = _path(_simplified(np.c_[self._across(x), self._along(y)]))
        self._drawn.append(f'<path d="{drawn}" style="fill:none;stroke:var(--{colour});stroke-width:{wide:g}"/>')

    def band(self, x: Array, low: Array, high: Array, colour: str) -> None:
        """The area between two lines over the same points (N,)."""
        above, below = (_simplified(np.c_[self._across(x), self._along(y)]) for y in (high, low))
        drawn = f"{_path(np.r_[above, below[::-1]])}z"
        self._drawn.append(f'<path d="{drawn}" style="fill:var(--{colour});fill-opacity:0.45"/>')

    def rug(self, x: Array, colour: str) -> None:
        """A short stroke on the axis below at each of these places (N,)."""
        drawn = "".join(f"M{a:.1f} {self._bottom - 4.0:g}v4" for a in self._across(x).tolist())
        self._drawn.append(f'<path d="{drawn}" style="stroke:var(--{colour});stroke-width:0.5"/>')

    def chart(self, name: str, x: str, y: str, alt: str, caption: str) -> Chart:
        """The chart for a page. x, y: what the axes show, with units. alt, caption: as of other charts."""
        zero = float(self._along(np.zeros(1))[0])
        ticks, texts, widest = [], [], 0.0
        for value, said in _labelled(*self.x):
            at = float(self._across(np.array(value)))
            ticks.append(f"M{at:.2f} {self._bottom:g}v{_TICK}")
            texts.append(_text(said, at, self._bottom + 12.7, _SMALL))
        for value, said in _labelled(*self.y):
            at = float(self._along(np.array(value)))
            ticks.append(f"M{_LEFT} {at:.2f}h-{_TICK}")
            texts.append(_text(said, _LEFT - _TICK - _PAD, at + 2.85, _SMALL, "end"))
            widest = max(widest, _SMALL * sum(_WIDE.get(letter, _DIGIT) for letter in said))
        texts.append(_text(x, 0.5 * (_LEFT + _RIGHT), self._bottom + 24.58, _LARGE))
        beside = _LEFT - _TICK - _PAD - widest - 5.92
        texts.append(_text(y, beside, 0.5 * (_TOP + self._bottom), _LARGE, turned=True))
        clip = f"{name}-inside"
        marks = "".join(_marker(f"{name}-mark{k}", mark) for k, mark in enumerate(self._marks))
        drawn = "".join(_at(*d, name) if isinstance(d, tuple) else d for d in self._drawn)
        ink = "fill:none;stroke:var(--ink);stroke-width:0.8"
        size = f'width="{_RIGHT - _LEFT:g}" height="{self._bottom - _TOP:g}"'
        body = (
            f'<rect width="{_WIDTH:g}" height="{self.height:g}" style="fill:var(--paper)"/>'
            f'{marks}<clipPath id="{clip}"><rect x="{_LEFT}" y="{_TOP}" {size}/></clipPath>'
            f'<g clip-path="url(#{clip})">'
            f'<path d="M{_LEFT} {zero:.2f}H{_RIGHT}" style="stroke:var(--line);stroke-width:0.8"/>'
            f"{drawn}</g>"
            f'<path d="{"".join(ticks)}" style="{ink}"/>'
            f'<path d="M{_LEFT} {_TOP}V{self._bottom:g}H{_RIGHT}" style="{ink};stroke-linecap:square"/>'
            f'<g style="font-family:{_FONT};fill:var(--ink)">{"".join(texts)}</g></svg>'
        )
        return Chart(name, framed(body, _WIDTH, self.height, alt), caption)

    def _across(self, x: Array) -> Array:
        low, high = self.x
        return np.asarray(_LEFT + (x - low) / (high - low) * (_RIGHT - _LEFT))

    def _along(self, y: Array) -> Array:
        low, high = self.y
        return np.asarray(self._bottom - (y - low) / (high - low) * (self._bottom - _TOP))


def side_by_side(charts: Sequence[Chart], height: float) -> str:
    """Charts of panels of one height as a file of its own, SVG, in the colours of light pages."""
    whole = f'viewBox="0 0 {_WIDTH * len(charts):g} {height:g}"'
    parts = [
        one.drawn.replace("<svg", f'<svg x="{k * _WIDTH:g}" width="{_WIDTH:g}" height="{height:g}"', 1)
        for k, one in enumerate(charts)
    ]
    drawn = re.sub(r"var\(--(\w+)\)", lambda found: LIGHT[found[1]], "".join(parts))
    return f'<svg xmlns="http://www.w3.org/2000/svg" {whole}>{drawn}</svg>\n'


def _marker(name: str, mark: str) -> str:
    """A mark that lines refer to, in the units of the page."""
    box = 'viewBox="-4 -4 8 8" markerWidth="8" markerHeight="8" markerUnits="userSpaceOnUse"'
    return f'<marker id="{name}" {box}>{mark}</marker>'


def _at(places: str, k: int, name: str) -> str:
    """The k-th mark of a chart at these places."""
    ends = "".join(f' marker-{end}="url(#{name}-mark{k})"' for end in ("start", "mid", "end"))
    return f'<path d="M{places}" fill="none"{ends}/>'


def _path(points: Array) -> str:
    """Points (N, 2) as the path of a line, to a tenth of a point: less than its width."""
    return "M" + _places(points, "L")


def _places(points: Array, between: str) -> str:
    """Points (N, 2) to a tenth, all at once, which takes a third of the time of one after the other."""
    return (f"{between}%.1f %.1f" * len(points))[1:] % tuple(points.ravel().tolist())


def _simplified(points: Array) -> Array:
    """The points (N, 2) that a line needs to stay within _OFF of all of them (Douglas and Peucker)."""
    if len(points) < 3:
        return points
    kept = np.array([0, len(points) - 1])
    while True:  # all parts between points that are kept at once
        first, last = kept[:-1], kept[1:]
        part = np.repeat(np.arange(len(first)), last - first)
        inside, chord = points[:-1] - points[first][part], points[last] - points[first]
        length, chord = np.hypot(*chord.T)[part], chord[part]
        along = np.einsum("ni,ni->n", inside, chord) / np.maximum(length, 1e-12)
        across = np.abs(inside[:, 0] * chord[:, 1] - inside[:, 1] * chord[:, 0]) / np.maximum(length, 1e-12)
        off = np.where((along < 0.0) | (along > length), np.hypot(inside[:, 0], inside[:, 1]), across)
        far = np.flatnonzero((off > _OFF) & (off == np.maximum.reduceat(off, first)[part]))
        if not len(far):
            return points[kept]
        kept = np.sort(np.r_[kept, far[np.unique(part[far], return_index=True)[1]]])


def round_numbers(low: float, high: float) -> tuple[Array, float]:
    """(Round numbers from low to high, about four and at least two; the step between them)."""
    raw = (high - low) / _TICKS
    decade = 10.0 ** np.floor(np.log10(raw))
    steps = [part * decade for part in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 2.5, 5.0, 10.0)]
    usual = next(i for i, step in enumerate(steps) if step >= raw * (1.0 - 1e-9))
    for step in steps[usual::-1]:
        first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
        if last > first:
            break
    return np.arange(first, last + 1.0) * step, float(step)


def _labelled(low: float, high: float) -> list[tuple[float, str]]:
    """Where the ticks stand, and what they say: all with as many digits behind the point."""
    values, step = round_numbers(low, high)
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    digits += int(abs(step * 10.0**digits - round(step * 10.0**digits)) > 1e-6)
    usual = digits <= 5 and np.abs(values).max() < 1e6
    said = [f"{value:.{digits}f}" if usual else f"{value:.3g}" for value in values + 0.0]
    return [(float(value), text.replace("-", "−")) for value, text in zip(values, said, strict=True)]


def _text(said: str, x: float, y: float, size: float, anchor: str = "middle", turned: bool = False) -> str:
    turn = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if turned else ""
    style = f"font-size:{size:g}px;text-anchor:{anchor}"
    return f'<text x="{x:.2f}" y="{y:.2f}"{turn} style="{style}">{escape(said)}</text>'


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
_FILE_FONT = "DejaVu Sans, Bitstream Vera Sans, Verdana, Geneva, Arial, Helvetica, sans-serif"


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
