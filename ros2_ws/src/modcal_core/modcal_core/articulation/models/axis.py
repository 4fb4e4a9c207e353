"""Motions about one axis: what rigid, prismatic, revolute and screw share.

A motion carries a frame G at the handle's start p: column 0 points along the handle's path (for a screw, along the part
of it that goes round), column 1 from the handle to the axis, column 2 along the axis, which stands at p + r G[:, 1].
What was seen at configuration a is unwound to configuration 0 and compared with the start, in the axes of G:

    e = Rz(−a) x + (0, r, −h a),  x = Gᵀ(p_seen − p) − (0, r, 0)        (shift; the tangent ∂e/∂a is −(r, 0, h))
    φ = log(Rz(−a) Gᵀ R_seen R_startᵀ G)                                  (turn)

Parameters are small changes: G exp(δ), p + G β with β across the path only (along it, the configurations absorb it),
R_start turned by γ in G's axes, log r, and log |h|. So prismatic has 4 (7 with rotations), revolute 6 (9), screw 7
(10). As log r grows without end, a revolute motion becomes the prismatic one with the same G.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from modcal_core.articulation.joint_motion import (
    KEEP,
    ArticulationModel,
    Motion,
    best_of,
    frame,
    log_and_jacobian,
    middle_rotation,
    quick_log,
)
from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.track import Track
from modcal_core.geometry import Array, posed, so3, turned


class AxisModel(ArticulationModel):
    """A joint type that is a screw motion about one axis, or none."""

    joint: ClassVar[type[JointModel]]


@dataclass(frozen=True)
class AxisMotion(Motion):
    """p: start (3,) [m]; G: its frame (3, 3); R: start's rotation or None; r: radius [m]; h: pitch [m/rad]."""

    p: Array
    G: Array
    R: Array | None = None
    r: float = 1.0
    h: float = 0.0

    uniform: ClassVar[bool] = True
    made: ClassVar[type[JointModel]]
    frame_turns: ClassVar[int]  # how many turns of its frame change it
    shifts: ClassVar[int] = 2  # how many shifts of its start do
    sizes: ClassVar[int] = 0  # how many of r and h are its parameters
    first_rise: ClassVar[float] = 0.0  # m/rad, where nothing is known

    @property
    def size(self) -> int:
        """How many parameters it has."""
        return self.frame_turns + self.shifts + self.sizes + 3 * (self.R is not None)

    @property
    def start_turn(self) -> int:
        """Which parameter is the first of the three by which the start is turned; with rotations only."""
        return self.frame_turns + self.shifts

    @property
    @abstractmethod
    def length_per_unit(self) -> float:
        """Path of the handle [m] per unit of configuration."""

    @property
    def climb(self) -> tuple[float, float]:
        """Sine and cosine of the angle between the path and the circle that it goes round."""
        return 0.0, 1.0

    @property
    def across(self) -> Array:
        """Directions (3, k) in G's axes in which the start may shift: two across the path; all three when rigid."""
        rise, run = self.climb
        return np.array([[0.0, -rise], [1.0, 0.0], [0.0, run]])

    def moved(self, z: Array) -> AxisMotion:
        """Motion with its parameters changed by z (size,); radius and pitch are limited to plausible values."""
        k = self.frame_turns
        across = self.across
        j = k + across.shape[1]
        delta = np.zeros(3)
        delta[3 - k :] = z[:k]
        G, R = self.G @ turned(delta), self.R
        if R is not None:
            R = turned(self.G @ z[j : j + 3]) @ R
        j += 3 * (R is not None)
        r, h = self.resized(z[j:])
        return type(self)(self.p + self.G @ (across @ z[k : k + across.shape[1]]), G, R, r, h)

    def resized(self, z: Array) -> tuple[float, float]:
        """Radius and pitch, changed by the parameters that are theirs."""
        return self.r, self.h

    def configurations(self, track: Track, sigma: tuple[float, float] = (1.0, 1.0)) -> Array:
        """Latent configurations (n,) that are most likely where noise is sigma, (m, rad)."""
        return self.along((track.positions - self.p) @ self.G, track, sigma)

    @abstractmethod
    def along(self, y: Array, track: Track, sigma: tuple[float, float]) -> Array:
        """The same, of positions y (n, 3) in G's axes from the start."""

    def placed(self, p: Array, R: Array | None, sigma: tuple[float, float]) -> tuple[float, Array]:
        """Configuration and residual (3,) or (6,) of one pose: as ``configurations`` and ``residuals`` of many."""
        track = Track.trusted(p[None], None if R is None else R[None])
        a = self.configurations(track, sigma)
        return float(a[0]), self.residuals(track, a)[0]

    def expanded(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array]:
        """Residuals and, beside them, their derivatives by the parameters (n, m, 1 + size); derivatives by a (n, m)."""
        oriented = self.R is not None and track.rotations is not None
        n, m, width = len(a), 6 if oriented else 3, 1 + self.size * derivatives
        both, by_a = np.zeros((n, m, width)), np.zeros((n, m))
        y = (track.positions - self.p) @ self.G
        # as it was seen: the position; how it shifts with a turn of the frame, the start, and the radius
        shifts = self.by_shift()
        part = y[:, :, None]
        if derivatives:
            by_turn = so3.hat(y)[:, :, 3 - self.frame_turns :]
            part = np.concatenate([part, by_turn, np.broadcast_to(shifts, (n, *shifts.shape))], axis=2)
        C = self.unwind(part, a, both, by_a, derivatives)
        if oriented:
            self._turned(track, C, both, by_a, derivatives)
        return both, by_a

    def by_shift(self) -> Array:
        """What no position changes (3, 2 or 3): how residuals shift with the start and log r, before unwinding."""
        return -self.across

    @abstractmethod
    def unwind(self, part: Array, a: Array, both: Array, by_a: Array, derivatives: bool) -> Array | None:
        """Write what positions leave into both and by_a; Rz(−a) (n, 3, 3) where it turns."""

    def _turned(self, track: Track, C: Array | None, both: Array, by_a: Array, derivatives: bool) -> None:
        Q = self.against_start(track)
        if not derivatives:
            both[:, 3:, 0] = quick_log(Q if C is None else C @ Q)[0]
            return
        both[:, 3:, 0], J_phi = log_and_jacobian(Q if C is None else C @ Q)
        if C is not None:
            by_a[:, 3:] = -J_phi[:, 2]  # J(−φ) Eᵀ = J(φ) = J(−φ)ᵀ
        k, j = self.frame_turns, 1 + self.start_turn
        both[:, 3:, 1 : 1 + k] = (J_phi - J_phi @ Q.transpose(0, 2, 1))[:, :, 3 - k :]
        both[:, 3:, j : j + 3] = -J_phi

    def against_start(self, track: Track) -> Array:
        """Gᵀ R_seen R_startᵀ G (n, 3, 3)."""
        assert self.R is not None
        assert track.rotations is not None
        return self.G.T @ track.rotations @ (self.R.T @ self.G)

    def apart(self, both: Array, by_a: Array) -> Array:
        """What positions leave across the path (k, 2 or 3, 1 + size); what a configuration absorbs leaves both."""
        t = by_a[:, :3]
        along = t[:, None] @ both[:, :3] / (t * t).sum(axis=1)[:, None, None]
        both -= by_a[:, :, None] * along
        return both[:, 1:3]

    def turns_apart(self, both: Array) -> tuple[Array, Array | None]:
        """Rotation residuals that no position tells of, and those about the axis that positions tell, None without."""
        return both[:, 3:], None

    def priors(self) -> list[tuple[float, tuple[float, float]]]:
        """For each size that is a parameter, its logarithm, and mean and standard deviation of its prior."""
        return []

    def prior_terms(self) -> tuple[float, Array, Array]:
        """Half the squared distance from the prior, its gradient (size,) and its curvature (size,), diagonal."""
        cost, gradient = 0.0, np.zeros(self.size)
        priors = self.priors()
        for at, (value, (mean, std)) in enumerate(priors, self.size - len(priors)):
            d = (value - mean) / std
            cost += 0.5 * d * d
            gradient[at] = d / std
        return cost, gradient, _prior_curvature(self.frame_turns, self.size, tuple(std for _, (_, std) in priors))

    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in the coordinates of the motion."""
        return -math.log(4.0 * math.pi)

    def zero(self, a: Array) -> float:
        """Configuration 0 is where the first sample is."""
        return float(a[0])

    def sound(self) -> bool:
        """Whether start and frame are finite."""
        return bool(np.isfinite(self.p).all() and np.isfinite(self.G).all())

    @property
    def axis(self) -> Array:
        """Direction (3,) of the axis, or of sliding."""
        axis = self.G[:, 2 if self.turns else 0]
        return axis / math.sqrt(axis @ axis)

    def joint(self, a: float = 0.0) -> JointModel:
        """The joint, with its configuration 0 where this motion has a."""
        R = np.eye(3) if self.R is None else self.R
        p, point, R = self.at(a, R)
        return self.made.trusted(posed(R, p), self.axis, point, self.h, self.R is not None)

    def at(self, a: float, R: Array) -> tuple[Array, Array, Array]:
        """Start and point on the axis [m], and the start's rotation, at configuration a; R: at 0."""
        return self.p, np.zeros(3), R

    def gradients(self) -> dict[str, Array]:
        """How axis (3, size), start (3, size), and where it has them point (3, size) and pitch (1, size), change."""
        k = self.frame_turns
        turn = np.zeros((3, self.size))
        turn[:, :k] = self.G[:, 3 - k :]
        across = self.across
        shift = np.zeros((3, self.size))
        shift[:, k : k + across.shape[1]] = self.G @ across
        return {"axis": -so3.hat(self.axis) @ turn, "start": shift, **self.own_gradients(turn, shift)}

    def own_gradients(self, turn: Array, shift: Array) -> dict[str, Array]:
        """Gradients of point and pitch by the parameters; none by default."""
        return {}

    def covariance(self, parameters: Array) -> dict[str, Array]:
        """Covariances of axis, start, point (or centre) and pitch, from that of the parameters (size, size)."""
        named = {name: g @ parameters @ g.T for name, g in self.gradients().items()}
        if "point" in named:
            named["centre"] = named["point"]
        return named


