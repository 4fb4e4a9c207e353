"""What a person states about the arm and the instrument: how well one repeats, how well the other measures."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from modcal_core.errors import BadTable

# RP of ISO 9283 is mean + 3 standard deviations of the distance to the mean position. For equal, normal scatter along
# three axes the distance has a Maxwell distribution: mean √(8/π) σ, standard deviation √(3 − 8/π) σ, RMS √3 σ.
RMS_OF_RP = float(np.sqrt(3.0) / (np.sqrt(8.0 / np.pi) + 3.0 * np.sqrt(3.0 - 8.0 / np.pi)))
MAX_MM, MAX_DEG = 100.0, 10.0  # a statement above this is a wrong unit


@dataclass(frozen=True)
class Stated:
    """Repeatability of the arm and accuracy of the instrument, None where not stated.

    repeatability_mm, instrument_mm: RMS over space [mm]. repeatability_deg, instrument_deg: RMS of the angle [deg].
    repeatability_iso_mm: RP of ISO 9283 [mm], as data sheets give it. Raises BadTable for a value out of range, and
    where repeatability is stated both ways.
    """

    repeatability_mm: float | None = None
    repeatability_deg: float | None = None
    repeatability_iso_mm: float | None = None
    instrument_mm: float | None = None
    instrument_deg: float | None = None

    def __post_init__(self) -> None:
        for name, value in self.given().items():
            limit, unit = (MAX_DEG, "deg") if name.endswith("_deg") else (MAX_MM, "mm")
            if not 0.0 < value <= limit:
                said = f"{value:g} {unit}, above 0 and at most {limit:g} {unit} is allowed"
                raise BadTable(f"stated {name}", said, f"give {unit}")
        if self.repeatability_mm is not None and self.repeatability_iso_mm is not None:
            raise BadTable(
                "stated repeatability",
                f"given twice: {self.repeatability_mm:g} mm RMS and RP {self.repeatability_iso_mm:g} mm",
                "state one of them",
            )

    @property
    def rms_mm(self) -> float | None:
        """RMS over space of what the arm does not repeat [mm], from either statement; None if there is none."""
        if self.repeatability_iso_mm is not None:
            return RMS_OF_RP * self.repeatability_iso_mm
        return self.repeatability_mm

    def given(self) -> dict[str, float]:
        """The values that were stated, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: float(value) for name, value in values.items() if value is not None}

    def over(self, other: Stated) -> Stated:
        """These statements, and the other's where these have none. Repeatability counts as one, however stated."""
        mine, theirs = self.given(), other.given()
        if self.rms_mm is not None:
            theirs = {name: v for name, v in theirs.items() if name not in ("repeatability_mm", "repeatability_iso_mm")}
        return Stated(**{**theirs, **mine})
