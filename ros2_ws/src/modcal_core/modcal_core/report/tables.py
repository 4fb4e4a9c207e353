"""Tables that page, terminal and certificate share: errors by stage, effects, and the account of the squared error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import TYPE_CHECKING

from modcal_core.geometry import Array
from modcal_core.outcome import STAGES, Outcome
from modcal_core.report.blocks import Summary, SummaryLine, TableBlock, legend
from modcal_core.report.words import STATISTICS
from modcal_core.robots import PARAMETERS
from modcal_core.verdict import Row, Verdict

if TYPE_CHECKING:
    from modcal_core.calibration import ByDistances

_EFFECT_COLUMNS = {
    "place": "where the error arises",
    "direction": "the way it moves the arm there",
    "driver": "what its size depends on",
    "error": "RMS over what was held out, without the effect and with it",
    "p": "probability of as much by chance, after everything that was tried",
}
_WORDS = {
    "shared": "shared among effects",
    "predictable": "predictable, not modelled",
    "estimation": "uncertainty of the parameters",
    "repeatability": "repeatability of the arm",
    "unaccounted": "unaccounted for",
}
_OF_FLOOR = ("repeatability", "instrument")
_EFFECT = "effect:"
_ROUNDING = 1e-9  # of the whole; the rows sum to it within as much
_SMALL, _MANY = 0.01, 3  # effects with less than this share stand in one row where there are so many; all are in files


def error_tables(report: Outcome, stages: Mapping[str, str] | None = None) -> list[TableBlock]:
    """Sizes of the held-out errors, positions and orientations apart. stages: those that are shown, and their names."""
    stages = stages or {stage: stage for stage in STAGES}
    position, orientation = [], []
    for stage, name in stages.items():
        if (size := report.size_mm(stage)) is not None:
            ends = span(report.interval_mm(stage), 3)
            position.append((name, *(f"{x:.3f}" for x in astuple(size)), ends))
        if (angle := report.size_deg(stage)) is not None:
            orientation.append((name, *(f"{x:.4f}" for x in astuple(angle))))
    header = ("position error, mm", *STATISTICS.values(), "95 % interval of the RMS")
    out = [TableBlock("Position errors before and after", header, tuple(position), strong=2)] if position else []
    if orientation:
        turned = ("orientation error, °", *STATISTICS.values())
        out.append(TableBlock("Orientation errors before and after", turned, tuple(orientation), strong=2))
    return out


def effects_table(report: Outcome) -> TableBlock:
    """What was added to the geometry."""
    header = ("effect", "place", "direction", "driver", "moves the tool by, mm", "error without it, mm", "with it, mm")
    rows = tuple(
        (
            *(f.family.replace("_", " "), f.place, f.direction, f.driver.replace(":", " of ")),
            *("" if x is None else f"{1e3 * x:.3f}" for x in (f.tool, f.before, f.after)),
            f"{f.p_value:.1g}",
        )
        for f in report.effects
    )
    return TableBlock("Effects", (*header, "p"), rows, words=4, below=legend(_EFFECT_COLUMNS).text.strip())


def account_tables(verdict: Verdict | None, fold: bool = False) -> list[TableBlock]:
    """Where the squared error of the nominal model went, of positions and orientations, where that is known.

    fold: small rows of effects as one row.
    """
    if verdict is None:
        return []
    both = (("mm", verdict.account_mm2, verdict.floor_mm), ("deg", verdict.account_deg2, verdict.floor_deg))
    return [_account(unit, rows, floor is not None, fold) for unit, rows, floor in both if rows]


def _account(unit: str, rows: Sequence[Row], floor_known: bool, fold: bool) -> TableBlock:
    total = sum(row.value for row in rows)
    small = [row for row in rows if row.what.startswith(_EFFECT) and abs(row.value) < _SMALL * total]
    small = small if fold and len(small) >= _MANY else []
    # parts that overlap by more than the whole, or that leave more of it than there was, are no shares of it
    divided = all(abs(row.value) <= (1.0 + _ROUNDING) * total for row in rows)
    cells = []
    for row in rows:
        known = floor_known or row.what not in _OF_FLOOR
        if row not in small:
            sizes = (*_sizes(row.value, total, divided), span(row.ci95)) if known else ("not known", "", "", "")
            cells.append((_words(row.what), *sizes))
        elif row is small[-1]:
            words = f"{len(small)} effects of less than {_SMALL:.0%} each, in report.json"
            cells.append((words, *_sizes(sum(one.value for one in small), total, divided), ""))
    cells.append(("nominal model", *_sizes(total, total), ""))
    header = ("account of the squared error", f"{unit}²", "of the nominal", f"root, {unit}", f"95 % interval, {unit}²")
    return TableBlock(f"Account in {unit}²", header, tuple(cells))


def distances_table(found: ByDistances | None) -> list[Summary]:
    """A Delta from distances alone, method by method, and what distances cannot tell; nothing where not asked for."""
    if found is None:
        return []
    rows = tuple((m.name, f"{1e3 * m.f:.4f}", f"{1e3 * m.held_out:.4f}", f"{m.evaluations}") for m in found.methods)
    header = ("by distances alone", "RMS of fitted distances, mm", "held-out RMS, mm", "evaluations")
    said = (
        f"Of the Delta's {PARAMETERS} parameters distances between {found.points} points show {found.seen.rank}; not "
    )
    lines = [f"{said}shown, and left nominal: {'; '.join(found.seen.unseen) or 'none'}."]
    lines += [f"Ended at a bound of what is allowed: {', '.join(found.at_bound)}."] * bool(found.at_bound)
    return [TableBlock("By distances alone", header, rows), *map(SummaryLine, lines)]


def _sizes(value: float, total: float, divided: bool = True) -> tuple[str, str, str]:
    """A part of the squared error: itself, as a share where the whole can be divided, and its root with its sign."""
    value = 0.0 if abs(value) < _ROUNDING * total else value
    root = abs(value) ** 0.5 * (-1.0 if value < 0.0 else 1.0)
    share = f"{round(100.0 * value / max(total, 1e-300), 2) + 0.0:.2f} %" if divided else "cannot be divided"
    return f"{value:.4g}", share, f"{root:.4f}"


def _words(what: str) -> str:
    effect = what.removeprefix(_EFFECT)
    return effect.replace(":", " of ") if effect != what else _WORDS.get(what, what.replace("_", " "))


def span(ends: Sequence[float] | None, digits: int | None = None) -> str:
    """Both ends of an interval, with three significant digits or so many behind the point; nothing for None."""
    form = ".3g" if digits is None else f".{digits}f"
    return "" if ends is None else " … ".join(f"{end:{form}}" for end in ends)


def csv_text(names: Sequence[str], rows: Array, digits: str = ".9f") -> str:
    """Numbers (N, n) as CSV under their names."""
    return ",".join(names) + "\n" + "".join(",".join(f"{x:{digits}}" for x in row) + "\n" for row in rows)


def stations_table(title: str, joints: Sequence[str], q: Array) -> TableBlock:
    """Postures (N, n) in their order."""
    rows = tuple((str(i), *(f"{x:.4f}" for x in row)) for i, row in enumerate(q, 1))
    return TableBlock(f"{title}, rad or m", ("station", *joints), rows, heading=True)
