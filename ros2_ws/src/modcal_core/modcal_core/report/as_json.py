"""The report as the data of ``report.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration import ErrorSize
from modcal_core.claim import Claim, Statistic
from modcal_core.diagnosis import EffectChoice, Loads
from modcal_core.effects import Quantity
from modcal_core.outcome import STAGES, Finding, Outcome
from modcal_core.report.tables import sentence
from modcal_core.verdict import Row, Tolerance, Verdict, reading_scatter_mm

if TYPE_CHECKING:
    from modcal_core.calibration import ByDistances

FORMAT = 1
_STRONGEST = 10  # candidates of a scan that report.json names


def to_json_data(report: Outcome) -> dict[str, Any]:
    """The report as the data of ``report.json``: plain dictionaries, None where something does not apply."""
    seen, out, rest = report.identifiability, report.rejection, report.unexplained_mm
    return {
        "modcal_report": FORMAT,
        "title": report.title,
        "recording": {
            "stations": report.samples.stations,
            "rejected": report.rejected_stations(),
            "readmitted": report.readmitted.stations,
            "dropped": dict(report.dropped),
            "measurement": report.measurement,
            "joints": list(report.samples.names),
            "duration_s": round(float(np.ptp(report.samples.stamps)), 6),
        },
        "split": {"unit": report.sets.unit, **report.set_sizes()},
        "error_mm": {stage: _size(report.size_mm(stage), report.interval_mm(stage)) for stage in STAGES},
        "error_deg": {stage: _size(report.size_deg(stage)) for stage in STAGES},
        **_judged(report),
        "reading_scatter_mm": reading_scatter_mm(report.samples),
        "converged": report.grounds.converged,
        "rejected_rms_mm": picked(out, "stations", "of", without="without_mm", **{"with": "with_mm"}),
        "not_applied": [asdict(missing) for missing in report.grounds.not_applied],
        "regimes": [asdict(regime) for regime in report.grounds.regimes],
        "convention": report.grounds.convention,
        **claim_data(report.claim),
        "tolerance": tolerance_data(report.tolerance),
        "trace": asdict(report.trace),
        "steps": [picked(step, "added", "rms_mm") for step in report.steps],
        "effects": [_effect(finding) for finding in report.effects],
        "unproved": [_effect(finding) for finding in report.unproved],
        "unexplained": None if rest is None else unexplained(rest, report.left),
        "identifiability": None
        if seen is None
        else {
            **picked(seen, "parameters", "rank", "unobservable"),
            "condition": finite(seen.condition),
            "left_out": list(report.left_out),
            "weak": [{"direction": name, "std_over_prior": share} for name, share in seen.weak],
        },
        "loads": loads_to_json(report.loads),
        "known_distances": [
            picked(known, "name", "contradicted")
            | in_mm(known, stated_mm="stated", stated_std_mm="stated_std", misfit_mm="residual")
            | in_mm(known, found_mm="found", found_std_mm="std")
            for known in report.distances
        ],
        "by_distances": None if report.by_distances is None else _by_distances(report.by_distances),
        "evidence": [
            {
                "p_value": seen_then.p_value,
                "strongest": [
                    dict(zip(("place", "direction", "driver", "share"), one, strict=True))
                    for one in seen_then.strongest(_STRONGEST)
                ],
            }
            for seen_then in report.evidence
        ],
        "rejected": [
            {
                "station": int(report.samples.station[row]),
                "stamp": float(report.samples.stamps[row]),
                "miss_mm": 1e3 * float(report.residuals[row]),
            }
            for row in report.rejected_rows()
        ],
        "parameters": [dict(zip(("name", "value", "std", "unit"), one, strict=True)) for one in report.parameters],
        "joint_offsets": None
        if report.offsets is None
        else [
            {**picked(o, "joint", "value", "std"), "unit": "rad" if o.turning else "m"} for o in report.offsets.found
        ],
        "notes": list(report.notes),
        "verdict": sentence(report),
        "story": list(report.story),
    }


def _by_distances(found: ByDistances) -> dict[str, Any]:
    keys = ("method", "distances_rms_mm", "held_out_rms_mm", "evaluations")
    methods = [(m.name, 1e3 * m.f, 1e3 * m.held_out, m.evaluations) for m in found.methods]
    return {
        **picked(found, "points", "at_bound"),
        **picked(found.seen, "rank", "unseen"),
        "methods": [dict(zip(keys, values, strict=True)) for values in methods],
    }


def _effect(finding: Finding) -> dict[str, Any]:
    return {
        **picked(finding, "family", "place", "direction", "driver", "p_value", "gain_mm2", "chance", "same_as"),
        "parameters": sizes_to_json(finding.parameters),
        **in_mm(finding, rms_mm_before="before", rms_mm_after="after", tool_rms_mm="tool"),
        "gain_ci95_mm2": plain(finding.ci95),
    }


def unexplained(size: float, left: EffectChoice | None) -> dict[str, Any]:
    """What is left of this size [mm], and what it correlates with."""
    if left is None:
        return {"place": None, "driver": None, "size_mm": size}
    return {
        **picked(left.effect, "place", "direction", driver="public_driver"),
        "size_mm": size,
        "p_value": left.p_value if left.p_value < 1.0 else None,  # not tested where the verdict had found it already
        "same_as": list(left.same_as),
    }


def _size(size: ErrorSize | None, interval: tuple[float, float] | None = None) -> dict[str, Any] | None:
    if size is None:
        return None
    out: dict[str, Any] = picked(size, "mean", "rms", "p95", "max")
    return out if interval is None else {**out, "rms_ci95": list(interval)}


def _judged(report: Outcome) -> Mapping[str, Any]:
    """What follows from the verdict."""
    judged = report.judged or Verdict("cannot_tell")
    return {
        **picked(judged, "status", "open_because", noise_floor_mm="floor_mm", noise_floor_deg="floor_deg"),
        "remedy": judged.remedy or None,
        "not_asked": [asdict(question) for question in judged.not_asked],
        "account_mm2": _account(judged.account_mm2),
        "account_deg2": _account(judged.account_deg2),
        "predictable": picked(judged.predictable, "share", "ci95"),
        "predictable_deg": picked(judged.predictable_deg, "share", "ci95"),
        "repeatability_mm": None if report.size_mm("final") is None else asdict(judged.repeatability_mm),
        "repeatability_deg": None if report.size_deg("final") is None else asdict(judged.repeatability_deg),
    }


def _account(rows: tuple[Row, ...] | None) -> list[dict[str, Any]] | None:
    if rows is None:
        return None
    return [{**asdict(row), "ci95": plain(row.ci95)} for row in rows]


def plain(value: Any) -> Any:
    """A value as JSON has it: lists in place of tuples and arrays."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return list(value) if type(value) is tuple else value


