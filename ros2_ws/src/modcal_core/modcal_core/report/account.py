"""The account of the squared error for a page: its rows in words, and a picture of them."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import fill

import numpy as np

from modcal_core.report.page import AFTER, BAD, INK, LIGHT, SOFT, WARN, Chart
from modcal_core.report.plots import chart, in_decades, line_size, plot, with_margin
from modcal_core.verdict import Row, Verdict

EFFECT = "effect:"
# How a row is called on a page, and its colour: what the model took away, what it leaves though it could be predicted,
# what no model can take away, and what nobody has a name for.
_WORDS = {
    "geometry": ("geometry", AFTER),
    "shared": ("shared among effects", AFTER),
    "predictable": ("predictable, not modelled", BAD),
    "estimation": ("uncertainty of the parameters", SOFT),
    "repeatability": ("repeatability of the arm", SOFT),
    "instrument": ("instrument", SOFT),
    "unaccounted": ("unaccounted for", WARN),
}
_OF_FLOOR = ("repeatability", "instrument")
_ROUNDING = 1e-9  # of the whole; the rows sum to it within as much
_LETTERS = 30  # of a line beside the bars
_MIN_DECADE = 1e-6  # of the largest row; smaller ones are drawn as this


@dataclass(frozen=True)
class Line:
    """A row of the account in words. share: of the nominal model's squared error. rms: root of the value, with the
    value's sign. ci95: the interval of the value. known: False for a part of the floor where that is not known.
    effect: whether it is what an effect explains.
    """

    words: str
    colour: str
    value: float
    share: float
    rms: float
    ci95: tuple[float, float] | None
    known: bool
    effect: bool


@dataclass(frozen=True)
class Account:
    """One account. unit: mm or deg. total: squared error of the nominal model."""

    unit: str
    total: float
    lines: tuple[Line, ...]

    def drawn(self) -> Chart:
        """Its picture."""
        return _chart(tuple(line for line in self.lines if line.known), self.unit)


def account(rows: tuple[Row, ...], unit: str, floor: float | None) -> Account:
    """The account as text. unit: mm or deg. floor: None where it is not known."""
    total = sum(row.value for row in rows)
    lines = tuple(_line(row, total, floor is not None or row.what not in _OF_FLOOR) for row in rows)
    return Account(unit, total, lines)


def accounts(verdict: Verdict | None) -> tuple[Account, ...]:
    """Accounts of position and orientation, where there are any."""
    if verdict is None:
        return ()
    both = (("mm", verdict.account_mm2, verdict.floor_mm), ("deg", verdict.account_deg2, verdict.floor_deg))
    return tuple(account(rows, unit, floor) for unit, rows, floor in both if rows)


def in_words(what: str) -> str:
    """Name of a row as text."""
    if what.startswith(EFFECT):
        return what.removeprefix(EFFECT).replace(":", " of ")
    return _WORDS.get(what, (what.replace("_", " "), SOFT))[0]


def _line(row: Row, total: float, known: bool) -> Line:
    value = 0.0 if abs(row.value) < _ROUNDING * total else row.value
    effect = row.what.startswith(EFFECT)
    colour = AFTER if effect else _WORDS.get(row.what, ("", SOFT))[1]
    rms = float(np.copysign(np.sqrt(abs(value)), value))
    return Line(in_words(row.what), colour, value, value / max(total, 1e-300), rms, row.ci95, known, effect)


def _chart(lines: tuple[Line, ...], unit: str) -> Chart:
    """A bar a row on a logarithmic axis, outlined where negative, with whiskers for the interval."""
    import lets_plot as lp

    names = [fill(line.words, _LETTERS) for line in lines]
    high = 62 + 21 * len(lines) + 11 * sum(name.count("\n") + 1 for name in names)
    longest = max(len(part) for name in names for part in name.split("\n"))
    most = max(abs(line.value) for line in lines) or 1.0
    least = _MIN_DECADE * most
    ends = with_margin(0.5 * least, max([most, *(line.ci95[1] for line in lines if line.ci95)]), 0.02)
    drawn = plot(362 + 8 * longest, high, f"squared error, {unit}²", "")
    for k, line in enumerate(lines):
        if not line.value:
            continue
        tone, outlined = LIGHT[line.colour], line.value < 0.0
        bar = {"xmin": 0.5 * least, "xmax": max(abs(line.value), least), "ymin": k - 0.31, "ymax": k + 0.31}
        drawn += lp.geom_rect(**bar, fill="rgba(0,0,0,0)" if outlined else tone, color=tone, size=line_size(1.2))
        if line.ci95 is not None and not outlined:
            low, top = (max(end, least) for end in line.ci95)
            drawn += lp.geom_errorbar(y=k, xmin=low, xmax=top, width=0.4, color=LIGHT[INK], size=line_size(1.3))
    drawn += lp.scale_x_log10(limits=list(ends), expand=[0, 0], **in_decades(*ends))
    rows = list(range(len(lines)))
    drawn += lp.scale_y_reverse(limits=[-0.5, len(lines) - 0.5], expand=[0, 0], breaks=rows, labels=names)
    drawn += lp.theme(axis_line_y=lp.element_blank(), axis_ticks_y=lp.element_blank())
    said = "; ".join(f"{line.words} {line.value:.3g}" for line in lines)
    alt = f"Account of the squared error of the nominal model in {unit}²: {said}."
    words = (
        "Contributions to the squared error of the nominal model, on a logarithmic axis. Outlined: negative. "
        "Whiskers: 95 % interval."
    )
    return chart(drawn, f"account-{unit}", alt, words)
