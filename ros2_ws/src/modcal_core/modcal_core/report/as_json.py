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
from modcal_core.report.words import sentence
from modcal_core.verdict import Row, Share, Tolerance, Verdict, reading_scatter_mm

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
        "rejected_rms_mm": None
        if out is None
        else {"with": out.with_mm, "without": out.without_mm, "stations": out.stations, "of": out.of},
        "not_applied": [asdict(missing) for missing in report.grounds.not_applied],
        "regimes": [asdict(regime) for regime in report.grounds.regimes],
        "convention": report.grounds.convention,
        **claim_data(report.claim),
        "tolerance": tolerance_data(report.tolerance),
        "trace": asdict(report.trace),
        "steps": [{"added": step.added, "rms_mm": step.rms_mm} for step in report.steps],
        "effects": [_effect(finding) for finding in report.effects],
        "unproved": [_effect(finding) for finding in report.unproved],
        "unexplained": None if rest is None else unexplained(rest, report.left),
        "identifiability": None
        if seen is None
        else {
            "parameters": seen.parameters,
            "rank": seen.rank,
            "condition": finite(seen.condition),
            "unobservable": list(seen.unobservable),
            "left_out": list(report.left_out),
            "weak": [{"direction": name, "std_over_prior": share} for name, share in seen.weak],
        },
        "loads": loads_to_json(report.loads),
        "known_distances": [
            {
                "name": known.name,
                "stated_mm": 1e3 * known.stated,
                "stated_std_mm": 1e3 * known.stated_std,
                "misfit_mm": 1e3 * known.residual,
                "found_mm": 1e3 * known.found,
                "found_std_mm": 1e3 * known.std,
                "contradicted": known.contradicted,
            }
            for known in report.distances
        ],
        "by_distances": None if report.by_distances is None else _by_distances(report.by_distances),
        "evidence": [
            {
                "p_value": seen_then.p_value,
                "strongest": [
                    {"place": place, "direction": direction, "driver": driver, "share": share}
                    for place, direction, driver, share in seen_then.strongest(_STRONGEST)
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
        "parameters": [
            {"name": name, "value": value, "std": std, "unit": unit} for name, value, std, unit in report.parameters
        ],
        "joint_offsets": None
        if report.offsets is None
        else [
            {"joint": o.joint, "value": o.value, "std": o.std, "unit": "rad" if o.turning else "m"}
            for o in report.offsets.found
        ],
        "notes": list(report.notes),
        "verdict": sentence(report),
        "story": list(report.story),
    }


def _by_distances(found: ByDistances) -> dict[str, Any]:
    keys = ("method", "distances_rms_mm", "held_out_rms_mm", "evaluations")
    methods = [(m.name, 1e3 * m.f, 1e3 * m.held_out, m.evaluations) for m in found.methods]
    return {
        "points": found.points,
        "rank": found.seen.rank,
        "unseen": list(found.seen.unseen),
        "at_bound": list(found.at_bound),
        "methods": [dict(zip(keys, values, strict=True)) for values in methods],
    }


def _effect(finding: Finding) -> dict[str, Any]:
    return {
        "family": finding.family,
        "place": finding.place,
        "direction": finding.direction,
        "driver": finding.driver,
        "parameters": sizes_to_json(finding.parameters),
        "p_value": finding.p_value,
        "rms_mm_before": 1e3 * finding.before,
        "rms_mm_after": 1e3 * finding.after,
        "gain_mm2": finding.gain_mm2,
        "gain_ci95_mm2": None if finding.ci95 is None else list(finding.ci95),
        "tool_rms_mm": None if finding.tool is None else 1e3 * finding.tool,
        "chance": finding.chance,
        "same_as": list(finding.same_as),
    }


def unexplained(size: float, left: EffectChoice | None) -> dict[str, Any]:
    """What is left of this size [mm], and what it correlates with."""
    if left is None:
        return {"place": None, "driver": None, "size_mm": size}
    return {
        "place": left.effect.place,
        "direction": left.effect.direction,
        "driver": left.effect.public_driver,
        "size_mm": size,
        "p_value": left.p_value if left.p_value < 1.0 else None,  # not tested where the verdict had found it already
        "same_as": list(left.same_as),
    }


def _size(size: ErrorSize | None, interval: tuple[float, float] | None = None) -> dict[str, Any] | None:
    if size is None:
        return None
    out: dict[str, Any] = {"mean": size.mean, "rms": size.rms, "p95": size.p95, "max": size.max}
    return out if interval is None else {**out, "rms_ci95": list(interval)}


def _judged(report: Outcome) -> Mapping[str, Any]:
    """What follows from the verdict."""
    judged = report.judged or Verdict("cannot_tell")
    return {
        "status": judged.status,
        "open_because": list(judged.open_because),
        "remedy": judged.remedy or None,
        "not_asked": [asdict(question) for question in judged.not_asked],
        "noise_floor_mm": judged.floor_mm,
        "noise_floor_deg": judged.floor_deg,
        "account_mm2": _account(judged.account_mm2),
        "account_deg2": _account(judged.account_deg2),
        "predictable": _share(judged.predictable),
        "predictable_deg": _share(judged.predictable_deg),
        "repeatability_mm": None if report.size_mm("final") is None else asdict(judged.repeatability_mm),
        "repeatability_deg": None if report.size_deg("final") is None else asdict(judged.repeatability_deg),
    }


def _account(rows: tuple[Row, ...] | None) -> list[dict[str, Any]] | None:
    if rows is None:
        return None
    return [{**asdict(row), "ci95": None if row.ci95 is None else list(row.ci95)} for row in rows]


def _share(share: Share | None) -> dict[str, Any] | None:
    return None if share is None else {"share": share.share, "ci95": list(share.ci95)}


def finite(x: float) -> float | None:
    """The number, None where it is not finite."""
    return float(x) if np.isfinite(x) else None


def claim_data(claim: Claim | None) -> dict[str, Any]:
    """The claim at the tool as ``report.json`` has it, and whether to use the calibration."""
    if claim is None:
        return {"claim_mm": None, "claim_deg": None, "apply": None, "apply_within": None}

    def sizes(found: Mapping[Any, Statistic]) -> dict[str, Any]:
        return {str(name): {"value": s.value, "ci95": list(s.ci95)} for name, s in found.items()}

    rest = {"over": claim.over, "shown_mm": claim.shown_mm, "unshown_mm": claim.unshown_mm}
    opened = {"open": claim.open.what if claim.is_open else None, "remedy": claim.remedy}
    return {
        "claim_mm": {**sizes(claim.mm), **rest, **opened, "nominal_p95": claim.nominal_p95},
        "claim_deg": None if claim.deg is None else {**sizes(claim.deg), "over": claim.over},
        "apply": claim.apply,
        "apply_within": claim.ranges and {name: list(ends) for name, ends in claim.ranges.items()},
    }


def tolerance_data(met: Tolerance | None) -> dict[str, Any] | None:
    """The tolerance as ``report.json`` has it."""
    if met is None:
        return None
    return {
        "asked_mm": met.asked.mm,
        "statistic": met.asked.statistic,
        "value_mm": met.value_mm,
        "ci95": list(met.ci95),
        "result": met.result,
        "because": met.because,
    }


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
            "direction": [float(x) for x in loads.down],
            "std_deg": float(np.degrees(loads.down_std)),
            "turned_deg": float(np.degrees(loads.turned)),
        },
        "gravity_unknown": loads.unknown,
        "relative": loads.relative,
        "stated_payload_centre_m": None if loads.centre is None else [float(x) for x in loads.centre],
        "stated_payload_centre_std_m": None if loads.centre_std is None else [float(x) for x in loads.centre_std],
        "payloads": [
            {
                "since": p.since,
                "mass": p.mass,
                "mass_std": p.mass_std,
                "centre_m": None if p.place is None else [float(x) for x in p.place],
                "centre_std_m": None if p.place_std is None else [float(x) for x in p.place_std],
            }
            for p in loads.payloads
        ],
    }
