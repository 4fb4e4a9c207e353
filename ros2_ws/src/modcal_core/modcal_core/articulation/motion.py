"""A joint while it is being fitted: minimal parameters, residuals of what was seen, and their exact derivatives.

A motion carries a frame G at the handle's start p: column 0 points along the handle's path (for a screw, along the part
of it that goes round), column 1 from the handle to the axis, column 2 along the axis, which stands at p + r G[:, 1].
A prismatic motion goes along column 0. What was seen at configuration a is *unwound* to configuration 0 and compared
with the start, in the axes of G:

    e = Rz(−a) x + (0, r, −h a),  x = Gᵀ(p_seen − p) − (0, r, 0)        (shift; the tangent ∂e/∂a is −(r, 0, h))
    φ = log(Rz(−a) Gᵀ R_seen R_startᵀ G)                                  (turn)

There, play and bias of handle and tracker look alike wherever on the path they occur, and the direction along which the
latent configuration a absorbs them is the same for all samples.

Parameters are small changes: G exp(δ), p + G β with β across the path only (along it, the configurations absorb it),
R_start turned by γ in G's axes, log r, and log |h|. So prismatic has 4 (7 with rotations), revolute 6 (9), screw 7
(10).
As log r grows without end, a revolute motion becomes the prismatic one with the same G.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from modcal_core.articulation.joints import JointModel, Kind, wrapped
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.single import posed, turned
from modcal_core.geometry.so3 import HAT, Array
from modcal_core.robots.posture import rotation_vector

RADIUS = (2e-3, 200.0)  # m; beyond, a circle cannot be told from a turn on the spot, or from a line
PITCH = (1e-5, 2.0)  # m/rad
_EYE = np.eye(3)
_SINE_AND_TRACE = np.concatenate([0.5 * HAT, _EYE.reshape(1, 9)]).T


@dataclass(frozen=True)
class Motion:
    """kind; p: start (3,) [m]; G: its frame (3, 3); R: start's rotation or None; r: radius [m]; h: pitch [m/rad]."""

    kind: Kind
    p: Array
    G: Array
    R: Array | None = None
    r: float = 1.0
    h: float = 0.0

    @property
    def turns(self) -> bool:
        """Whether configurations are angles."""
        return self.kind in ("revolute", "screw")

    @property
    def size(self) -> int:
        """How many parameters it has."""
        return {"rigid": 3, "prismatic": 4, "revolute": 6, "screw": 7}[self.kind] + 3 * (self.R is not None)

    @property
    def start_turn(self) -> int:
        """Which parameter is the first of the three by which the start is turned; with rotations only."""
        return {"rigid": 3, "prismatic": 4}.get(self.kind, 5)

    @property
    def length_per_unit(self) -> float:
        """Path of the handle [m] per unit of configuration."""
        return math.hypot(self.r, self.h) if self.turns else float(self.kind == "prismatic")

    @property
    def across(self) -> Array:
        """Directions (3, k) in G's axes in which the start may shift: two across the path; all three when rigid."""
        if self.kind == "rigid":
            return np.eye(3)
        rise, run = self._climb
        return np.array([[0.0, -rise], [1.0, 0.0], [0.0, run]])

    @property
    def _climb(self) -> tuple[float, float]:
        """Sine and cosine of the angle between the path and the circle that it goes round."""
        length = self.length_per_unit
        return (self.h / length, self.r / length) if self.turns else (0.0, 1.0)

    def moved(self, z: Array) -> Motion:
        """The motion with its parameters changed by z (size,), radius and pitch kept within what can be told."""
        k = _turns(self.kind)
        across = self.across
        j = k + across.shape[1]
        delta = np.zeros(3)
        delta[3 - k :] = z[:k]
        G, R = self.G @ turned(delta), self.R
        if R is not None:
            R = turned(self.G @ z[j : j + 3]) @ R
        j += 3 * (R is not None)
        r, h = self.r, self.h
        if self.turns:
            r = _scaled(r, z[j], RADIUS)
        if self.kind == "screw":
            h = math.copysign(_scaled(abs(h), z[j + 1], PITCH), h)
        return Motion(self.kind, self.p + self.G @ (across @ z[k : k + across.shape[1]]), G, R, r, h)

    def configurations(self, track: Track, sigma: tuple[float, float] = (1.0, 1.0)) -> Array:
        """Latent configurations (n,) that are most likely where noise is sigma, (m, rad)."""
        y = (track.positions - self.p) @ self.G
        if self.kind == "rigid":
            return np.zeros(len(y))
        if self.kind == "prismatic":
            return y[:, 0]
        x = y - np.array([0.0, self.r, 0.0])
        a = np.arctan2(x[:, 0], -x[:, 1])
        w = (np.hypot(x[:, 0], x[:, 1]) * self.r + 1e-12) / sigma[0] ** 2  # curvatures of both parts of the cost
        u = 0.0
        about = a
        if self.R is not None and track.rotations is not None and sigma[1] < 1e6:
            Q = self._against_start(track)
            about = np.arctan2(Q[:, 1, 0] - Q[:, 0, 1], Q[:, 0, 0] + Q[:, 1, 1])  # nearest turn about the axis
            u = 1.0 / sigma[1] ** 2
            a = wrapped(about + wrapped(a - about) * w / (w + u))
        if self.kind == "screw":
            far = len(a) > 1 and float(np.abs(a[1:] - a[:-1]).max()) > np.pi
            a = self._along_thread(np.unwrap(a) if far else a, x, w, u, sigma[0])
        return a

    def _along_thread(self, a0: Array, x: Array, w: Array, u: float, sigma: float) -> Array:
        # Which turn of the thread: the same for all samples, as they were unwrapped one after the other.
        a = a0 - 2.0 * np.pi * np.round(np.median(a0 - x[:, 2] / self.h) / (2.0 * np.pi)) if _many(a0) else a0
        angle, v = a, (self.h / sigma) ** 2
        for _ in range(3):
            slope = (w + u) * np.sin(a - angle) - self.h * (x[:, 2] - self.h * a) / sigma**2
            a = a - slope / ((w + u) * np.maximum(np.cos(a - angle), 0.2) + v)
        return a

    def placed(self, p: Array, R: Array | None, sigma: tuple[float, float]) -> tuple[float, Array]:
        """Configuration and residual (3,) or (6,) of one pose: as ``configurations`` and ``residuals`` of many.

        In plain numbers, as arrays of one take longer to begin than this to finish.
        """
        x, y, z = (self.G.T @ (p - self.p)).tolist()
        Q = self.G.T @ R @ (self.R.T @ self.G) if R is not None and self.R is not None else None
        a = x if self.kind == "prismatic" else 0.0
        if self.turns:
            y -= self.r
            a, u = math.atan2(x, -y), 0.0
            w = (math.hypot(x, y) * self.r + 1e-12) / sigma[0] ** 2
            if Q is not None and sigma[1] < 1e6:
                u = 1.0 / sigma[1] ** 2
                about = math.atan2(Q[1, 0] - Q[0, 1], Q[0, 0] + Q[1, 1])
                a = _wrapped(about + _wrapped(a - about) * w / (w + u))
            angle = a
            for _ in range(3 if self.kind == "screw" else 0):
                slope = (w + u) * math.sin(a - angle) - self.h * (z - self.h * a) / sigma[0] ** 2
                a -= slope / ((w + u) * max(math.cos(a - angle), 0.2) + (self.h / sigma[0]) ** 2)
            c, s = math.cos(a), math.sin(a)
            shift = [c * x + s * y, c * y - s * x + self.r, z - self.h * a]
        else:
            shift = [x - a, y, z]
        if Q is None:
            return a, np.array(shift)
        if self.turns:
            Q = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ Q
        return a, np.array([*shift, *rotation_vector(Q)])

    def residuals(self, track: Track, a: Array) -> Array:
        """Residuals (n, 3) [m], or (n, 6) [m, rad] with rotations, in G's axes, at configurations a (n,)."""
        return self.linearise(track, a, derivatives=False)[0]

    def linearise(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array, Array]:
        """Residuals (n, m), their derivatives by a (n, m) and by the parameters (n, m, size); m is 3 or 6."""
        both, by_a = self.expanded(track, a, derivatives)
        return both[:, :, 0], by_a, both[:, :, 1:]

    def expanded(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array]:
        """Residuals and, beside them, their derivatives by the parameters (n, m, 1 + size); derivatives by a (n, m)."""
        oriented = self.R is not None and track.rotations is not None
        n, m, width = len(a), 6 if oriented else 3, 1 + self.size * derivatives
        both, by_a = np.zeros((n, m, width)), np.zeros((n, m))
        y = (track.positions - self.p) @ self.G
        # as it was seen: the position; how it shifts with a turn of the frame, the start, and the radius
        part = (y @ _linear(self.kind)).reshape(n, 3, -1) if derivatives else y[:, :, None]
        if derivatives:
            part[:, :, 1 + _turns(self.kind) :] = self._shifts
        C = None
        if self.turns:
            part[:, 1, 0] -= self.r
            C = _unwinding(a)
            part = C @ part
            by_a[:, 0], by_a[:, 1], by_a[:, 2] = part[:, 1, 0], -part[:, 0, 0], -self.h
            part[:, 1, 0] += self.r
            part[:, 2, 0] -= self.h * a
            if derivatives:
                part[:, 1, -1] += self.r
        elif self.kind == "prismatic":
            part[:, 0, 0] -= a
            by_a[:, 0] = -1.0
        if self.turns and derivatives:  # a turn of the start stands before the radius
            radius = -1 if self.kind == "revolute" else -2
            both[:, :3, :6], both[:, :3, radius] = part[:, :, :6], part[:, :, 6]
            if self.kind == "screw":
                both[:, 2, -1] = -self.h * a
        else:
            both[:, :3, : part.shape[2]] = part
        if oriented:
            self._turned(track, C, both, by_a, derivatives)
        return both, by_a

    @property
    def _shifts(self) -> Array:
        """What no position changes (3, 2 or 3): how residuals shift with the start and log r, before unwinding."""
        if not self.turns:
            return -self.across
        rise, run = self._climb
        return np.array([[0.0, rise, 0.0], [-1.0, 0.0, -self.r], [0.0, -run, 0.0]])

    def _turned(self, track: Track, C: Array | None, both: Array, by_a: Array, derivatives: bool) -> None:
        """Write what rotations leave, and how it changes with a and with the parameters."""
        Q = self._against_start(track)
        if not derivatives:
            both[:, 3:, 0] = quick_log(Q if C is None else C @ Q)[0]
            return
        both[:, 3:, 0], J_phi = _log_and_jacobian(Q if C is None else C @ Q)
        if C is not None:
            by_a[:, 3:] = -J_phi[:, 2]  # J(−φ) Eᵀ = J(φ) = J(−φ)ᵀ
        k, j = _turns(self.kind), 1 + self.start_turn
        both[:, 3:, 1 : 1 + k] = (J_phi - J_phi @ Q.transpose(0, 2, 1))[:, :, 3 - k :]
        both[:, 3:, j : j + 3] = -J_phi

    def _against_start(self, track: Track) -> Array:
        """Gᵀ R_seen R_startᵀ G (n, 3, 3)."""
        assert self.R is not None
        assert track.rotations is not None
        return self.G.T @ track.rotations @ (self.R.T @ self.G)

    def model(self, a: float = 0.0) -> JointModel:
        """The joint, with its configuration 0 where this motion has a."""
        R, p, axis, point = np.eye(3) if self.R is None else self.R, self.p, self.axis, np.zeros(3)
        if self.kind == "prismatic":
            p = p + a * axis
        if self.turns:
            point = self.p + self.r * self.G[:, 1]
            turn = turned(a * axis)
            rise = self.h * a * axis
            p = point + turn @ (p - point) + rise
            point = point + rise  # stays nearest to the start
            R = turn @ R if self.R is not None else R
        return JointModel.trusted(self.kind, posed(R, p), axis, point, self.h, self.R is not None)

    @property
    def axis(self) -> Array:
        """Direction (3,) of the axis, or of sliding."""
        axis = self.G[:, 2 if self.turns else 0]
        return axis / math.sqrt(axis @ axis)

    def gradients(self) -> dict[str, Array]:
        """How axis (3, size), point (3, size) and pitch (1, size) change with the parameters."""
        k = _turns(self.kind)
        turn = np.zeros((3, self.size))
        turn[:, :k] = self.G[:, 3 - k :]
        across = self.across
        shift = np.zeros((3, self.size))
        shift[:, k : k + across.shape[1]] = self.G @ across
        out = {"axis": -so3.hat(self.axis) @ turn, "start": shift}
        if self.turns:
            arm = self.r * self.G[:, 1]
            j = k + across.shape[1] + 3 * (self.R is not None)
            point = shift - so3.hat(arm) @ turn
            point[:, j] += arm
            out["point"] = point
            if self.kind == "screw":
                out["pitch"] = np.zeros((1, self.size))
                out["pitch"][0, j + 1] = self.h
        return out


