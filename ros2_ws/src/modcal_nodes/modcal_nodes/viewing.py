"""The pictures of the live view, each as a MarkerArray, and the last stations that it keeps."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from visualization_msgs.msg import Marker, MarkerArray

from modcal_core.correction import (
    ArmState,
    Correction,
    Residuals,
    arm_state_of,
    enlarged_axes,
    joint_axes,
    known_to,
    residuals,
)
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, SignalTrack
from modcal_core.robots import Chain, chain_forward
from modcal_msgs_py import Colour, arrows, caption, colour_of, dots, ellipsoids, fill_picture

_MIN_GAP = 0.2  # s between readings of an arm in motion that are kept


@dataclass(frozen=True)
class JudgedStations:
    """calibrated, nominal: by how much either model misses the stations. moments: theirs, for the calibrated arm.
    strangers: frames of readings that the calibration does not know.
    """

    calibrated: Residuals
    nominal: Residuals
    moments: tuple[ArmState, ...]
    strangers: tuple[str, ...]


class Stations:
    """The last so many stations; of an arm in motion, readings some time apart."""

    def __init__(self, most: int) -> None:
        self._kept: deque[Samples] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, sample: Samples) -> bool:
        """Keep one sample (a row), if it is wanted; returns whether it was."""
        since = float(sample.stamps[0] - self._kept[-1].stamps[0]) if self._kept else _MIN_GAP
        if sample.moving[0] and 0.0 <= since < _MIN_GAP:
            return False
        self._kept.append(sample)
        return True

    def clear(self) -> None:
        """Forget them."""
        self._kept.clear()

    @property
    def postures(self) -> np.ndarray:
        """Joint positions of them all, (N, n); (0, 0) while there are none."""
        return np.concatenate([s.q for s in self._kept]) if self._kept else np.empty((0, 0))

    def judged(self, correction: Correction, signals: tuple[SignalTrack, ...]) -> JudgedStations | None:
        """What a calibration and its nominal arm make of them; None while there are none that it can tell of.

        signals: what the effects depend on. Raises MissingDriver where that is not known.
        """
        if not self._kept:
            return None
        calibration, (*before, last) = correction.calibration, self._kept
        of_frame = [s.frames[int(s.frame[0])] for s in self._kept]
        strangers = tuple(sorted(set(of_frame) - set(calibration.calibrated.frames)))
        samples = replace(known_to(calibration.calibrated, last.join(*before)), signals=signals)
        if not len(samples):
            return JudgedStations(_NOTHING, _NOTHING, (), strangers)
        moments = tuple(arm_state_of(samples.select(np.array([i])), signals) for i in range(len(samples)))
        for at in moments:
            correction.require(at)
        models, noise = (calibration.calibrated, calibration.nominal), calibration.noise
        calibrated, nominal = (residuals(model, samples, noise) for model in models)
        return JudgedStations(calibrated, nominal, moments, strangers)


_NOTHING = Residuals(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, bool))


CALIBRATED, NOMINAL, SCALE = "calibrated", "nominal", "scale"
PRESENT, STATIONS = "present", "stations"
RECORDED, FITTING, REJECTED, WAITING = "recorded", "fitting", "rejected", "waiting"

_SHAFT, _AXIS, _AXIS_LENGTH = 0.006, 0.012, 0.25  # m
_DOT, _TEXT = 0.02, 0.05  # m
_GREY: Colour = (0.55, 0.58, 0.62, 0.8)
_BLUE: Colour = (0.13, 0.44, 0.71, 1.0)
_RED: Colour = (0.84, 0.15, 0.16, 1.0)
_YELLOW: Colour = (0.98, 0.78, 0.18, 1.0)
_PALE: Colour = (0.13, 0.44, 0.71, 0.25)
_NOW: Colour = (0.98, 0.78, 0.18, 0.4)

Shapes = Sequence[tuple[Array, Array]]


def nothing(frame: str) -> MarkerArray:
    """A picture of nothing, which takes away what was shown."""
    return fill_picture(MarkerArray(), Marker, frame, [])


def residual_picture(
    chain: Chain, judged: JudgedStations | None, scale: float, full: float, change: str
) -> MarkerArray:
    """Arrows from where the models expect the tool to where it was seen, so much enlarged, and what they say in words.

    full: size of the residuals that are drawn in red [m]. change: what seems to have changed since; may be empty.
    """
    if judged is None:
        return nothing(chain.base)
    parts = _residuals(CALIBRATED, judged.calibrated, scale, full, 1.0)
    parts += _residuals(NOMINAL, judged.nominal, scale, full, 0.35)
    lines = [f"1 mm is drawn as {scale:g} mm, {1e3 * full:g} mm and more in red"]
    lines += [
        f"{name}: RMS {1e3 * rms(m):.3f} mm, largest {1e3 * m.size.max():.3f} mm, {len(m)} stations"
        for name, m in ((CALIBRATED, judged.calibrated), (NOMINAL, judged.nominal))
        if len(m)
    ]
    above = chain.T_base_root[:3, 3] + np.array([0.0, 0.0, 1.1 * chain.reach()])
    parts.append(caption(Marker, SCALE, above, "\n".join([*lines, change]).strip(), _TEXT))
    return fill_picture(MarkerArray(), Marker, chain.base, parts)


def rms(of: Residuals) -> float:
    """Root mean square of the misses [m]; 0 where there are none."""
    return float(np.sqrt(np.mean(of.size**2))) if len(of) else 0.0


def _residuals(space: str, of: Residuals, scale: float, full: float, solid: float) -> list[Marker]:
    colours = [colour_of(size / full, solid) for size in of.size]
    return arrows(Marker, space, of.expected, scale * of.residual, colours, _SHAFT)


def axes_picture(nominal: Chain, calibrated: Chain | None, q: Array, scale: float, lifetime: float) -> MarkerArray:
    """Every joint's axis: the nominal ones thin, the calibrated ones thicker, standing off them so much enlarged."""
    parts = []
    where = {NOMINAL: (joint_axes(nominal, q), _GREY, 0.4 * _AXIS)}
    if calibrated is not None:
        where[CALIBRATED] = (enlarged_axes(nominal, calibrated, q, scale), _BLUE, _AXIS)
    for space, ((points, directions), colour, thickness) in where.items():
        parts += arrows(Marker, space, points, _AXIS_LENGTH * directions, [colour] * len(points), thickness)
    return fill_picture(MarkerArray(), Marker, nominal.base, parts, lifetime)


