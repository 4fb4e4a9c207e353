"""Charts of a page, written as SVG directly: one pair of axes, a few ticks, marks, lines and bars.

A page has dozens of them. Matplotlib takes half a second to load, and some 30 ms for each, nearly all for ticks and the
sizes of texts; as text they take one. They look as its charts do, beside which they stand: the same sizes, strokes,
ticks and letters.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.report.page import Chart, framed
from modcal_core.report.palette import LIGHT

_WIDTH, _HEIGHT = 216.0, 126.0  # points
_LEFT, _TOP = 44.64, 8.64  # of the axes
_BELOW, _BESIDE = 30.24, 5.76  # points from the axes to the edge below and on the right
_TICK, _PAD = 3.5, 3.5
_SMALL, _LARGE = 7.5, 8.0  # print of ticks and of names
_WIDE = {"−": 0.838, ".": 0.318}  # widths of letters in units of their size; digits have another
_DIGIT = 0.636
_OFF = 0.15  # points, an eighth of a line's width: what a drawn curve may be off by
_TICKS = 4  # about as many
_ROOM = 1.08  # of the range of the points that are shown to scale
_FONT = "'DejaVu Sans','Bitstream Vera Sans',Verdana,Geneva,Arial,Helvetica,sans-serif"
_LETTER = 0.6  # usual width of a letter, in units of its size
_LINE = 8.8  # points between lines of small print
_LEGEND = 13.0  # points for a line of what colours and marks stand for
_STEPS: tuple[tuple[float, ...], ...] = (  # of a decade, tried in turn until two numbers stand on the axis
    (1.0,),
    (1.0, 3.0),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
)
_MOST_DECADES = 6  # that are written
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SHAPES = {  # around a point
    "circle": "M-1.4 0a1.4 1.4 0 1 0 2.8 0a1.4 1.4 0 1 0 -2.8 0z",
    "triangle": "M0 -1.4l-1.4 2.8h2.8z",
    "square": "M-1.4 -1.4h2.8v2.8h-2.8z",
}


@dataclass
class Panel:
    """A chart of this range, (low, high) along either axis, to which marks are added.

    Numbers along x are in the unit that its name says, those along y in that of its own name. Colours are names of the
    page's palette. height, width: of the chart [points]. left: room for what stands beside the axes. logarithmic: the
    names of axes that are. ticks: (where, what is said) of axes whose ticks are not round numbers. ruled: whether there
    is a line at zero. legend: what marks stand for, (mark about its middle, words), in a line above.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    height: float = _HEIGHT
    width: float = _WIDTH
    left: float = _LEFT
    logarithmic: str = ""
    ticks: Mapping[str, Sequence[tuple[float, str]]] = field(default_factory=dict)
    ruled: bool = True
    legend: Sequence[tuple[str, str]] = ()
    _drawn: list[str | tuple[str, int]] = field(default_factory=list)  # elements, or places of a mark and its number
    _marks: list[str] = field(default_factory=list)

    @classmethod
    def to_scale(cls, x: Array, y: Array, height: float, width: float = _WIDTH) -> Panel:
        """A chart that shows these points (N,) with both axes to one scale."""
        wide, high = width - _BESIDE - _LEFT, height - _BELOW - _TOP
        scale = _ROOM * max(np.ptp(x) / wide, np.ptp(y) / high, 1e-9)  # units of a point of the chart
        across, along = (0.5 * (float(np.min(v)) + float(np.max(v))) for v in (x, y))
        half, tall = 0.5 * scale * wide, 0.5 * scale * high
        return cls((across - half, across + half), (along - tall, along + tall), height, width)

    @property
    def _bottom(self) -> float:
        return self.height - _BELOW

    @property
    def _right(self) -> float:
        return self.width - _BESIDE

    @property
    def _top(self) -> float:
        return _TOP + _LEGEND * bool(self.legend)

    def dashes(self, x: Array, y: Array, colour: str, half: float, wide: float) -> None:
        """A dash of this half length, in units of the width, at every point (N,); a dot where it has none."""
        length = half * (self._right - self.left)
        drawn = f'<path d="M-{length:.3g} 0H{length:.3g}" style="stroke-linecap:round'
        self._mark(x, y, f'{drawn};stroke:var(--{colour});stroke-width:{wide:g}"/>')

    def hollow(self, x: Array, y: Array, colour: str, shape: str) -> None:
        """A hollow circle, triangle or square at every point (N,)."""
        self._mark(x, y, hollow(colour, shape))

    def _mark(self, x: Array, y: Array, mark: str) -> None:
        """The same mark at every point (N,): drawn once, and set at the corners of a line that is not."""
        places = " ".join(f"{a:.1f} {b:.1f}" for a, b in zip(self._across(x), self._along(y), strict=True))
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

    def strokes(self, begin: Array, end: Array, colour: str, wide: float) -> None:
        """Straight strokes from points (N, 2) to others (N, 2)."""
        from_x, from_y, to_x, to_y = (f(p) for p in (begin.T, end.T) for f in (self._x_of, self._y_of))
        ends = zip(from_x.tolist(), from_y.tolist(), to_x.tolist(), to_y.tolist(), strict=True)
        drawn = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in ends)
        self._drawn.append(f'<path d="{drawn}" style="{_stroke(colour, wide)}"/>')

    def crosses(self, x: Array, y: Array, colour: str, wide: float = 1.6) -> None:
        """A cross at every point (N,)."""
        self._mark(x, y, cross(colour, wide))

    def level(self, y: float, colour: str) -> None:
        """A dashed line across the chart."""
        at = float(self._along(np.array(y)))
        style = f"{_stroke(colour, 0.9)};stroke-dasharray:3.3 1.5"
        self._drawn.append(f'<path d="M{self.left:g} {at:.1f}H{self._right:g}" style="{style}"/>')

    def bars(self, x: Array, y: Array, colour: str, hatched: bool = False) -> None:
        """Bars between the ends x (N, 2) and y (N, 2)."""
        (a, b), (c, d) = self._across(x).T.tolist(), self._along(y).T.tolist()
        corners = zip(a, b, c, d, strict=True)
        drawn = "".join(f"M{e:.1f} {g:.1f}H{f:.1f}V{h:.1f}H{e:.1f}z" for e, f, g, h in corners)
        self._drawn.append(f'<path d="{drawn}" style="{_filled(colour, hatched)};stroke-width:0.8"/>')

    def whisker(self, low: float, high: float, y: float, colour: str) -> None:
        """A line between two numbers along x, with its ends marked."""
        (a, b), at = self._across(np.array([low, high])).tolist(), float(self._along(np.array(y)))
        drawn = f"M{a:.1f} {at:.1f}H{b:.1f}M{a:.1f} {at - 2.5:.1f}v5M{b:.1f} {at - 2.5:.1f}v5"
        self._drawn.append(f'<path d="{drawn}" style="{_stroke(colour, 1.0)}"/>')

    def words(self, x: float, y: float, said: str) -> None:
        """Small print that begins at a point."""
        at = float(self._across(np.array(x))), float(self._along(np.array(y)))
        self._drawn.append(f'<g style="font-family:{_FONT};fill:var(--ink)">{_text(said, *at, 7.0, "start")}</g>')

    def rug(self, x: Array, colour: str) -> None:
        """A short stroke on the axis below at each of these places (N,)."""
        drawn = "".join(f"M{a:.1f} {self._bottom - 4.0:g}v4" for a in self._across(x).tolist())
        self._drawn.append(f'<path d="{drawn}" style="stroke:var(--{colour});stroke-width:0.5"/>')

    def chart(self, name: str, x: str, y: str, alt: str, caption: str) -> Chart:
        """The chart for a page. x, y: what the axes show, with units. alt, caption: as of other charts."""
        return Chart(name, framed(f"{self.body(name, x, y)}</svg>", self.width, self.height, alt), caption)

    def body(self, name: str, x: str, y: str) -> str:
        """What stands in the chart's element. name: unique on the page."""
        ticks, texts, widest = [], [], 0.0
        for value, said in self._ticks("x", self.x):
            at = float(self._across(np.array(value)))
            ticks.append(f"M{at:.2f} {self._bottom:g}v{_TICK}")
            texts.append(_text(said, at, self._bottom + 12.7, _SMALL))
        for value, said in self._ticks("y", self.y):
            at = float(self._along(np.array(value)))
            ticks.append(f"M{self.left:g} {at:.2f}h-{_TICK}")
            lines = said.split("\n")
            first = at + 2.85 - 0.5 * _LINE * (len(lines) - 1)
            texts += [
                _text(line, self.left - _TICK - _PAD, first + _LINE * k, _SMALL, "end") for k, line in enumerate(lines)
            ]
            widest = max(widest, _SMALL * sum(_WIDE.get(letter, _DIGIT) for letter in said))
        texts.append(_text(x, 0.5 * (self.left + self._right), self._bottom + 24.58, _LARGE))
        beside = self.left - _TICK - _PAD - widest - 5.92
        texts += [_text(y, beside, 0.5 * (self._top + self._bottom), _LARGE, turned=True)] if y else []
        clip = f"{name}-inside"
        marks = "".join(_marker(f"{name}-mark{k}", mark) for k, mark in enumerate(self._marks))
        drawn = "".join(_at(*d, name) if isinstance(d, tuple) else d for d in self._drawn)
        ink = "fill:none;stroke:var(--ink);stroke-width:0.8"
        size = f'width="{self._right - self.left:g}" height="{self._bottom - self._top:g}"'
        zero = ""
        if self.ruled:
            at = float(self._along(np.zeros(1))[0])
            zero = f'<path d="M{self.left:g} {at:.2f}H{self._right:g}" style="stroke:var(--line);stroke-width:0.8"/>'
        legend = self._legend(texts)
        hatches = "".join(_hatch(name, colour) for colour in LIGHT if f"@-{colour})" in drawn + legend)
        return (
            f'<rect width="{self.width:g}" height="{self.height:g}" style="fill:var(--paper)"/>'
            f'{marks}<clipPath id="{clip}"><rect x="{self.left:g}" y="{self._top:g}" {size}/></clipPath>{hatches}'
            f'<g clip-path="url(#{clip})">{zero}{drawn}</g>{legend}'
            f'<path d="{"".join(ticks)}" style="{ink}"/>'
            f'<path d="M{self.left:g} {self._top:g}V{self._bottom:g}H{self._right:g}" '
            f'style="{ink};stroke-linecap:square"/>'
            f'<g style="font-family:{_FONT};fill:var(--ink)">{"".join(texts)}</g>'
        ).replace("url(#@-", f"url(#{name}-hatch-")

    def _legend(self, texts: list[str]) -> str:
        """The marks of the legend; its words join the texts."""
        wide = [22.0 + _LETTER * _SMALL * len(words) for _, words in self.legend]
        at = max(0.5 * (self.left + self._right - sum(wide)), 2.0)
        out = []
        for (mark, words), room in zip(self.legend, wide, strict=True):
            out.append(f'<g transform="translate({at + 5.0:.1f} {_TOP - 0.5:.1f})">{mark}</g>')
            texts.append(_text(words, at + 13.0, _TOP + 2.1, _SMALL, "start"))
            at += room
        return "".join(out)

    def _ticks(self, axis: str, ends: tuple[float, float]) -> Sequence[tuple[float, str]]:
        if axis in self.ticks:
            return self.ticks[axis]
        return log_ticks(*ends) if axis in self.logarithmic else _labelled(*ends)

    def _x_of(self, points: Array) -> Array:
        return self._across(points[0])

    def _y_of(self, points: Array) -> Array:
        return self._along(points[1])

    def _across(self, x: Array) -> Array:
        return np.asarray(self.left + _share(x, self.x, "x" in self.logarithmic) * (self._right - self.left))

    def _along(self, y: Array) -> Array:
        return np.asarray(self._bottom - _share(y, self.y, "y" in self.logarithmic) * (self._bottom - self._top))