def robust(guesses: Iterable[Motion], track: Track, motion: type[AxisMotion]) -> list[Motion]:
    """The best two of these guesses, or the fallback."""
    return or_fallback(best_of(guesses, track, KEEP), track, motion)


def or_fallback(guesses: Iterable[Motion], track: Track, motion: type[AxisMotion]) -> list[Motion]:
    """These, or where there are none something to begin with, for no sample differs from another."""
    if found := list(guesses):
        return found
    G = frame(np.linalg.svd(track.positions - track.positions.mean(axis=0))[2][0])
    R = None if track.rotations is None else middle_rotation(track.rotations)
    return [motion(track.positions[0], G, R, 0.4, motion.first_rise)]


@cache
def _prior_curvature(frame_turns: int, size: int, widths: Sequence[float]) -> Array:
    curvature = np.zeros(size)
    if frame_turns:
        # Directions are all alike, so they have no gradient, but their space is bounded: this is the curvature at which
        # Laplace's method gives a whole sphere for the path and a whole circle for the axis around it.
        k = frame_turns
        curvature[k - 2 : k], curvature[: k - 2] = 0.5, 0.5 / np.pi
    curvature[size - len(widths) :] = [1.0 / std**2 for std in widths]
    curvature.flags.writeable = False
    return curvature
