"""Small charts of points against one number, written as SVG directly.

A page has dozens of them, all alike: one pair of axes, a few ticks, a line at zero. Matplotlib takes some 30 ms for
each, nearly all for ticks and the sizes of texts; as text they take one. They look as its charts do, beside which they
stand: the same sizes, strokes, ticks and letters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.report.page import Chart, framed

_WIDTH, _HEIGHT = 216.0, 126.0  # points
_LEFT, _RIGHT, _TOP, _BOTTOM = 44.64, 210.24, 8.64, 95.76  # of the axes
_TICK, _PAD = 3.5, 3.5
_SMALL, _LARGE = 7.5, 8.0  # print of ticks and of names
_WIDE = {"−": 0.838, ".": 0.318}  # widths of letters in units of their size; digits have another
_DIGIT = 0.636
_TICKS = 4  # about as many
_FONT = "'DejaVu Sans','Bitstream Vera Sans',Verdana,Geneva,Arial,Helvetica,sans-serif"
_SHAPES = {  # around a point, in units of half a marker
    "circle": "m-{0} 0a{0} {0} 0 1 0 {1} 0a{0} {0} 0 1 0 -{1} 0z",
    "triangle": "m0 -{0}l-{0} {1}h{1}z",
    "square": "m-{0} -{0}h{1}v{1}h-{1}z",
}


@dataclass
class Panel:
    """A chart of this range, (low, high) along either axis, to which marks are added.

    Numbers along x are in the unit that its name says, those along y in that of its own name. Colours are names of the
    page's palette.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    _drawn: list[str] = field(default_factory=list)

    def dashes(self, x: Array, y: Array, colour: str, half: float, wide: float) -> None:
        """A dash of this half length, in units of the width, at every point (N,); a dot where it has none."""
        length = 2.0 * half * (_RIGHT - _LEFT)
        across, along = self._across(x) - 0.5 * length, self._along(y)
        path = "".join(f"M{a:.2f} {b:.2f}h{length:.3g}" for a, b in zip(across.tolist(), along.tolist(), strict=True))
        self._drawn.append(
            f'<path d="{path}" style="fill:none;stroke:var(--{colour});stroke-width:{wide:g};stroke-linecap:round"/>'
        )

    def hollow(self, x: Array, y: Array, colour: str, shape: str) -> None:
        """A hollow circle, triangle or square at every point (N,)."""
        mark = _SHAPES[shape].format("1.2", "2.4")
        points = zip(self._across(x).tolist(), self._along(y).tolist(), strict=True)
        path = "".join(f"M{a:.2f} {b:.2f}{mark}" for a, b in points)
        self._drawn.append(f'<path d="{path}" style="fill:none;stroke:var(--{colour});stroke-width:0.7"/>')

    def chart(self, name: str, x: str, y: str, alt: str, caption: str) -> Chart:
        """The chart for a page. x, y: what the axes show, with units. alt, caption: as of other charts."""
        zero = float(self._along(np.zeros(1))[0])
        ticks, texts, widest = [], [], 0.0
        for value, said in _labelled(*self.x):
            at = float(self._across(np.array(value)))
            ticks.append(f"M{at:.2f} {_BOTTOM}v{_TICK}")
            texts.append(_text(said, at, _BOTTOM + 12.7, _SMALL))
        for value, said in _labelled(*self.y):
            at = float(self._along(np.array(value)))
            ticks.append(f"M{_LEFT} {at:.2f}h-{_TICK}")
            texts.append(_text(said, _LEFT - _TICK - _PAD, at + 2.85, _SMALL, "end"))
            widest = max(widest, _SMALL * sum(_WIDE.get(letter, _DIGIT) for letter in said))
        texts.append(_text(x, 0.5 * (_LEFT + _RIGHT), 120.34, _LARGE))
        beside = _LEFT - _TICK - _PAD - widest - 5.92
        texts.append(_text(y, beside, 0.5 * (_TOP + _BOTTOM), _LARGE, turned=True))
        clip = f"{name}-inside"
        ink = "fill:none;stroke:var(--ink);stroke-width:0.8"
        size = f'width="{_RIGHT - _LEFT:g}" height="{_BOTTOM - _TOP:g}"'
        body = (
            f'<rect width="{_WIDTH:g}" height="{_HEIGHT:g}" style="fill:var(--paper)"/>'
            f'<clipPath id="{clip}"><rect x="{_LEFT}" y="{_TOP}" {size}/></clipPath>'
            f'<g clip-path="url(#{clip})">'
            f'<path d="M{_LEFT} {zero:.2f}H{_RIGHT}" style="stroke:var(--line);stroke-width:0.8"/>'
            f"{''.join(self._drawn)}</g>"
            f'<path d="{"".join(ticks)}" style="{ink}"/>'
            f'<path d="M{_LEFT} {_TOP}V{_BOTTOM}H{_RIGHT}" style="{ink};stroke-linecap:square"/>'
            f'<g style="font-family:{_FONT};fill:var(--ink)">{"".join(texts)}</g></svg>'
        )
        return Chart(name, framed(body, _WIDTH, _HEIGHT, alt), caption)

    def _across(self, x: Array) -> Array:
        low, high = self.x
        return np.asarray(_LEFT + (x - low) / (high - low) * (_RIGHT - _LEFT))

    def _along(self, y: Array) -> Array:
        low, high = self.y
        return np.asarray(_BOTTOM - (y - low) / (high - low) * (_BOTTOM - _TOP))


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
