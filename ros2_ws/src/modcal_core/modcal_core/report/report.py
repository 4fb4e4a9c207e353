"""The report: the data of ``report.json``, what a person reads on one screen, and the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from modcal_core.calibration import Calibration, ErrorSize, to_data
from modcal_core.claim import Claim, Statistic
from modcal_core.diagnosis import EffectChoice, Loads
from modcal_core.files import to_json, to_yaml, write_folder
from modcal_core.geometry import Array, so3
from modcal_core.outcome import STAGES, Finding, Outcome
from modcal_core.report.blocks import Summary, SummaryLine, text, tone_of
from modcal_core.report.tables import (
    MAX_REASONS,
    account_tables,
    distances_table,
    effects_table,
    error_tables,
    sentence,
    tolerance_lines,
)
from modcal_core.robots import Chain, Delta, Mechanism, delta_to_data, is_serial_arm
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
        "effects": [effect_data(finding) for finding in report.effects],
        "unproved": [effect_data(finding) for finding in report.unproved],
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


def effect_data(finding: Finding) -> dict[str, Any]:
    """An effect as ``report.json`` has it."""
    sizes = finding.parameters.items()
    return {
        **picked(finding, "family", "place", "direction", "driver", "p_value", "gain_mm2", "chance", "same_as"),
        "parameters": {name: dict(zip(("value", "std", "unit"), size, strict=True)) for name, size in sizes},
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


def summary(report: Outcome) -> list[Summary]:
    """Before and after, what the data could not tell, the effects, the account, and the verdict."""
    out: list[Summary] = [*error_tables(report)]
    if (seen := report.identifiability) is not None:
        said = f"{seen.parameters} parameters, rank {seen.rank} (directions that the stations determine), "
        out.append(SummaryLine(said + f"condition {seen.condition:.0f} (largest over smallest singular value)"))
        out += (SummaryLine(f"not determined by these stations: {name}", "doubt") for name in seen.unobservable)
    if report.effects:
        out += [effects_table([effect_data(finding) for finding in report.effects]), *map(SummaryLine, report.story)]
    out += (SummaryLine(note, "doubt") for note in report.notes)
    out += [*distances_table(report.by_distances), *account_tables(report.judged, fold=True)]
    out.append(SummaryLine(sentence(report), tone_of(report.status)))
    out += (SummaryLine(f"Open: {reason}", "reason") for reason in report.open_because[MAX_REASONS:])
    if report.claim is not None:
        out.append(SummaryLine(report.claim.sentence, "plain" if report.claim.apply else "doubt"))
    return [*out, *tolerance_lines(report.tolerance)]


def calibration_files(
    calibration: Calibration,
    report: Outcome,
    nominal: Mechanism | None = None,
    urdf: str | None = None,
    factory: Mapping[str, Any] | None = None,
    page: bool = True,
) -> dict[str, str]:
    """Names and texts of everything that a calibration leaves behind; without report.html if not page.

    nominal, urdf: the arm as its description has it. factory: as of :func:`model_files`.
    """
    return report_files(report, page, others=model_files(calibration, nominal, urdf, factory))


def model_files(
    calibration: Calibration, nominal: Mechanism | None, urdf: str | None, factory: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """The same without a report. Of a Delta, into whose file the tool that was found is written, and of an arm without
    a description there is no URDF.

    factory: the kinematics that the manufacturer's tool took from this arm, whose form and hash are kept. The robot
    description and the kinematics hold the geometry that is best alone: their readers know no effects.
    """
    files = {"calibration.yaml": to_yaml(to_data(calibration))}
    calibrated = calibration.geometric.chain
    if isinstance(calibrated, Delta):
        T = calibration.geometric.T_tip_tool
        tool = np.r_[T[:3, 3], so3.log(T[:3, :3])]
        with_tool = calibrated.with_vector(np.r_[calibrated.constants.ravel(), tool])
        return {**files, "calibrated_delta.yaml": to_yaml(delta_to_data(with_tool))}
    if urdf is None or nominal is None or not is_serial_arm(nominal):
        return files
    from modcal_core.robots import calibrated_urdf, joint_origins  # a parser of URDFs comes with these

    corrected = calibrated_urdf(urdf, nominal, calibrated)
    kinematics = kinematics_text(calibrated, joint_origins(corrected), factory)
    return {**files, "calibrated.urdf": corrected, "kinematics.yaml": kinematics}


def kinematics_text(chain: Chain, origins: Mapping[str, Array], factory: Mapping[str, Any] | None = None) -> str:
    """The text of a kinematics.yaml, with a line that says so where it lacks the maker's hash. origins: by joint."""
    from modcal_core.robots import NO_HASH, kinematics_yaml_data, lacks_hash

    data = kinematics_yaml_data(chain, origins, factory)
    return (NO_HASH if lacks_hash(data) else "") + to_yaml(data)


def report_files(
    report: Outcome, page: bool = True, calibration: str = "", others: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Names and texts of a report and of the others, which its page names. calibration: what was evaluated, by name."""
    data, others = to_json_data(report), others or {}
    files = {"report.json": to_json(data)}
    if page:
        # drawing it takes longer than many a fit, and so does the import of what draws it
        from modcal_core.report.html import to_html

        files["report.html"] = to_html(report, data, ["report.json", *others], calibration)
    return {**files, **others}


@dataclass(frozen=True)
class Report(Outcome):
    """An outcome with what a person and a program read of it."""

    @classmethod
    def of(cls, outcome: Outcome) -> Self:
        """The report of an outcome."""
        return cls(**{one.name: getattr(outcome, one.name) for one in fields(outcome)})

    @property
    def verdict(self) -> str:
        """What a person reads first: what was scored, how large the error is, and what may be said of the rest."""
        return sentence(self)

    def __str__(self) -> str:
        """What the command shows on the terminal."""
        return text(summary(self))

    def _repr_html_(self) -> str:
        """The page for notebooks, in a frame of its own: its styles and scripts meet no others."""
        from modcal_core.report.html import to_html

        page = escape(to_html(self, self.to_data()))
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 60em; border: 0"></iframe>'

    def to_data(self) -> dict[str, Any]:
        """The data of ``report.json``: dictionaries, lists, texts, numbers and None."""
        return to_json_data(self)

    def save(self, folder: str | Path, page: bool = True) -> Path:
        """Write report.json, and report.html if page, into a folder; returns the folder."""
        write_folder(Path(folder), report_files(self, page))
        return Path(folder)