def picked(one: object, *same: str, **named: str) -> Any:
    """Attributes for ``report.json``: of the same name, and by other names; None of nothing."""
    names = dict.fromkeys(same) | named
    return None if one is None else {key: plain(getattr(one, name or key)) for key, name in names.items()}


def in_mm(one: object, **named: str) -> dict[str, float | None]:
    """Attributes [m] for ``report.json``, by other names, in mm."""
    return {key: None if (x := getattr(one, name)) is None else 1e3 * x for key, name in named.items()}


def finite(x: float) -> float | None:
    """The number, None where it is not finite."""
    return float(x) if np.isfinite(x) else None


def claim_data(claim: Claim | None) -> dict[str, Any]:
    """The claim at the tool as ``report.json`` has it, and whether to use the calibration."""
    if claim is None:
        return {"claim_mm": None, "claim_deg": None, "apply": None, "apply_within": None}

    def sizes(found: Mapping[Any, Statistic]) -> dict[str, Any]:
        return {str(name): picked(s, "value", "ci95") for name, s in found.items()}

    rest = picked(claim, "over", "shown_mm", "unshown_mm", "nominal_p95")
    opened = {"open": claim.open.what if claim.is_open else None, "remedy": claim.remedy}
    return {
        "claim_mm": {**sizes(claim.mm), **rest, **opened},
        "claim_deg": None if claim.deg is None else {**sizes(claim.deg), "over": claim.over},
        "apply": claim.apply,
        "apply_within": claim.ranges and {name: list(ends) for name, ends in claim.ranges.items()},
    }


def tolerance_data(met: Tolerance | None) -> dict[str, Any] | None:
    """The tolerance as ``report.json`` has it."""
    if met is None:
        return None
    return {**picked(met.asked, "statistic", asked_mm="mm"), **picked(met, "value_mm", "ci95", "result", "because")}


def sizes_to_json(sizes: Mapping[str, Quantity]) -> dict[str, Any]:
    """Named sizes for ``report.json``."""
    return {name: {"value": value, "std": std, "unit": unit} for name, (value, std, unit) in sizes.items()}


def loads_to_json(loads: Loads | None) -> dict[str, Any] | None:
    """For ``report.json``."""
    if loads is None:
        return None
    return {
        "gravity": None
        if loads.down is None
        else {
            "direction": plain(loads.down),
            "std_deg": float(np.degrees(loads.down_std)),
            "turned_deg": float(np.degrees(loads.turned)),
        },
        **picked(loads, "relative", gravity_unknown="unknown"),
        **picked(loads, stated_payload_centre_m="centre", stated_payload_centre_std_m="centre_std"),
        "payloads": [
            picked(p, "since", "mass", "mass_std", centre_m="place", centre_std_m="place_std") for p in loads.payloads
        ],
    }