def _many(a: Array) -> bool:
    """Whether a thread was followed for more than a turn."""
    return bool(np.ptp(a) > 2.0 * np.pi)


def quick_log(R: Array) -> tuple[Array, Array, Array]:
    """Rotation vectors (n, 3) of rotations (n, 3, 3); sines and cosines (n,) of their angles.

    By the sine where no angle is large, which is quicker than by quaternions.
    """
    found = R.reshape(-1, 9) @ _SINE_AND_TRACE
    v, cosine = found[:, :3], 0.5 * (found[:, 3] - 1.0)
    sine = np.sqrt((v * v).sum(axis=1))
    if cosine.min() < -0.8:
        return so3.log(R), sine, cosine
    return v * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[:, None], sine, cosine


def _log_and_jacobian(R: Array) -> tuple[Array, Array]:
    """Rotation vectors φ (n, 3) of rotations (n, 3, 3), and so3.left_jacobian_inverse(−φ) (n, 3, 3).

    I + ½ [φ] + k [φ]² with k = (1 − ½ θ cot ½θ) / θ², and cot ½θ = (1 + cos θ) / sin θ is at hand.
    """
    phi, sine, cosine = quick_log(R)
    square = (phi * phi).sum(axis=1)
    if sine.min() < 1e-3:  # the quotient would lose digits
        return phi, so3.left_jacobian_inverse(-phi)
    k = (1.0 - 0.5 * np.sqrt(square) * (1.0 + cosine) / sine) / square
    W = (phi @ HAT).reshape(-1, 3, 3)
    return phi, 0.5 * W + k[:, None, None] * (W @ W) + _EYE


