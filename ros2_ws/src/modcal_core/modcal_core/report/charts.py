"""Charts of pages, written as SVG in the page's colours.

A chart is a :class:`Panel`: two axes, to which marks, lines and bars are added. As text each takes a millisecond, where
a plotting library takes some 20.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Self

import numpy as np

from modcal_core.geometry import Array

INK, SOFT, LINE, PAPER, PANEL = "ink", "soft", "line", "paper", "panel"
AFTER, BEFORE, GOOD, WARN, BAD = "after", "before", "good", "warn", "bad"

# Text stands on paper and on panels in ink, soft, after, good, warn and bad: those keep a contrast of 4.5 there.
COLOURS: dict[str, tuple[str, str]] = {
    INK: ("#1c2430", "#e6eaf0"),
    SOFT: ("#566172", "#a9b3c1"),
    LINE: ("#d5dbe4", "#3a4350"),
    PAPER: ("#ffffff", "#12161c"),
    PANEL: ("#f3f6fa", "#1c222b"),
    AFTER: ("#1a5fd0", "#7db1ff"),
    BEFORE: ("#8791a0", "#7f8a99"),
    GOOD: ("#2c6a38", "#7fcb8d"),
    WARN: ("#85560a", "#e3b560"),
    BAD: ("#b3263c", "#ff8f99"),
}
LIGHT = {name: light for name, (light, _) in COLOURS.items()}
DARK = {name: dark for name, (_, dark) in COLOURS.items()}
OF_AXES = ((BAD, "circle"), (GOOD, "triangle"), (AFTER, "square"))  # x, y, z

# Lengths of a chart are points: three small charts fill a row of a page.
SMALL, LARGE = (216.0, 126.0), (331.0, 166.0)
_PX = 1.48  # of the page, per point
_NARROWEST = 300.0  # px; a wider chart is shrunk no further than 0.65 of its size, and can be moved sideways instead
_LEFT, _RIGHT, _TOP, _BELOW = 44.64, 5.76, 8.64, 30.24  # from the edges to the axes
_KEYS = 13.0  # height of a legend
_TICK, _PAD = 3.5, 3.5
_TICK_PRINT, _NAME_PRINT = 7.5, 8.0  # sizes of letters
_WIDE = {"−": 0.838, ".": 0.318}  # widths of letters in units of their size; digits and others have another
_DIGIT = 0.636
_TICKS = 4  # about as many
_MAX_DECADES = 7  # with a number on an axis
_IN_POWERS = 1e4  # ratio of the ends of a logarithmic axis, beyond which powers of ten stand on it
_STEPS: tuple[tuple[float, ...], ...] = (  # of a decade, tried in turn until two numbers stand on the axis
    (1.0,),
    (1.0, 3.0),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
)
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_FONT = "'DejaVu Sans','Bitstream Vera Sans',Verdana,Geneva,Arial,Helvetica,sans-serif"
_SHAPES = {  # around a point; all but dot and dash hollow
    "circle": "M-1.4 0a1.4 1.4 0 1 0 2.8 0a1.4 1.4 0 1 0 -2.8 0z",
    "triangle": "M0 -1.4l-1.4 2.8h2.8z",
    "square": "M-1.4 -1.4h2.8v2.8h-2.8z",
    "cross": "M-1.4 -1.4l2.8 2.8M-1.4 1.4l2.8 -2.8",
    "dot": "M0 0H0",
    "dash": "M-2 0H2",
    "line": "M-5 0H5",
    "bar": "M-3 -3h6v6h-6z",
}


@dataclass(frozen=True)
class Chart:
    """A picture of a page. drawn: SVG in the page's colours. caption: under it. name: unique there. width [points]."""

    name: str
    drawn: str
    caption: str
    width: float


@dataclass(frozen=True)
class Axis:
    """An axis from low to high. words: what it shows, with its unit. log: whether it is logarithmic. names: what stands
    at 0, 1, 2, … in place of numbers. whole: whether it counts.
    """

    words: str
    low: float
    high: float
    log: bool = False
    names: tuple[str, ...] = ()
    whole: bool = False

    @classmethod
    def around(cls, words: str, values: Array, margin: float = 0.04) -> Self:
        """A linear axis with room beside these values (N,)."""
        low, high = float(np.min(values)), float(np.max(values))
        room = margin * max(high - low, 1e-6)
        return cls(words, low - room, high + room)

    @classmethod
    def decades(cls, words: str, low: float, high: float) -> Self:
        """A logarithmic axis with room for the marks of the outermost."""
        room = (high / low) ** 0.05
        return cls(words, low / room, high * room, log=True)

    @classmethod
    def rows(cls, names: Sequence[str]) -> Self:
        """Names one below the other, the first above."""
        return cls("", len(names) - 0.5, -0.5, names=tuple(names))

    def share(self, values: Array) -> Array:
        """Where values stand, 0 at low and 1 at high."""
        low, high, at = self.low, self.high, np.asarray(values, dtype=float)
        if self.log:
            low, high, at = np.log10(low), np.log10(high), np.log10(np.maximum(at, 1e-3 * self.low))
        return np.asarray((at - low) / (high - low))

    def ticks(self) -> list[tuple[float, str]]:
        """Where ticks stand, and what they say."""
        if self.names:
            return [(float(k), name) for k, name in enumerate(self.names)]
        if self.log:
            powers = self.high > _IN_POWERS * self.low
            places = _in_numbers(self.low, self.high)
            return [(x, f"10{f'{np.log10(x):.0f}'.translate(_RAISED)}" if powers else f"{x:g}") for x in places]
        ticks = _labelled(self.low, self.high)
        return [(value, f"{value + 0.0:.0f}") for value, _ in ticks if value == round(value)] if self.whole else ticks


