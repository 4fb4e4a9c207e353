"""The report: what was recorded, how far the robot misses before and after, and what the data could not tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.calibration.identifiability import Identifiability
from modcal_core.calibration.score import Errors, ErrorSize
from modcal_core.calibration.split import Split
from modcal_core.diagnosis.scan import Finding
from modcal_core.measurements.samples import Samples

FORMAT = 1
STAGES = ("nominal", "geometric", "final")


@dataclass(frozen=True)
class Report:
    """Everything a calibration or an evaluation has to say.

    scored: the held-out samples less the outliers. errors: theirs by stage (nominal, geometric, final). rejected: how
    many samples were left out as outliers. noise_floor: [m], None where the recording does not show it. left: where
    what remains sits and on what it depends, None where that cannot be told from noise. parameters: (name, value,
    standard deviation, unit). left_out: parameters that say the same as others. notes: a sentence each, for a person.
    """

    samples: Samples
    sets: Split
    scored: Samples
    rejected: int
    errors: dict[str, Errors]
    noise_floor: float | None
    left: Finding | None = None
    identifiability: Identifiability | None = None
    parameters: tuple[tuple[str, float, float, str], ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    title: str = "recording"

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

    @property
    def unexplained_mm(self) -> float | None:
        """RMS of what is left beyond the noise [mm]; None when the rest is noise as far as the recording shows.

        With a known noise floor, what exceeds it by more than a fifth; else the size of what was found to be left.
        """
        final = self.size_mm("final")
        if final is None or self.noise_floor is None:
            return None if self.left is None else 1e3 * self.left.size
        rest = final.rms**2 - (1e3 * self.noise_floor) ** 2
        if final.rms > 1.2 * 1e3 * self.noise_floor:
            return float(np.sqrt(rest))
        return None if self.left is None else 1e3 * self.left.size

    @property
    def verdict(self) -> str:
        """One or two sentences for a person."""
        before, after = self.size_mm("nominal"), self.size_mm("final")
        if before is None or after is None:
            return "Nothing was held out, so nothing can be said of the error."
        held_out = self.set_sizes()["held_out"]
        text = (
            f"On {held_out} stations that were not used for fitting, the error is {after.rms:.3f} mm RMS "
            f"({before.rms:.3f} mm with the nominal model)"
        )
        return text + self._about_the_rest()

    def _about_the_rest(self) -> str:
        rest = self.unexplained_mm
        if rest is None and self.noise_floor is None:
            return "; nothing in what is left stands out from noise."
        if rest is None:
            return f", which is the noise of the measurement ({1e3 * (self.noise_floor or 0.0):.3f} mm)."
        said = f"; at least {rest:.3f} mm of it is more than noise, and geometry does not explain it."
        if self.left is None:
            return said
        periodic = "" if self.left.cycles is None else f", with about {self.left.cycles:g} cycles a turn"
        return (
            f"{said} The largest part sits at {self.left.place} ({self.left.direction}) and goes along with "
            f"{self.left.driver.replace(':', ' of ')}{periodic}."
        )


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
        "error_mm": {stage: _size(report.size_mm(stage)) for stage in STAGES},
        "error_deg": {stage: _size(report.size_deg(stage)) for stage in STAGES},
        "noise_floor_mm": None if report.noise_floor is None else 1e3 * report.noise_floor,
        "effects": [],
        "unexplained": None if rest is None else _unexplained(rest, report.left),
        "identifiability": None
        if seen is None
        else {
            "parameters": seen.parameters,
            "rank": seen.rank,
            "condition": seen.condition if np.isfinite(seen.condition) else None,
            "unobservable": list(seen.unobservable),
            "left_out": list(report.left_out),
        },
        "parameters": [
            {"name": name, "value": value, "std": std, "unit": unit} for name, value, std, unit in report.parameters
        ],
        "notes": list(report.notes),
        "verdict": report.verdict,
    }


def _unexplained(size: float, left: Finding | None) -> dict[str, Any]:
    if left is None:
        return {"place": None, "driver": None, "size_mm": size}
    return {
        "place": left.place,
        "direction": left.direction,
        "driver": left.driver,
        "cycles_per_turn": left.cycles,
        "size_mm": size,
        "found_mm": 1e3 * left.size,
        "p_value": left.p_value,
        "same_as": list(left.same_as),
    }


def _size(size: ErrorSize | None) -> dict[str, float] | None:
    return None if size is None else {"mean": size.mean, "rms": size.rms, "p95": size.p95, "max": size.max}
