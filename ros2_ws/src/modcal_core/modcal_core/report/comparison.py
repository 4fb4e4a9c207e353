"""Two calibrations, checks or cells side by side, and the history of an arm, for programs and for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import ndtri

from modcal_core.calibration import Calibration
from modcal_core.effects import Sizes, claimed
from modcal_core.errors import BadRobot, NotEnoughData
from modcal_core.files import to_json
from modcal_core.moves import Series
from modcal_core.outcome import ToolDifference, tool_difference
from modcal_core.report.as_json import picked, sizes_to_json
from modcal_core.report.blocks import Summary, SummaryLine, TableBlock, VerbResult, legend, scaled, tone_of

_MAX_SAID = 90  # characters of a verdict in a table


@dataclass(frozen=True)
class HistoryEntry:
    """One calibration or check. time: [s]; None where its recording has no clock. said: its verdict."""

    name: str
    what: str
    date: str | None
    time: float | None
    said: str


@dataclass(frozen=True)
class History:
    """Of one robot: its name, entries in order of time, series of what may grow."""

    robot: str
    entries: tuple[HistoryEntry, ...]
    series: tuple[Series, ...]
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The answer, as text."""
        trends = [s.sentence for s in self.series if s.trend is not None]
        seen = f"{len(self.entries)} calibrations and checks"
        return " ".join(trends) or f"Nothing grows or falls beyond chance over {seen}."


def history_report(found: Sequence[History]) -> VerbResult:
    """The history of some robots as a verb leaves it."""
    data = {
        "modcal_history": 1,
        "robots": [
            {
                "robot": h.robot,
                "verdict": h.sentence,
                "entries": [{"name": e.name, "what": e.what, "date": e.date, "verdict": e.said} for e in h.entries],
                "series": [_series(s) for s in h.series],
                "notes": list(h.notes),
            }
            for h in found
        ],
    }
    said = [block for h in found for block in _shown(h)]
    return VerbResult(data, said, {"history.json": to_json(data)}, "History", "history.json")


def _series(s: Series) -> dict[str, Any]:
    trend = None
    if (t := s.trend) is not None:
        trend = {**picked(t, "change", "share", "days"), "ci95": [t.low, t.high], "sentence": s.sentence}
    return {
        **picked(s, "name", "unit"),
        "points": [picked(p, "entry", "value", "std") for p in s.points],
        "trend": trend,
    }


def _shown(h: History) -> list[Summary]:
    """What a terminal shows of a robot."""
    rows = tuple((e.name, e.what, (e.date or "")[:10], _short(e.said)) for e in h.entries)
    out: list[Summary] = [TableBlock("", (f"robot {h.robot}", "what", "date", "verdict"), rows, words=4)]
    growing = tuple(
        (s.name, f"{s.points[0].value:.4g}", f"{s.points[-1].value:.4g}", f"{t.low:+.3g} … {t.high:+.3g}", s.unit)
        for s in h.series
        if (t := s.trend) is not None
    )
    if growing:
        out.append(TableBlock("", ("grows or falls", "first", "last", "95 % of the change", "unit"), growing))
    out += [SummaryLine(note, "doubt") for note in h.notes]
    return [*out, SummaryLine(h.sentence, "warn" if growing else "good")]


def _short(said: str) -> str:
    first = said.partition(". ")[0].rstrip(".")
    return first if len(first) <= _MAX_SAID else first[: _MAX_SAID - 1] + "…"


_TAIL = 0.05  # of differences that are taken for real while there is none, all parameters together


Result = Literal["same", "differs", "within tolerance", "beyond tolerance", "cannot tell"]
_NORMAL = 1.96  # deviations of a 95 % interval
_LARGEST = 12  # parameters on a terminal
_LEGEND = {
    "±": "one standard deviation",
    "difference": "the second minus the first",
    "shown": "whether it is more than the uncertainty of both explains, at 95 % for all parameters together",
    "of base or tool": "base and tool take it up",
}
_SET_UP = ("frame ", "tool/", "instrument ")  # parameters that are not the arm's