@dataclass
class Panel:
    """A chart to which marks are added. width, height [points]. keys: (words, colour, shape) of a legend above it.

    Colours are names of the page's palette, shapes those of ``_SHAPES``.
    """

    x: Axis
    y: Axis
    width: float = SMALL[0]
    height: float = SMALL[1]
    keys: tuple[tuple[str, str, str], ...] = ()
    _drawn: list[str] = field(default_factory=list)
    _marks: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Where the axes stand, beside the names and below the legend."""
        longest = max(map(len, self.y.names), default=0)
        beside = max(_LEFT, _TICK + _PAD + 4.0 + 0.62 * _TICK_PRINT * longest) if longest else 8.0
        self._left, self._right = beside if self.y.names else _LEFT, self.width - _RIGHT
        self._top, self._bottom = _TOP + (_KEYS if self.keys else 0.0), self.height - _BELOW

    def marks(self, x: Array, y: Array, colour: str, shape: str = "circle", wide: float = 0.7) -> None:
        """The same mark at every point (N,): drawn once, and set at the corners of a line that is not seen."""
        places = _places(np.stack([self._across(x), self._along(y)], axis=1), " ")
        if places:
            name = f"@mark{len(self._marks)}"  # chart() puts its own name for the @
            box = 'viewBox="-4 -4 8 8" markerWidth="8" markerHeight="8" markerUnits="userSpaceOnUse"'
            self._marks.append(f'<marker id="{name}" {box}>{_mark(shape, colour, wide)}</marker>')
            ends = "".join(f' marker-{end}="url(#{name})"' for end in ("start", "mid", "end"))
            self._drawn.append(f'<path d="M{places}" fill="none"{ends}/>')

    def line(self, x: Array, y: Array, colour: str, wide: float = 1.1, dashed: bool = False) -> None:
        """A line through points (N,) in order."""
        drawn = "M" + _places(np.c_[self._across(x), self._along(y)], "L")
        more = ";stroke-dasharray:4 2" if dashed else ""
        self._drawn.append(f'<path d="{drawn}" style="fill:none;stroke:var(--{colour});stroke-width:{wide:g}{more}"/>')

    def band(self, x: Array, low: Array, high: Array, colour: str) -> None:
        """The area between two lines over the same points (N,)."""
        above, below = (np.c_[self._across(x), self._along(y)] for y in (high, low))
        drawn = f"M{_places(np.r_[above, below[::-1]], 'L')}z"
        self._drawn.append(f'<path d="{drawn}" style="fill:var(--{colour});fill-opacity:0.45"/>')

    def bars(self, x: tuple[Array, Array], y: tuple[Array, Array], colour: str, full: float = 1.0) -> None:
        """Rectangles between the ends (N,) along both axes. full: opacity of what is inside; 0 leaves an outline."""
        ends = [*map(self._across, x), *map(self._along, y)]
        drawn = "".join(
            f"M{a:.1f} {c:.1f}H{b:.1f}V{d:.1f}H{a:.1f}z" for a, b, c, d in np.stack(np.broadcast_arrays(*ends), -1)
        )
        look = f"fill:var(--{colour});fill-opacity:{full:g}" if full else f"fill:none;stroke:var(--{colour})"
        self._drawn.append(f'<path d="{drawn}" style="{look};stroke-width:0.8"/>')

    def rug(self, x: Array, colour: str) -> None:
        """A short stroke on the axis below at each of these places (N,)."""
        drawn = "".join(f"M{a:.1f} {self._bottom - 4.0:g}v4" for a in self._across(x).tolist())
        self._drawn.append(f'<path d="{drawn}" style="stroke:var(--{colour});stroke-width:0.5"/>')

    def chart(self, name: str, alt: str, caption: str) -> Chart:
        """The chart for a page. alt: what it shows, for those who do not see it. caption: how to read it."""
        ticks, texts, widest = [], [], 0.0
        for value, said in self.x.ticks():
            at = float(self._across(np.array(value)))
            ticks.append(f"M{at:.2f} {self._bottom:g}v{_TICK}")
            texts.append(_text(said, at, self._bottom + 12.7, _TICK_PRINT))
        for value, said in self.y.ticks():
            at = float(self._along(np.array(value)))
            ticks.append(f"M{self._left:g} {at:.2f}h-{_TICK}")
            texts.append(_text(said, self._left - _TICK - _PAD, at + 2.85, _TICK_PRINT, "end"))
            widest = max(widest, _TICK_PRINT * sum(_WIDE.get(letter, _DIGIT) for letter in said))
        texts.append(_text(self.x.words, 0.5 * (self._left + self._right), self._bottom + 24.58, _NAME_PRINT))
        if self.y.words:
            beside = self._left - _TICK - _PAD - widest - 5.92
            texts.append(_text(self.y.words, beside, 0.5 * (self._top + self._bottom), _NAME_PRINT, turned=True))
        ink = "fill:none;stroke:var(--ink);stroke-width:0.8"
        size = f'width="{self._right - self._left:g}" height="{self._bottom - self._top:g}"'
        zero = ""
        if not self.y.log and self.y.low < 0.0 < self.y.high:
            at = float(self._along(np.zeros(1))[0])
            zero = f'<path d="M{self._left:g} {at:.2f}H{self._right:g}" style="stroke:var(--line);stroke-width:0.8"/>'
        inside = (
            f'{"".join(self._marks)}<clipPath id="@in"><rect x="{self._left:g}" y="{self._top:g}" {size}/></clipPath>'
            f'<g clip-path="url(#@in)">{zero}{"".join(self._drawn)}</g>'
        ).replace("@", f"{name}-")
        body = (
            f'<rect width="{self.width:g}" height="{self.height:g}" style="fill:var(--paper)"/>'
            f'{inside}<path d="{"".join(ticks)}" style="{ink}"/>'
            f'<path d="M{self._left:g} {self._top:g}V{self._bottom:g}H{self._right:g}" '
            f'style="{ink};stroke-linecap:square"/>'
            f'<g style="font-family:{_FONT};fill:var(--ink)">{self._legend()}{"".join(texts)}</g>'
        )
        natural = _PX * self.width
        least = min(natural, max(_NARROWEST, 0.65 * natural))
        drawn = (
            f'<svg class="chart" viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{escape(alt, quote=True)}" style="max-width:{natural:.0f}px;min-width:{least:.0f}px">'
            f"{body}</svg>"
        )
        return Chart(name, drawn, caption, self.width)

    def _legend(self) -> str:
        out, at = [], self._left + 6.0
        for said, colour, shape in self.keys:
            out.append(f'<g transform="translate({at:.1f} {_TOP})">{_mark(shape, colour, 1.1)}</g>')
            out.append(_text(said, at + 8.0, _TOP + 2.85, _TICK_PRINT, "start"))
            at += 24.0 + 0.6 * _TICK_PRINT * len(said)
        return "".join(out)

    def _across(self, x: Array) -> Array:
        return np.asarray(self._left + self.x.share(x) * (self._right - self._left))

    def _along(self, y: Array) -> Array:
        return np.asarray(self._bottom - self.y.share(y) * (self._bottom - self._top))


def _mark(shape: str, colour: str, wide: float) -> str:
    """A mark around the origin."""
    fill = f"var(--{colour})" if shape == "bar" else "none"
    round_ends = ";stroke-linecap:round" if shape in ("dot", "dash") else ""
    style = f"fill:{fill};stroke:var(--{colour});stroke-width:{wide:g}{round_ends}"
    return f'<path d="{_SHAPES[shape]}" style="{style}"/>'


def _places(points: Array, between: str) -> str:
    """Points (N, 2) to a tenth, all at once, which takes a third of the time of one after the other."""
    return (f"{between}%.1f %.1f" * len(points))[1:] % tuple(points.ravel().tolist())


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
    """Ticks of a linear axis, all with as many digits behind the point."""
    values, step = round_numbers(low, high)
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    digits += int(abs(step * 10.0**digits - round(step * 10.0**digits)) > 1e-6)
    usual = digits <= 5 and np.abs(values).max() < 1e6
    said = [f"{value:.{digits}f}" if usual else f"{value:.3g}" for value in values + 0.0]
    return [(float(value), text.replace("-", "−")) for value, text in zip(values, said, strict=True)]


def _in_numbers(low: float, high: float) -> list[float]:
    """Ticks of a logarithmic axis, at least two of them."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps in _STEPS:
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= low * (1.0 - 1e-9)) & (ticks <= high * (1.0 + 1e-9))]
        if len(ticks) > 1:
            break
    else:  # hardly a stretch of a decade: as a linear axis has them
        ticks = round_numbers(low, high)[0]
    return list(ticks[:: -(-len(ticks) // _MAX_DECADES)].tolist())


def _text(said: str, x: float, y: float, size: float, anchor: str = "middle", turned: bool = False) -> str:
    turn = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if turned else ""
    style = f"font-size:{size:g}px;text-anchor:{anchor}"
    return f'<text x="{x:.2f}" y="{y:.2f}"{turn} style="{style}">{escape(said)}</text>'
