"""Two calibrations, or two reports, side by side: what differs, and whether that is more than their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import ndtri

from modcal_core.calibration import Calibration
from modcal_core.effects import Sizes, claimed
from modcal_core.errors import BadRobot, NotEnoughData
from modcal_core.outcome import ToolDifference, tool_difference
from modcal_core.report.as_json import sizes_to_json
from modcal_core.report.blocks import Summary, SummaryLine, SummaryTable, Tone, legend

_TAIL = 0.05  # of differences that are taken for real while there is none, all parameters together


Result = Literal["same", "differs", "within tolerance", "beyond tolerance", "cannot tell"]
_NORMAL = 1.96  # deviations of a 95 % interval
_TONES: dict[str, Tone] = {"same": "good", "within tolerance": "good", "beyond tolerance": "bad"}
_LARGEST = 12  # parameters on a terminal
_LEGEND = {
    "±": "one standard deviation",
    "difference": "the second minus the first",
    "shown": "whether it is more than the uncertainty of both explains, at 95 % for all parameters together",
    "of base or tool": "base and tool take it up",
}
_KINDS = (("m", "mm", 1e3, "Lengths"), ("rad", "mrad", 1e3, "Angles"))


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


@dataclass(frozen=True)
class ParameterDifference:
    """A parameter of both: values and standard deviations [unit]; None in one where it was not fitted there.

    shown: whether the difference is more than the uncertainty of both, at 95 % for all parameters together; None where
    that cannot be asked: in one only, or a motion that base or tool can take up.
    """

    name: str
    unit: str
    first: tuple[float, float] | None
    second: tuple[float, float] | None
    shown: bool | None

    @property
    def difference(self) -> float | None:
        """Second less first; None where one of them has none."""
        return None if self.first is None or self.second is None else self.second[0] - self.first[0]

    @property
    def std(self) -> float | None:
        """Its standard deviation."""
        return None if self.first is None or self.second is None else float(np.hypot(self.first[1], self.second[1]))


@dataclass(frozen=True)
class EffectDifference:
    """An effect with its sizes in either, {name: (value, standard deviation, unit)}; None where it is not there."""

    name: str
    first: Sizes | None
    second: Sizes | None


@dataclass(frozen=True)
class Comparison:
    """What differs. result: whether it matters. sentence: the same in words. notes: what to know beside it."""

    sides: tuple[Side, Side]
    result: Result
    sentence: str
    tolerance_mm: float | None
    parameters: tuple[ParameterDifference, ...]
    effects: tuple[EffectDifference, ...]
    tool: ToolDifference | None
    notes: tuple[str, ...]


def compare(first: Side, second: Side, tolerance_mm: float | None = None) -> Comparison:
    """The comparison. tolerance_mm: what may differ at the tool, 95th percentile; None: not judged.

    Raises BadRobot for arms with other joints, NotEnoughData where there is nothing that both have.
    """
    if first.joints and second.joints and first.joints != second.joints:
        raise BadRobot(
            f"{first.name} has joints {', '.join(first.joints)}",
            f"{second.name} has {', '.join(second.joints)}",
            "compare calibrations of one arm",
        )
    one, two = first.calibration, second.calibration
    tool = None if one is None or two is None else tool_difference(one, two)
    errors = tuple(_final(side) for side in (first, second))
    if tool is None and None in errors:
        where = " and ".join(s.name for s, e in zip((first, second), errors, strict=True) if e is None)
        raise NotEnoughData(where, "holds no error to compare", "give folders of modcal calibrate or modcal evaluate")
    result, sentence = _judged_tool(tool, tolerance_mm) if tool is not None else _judged_errors(first, second)
    in_one, in_two = (_effects_of(side) for side in (first, second))
    return Comparison(
        sides=(first, second),
        result=result,
        sentence=sentence,
        tolerance_mm=tolerance_mm,
        parameters=_parameters(first, second, frozenset() if tool is None else tool.of_base_or_tool),
        effects=tuple(EffectDifference(name, in_one.get(name), in_two.get(name)) for name in {**in_one, **in_two}),
        tool=tool,
        notes=_notes(first, second, tool),
    )


def _parameters(first: Side, second: Side, of_base_or_tool: frozenset[str]) -> tuple[ParameterDifference, ...]:
    """Those of the arm in the order of the chain, then base, tool and instruments."""
    tables = [{name: (value, std, unit) for name, value, std, unit in side.parameters} for side in (first, second)]
    names = list(dict.fromkeys([*tables[0], *tables[1]]))
    names = sorted(names, key=lambda name: name.startswith(("frame ", "tool/", "instrument ")))
    both = sum(name in tables[0] and name in tables[1] for name in names)
    limit = float(-ndtri(0.5 * _TAIL / max(both, 1)))  # Bonferroni: all together hold with 95 %
    out = []
    for name in names:
        rows = [table.get(name) for table in tables]
        unit = next(row[2] for row in rows if row is not None)
        one, two = (None if row is None else (row[0], row[1]) for row in rows)
        shown = None
        own = name not in of_base_or_tool
        if own and one is not None and two is not None and (std := np.hypot(one[1], two[1])) > 0.0:
            shown = bool(abs(two[0] - one[0]) > limit * std)
        out.append(ParameterDifference(name, unit, one, two, shown))
    return tuple(out)


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
    if tolerance is None:
        return ("same", f"No difference is shown. {said}") if within else ("differs", f"They differ. {said}")
    if size.p95 > tolerance and not within:
        return "beyond tolerance", f"They differ by more than {tolerance:g} mm. {said}"
    if within and expected is not None and expected > tolerance:
        return "cannot tell", f"Their uncertainty is larger than {tolerance:g} mm: it cannot be told. {said}"
    if size.p95 > tolerance:
        return "cannot tell", f"They differ by more than {tolerance:g} mm, but within their uncertainty. {said}"
    if within:
        return "same", f"No difference is shown, and {tolerance:g} mm would matter. {said}"
    return "within tolerance", f"They differ, by less than {tolerance:g} mm. {said}"


def _judged_errors(first: Side, second: Side) -> tuple[Result, str]:
    """Of two reports: whether the errors differ by more than their intervals."""
    one, two = _final(first), _final(second)
    assert one is not None
    assert two is not None
    said = f"The error is {one['rms']:.3f} mm RMS in {first.name} and {two['rms']:.3f} mm in {second.name}"
    ends = [e["rms_ci95"] for e in (one, two) if e.get("rms_ci95") is not None]
    if len(ends) < 2:
        return "cannot tell", f"{said}; one of them has no interval."
    apart = ends[0][1] < ends[1][0] or ends[1][1] < ends[0][0]
    how = "do not overlap" if apart else "overlap"
    spans = " and ".join(f"{low:.3f} … {high:.3f} mm" for low, high in ends)
    word = "They differ" if apart else "No difference is shown"
    return "differs" if apart else "same", f"{word}. {said}; their 95 % intervals, {spans}, {how}."


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


def comparison_data(found: Comparison) -> dict[str, Any]:
    """The data of comparison.json: plain dictionaries, None where something does not apply."""
    tool = found.tool
    return {
        "modcal_comparison": 1,
        "result": found.result,
        "verdict": found.sentence,
        "tolerance_mm": found.tolerance_mm,
        "sides": [_side(side) for side in found.sides],
        "tool": None
        if tool is None
        else {
            "postures": len(tool.q),
            "mm": asdict(tool.size_mm),
            "deg": None if tool.size_deg is None else asdict(tool.size_deg),
            "expected_rms_mm": tool.expected_mm,
            "base_to_tip_as_they_are_mm": asdict(tool.as_they_are_mm),
            "left_out": list(tool.left_out),
        },
        "of_base_or_tool": [] if tool is None else sorted(tool.of_base_or_tool),
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "first": None if p.first is None else {"value": p.first[0], "std": p.first[1]},
                "second": None if p.second is None else {"value": p.second[0], "std": p.second[1]},
                "difference": p.difference,
                "difference_ci95": None
                if p.difference is None or p.std is None
                else [p.difference - _NORMAL * p.std, p.difference + _NORMAL * p.std],
                "shown": p.shown,
            }
            for p in found.parameters
        ],
        "effects": [{"effect": e.name, "first": _sizes(e.first), "second": _sizes(e.second)} for e in found.effects],
        "notes": list(found.notes),
    }


def _side(side: Side) -> dict[str, Any]:
    report = side.report or {}
    trace = report.get("trace") or {}
    return {
        "name": side.name,
        "date": trace.get("date"),
        "version": trace.get("version"),
        "robot": trace.get("robot"),
        "stations": (report.get("recording") or {}).get("stations"),
        "status": report.get("status"),
        "error_mm": _final(side),
        "tolerance": (report.get("tolerance") or {}).get("result"),
    }


def _sizes(sizes: Sizes | None) -> dict[str, Any] | None:
    return None if sizes is None else sizes_to_json(sizes)


def comparison_summary(found: Comparison) -> tuple[Summary, ...]:
    """What a terminal shows: errors, tool, the parameters that differ most for their uncertainty, effects, result."""
    names = tuple(side.name for side in found.sides)
    out: list[Summary] = []
    data = comparison_data(found)
    rows = []
    for side in data["sides"]:
        e = side["error_mm"] or {}
        numbers = [f"{e[k]:.3f}" if k in e else "" for k in ("mean", "rms", "p95", "max")]
        rows.append((side["name"], *numbers, side["status"] or "", side["tolerance"] or ""))
    header = ("error on scored stations", "mean mm", "RMS mm", "95 % mm", "max mm", "status", "tolerance")
    out.append(SummaryTable(header, tuple(rows)))
    for title, unit, factor, part in _parts(found):
        # the largest for its uncertainty before the others
        ranked = sorted(part, key=lambda p: (p.shown is None, -abs(p.difference or 0.0) / (p.std or np.inf)))[:_LARGEST]
        head = (f"{title.lower()}, {unit}", *names, "difference", "95 % interval", "shown")
        out.append(SummaryTable(head, tuple(_cells(p, factor) for p in ranked)))
        if len(part) > len(ranked):
            out.append(SummaryLine(f"{len(part) - len(ranked)} more are in comparison.json."))
    if any(part for *_, part in _parts(found)):
        out.append(legend(_LEGEND))
    if found.effects:
        rows = [(e.name, *("yes" if s is not None else "no" for s in (e.first, e.second))) for e in found.effects]
        out.append(SummaryTable(("effect", *names), tuple(rows)))
    out += [SummaryLine(note, "doubt") for note in found.notes]
    out.append(SummaryLine(found.sentence, _TONES.get(found.result, "undecided")))
    return tuple(out)


def _parts(found: Comparison) -> list[tuple[str, str, float, list[ParameterDifference]]]:
    """Parameters by unit, those of the arm: a table never mixes two units."""
    arm = [p for p in found.parameters if not p.name.startswith(("frame ", "tool/", "instrument "))]
    parts = [(title, unit, factor, [p for p in arm if p.unit == si]) for si, unit, factor, title in _KINDS]
    others = sorted({p.unit for p in arm} - {"m", "rad"})
    parts += [(f"Others in {unit}", unit, 1.0, [p for p in arm if p.unit == unit]) for unit in others]
    return [part for part in parts if part[3]]


def _cells(p: ParameterDifference, factor: float) -> tuple[str, ...]:
    def said(pair: tuple[float, float] | None) -> str:
        return "not fitted" if pair is None else f"{factor * pair[0]:.4f} ± {factor * pair[1]:.4f}"

    difference = "" if p.difference is None else f"{factor * p.difference:+.4f}"
    span = ""
    if p.difference is not None and p.std is not None:
        low, high = (factor * (p.difference + k * _NORMAL * p.std) for k in (-1.0, 1.0))
        span = f"{low:.4f} … {high:.4f}"
    return (
        p.name,
        said(p.first),
        said(p.second),
        difference,
        span,
        {True: "yes", False: "no", None: "" if p.difference is None else "of base or tool"}[p.shown],
    )