@dataclass(frozen=True)
class Side:
    """One of the two. name: as the user gave it. report: the data of its report.json; None where there is none."""

    name: str
    calibration: Calibration | None = None
    report: Mapping[str, Any] | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from whatever is there."""
        if self.calibration is not None:
            return tuple(self.calibration.nominal.chain.names)
        return tuple((self.report or {}).get("recording", {}).get("joints", ()))

    @property
    def parameters(self) -> tuple[tuple[str, float, float, str], ...]:
        """(name, value, standard deviation, unit) of every fitted parameter."""
        if self.calibration is not None:
            return self.calibration.parameters
        rows = (self.report or {}).get("parameters", ())
        return tuple((str(r["name"]), float(r["value"]), float(r["std"]), str(r["unit"])) for r in rows)


def compare(first: Side, second: Side, tolerance_mm: float | None = None) -> VerbResult:
    """The comparison: the data of comparison.json, and what a terminal shows.

    tolerance_mm: what may differ at the tool, 95th percentile; None: not judged. Raises BadRobot for arms with other
    joints, NotEnoughData where there is nothing that both have.
    """
    if first.joints and second.joints and first.joints != second.joints:
        raise BadRobot(
            f"{first.name} has joints {', '.join(first.joints)}",
            f"{second.name} has {', '.join(second.joints)}",
            "compare calibrations of one arm",
        )
    one, two = first.calibration, second.calibration
    tool = None if one is None or two is None else tool_difference(one, two)
    without = [side.name for side in (first, second) if _final(side) is None]
    if tool is None and without:
        remedy = "give folders of modcal calibrate or modcal evaluate"
        raise NotEnoughData(" and ".join(without), "holds no error to compare", remedy)
    result, sentence = _judged_tool(tool, tolerance_mm) if tool is not None else _judged_errors(first, second)
    sides = {"first": _effects_of(first), "second": _effects_of(second)}
    of_base_or_tool = frozenset() if tool is None else tool.of_base_or_tool
    data = {
        "modcal_comparison": 1,
        "result": result,
        "verdict": sentence,
        "tolerance_mm": tolerance_mm,
        "sides": [_side(side) for side in (first, second)],
        "tool": None
        if tool is None
        else {
            "postures": len(tool.q),
            "mm": asdict(tool.size_mm),
            "deg": tool.size_deg and asdict(tool.size_deg),
            **picked(tool, "left_out", expected_rms_mm="expected_mm"),
            "base_to_tip_as_they_are_mm": asdict(tool.as_they_are_mm),
        },
        "of_base_or_tool": sorted(of_base_or_tool),
        "parameters": _parameters(first, second, of_base_or_tool),
        "effects": [
            {
                "effect": name,
                **{w: None if name not in side else sizes_to_json(side[name]) for w, side in sides.items()},
            }
            for name in {**sides["first"], **sides["second"]}
        ],
        "notes": list(_notes(first, second, tool)),
    }
    files = {"comparison.json": to_json(data)}
    return VerbResult(data, _summary(data), files, "Comparison", "comparison.json")


def _parameters(first: Side, second: Side, of_base_or_tool: frozenset[str]) -> list[dict[str, Any]]:
    """Those of the arm in the order of the chain, then base, tool and instruments.

    shown: whether the difference is more than the uncertainty of both, at 95 % for all parameters together; None where
    that cannot be asked: in one only, or a motion that base or tool can take up.
    """
    tables = [{name: (value, std, unit) for name, value, std, unit in side.parameters} for side in (first, second)]
    names = sorted(dict.fromkeys([*tables[0], *tables[1]]), key=lambda name: name.startswith(_SET_UP))
    both = len(tables[0].keys() & tables[1].keys())
    limit = float(-ndtri(0.5 * _TAIL / max(both, 1)))  # Bonferroni: all together hold with 95 %
    out = []
    for name in names:
        one, two = (table.get(name) for table in tables)
        row: dict[str, Any] = {"name": name, "unit": next(found[2] for found in (one, two) if found)}
        row |= {side: x and {"value": x[0], "std": x[1]} for side, x in (("first", one), ("second", two))}
        row |= dict.fromkeys(("difference", "difference_ci95", "shown"))
        if one and two:
            apart, std = two[0] - one[0], float(np.hypot(one[1], two[1]))
            row |= {"difference": apart, "difference_ci95": [apart - _NORMAL * std, apart + _NORMAL * std]}
            if name not in of_base_or_tool and std > 0.0:
                row["shown"] = bool(abs(apart) > limit * std)
        out.append(row)
    return out


def _effects_of(side: Side) -> dict[str, Sizes]:
    """Sizes of the effects by name, as its report has them; of a calibration alone the names."""
    if side.report is not None and (rows := side.report.get("effects")):
        return {
            _named(e["family"], e["place"], e["direction"], e["driver"]): {
                name: (q["value"], q["std"], q["unit"]) for name, q in e["parameters"].items()
            }
            for e in rows
        }
    effects = () if side.calibration is None else side.calibration.calibrated.effects
    return {_named(e.family, e.place, e.direction, e.public_driver): {} for e in effects if claimed(e)}


def _named(family: str, place: str, direction: str, driver: str) -> str:
    return f"{family.replace('_', ' ')}: {place} {direction} by {driver.replace(':', ' of ')}"


def _final(side: Side) -> Mapping[str, Any] | None:
    """Sizes of the final error of its report [mm]."""
    errors = (side.report or {}).get("error_mm") or {}
    return errors.get("final") or None


def _judged_tool(tool: ToolDifference, tolerance: float | None) -> tuple[Result, str]:
    size, expected = tool.size_mm, tool.expected_mm
    angle = "" if tool.size_deg is None else f" and {tool.size_deg.rms:.3g}°"
    said = (
        f"At the tool the two differ by {size.rms:.3f} mm RMS ({size.p95:.3f} mm at 95 %, {size.max:.3f} mm at most)"
        f"{angle} over {len(tool.q)} postures, base and tool fitted to each other."
    )
    within = expected is not None and size.rms <= expected
    if expected is None:
        said += " One of them does not keep its uncertainty."
    else:
        how = "no more than" if within else "more than"
        said += f" That is {how} their uncertainty explains ({expected:.3f} mm RMS with 95 %)."
    result: Result = "same" if within else "differs"
    words = "No difference is shown." if within else "They differ."
    if tolerance is not None and size.p95 > tolerance:
        result = "cannot tell" if within else "beyond tolerance"
        words = f"They differ by more than {tolerance:g} mm{', but within their uncertainty' if within else ''}."
    elif tolerance is not None and not within:
        result, words = "within tolerance", f"They differ, by less than {tolerance:g} mm."
    elif tolerance is not None and expected is not None and expected > tolerance:
        result, words = "cannot tell", f"Their uncertainty is larger than {tolerance:g} mm: it cannot be told."
    return result, f"{words} {said}"


def _judged_errors(first: Side, second: Side) -> tuple[Result, str]:
    """Of two reports: whether the errors differ by more than their intervals."""
    sizes = [size for side in (first, second) if (size := _final(side))]
    said = " and ".join(f"{e['rms']:.3f} mm RMS in {s.name}" for e, s in zip(sizes, (first, second), strict=True))
    ends = [e["rms_ci95"] for e in sizes if e.get("rms_ci95") is not None]
    if len(ends) < 2:
        return "cannot tell", f"The error is {said}; one of them has no interval."
    apart = ends[0][1] < ends[1][0] or ends[1][1] < ends[0][0]
    word, how = ("They differ", "do not overlap") if apart else ("No difference is shown", "overlap")
    spans = " and ".join(f"{low:.3f} … {high:.3f} mm" for low, high in ends)
    return ("differs" if apart else "same"), f"{word}. The error is {said}; their 95 % intervals, {spans}, {how}."


def _notes(first: Side, second: Side, tool: ToolDifference | None) -> tuple[str, ...]:
    out = []
    one, two = first.calibration, second.calibration
    if one is not None and two is not None:
        if one.robot != two.robot:
            out.append("The nominal kinematics differ: parameters are deviations from different descriptions.")
        if one.kind != two.kind:
            out.append(f"Readings are of different kinds ({one.kind}, {two.kind}): other parameters may be fitted.")
        low, high = np.maximum(one.seen[0], two.seen[0]), np.minimum(one.seen[1], two.seen[1])
        wide = np.maximum(one.seen[1] - one.seen[0], two.seen[1] - two.seen[0])
        few = [n for n, a, b, w in zip(first.joints, low, high, wide, strict=True) if b - a < 0.5 * w]
        if few:
            out.append(
                f"The recordings share less than half of the range of {', '.join(few)}: there one of the two "
                "calibrations is used where it has seen nothing."
            )
        out.append("The uncertainty is that of the fits: an effect that neither model has is not in it.")
    for side in (first, second):
        if side.report is not None and side.report.get("status") == "open":
            reasons = side.report.get("open_because") or ["no reason is given"]
            out.append(f"{side.name} is open: {reasons[0]}")
    if tool is not None and tool.left_out:
        out.append(f"Not compared at the tool, for a posture does not determine them: {', '.join(tool.left_out)}.")
    return tuple(out)


def _side(side: Side) -> dict[str, Any]:
    report = side.report or {}
    trace = report.get("trace") or {}
    return {
        "name": side.name,
        **{name: trace.get(name) for name in ("date", "version", "robot")},
        "stations": (report.get("recording") or {}).get("stations"),
        "status": report.get("status"),
        "error_mm": _final(side),
        "tolerance": (report.get("tolerance") or {}).get("result"),
    }


def _summary(data: Mapping[str, Any]) -> list[Summary]:
    """What a terminal shows: errors, the parameters that differ most for their uncertainty, effects, result."""
    names = tuple(side["name"] for side in data["sides"])
    rows = []
    for side in data["sides"]:
        e = side["error_mm"] or {}
        numbers = [f"{e[k]:.3f}" if k in e else "" for k in ("mean", "rms", "p95", "max")]
        rows.append((side["name"], *numbers, side["status"] or "", side["tolerance"] or ""))
    header = ("error on scored stations", "mean mm", "RMS mm", "95 % mm", "max mm", "status", "tolerance")
    out: list[Summary] = [TableBlock("", header, tuple(rows))]
    own = [row for row in data["parameters"] if not row["name"].startswith(_SET_UP)]
    for si in sorted({row["unit"] for row in own}):  # a table never mixes two units
        (unit, factor), part = scaled(si), sorted((row for row in own if row["unit"] == si), key=_rank)
        more = f" {len(part) - _LARGEST} more are in comparison.json." if len(part) > _LARGEST else ""
        head = (f"parameters, {unit}", *names, "difference", "95 % interval", "shown")
        cells = tuple(_cells(row, factor) for row in part[:_LARGEST])
        out.append(TableBlock("", head, cells, below=legend(_LEGEND) + more))
    if data["effects"]:
        rows = [(e["effect"], *("no" if e[s] is None else "yes" for s in ("first", "second"))) for e in data["effects"]]
        out.append(TableBlock("", ("effect", *names), tuple(rows)))
    out += [SummaryLine(note, "doubt") for note in data["notes"]]
    return [*out, SummaryLine(data["verdict"], tone_of(data["result"]))]


def _rank(row: Mapping[str, Any]) -> tuple[bool, float]:
    """The largest for its uncertainty before the others."""
    low, high = row["difference_ci95"] or (0.0, np.inf)
    return row["shown"] is None, -abs(row["difference"] or 0.0) / max(high - low, 1e-300)


def _cells(row: Mapping[str, Any], factor: float) -> tuple[str, ...]:
    sides = [
        "not fitted" if one is None else f"{factor * one['value']:.4f} ± {factor * one['std']:.4f}"
        for one in (row["first"], row["second"])
    ]
    if row["difference"] is None:
        return row["name"], *sides, "", "", ""
    low, high = (factor * end for end in row["difference_ci95"])
    shown = {True: "yes", False: "no", None: "of base or tool"}[row["shown"]]
    return row["name"], *sides, f"{factor * row['difference']:+.4f}", f"{low:.4f} … {high:.4f}", shown
