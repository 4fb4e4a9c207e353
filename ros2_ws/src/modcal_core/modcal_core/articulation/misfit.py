"""Whether the best joint type is good enough: what it leaves, against noise and what furniture and tracking leave.

Probabilities compare joint types with each other and say nothing of what none of them describes. So what the best one
leaves is compared with an absolute size: four times the usual play and sway of ``furniture``, beside the track's own
noise. Nine tenths of the samples count, for markers are lost at the end of a swing; where more than a quarter lies
grossly off, these are no outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.fit import JointFit
from modcal_core.articulation.furniture import DISTORTION, PLAY, SWAY
from modcal_core.articulation.models.model import Kind
from modcal_core.articulation.telling import travelled
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

NONE: Kind = "none"  # of what moves as no joint type does
MUCH = 4.0  # times the usual play or sway
_NOISE = 3.0  # deviations of white noise beside it
_COUNTED = 0.9  # of the samples, those that fit best
OUTLIERS = 0.25  # share of samples beyond the limits that outliers may have
_SMOOTH = 5  # samples of a median along the path
_NOTHING = 1e-9  # m, rad: far below what anything measures


@dataclass(frozen=True)
class Misfit:
    """What a joint leaves. position [m], rotation [rad, nan without]: RMS of the best nine tenths of samples.

    much: what would be too much of each, (m, rad). off: share of samples beyond. between: from where to where along the
    path it fails [m], None where it does nowhere. white: noise of one sample on an axis, (m, rad).
    """

    position: float
    rotation: float
    much: tuple[float, float]
    off: float
    between: tuple[float, float] | None
    white: tuple[float, float]

    @property
    def fails(self) -> bool:
        """Whether the track is not described by this kind of joint."""
        return too_much(self.position, self.rotation, self.white) or self.off > OUTLIERS

    @property
    def said(self) -> str:
        """Reason as text: what remains, what would be too much, and where."""
        left, much = f"{1e3 * self.position:.0f} mm", f"{1e3 * self.much[0]:.0f} mm"
        if self.rotation > self.much[1]:
            left += f" and {np.degrees(self.rotation):.0f}°"
            much += f" and {np.degrees(self.much[1]):.0f}°"
        where = ""
        if self.between is not None:
            where = f", most between {1e2 * self.between[0]:.0f} and {1e2 * self.between[1]:.0f} cm of the path"
        if self.position <= self.much[0] and not self.rotation > self.much[1]:
            return f"leaves {100.0 * self.off:.0f} % of the samples far off{where}"
        return f"leaves {left} where {much} would be much{where}"


def limits(noise: tuple[float, float]) -> tuple[float, float]:
    """What would be too much to leave (m, rad), beside white noise of one sample (m, rad)."""
    usual = float(np.exp(PLAY[0])), float(np.exp(SWAY[0]))
    shift, turn = (float(np.hypot(MUCH * u, _NOISE * n)) for u, n in zip(usual, noise, strict=True))
    return shift, turn


def too_much(position: float, rotation: float, noise: tuple[float, float]) -> bool:
    """Whether a joint type that leaves so much [m, rad; nan where nothing was seen] is none."""
    shift, turn = limits(noise)
    return position > shift or rotation > turn


def usual(position: float, rotation: float, noise: tuple[float, float]) -> bool:
    """Whether what is left [m, rad] is no more than the usual play and the usual distortion of what measures."""
    shift, turn = (
        float(np.hypot(np.hypot(np.exp(play[0]), d), _NOISE * n))
        for play, d, n in zip((PLAY, SWAY), DISTORTION, noise, strict=True)
    )
    return position <= shift and not rotation > turn


def misfit(found: JointFit, track: Track, noise: tuple[float, float]) -> Misfit:
    """What a fit leaves of a track that has no outliers and no rests. noise: white, of one sample [m, rad]."""
    e = found.motion.residuals(track, found.motion.configurations(track, scales(found)))
    shift = np.linalg.norm(e[:, :3], axis=1)
    turn = np.linalg.norm(e[:, 3:], axis=1) if e.shape[1] == 6 else None
    much = limits(noise)
    beyond = shift > much[0] if turn is None else (shift > much[0]) | (turn > much[1])
    smooth = _median(shift) > much[0]
    if turn is not None:
        smooth |= _median(turn) > much[1]
    way = travelled(track)[smooth]
    return Misfit(
        rms(shift),
        np.nan if turn is None else rms(turn),
        much,
        float(beyond.mean()),
        (float(way.min()), float(way.max())) if len(way) else None,
        noise,
    )


def scales(found: JointFit) -> tuple[float, float]:
    """Scatter of one sample [m, rad], 1 rad without rotations; never 0."""
    turn = found.sigma_rotation if np.isfinite(found.sigma_rotation) else 1.0
    return max(found.sigma_position, _NOTHING), max(turn, _NOTHING)


def rms(sizes: Array) -> float:
    """RMS of the smallest nine tenths of sizes (n,)."""
    best = np.sort(sizes)[: max(1, int(np.ceil(_COUNTED * len(sizes))))]
    return float(np.sqrt(np.mean(best**2)))


def _median(sizes: Array) -> Array:
    """Along the track, over some neighbours."""
    half = _SMOOTH // 2
    return np.array([np.median(sizes[max(0, i - half) : i + half + 1]) for i in range(len(sizes))])
