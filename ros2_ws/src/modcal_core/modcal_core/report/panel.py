"""Small charts of points against one number, written as SVG directly.

A page has dozens of them, all alike: one pair of axes, a few ticks, a line at zero. A plotting library takes some 10 to
30 ms for each, nearly all for ticks and the sizes of texts; as text they take one. They look as those of Lets-Plot do,
beside which they stand: the same sizes, strokes and letters.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from modcal_core.geometry import Array
from modcal_core.report.page import LIGHT, Chart, framed

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