def _share(value: Array, ends: tuple[float, float], logarithmic: bool) -> Array:
    """How far along an axis values are."""
    low, high = ends
    if logarithmic:
        return np.asarray(np.log(np.maximum(value, 1e-300) / low) / np.log(high / low))
    return np.asarray((value - low) / (high - low))


def log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Ticks of a logarithmic axis in plain numbers, at least two of them where it can be."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps in _STEPS:
        values = np.outer(decades, steps).ravel()
        values = values[(values >= low * (1.0 - 1e-9)) & (values <= high * (1.0 + 1e-9))]
        if len(values) > 1:
            break
    else:  # hardly a stretch of a decade: as a plain axis has them
        values = round_numbers(low, high)[0]
    return [(value, f"{value:g}") for value in values.tolist()]


def decades(low: float, high: float) -> list[tuple[float, str]]:
    """Ticks of a logarithmic axis as powers of ten."""
    exponents = np.arange(np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9) + 1.0).astype(int)
    some = exponents[:: max(-(-len(exponents) // _MOST_DECADES), 1)].tolist()
    return [(10.0**k, "10" + f"{k:d}".translate(_RAISED)) for k in some]


def cross(colour: str, wide: float) -> str:
    """A cross about its middle."""
    return f'<path d="M-2.2 -2.2l4.4 4.4M-2.2 2.2l4.4 -4.4" style="{_stroke(colour, wide)}"/>'


def hollow(colour: str, shape: str) -> str:
    """A hollow circle, triangle or square about its middle."""
    return f'<path d="{_SHAPES[shape]}" style="fill:none;stroke:var(--{colour});stroke-width:0.7"/>'


def swatch(colour: str, hatched: bool) -> str:
    """A small bar about its middle."""
    return f'<path d="M-5 -2.6h10v5.2h-10z" style="{_filled(colour, hatched)};stroke-width:0.8"/>'


def _stroke(colour: str, wide: float) -> str:
    return f"fill:none;stroke:var(--{colour});stroke-width:{wide:g}"


def _filled(colour: str, hatched: bool) -> str:
    """The style of an area; the page's name of a hatching is not known yet."""
    return f"fill:{f'url(#@-{colour})' if hatched else f'var(--{colour})'};stroke:var(--{colour})"


def _hatch(name: str, colour: str) -> str:
    size = 'width="4" height="4" patternUnits="userSpaceOnUse"'
    drawn = f'<path d="M-1 1l2 -2M0 4l4 -4M3 5l2 -2" style="{_stroke(colour, 0.8)}"/>'
    return f'<pattern id="{name}-hatch-{colour}" {size}>{drawn}</pattern>'


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
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in points.tolist())


def _simplified(points: Array) -> Array:
    """Those of the points (N, 2) that a line needs so that it leaves none by more than _OFF (Douglas and Peucker)."""
    kept = np.zeros(len(points), bool)
    kept[[0, -1]] = True
    parts = [(0, len(points) - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        inside, chord = points[first + 1 : last] - points[first], points[last] - points[first]
        length = float(np.hypot(*chord))
        along = inside @ chord / max(length, 1e-12)
        across = np.abs(inside[:, 0] * chord[1] - inside[:, 1] * chord[0]) / max(length, 1e-12)
        off = np.where((along < 0.0) | (along > length), np.hypot(inside[:, 0], inside[:, 1]), across)
        far = int(np.argmax(off))
        if off[far] > _OFF:
            kept[first + 1 + far] = True
            parts += [(first, first + 1 + far), (first + 1 + far, last)]
    return points[kept]


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
