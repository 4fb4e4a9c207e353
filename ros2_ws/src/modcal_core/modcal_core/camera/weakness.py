"""What the images do not show well, by name, and what it would be worth to know more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.causes import flange_motions
from modcal_core.camera.contradicted import SIZE, DoubtedStatement
from modcal_core.camera.corners import COMMON, READOUT, CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.mounting import Mounting
from modcal_core.camera.tool_error import ToolError
from modcal_core.geometry import Array, se3

_TILT = np.radians(20.0)  # below, the focal length is told by perspective of second order only
_DISTANCES = 1.3  # farthest over nearest
_COVERED = 0.4  # of the image, in a grid of eight by eight
_GRID = 8  # cells a side
_JOINT = np.radians(20.0)  # range of a joint that shows what its axis does
_RESTS = 3.0  # times better is the stated size known than the images show it: they say nothing against it
_SLIDE = 0.05  # m, of a sliding joint
ALL_BUT_IMAGES = "lens, sheet and clock"


def weak_directions(fit: CameraFit, mounting: Mounting) -> tuple[str, ...]:
    """What these images leave open, each with what to do, in sentences."""
    out = []
    T, _ = fit.poses.tool_motions(fit.state.values, fit.state.offset_s)
    seen = fit.poses.seen(T)
    centre = fit.table.points.mean(axis=0)
    tilts, away = tilt_and_distance(seen, centre)
    tilt = float(tilts.max())
    if tilt < _TILT and not fit.table.places:
        out.append(
            f"The target was never tilted by more than {np.degrees(tilt):.0f}°: focal length and distance cannot be "
            "told apart. Take images with 20° to 45° of tilt."
        )
    if away.max() < _DISTANCES * away.min():
        out.append(
            f"All images are from {away.min():.2f} to {away.max():.2f} m: the distance and the lens go together. "
            "Take some from half as far, or twice as far."
        )
    if (share := covered(fit.table, fit.state.lens.size)) < _COVERED:
        out.append(
            f"Corners cover {100.0 * share:.0f} % of the image: the lens is not known at its edges. "
            "Bring the target into every corner of the image."
        )
    if mounting.one_axis:
        turns = np.degrees(mounting.turns)
        out.append(
            f"The arm turned its tip about one axis only (RMS {turns[0]:.0f}°, across it {turns[1]:.1f}°): where "
            "camera and target are along this axis is open. Turn the wrist about a second axis."
        )
    chain = fit.poses.model.serial
    for name, low, high, turning in zip(
        chain.names, fit.poses.q.min(0), fit.poses.q.max(0), chain.revolute, strict=True
    ):
        if high - low < (_JOINT if turning else _SLIDE):
            moved = f"{np.degrees(high - low):.0f}°" if turning else f"{1e3 * (high - low):.0f} mm"
            out.append(f"Joint {name} moved by {moved} only: its axis is known from the drawing.")
    return tuple(out)


@dataclass(frozen=True)
class RestsOn:
    """What the sheet's stated size is worth. images_std: to what the images by themselves show it, relative.
    per_unit_m: RMS by which the tool is off per unit that it is wrong. if_wrong_m: upper end of the 95 % interval of
    the calibrated arm's error, were it wrong by what the images allow.
    """

    images_std: float
    per_unit_m: float
    if_wrong_m: float

    def sentence(self, nominal_m: float, body: bool = False) -> str:
        """The findings as sentences. nominal_m: error of the nominal arm. body: whether the target is a body."""
        what, again = ("body", "across it") if body else ("sheet", "a square")
        return (
            f"All of this rests on the {what}'s stated size, which these images by themselves show to "
            f"{100.0 * self.images_std:.1f} % only: each per cent that it is off puts the tool "
            f"{10.0 * self.per_unit_m:.1f} mm off. Were it wrong, the calibrated arm could be up to "
            f"{1e3 * self.if_wrong_m:.1f} mm off (95 %), the nominal arm is {1e3 * nominal_m:.1f} mm: measure {again} "
            "once more."
        )


def rests_on(fit: CameraFit, doubted: Sequence[DoubtedStatement], q: Array, error: ToolError) -> RestsOn | None:
    """The sheet's stated size, where the images by themselves hardly show it, and what it is worth at the tool over
    postures q (M, n); None where they show it as well. error: over these postures.
    """
    doubt = next((d for d in doubted if d.what == SIZE), None)
    if doubt is None:
        return None
    P = fit.poses.count
    x = P + 1 + LENS
    C = doubt.equations.solve(doubt.sizes).covariance()
    both = np.array([0.5, 0.5])
    free = float(np.sqrt(both @ C[x : x + 2, x : x + 2] @ both))
    held = float(np.sqrt(both @ fit.covariance[x : x + 2, x : x + 2] @ both))
    if free < _RESTS * held:
        return None
    per_unit = C[:P, x : x + 2] @ both / free**2
    moved = flange_motions(fit, q) @ per_unit
    return RestsOn(free, float(np.sqrt((moved**2).sum() / len(q))), error.if_wrong(SIZE)[2])


def tilt_and_distance(seen: Array, centre: Array) -> tuple[Array, Array]:
    """(tilt of the sheet against the line of sight [rad], its distance [m]) of T_camera_target (N, 4, 4), (N,) each."""
    at = se3.apply(seen, centre)
    away = np.linalg.norm(at, axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", seen[:, :3, 2], at)) / np.maximum(away, 1e-9)
    return np.arccos(np.clip(cosine, 0.0, 1.0)), away


def covered(table: CornerTable, size: tuple[int, int]) -> float:
    """Share of the image's cells, eight by eight, that hold a corner of some image."""
    cell = np.clip((table.pixels * _GRID / np.array(size)).astype(int), 0, _GRID - 1)
    return len(np.unique(cell[:, 0] * _GRID + cell[:, 1])) / _GRID**2


def shares(fit: CameraFit, q: Array) -> dict[str, tuple[float, float]]:
    """For lens, print scale, flatness, clock and places of markers, and for all of these at once: (mean square error at
    the tool that is known [m²], the same if that thing were known exactly), over postures q (M, n).
    """
    J = flange_motions(fit, q)
    P = J.shape[2]
    C = fit.covariance
    lens = np.arange(P + 1, P + 1 + LENS)
    places = np.arange(P + 1 + COMMON, len(C))
    groups = {
        "lens": lens,
        "print scale": lens[-1] + 1 + np.arange(2),
        "flatness": lens[-1] + 3 + np.arange(3),
        "clock": np.array([P]),
        "readout": np.array([P + 1 + READOUT]),
        "places of markers": places,
        ALL_BUT_IMAGES: np.r_[lens, lens[-1] + 1 + np.arange(5), P, P + 1 + READOUT, places],
    }
    whole = _mean_square(J, C[:P, :P])
    out = {}
    for name, rows in groups.items():
        rows = rows[np.diag(C)[rows] > 0.0]
        if len(rows):
            known = C[:P, :P] - C[:P][:, rows] @ np.linalg.pinv(C[np.ix_(rows, rows)], hermitian=True) @ C[rows][:, :P]
            out[name] = (whole, max(_mean_square(J, known), 0.0))
    return out


def _mean_square(J: Array, C: Array) -> float:
    return float(np.einsum("mip,pq,miq->", J, C, J) / len(J))
