"""Two calibrations, checks or cells side by side, and the history of an arm, for programs and for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.special import ndtri

from modcal_core.calibration import Calibration
from modcal_core.effects import claimed
from modcal_core.errors import BadRobot, NotEnoughData
from modcal_core.files import to_json
from modcal_core.moves import Series, Values
from modcal_core.outcome import ToolDifference, tool_difference
from modcal_core.report.blocks import Summary, SummaryLine, TableBlock, VerbResult, legend, scaled, tone_of, written
from modcal_core.report.report import picked

_MAX_SAID = 90  # characters of a verdict in a table


@dataclass(frozen=True)
class HistoryEntry:
    """One calibration or check. time: [s]; None where its recording has no clock. said: its verdict. robot, called: the
    fingerprint and the name of its arm, empty where it keeps no model. values: of what may grow, by name.
    """

    name: str
    what: str
    date: str | None
    time: float | None
    said: str
    robot: str = ""
    called: str = ""
    values: Values = field(default_factory=dict)

    @property
    def first_words(self) -> str:
        """As much of the verdict as a table has room for."""
        first = self.said.partition(". ")[0].rstrip(".")
        return first if len(first) <= _MAX_SAID else first[: _MAX_SAID - 1] + "…"


@dataclass(frozen=True)
class History:
    """Of one robot: its name, entries in order of time, series of what may grow."""

    robot: str
    entries: tuple[HistoryEntry, ...]
    series: tuple[Series, ...]
    notes: tuple[str, ...] = ()


def history_report(found: Sequence[History]) -> VerbResult:
    """The history of some robots as a verb leaves it."""
    robots, said = list[dict[str, Any]](), list[Summary]()
    for h in found:
        entries = [picked(e, "name", "what", "date", verdict="said") for e in h.entries]
        series = [_series(s) for s in h.series]
        growing = [{**s, "first": s["points"][0], "last": s["points"][-1]} for s in series if s["trend"]]
        quiet = f"Nothing grows or falls beyond chance over {len(entries)} calibrations and checks."
        answer = " ".join(s["trend"]["sentence"] for s in growing) or quiet
        robots.append({**picked(h, "robot", "notes"), "verdict": answer, "entries": entries, "series": series})
        header, cells = f"robot {h.robot} | what | date | verdict", "{name} | {what} | {date:.10} | {first_words}"
        said.append(TableBlock.of("", header, cells, h.entries, words=4))
        header = "grows or falls | first | last | 95 % of the change | unit"
        cells = "{name} | {first[value]:.4g} | {last[value]:.4g} | {trend[ci95]:+.3g} | {unit}"
        said += [TableBlock.of("", header, cells, growing)] if growing else []
        said += [*(SummaryLine(note, "doubt") for note in h.notes), SummaryLine(answer, "warn" if growing else "good")]
    data = {"modcal_history": 1, "robots": robots}
    return VerbResult(data, said, {"history.json": to_json(data)}, "History", "history.json")


def _series(s: Series) -> dict[str, Any]:
    trend = s.trend and {**picked(s.trend, "change", "share", "days"), "ci95": [s.trend.low, s.trend.high]}
    return {
        **picked(s, "name", "unit"),
        "points": [picked(p, "entry", "value", "std") for p in s.points],
        "trend": trend and {**trend, "sentence": s.sentence},
    }


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

    def kept(self, *keys: str) -> Any:
        """What its report has under these keys; None where it has nothing."""
        found: Any = self.report
        for key in keys:
            found = found.get(key) if found else None
        return found or None

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from whatever is there."""
        if self.calibration is not None:
            return tuple(self.calibration.nominal.chain.names)
        return tuple(self.kept("recording", "joints") or ())

    @property
    def parameters(self) -> tuple[tuple[str, float, float, str], ...]:
        """(name, value, standard deviation, unit) of every fitted parameter."""
        if self.calibration is not None:
            return self.calibration.parameters
        rows = self.kept("parameters") or ()
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
    without = [side.name for side in (first, second) if not side.kept("error_mm", "final")]
    if tool is None and without:
        remedy = "give folders of modcal calibrate or modcal evaluate"
        raise NotEnoughData(" and ".join(without), "holds no error to compare", remedy)
    result, sentence = _judged_tool(tool, tolerance_mm) if tool is not None else _judged_errors(first, second)
    effects = {"first": _effects_of(first), "second": _effects_of(second)}
    of_base_or_tool = frozenset() if tool is None else tool.of_base_or_tool
    data = {
        "modcal_comparison": 1,
        "result": result,
        "verdict": sentence,
        "tolerance_mm": tolerance_mm,
        "sides": [
            {
                "name": side.name,
                **{name: side.kept("trace", name) for name in ("date", "version", "robot")},
                "stations": side.kept("recording", "stations"),
                "status": side.kept("status"),
                "error_mm": side.kept("error_mm", "final"),
                "tolerance": side.kept("tolerance", "result"),
            }
            for side in (first, second)
        ],
        "tool": tool
        and {
            "postures": len(tool.q),
            "mm": asdict(tool.size_mm),
            "deg": tool.size_deg and asdict(tool.size_deg),
            **picked(tool, "left_out", expected_rms_mm="expected_mm"),
            "base_to_tip_as_they_are_mm": asdict(tool.as_they_are_mm),
        },
        "of_base_or_tool": sorted(of_base_or_tool),
        "parameters": _parameters(first, second, of_base_or_tool),
        "effects": [
            {"effect": name, **{which: side.get(name) for which, side in effects.items()}}
            for name in {**effects["first"], **effects["second"]}
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


_EFFECT = "{family:words}: {place} {direction} by {driver:driver}"


def _effects_of(side: Side) -> dict[str, Any]:
    """Sizes of the effects by name, as its report has them; of a calibration alone the names."""
    if rows := side.kept("effects"):
        return {written(_EFFECT, e): e["parameters"] for e in rows}
    own = () if side.calibration is None else side.calibration.calibrated.effects
    found = [picked(e, "family", "place", "direction", driver="public_driver") for e in own if claimed(e)]
    return {written(_EFFECT, e): {} for e in found}


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
    sizes = [side.kept("error_mm", "final") for side in (first, second)]
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
        if side.kept("status") == "open":
            out.append(f"{side.name} is open: {(side.kept('open_because') or ['no reason is given'])[0]}")
    if tool is not None and tool.left_out:
        out.append(f"Not compared at the tool, for a posture does not determine them: {', '.join(tool.left_out)}.")
    return tuple(out)


def _summary(data: Mapping[str, Any]) -> list[Summary]:
    """What a terminal shows: errors, the parameters that differ most for their uncertainty, effects, result."""
    sides, names = data["sides"], [side["name"] for side in data["sides"]]
    header = "error on scored stations | mean mm | RMS mm | 95 % mm | max mm | status | tolerance"
    sizes = " | ".join(f"{{error_mm[{name}]:.3f}}" for name in ("mean", "rms", "p95", "max"))
    out: list[Summary] = [TableBlock.of("", header, f"{{name}} | {sizes} | {{status}} | {{tolerance}}", sides)]
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
