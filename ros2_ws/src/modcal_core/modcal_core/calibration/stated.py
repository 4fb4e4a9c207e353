"""What a person states about the arm and the instrument: how well one repeats, how well the other measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from modcal_core.calibration.fit import Fit
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.placing import Known
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3

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
            said = f"given twice: {self.repeatability_mm:g} mm RMS and RP {self.repeatability_iso_mm:g} mm"
            raise BadTable("stated repeatability", said, "state one of them")

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


# --- Where tool and base are stated to be, with a tolerance

_CONTRADICTED = 4.0  # standard deviations, as of known distances


@dataclass(frozen=True)
class StatedTool:
    """Where the point or frame that the instruments see is in the tip, as a drawing has it.

    T_tip_tool: (4, 4) [m]. std_m, std_rad: how well position and orientation are known; infinite where not at all.
    """

    T_tip_tool: Array
    std_m: float
    std_rad: float = float("inf")


def stated_tool(tool: StatedTool, located: Array) -> Array:
    """The tool (4, 4) where it is stated, turned as it was located where its orientation is not stated."""
    if np.isfinite(tool.std_rad):
        return tool.T_tip_tool
    return se3.transform(located[:3, :3], tool.T_tip_tool[:3, 3])


def stated_std(p: ModelParameter, tool: StatedTool | None, known: Sequence[Known]) -> float | None:
    """How well a parameter is stated to be known, in its unit; None where it is not."""
    std: tuple[float, float] | None = None
    if p.name.startswith("tool/") and tool is not None:
        std = tool.std_m, tool.std_rad
    for k in known:
        if p.name.startswith(f"frame {k.frame}/") and k.to == "base":
            std = k.std
    if std is None:
        return None
    own = std[1] if p.turns else std[0]
    return own if np.isfinite(own) else None


def as_stated(model: Model, tool: StatedTool | None, known: Sequence[Known]) -> Model:
    """The model with tool and base where they are stated, so that priors on errors of these stand about that."""
    if tool is not None:
        model = replace(model, T_tip_tool=stated_tool(tool, model.T_tip_tool))
    poses = np.array(model.T_frame_base)
    for k in known:
        if k.std is not None and k.frame in model.frames:
            poses[model.frames.index(k.frame)] = k.T_frame_to
    return replace(model, T_frame_base=poses)


def contradicted_places(fit: Fit, tool: StatedTool | None, known: Sequence[Known]) -> tuple[str, ...]:
    """A sentence for each of tool and bases that the data put elsewhere than stated.

    A stated value of variance s² of which the fit leaves the variance v was pulled by s² − v, if the statement holds.
    """
    out = []
    places = dict.fromkeys(p.name.partition("/")[0] for p in fit.parameters if stated_std(p, tool, known) is not None)
    for place in places:
        worst, said = 0.0, ""
        for p, value, std in zip(fit.parameters, fit.values, fit.std, strict=True):
            stated = stated_std(p, tool, known)
            if p.name.partition("/")[0] != place or stated is None or std >= stated:
                continue
            z = abs(float(value)) / float(np.sqrt(stated**2 - std**2))
            if z > max(worst, _CONTRADICTED):
                scale, unit = (np.degrees(1.0), "deg") if p.turns else (1e3, "mm")
                worst, said = z, f"{scale * value:+.3f} {unit} along {p.name.partition('/')[2]}"
                said = f"{said}, stated to within {scale * stated:.3f} {unit}"
        if said:
            out.append(f"The readings put the {place} {said}: check what the cell file states of it")
    return tuple(out)
