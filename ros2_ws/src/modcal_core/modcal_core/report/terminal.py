"""What a report says on one screen: tables, the account of the squared error among them, and sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.outcome import STAGES, Outcome
from modcal_core.report.blocks import Summary, SummaryLine, SummaryTable, Tone, legend
from modcal_core.report.words import MAX_REASONS, sentence
from modcal_core.verdict import Row, Status, Verdict

EFFECT = "effect:"
_WORDS = {
    "shared": "shared among effects",
    "predictable": "predictable, not modelled",
    "estimation": "uncertainty of the parameters",
    "repeatability": "repeatability of the arm",
    "unaccounted": "unaccounted for",
}
_OF_FLOOR = ("repeatability", "instrument")
_ROUNDING = 1e-9  # of the whole; the rows sum to it within as much


@dataclass(frozen=True)
class Line:
    """A row of the account in words. share: of the nominal model's squared error. rms: root of the value, with the
    value's sign. ci95: the interval of the value. known: False for a part of the floor where that is not known.
    effect: whether it is what an effect explains.
    """

    words: str
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


def accounts(verdict: Verdict | None) -> tuple[Account, ...]:
    """Accounts of position and orientation, where there are any."""
    if verdict is None:
        return ()
    both = (("mm", verdict.account_mm2, verdict.floor_mm), ("deg", verdict.account_deg2, verdict.floor_deg))
    out = []
    for unit, rows, floor in both:
        if rows:
            total = sum(row.value for row in rows)
            lines = (_line(row, total, floor is not None or row.what not in _OF_FLOOR) for row in rows)
            out.append(Account(unit, total, tuple(lines)))
    return tuple(out)


def _line(row: Row, total: float, known: bool) -> Line:
    value = 0.0 if abs(row.value) < _ROUNDING * total else row.value
    effect = row.what.startswith(EFFECT)
    words = _WORDS.get(row.what, row.what.replace("_", " "))
    if effect:
        words = row.what.removeprefix(EFFECT).replace(":", " of ")
    rms = float(np.copysign(np.sqrt(abs(value)), value))
    return Line(words, value, value / max(total, 1e-300), rms, row.ci95, known, effect)


TONES: dict[Status, Tone] = {"at_floor": "good", "open": "bad", "cannot_tell": "undecided"}
# What stands in the tables, below them
_STAGES = {
    "nominal": "the robot description, base and tool fitted",
    "geometric": "lengths, angles and joint zeros corrected",
    "final": "the effects below as well",
}
_EFFECTS = {
    "place": "where the error arises",
    "direction": "the way it moves the arm there",
    "driver": "what its size depends on",
    "p": "probability of as much by chance, after everything that was tried",
    "RMS": "held-out error without the effect and with it",
}
_SHARES = {"share": "of the squared error of the nominal model"}
_SMALL, _MANY = 0.01, 3  # effects with less than this share stand in one row where there are so many; all are in files
_TOGETHER = f"{{}} effects of less than {_SMALL:.0%} each, in report.json"
_RESULTS: dict[str, Tone] = {"PASS": "good", "FAIL": "bad"}


def summary(report: Outcome) -> tuple[Summary, ...]:
    """Before and after, what the data could not tell, the effects, the account, and the verdict."""
    return tuple(_blocks(report))


def _blocks(report: Outcome) -> Iterator[Summary]:
    rows = []
    for stage in STAGES:
        size, angle = report.size_mm(stage), report.size_deg(stage)
        if size is not None:
            numbers = [f"{x:.3f}" for x in (size.mean, size.rms, size.p95, size.max)]
            rows.append((stage, *numbers, "" if angle is None else f"{angle.rms:.4f}"))
    names = ("mean mm", "RMS mm", "95 % mm", "max mm", "RMS deg")
    yield SummaryTable((f"held-out error ({report.sets.unit}s)", *names), tuple(rows))
    yield legend({stage: said for stage, said in _STAGES.items() if any(row[0] == stage for row in rows)})
    seen = report.identifiability
    if seen is not None:
        said = f"{seen.parameters} parameters, rank {seen.rank} (directions that the stations determine), "
        yield SummaryLine(said + f"condition {seen.condition:.0f} (largest over smallest singular value)")
        for name in seen.unobservable:
            yield SummaryLine(f"not determined by these stations: {name}", "doubt")
    if report.effects:
        yield _effects(report)
        yield legend(_EFFECTS)
        yield from map(SummaryLine, report.story)
    for note in report.notes:
        yield SummaryLine(note, "doubt")
    if judged := accounts(report.judged):
        yield from map(_account, judged)
        yield legend(_SHARES)
    yield SummaryLine(sentence(report), TONES[report.status])
    for reason in report.open_because[MAX_REASONS:]:
        yield SummaryLine(f"Open: {reason}", "reason")
    if report.claim is not None:
        yield SummaryLine(report.claim.sentence, "plain" if report.claim.apply else "doubt")
    if report.tolerance is not None:
        met = report.tolerance
        yield SummaryLine(f"{met.result}: {met.because}", _RESULTS.get(met.result, "undecided"))


def _account(one: Account) -> SummaryTable:
    """Contributions to the squared error of the nominal model, many small ones of effects as one row."""
    small = [line for line in one.lines if line.effect and abs(line.share) < _SMALL]
    together = small if len(small) >= _MANY else []
    rows = []
    for line in one.lines:
        ends = "" if line.ci95 is None else f"{line.ci95[0]:.3g} … {line.ci95[1]:.3g}"
        numbers = (f"{line.value:.4g}", ends, f"{100.0 * line.share:.2f} %") if line.known else ("not known", "", "")
        if line not in together:
            rows.append((line.words, *numbers))
        elif line is together[-1]:
            value, share = sum(each.value for each in together), sum(each.share for each in together)
            rows.append((_TOGETHER.format(len(together)), f"{value:.4g}", "", f"{100.0 * share:.2f} %"))
    rows.append(("nominal model", f"{one.total:.4g}", "", ""))
    return SummaryTable(("account of the squared error", f"{one.unit}²", "95 % interval", "share"), tuple(rows))


def _effects(report: Outcome) -> SummaryTable:
    rows = tuple(
        (f.family, f.place, f.direction, f.driver, f"{f.p_value:.1g}", f"{1e3 * f.before:.3f}", f"{1e3 * f.after:.3f}")
        for f in report.effects
    )
    return SummaryTable(("effect", "place", "direction", "driver", "p", "RMS mm before", "after"), rows, words=4)