def around_stations(shapes: Shapes, scale: float) -> list[Marker]:
    """Ellipsoids about the predicted tool at the last stations, so much enlarged, to be shown again and again."""
    return ellipsoids(Marker, STATIONS, [(T, scale * half) for T, half in shapes], _PALE)


def uncertainty_picture(
    frame: str, at_stations: list[Marker], present: Shapes, scale: float, lifetime: float
) -> MarkerArray:
    """Ellipsoids at the stations and at the present tool, as one picture."""
    parts = ellipsoids(Marker, PRESENT, [(T, scale * half) for T, half in present], _NOW)
    return fill_picture(MarkerArray(), Marker, frame, [*at_stations, *parts], lifetime)


def stations_picture(correction: Correction, judged: JudgedStations | None) -> MarkerArray:
    """Where the tool was: at the stations that the calibration was made from, and at the last ones by how they fit."""
    model, chain = correction.model, correction.model.serial
    parts = []
    if len(correction.calibration.postures):
        T = chain_forward(chain, correction.calibration.postures) @ model.T_tip_tool
        parts += dots(Marker, RECORDED, T[:, :3, 3], _GREY, 0.5 * _DOT)
    if judged is not None:
        at, rejected = judged.calibrated.expected, judged.calibrated.rejected
        parts += dots(Marker, FITTING, at[~rejected], _BLUE, _DOT)
        parts += dots(Marker, REJECTED, at[rejected], _RED, _DOT)
    return fill_picture(MarkerArray(), Marker, chain.base, parts)


def waiting_picture(chain: Chain, postures: Array) -> MarkerArray:
    """Where the nominal arm had its tip at stations that no calibration judges yet, postures (N, n)."""
    parts = dots(Marker, WAITING, chain_forward(chain, postures)[:, :3, 3], _YELLOW, _DOT) if len(postures) else []
    return fill_picture(MarkerArray(), Marker, chain.base, parts)
