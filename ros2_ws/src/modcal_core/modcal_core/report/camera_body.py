"""What a calibration by camera found of a body: how large it is, and where its markers are on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.camera.bundle import BundleMarker, MarkerBundle
from modcal_core.camera.corners import COMMON, SCALE, SHAPE
from modcal_core.camera.solve import CameraSolution

_NAMED = 3  # markers that are named in a sentence, those that are farthest off
_TIMES = 3.0  # the stated tolerance, beyond which a marker is named: one of a thousand is off by so much
_SURE = 3.0  # standard deviations of where it is


@dataclass(frozen=True)
class _MarkerPlace:
    """marker: whose. offset_m: from the drawing, in the body's frame, (3,). std_m: of it, RMS of the three. turn_rad:
    from the drawing, 0 where corners were not read.
    """

    marker: BundleMarker
    offset_m: np.ndarray
    std_m: float
    turn_rad: float

    @property
    def off_m(self) -> float:
        """How far it is from its place."""
        return float(np.linalg.norm(self.offset_m))


def body_data(solution: CameraSolution) -> dict[str, Any] | None:
    """The body as ``report.json`` has it, None of a sheet."""
    target, fit = solution.target, solution.fit
    if not isinstance(target, MarkerBundle):
        return None
    P = fit.poses.count + 1
    std = np.sqrt(np.diag(fit.covariance))[P + SCALE.start : P + SCALE.stop]
    sizes = {"size": (fit.state.shape[0], std[0])}
    if target.turning:
        sizes["print_size"] = (fit.state.shape[1], std[1])
    return {
        **{name: {"value": float(value), "std": float(s)} for name, (value, s) in sizes.items()},
        "tolerance_mm": 1e3 * target.place_m,
        "offsets_in_tolerances": fit.sizes.places,
        "markers": [
            {
                "id": one.marker.id,
                "offset_mm": (1e3 * one.offset_m).tolist(),
                "std_mm": 1e3 * one.std_m,
                "turn_deg": float(np.degrees(one.turn_rad)) if target.turning else None,
            }
            for one in _places(solution, target)
        ],
    }


def body_notes(solution: CameraSolution) -> tuple[str, ...]:
    """Where the markers of a body are, in sentences; nothing of a sheet."""
    target = solution.target
    if not isinstance(target, MarkerBundle):
        return ()
    places = _places(solution, target)
    rms = float(np.sqrt(np.mean([one.off_m**2 for one in places]) / 3.0))
    out = [f"Markers are {1e3 * rms:.2f} mm from their places on the drawing, RMS along an axis."]
    far = [one for one in places if one.off_m > _TIMES * target.place_m and one.off_m > _SURE * one.std_m]
    far = sorted(far, key=lambda one: -one.off_m)[:_NAMED]
    if far:
        named = ", ".join(f"{m.marker.label} by {1e3 * m.off_m:.1f} ± {1e3 * m.std_m:.1f} mm" for m in far)
        out.append(f"Off the drawing by more than {_TIMES:.0f} times what is stated: {named}.")
    return tuple(out)


def _places(solution: CameraSolution, target: MarkerBundle) -> list[_MarkerPlace]:
    """Where the markers are, in the order of the target."""
    fit = solution.fit
    values = fit.state.shape[SHAPE:].reshape(len(target.markers), -1)
    first = fit.poses.count + 1 + COMMON
    std = np.sqrt(np.diag(fit.covariance))[first:].reshape(values.shape)
    grown = fit.state.shape[0] * (target.middles - target.middles.mean(axis=0))
    return [
        _MarkerPlace(one, v[:3] + g, float(np.sqrt((s[:3] ** 2).mean())), float(np.linalg.norm(v[3:])))
        for one, v, g, s in zip(target.markers, values, grown, std, strict=True)
    ]