def _unwinding(a: Array) -> Array:
    """Rz(−a) (n, 3, 3)."""
    C = np.zeros((len(a), 3, 3))
    C[:, 0, 0] = C[:, 1, 1] = np.cos(a)
    C[:, 0, 1] = np.sin(a)
    C[:, 1, 0] = -C[:, 0, 1]
    C[:, 2, 2] = 1.0
    return C


def _wrapped(angle: float) -> float:
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


def _turns(kind: Kind) -> int:
    """How many turns of its frame change a motion."""
    return {"rigid": 0, "prismatic": 2}.get(kind, 3)


@cache
def _linear(kind: Kind) -> Array:
    """What makes, of positions y (n, 3) in G's axes, matrices [y, y × δ, and room for what is constant], flat."""
    k = _turns(kind)
    out = np.zeros((3, 3, 1 + k + 3))
    out[:, :, 0] = _EYE
    out[:, :, 1 : 1 + k] = so3.hat(_EYE)[:, :, 3 - k :]
    if kind == "prismatic":
        out = out[:, :, :-1]
    return np.ascontiguousarray(out.reshape(3, -1))


def _scaled(size: float, by: float, limits: tuple[float, float]) -> float:
    """A size times exp(by), by a factor of e at most, and within limits."""
    return min(max(size * math.exp(min(max(float(by), -1.0), 1.0)), limits[0]), limits[1])
