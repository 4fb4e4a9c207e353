"""The report: what was recorded, how far the robot misses before and after, and what the data could not tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.calibration.identifiability import Identifiability
from modcal_core.calibration.model import Model
from modcal_core.calibration.score import Errors, ErrorSize, Floor
from modcal_core.calibration.split import Split
from modcal_core.diagnosis.choice import Choice
from modcal_core.diagnosis.evidence_map import EvidenceMap
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.report.findings import Finding
from modcal_core.verdict.grounds import Grounds
from modcal_core.verdict.verdict import Verdict

FORMAT = 1
_DRAWS = 400
STAGES = ("nominal", "geometric", "final")
_REPEATS_WITHIN_MM = 0.1  # what an arm in order misses a posture by when it comes again (ISO 9283 RP of common arms)
_STRONGEST = 10  # candidates of a scan that report.json names


@dataclass(frozen=True)
class Step:
    """What is left after one more thing was added to the model. added: its name. errors: of the scored samples."""

    added: str
    errors: Errors

    @property
    def rms_mm(self) -> float:
        """RMS of the position errors [mm]; 0 where nothing was scored."""
        size = self.errors.size_mm()
        return 0.0 if size is None else size.rms


@dataclass(frozen=True)
class Report:
    """Everything a calibration or an evaluation has to say.

    scored: the held-out samples less the outliers. errors: theirs by stage (nominal, geometric, final). rejected: how
    many samples were left out as outliers. noise_floor: None where the recording does not show it. effects: what
    the diagnosis added. left: what stands out from noise still but predicts nothing, None where the rest is noise.
    parameters: (name, value, standard deviation, unit). left_out: parameters that say the same as others. notes: a
    sentence each, for a person.

    steps: what is left after geometry, then after each added effect, in the order found. evidence: what the first scan
    for effects saw and what the last one did; empty where nothing was looked for. model: the final one. missed: how far
    each of the samples lies from it [m], (N,). wrong: True for those left out as outliers, (N,). grounds: what else the
    verdict has to know. judged: the verdict; None until it was made.
    """

    samples: Samples
    sets: Split
    scored: Samples
    rejected: int
    errors: dict[str, Errors]
    noise_floor: Floor | None
    effects: tuple[Finding, ...] = ()
    left: Choice | None = None
    identifiability: Identifiability | None = None
    parameters: tuple[tuple[str, float, float, str], ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    title: str = "recording"
    steps: tuple[Step, ...] = ()
    evidence: tuple[EvidenceMap, ...] = ()
    model: Model | None = None
    missed: Array = field(default_factory=lambda: np.empty(0))
    wrong: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    grounds: Grounds = Grounds()
    judged: Verdict | None = None

    @property
    def measurement(self) -> str:
        """pose, point, same_point, or mixed."""
        kinds = {
            "same_point" if self.samples.is_same_point(f) else str(kind)
            for f in range(len(self.samples.frames))
            for kind in np.unique(self.samples.kind[self.samples.frame == f])
        }
        return kinds.pop() if len(kinds) == 1 else "mixed"

    def set_sizes(self) -> dict[str, int]:
        """Stations in each of the three sets."""
        rows = {"train": self.sets.train, "explain": self.sets.explain, "held_out": self.sets.held_out}
        return {name: len(np.unique(self.samples.station[r])) for name, r in rows.items()}

    def size_mm(self, stage: str) -> ErrorSize | None:
        """Sizes of the held-out position errors of a stage [mm]."""
        return self.errors[stage].size_mm() if stage in self.errors else None

    def size_deg(self, stage: str) -> ErrorSize | None:
        """Sizes of the held-out orientation errors of a stage [deg]."""
        return self.errors[stage].size_deg() if stage in self.errors else None

    def interval_mm(self, stage: str) -> tuple[float, float] | None:
        """95 % interval of the RMS position error of a stage [mm], by drawing held-out stations again."""
        if stage not in self.errors or not len(self.scored):
            return None
        _, station = np.unique(self.scored.station, return_inverse=True)
        square = np.bincount(station, 1e6 * self.errors[stage].position_norm ** 2)
        count = np.bincount(station)
        draws = np.random.default_rng(0).integers(len(count), size=(_DRAWS, len(count)))
        rms = np.sqrt(square[draws].sum(axis=1) / count[draws].sum(axis=1))
        return float(np.percentile(rms, 2.5)), float(np.percentile(rms, 97.5))

    def rejected_rows(self) -> np.ndarray:
        """Rows of the samples that were left out, the farthest first."""
        rows = np.flatnonzero(self.wrong)
        return rows[np.argsort(-self.missed[rows], kind="stable")]

    @property
    def unexplained_mm(self) -> float | None:
        """RMS of what is left beyond the noise [mm]; None when the rest is noise as far as the recording shows.

        What exceeds the noise floor by more than a fifth; where the floor lacks what the arm does not repeat, by
        more than arms in order do not. Otherwise what one more effect would take away.
        """
        final, beyond = self.size_mm("final"), self._beyond_floor_mm
        if final is None:
            return None
        if beyond and self.noise_floor is not None and (self.noise_floor.whole or beyond > _REPEATS_WITHIN_MM):
            return beyond
        return None if self.left is None else final.rms * float(np.sqrt(self.left.share))

    @property
    def _beyond_floor_mm(self) -> float:
        """RMS beyond the noise floor [mm], 0 where it is less than a fifth more, or where no floor is known."""
        final = self.size_mm("final")
        if final is None or self.noise_floor is None or final.rms <= 1.2e3 * self.noise_floor.rms:
            return 0.0
        return float(np.sqrt(final.rms**2 - (1e3 * self.noise_floor.rms) ** 2))

    @property
    def verdict(self) -> str:
        """One or two sentences for a person."""
        before, after = self.size_mm("nominal"), self.size_mm("final")
        if before is None or after is None:
            return "Nothing was held out, so nothing can be said of the error."
        held_out = self.set_sizes()["held_out"]
        named = [f for f in self.effects if f.family != "outliers"]
        geometric = self.size_mm("geometric")
        between = f", {geometric.rms:.3f} mm with geometry alone" if named and geometric is not None else ""
        text = (
            f"On {held_out} stations that were not used for fitting, the error is {after.rms:.3f} mm RMS "
            f"({before.rms:.3f} mm with the nominal model{between})"
        )
        return text + self._about_the_rest()

    def _about_the_rest(self) -> str:
        rest = self.unexplained_mm
        if rest is None and self.noise_floor is None:
            return "; nothing in what is left stands out from noise."
        if rest is None and self.noise_floor is not None:
            noise = 1e3 * self.noise_floor.rms
            if not self._beyond_floor_mm:
                return f", which is the noise of the measurement ({noise:.3f} mm)."
            return (
                f". Readings scatter by {noise:.3f} mm within a station; the rest goes along with nothing that was "
                "recorded, as what an arm does not repeat. Postures visited twice would tell."
            )
        said = f"; at least {rest:.3f} mm of it is more than noise, and the model does not explain it."
        if self.left is None:
            return said
        effect = self.left.effect
        return (
            f"{said} The largest part sits at {effect.place} ({effect.direction}) and goes along with "
            f"{effect.public_driver.replace(':', ' of ')}."
        )

    @property
    def story(self) -> tuple[str, ...]:
        """A sentence for each effect, for a technician."""
        return tuple(finding.sentence for finding in self.effects)


def to_json_data(report: Report) -> dict[str, Any]:
    """The report as the data of ``report.json``: plain dictionaries, None where something does not apply."""
    seen = report.identifiability
    rest = report.unexplained_mm
    return {
        "modcal_report": FORMAT,
        "title": report.title,
        "recording": {
            "stations": report.samples.stations,
            "rejected": report.rejected,
            "measurement": report.measurement,
            "joints": list(report.samples.names),
            "duration_s": round(float(np.ptp(report.samples.stamps)), 6),
        },
        "split": {"unit": report.sets.unit, **report.set_sizes()},
        "error_mm": {stage: _size(report.size_mm(stage), report.interval_mm(stage)) for stage in STAGES},
        "error_deg": {stage: _size(report.size_deg(stage)) for stage in STAGES},
        "noise_floor_mm": None if report.noise_floor is None else 1e3 * report.noise_floor.rms,
        "steps": [{"added": step.added, "rms_mm": step.rms_mm} for step in report.steps],
        "effects": [_effect(finding) for finding in report.effects],
        "unexplained": None if rest is None else _unexplained(rest, report.left),
        "identifiability": None
        if seen is None
        else {
            "parameters": seen.parameters,
            "rank": seen.rank,
            "condition": seen.condition if np.isfinite(seen.condition) else None,
            "unobservable": list(seen.unobservable),
            "left_out": list(report.left_out),
            "weak": [{"direction": name, "std_over_prior": share} for name, share in seen.weak],
        },
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
                "miss_mm": 1e3 * float(report.missed[row]),
            }
            for row in report.rejected_rows()
        ],
        "parameters": [
            {"name": name, "value": value, "std": std, "unit": unit} for name, value, std, unit in report.parameters
        ],
        "notes": list(report.notes),
        "verdict": report.verdict,
        "story": list(report.story),
    }


def _effect(finding: Finding) -> dict[str, Any]:
    return {
        "family": finding.family,
        "place": finding.place,
        "direction": finding.direction,
        "driver": finding.driver,
        "parameters": {
            name: {"value": value, "std": std, "unit": unit} for name, (value, std, unit) in finding.parameters.items()
        },
        "p_value": finding.p_value,
        "rms_mm_before": 1e3 * finding.before,
        "rms_mm_after": 1e3 * finding.after,
        "gain_mm2": finding.gain_mm2,
        "gain_ci95_mm2": None if finding.ci95 is None else list(finding.ci95),
        "tool_rms_mm": None if finding.tool is None else 1e3 * finding.tool,
        "chance": finding.chance,
        "same_as": list(finding.same_as),
    }


def _unexplained(size: float, left: Choice | None) -> dict[str, Any]:
    if left is None:
        return {"place": None, "driver": None, "size_mm": size}
    return {
        "place": left.effect.place,
        "direction": left.effect.direction,
        "driver": left.effect.public_driver,
        "size_mm": size,
        "p_value": left.p_value,
        "same_as": list(left.same_as),
    }


def _size(size: ErrorSize | None, interval: tuple[float, float] | None = None) -> dict[str, Any] | None:
    if size is None:
        return None
    out: dict[str, Any] = {"mean": size.mean, "rms": size.rms, "p95": size.p95, "max": size.max}
    return out if interval is None else {**out, "rms_ci95": list(interval)}
