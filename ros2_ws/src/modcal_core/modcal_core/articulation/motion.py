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

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.articulation.joints import JointModel, Kind, wrapped
from modcal_core.articulation.track import Track
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

RADIUS = (2e-3, 200.0)  # m; beyond, a circle cannot be told from a turn on the spot, or from a line
PITCH = (1e-5, 2.0)  # m/rad


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
    def tangent(self) -> Array:
        """∂(e, φ)/∂a (3,) or (6,), in G's axes, with its sign turned, where the motion fits."""
        if self.kind == "rigid":
            return np.zeros(3 if self.R is None else 6)
        t = np.array([self.r, 0.0, self.h, 0.0, 0.0, 1.0] if self.turns else [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        return t[: 3 if self.R is None else 6]

    @property
    def across(self) -> Array:
        """Directions (3, k) in G's axes in which the start may shift: two across the path; all three when rigid."""
        if self.kind == "rigid":
            return np.eye(3)
        length = np.hypot(self.r, self.h) if self.turns else 1.0
        rise, run = (self.h / length, self.r / length) if self.turns else (0.0, 1.0)
        return np.array([[0.0, -rise], [1.0, 0.0], [0.0, run]])

    def moved(self, z: Array) -> Motion:
        """The motion with its parameters changed by z (size,), radius and pitch kept within what can be told."""
        k = {"rigid": 0, "prismatic": 2}.get(self.kind, 3)
        delta = np.concatenate([np.zeros(3 - k), z[:k]])
        across = self.across
        shift = across @ z[k : k + across.shape[1]]
        z = z[k + across.shape[1] :]
        G, R = self.G @ so3.exp(delta), self.R
        if R is not None:
            R = so3.exp(self.G @ z[:3]) @ R
            z = z[3:]
        r, h = self.r, self.h
        if self.turns:
            r = float(np.clip(r * np.exp(np.clip(z[0], -1.0, 1.0)), *RADIUS))
        if self.kind == "screw":
            h = float(np.sign(h) * np.clip(abs(h) * np.exp(np.clip(z[1], -1.0, 1.0)), *PITCH))
        return replace(self, p=self.p + self.G @ shift, G=G, R=R, r=r, h=h)

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
        turned = a
        if self.R is not None and track.rotations is not None and sigma[1] < 1e6:
            Q = self.G.T @ track.rotations @ (self.R.T @ self.G)
            turned = np.arctan2(Q[:, 1, 0] - Q[:, 0, 1], Q[:, 0, 0] + Q[:, 1, 1])  # nearest turn about the axis
            u = 1.0 / sigma[1] ** 2
            a = wrapped(turned + wrapped(a - turned) * w / (w + u))
        if self.kind == "screw":
            a = self._along_thread(np.unwrap(a), x, turned, w, u, sigma[0])
        return a

    def _along_thread(self, a0: Array, x: Array, turned: Array, w: Array, u: float, sigma: float) -> Array:
        # Which turn of the thread: the same for all samples, as they were unwrapped one after the other.
        a = a0 - 2.0 * np.pi * np.round(np.median(a0 - x[:, 2] / self.h) / (2.0 * np.pi)) if _many(a0) else a0
        angle, v = a, (self.h / sigma) ** 2
        for _ in range(3):
            slope = (w + u) * np.sin(a - angle) - self.h * (x[:, 2] - self.h * a) / sigma**2
            a = a - slope / ((w + u) * np.maximum(np.cos(a - angle), 0.2) + v)
        return a

    def residuals(self, track: Track, a: Array) -> Array:
        """Residuals (n, 3) [m], or (n, 6) [m, rad] with rotations, in G's axes, at configurations a (n,)."""
        return self.linearise(track, a, derivatives=False)[0]

    def linearise(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array, Array]:
        """Residuals (n, m), their derivatives by a (n, m) and by the parameters (n, m, size); m is 3 or 6."""
        n, turned = len(a), self.R is not None and track.rotations is not None
        m = 6 if turned else 3
        y = (track.positions - self.p) @ self.G
        e, by_a = np.empty((n, m)), np.zeros((n, m))
        C = _rotations_z(-a) if self.turns else None
        x = y
        if C is not None:
            x = y - np.array([0.0, self.r, 0.0])
            e[:, :3] = (C @ x[:, :, None])[:, :, 0]
            by_a[:, 0], by_a[:, 1], by_a[:, 2] = e[:, 1], -e[:, 0], -self.h
            e[:, 1] += self.r
            e[:, 2] -= self.h * a
        else:
            e[:, :3] = y
            if self.kind == "prismatic":
                e[:, 0] -= a
                by_a[:, 0] = -1.0
        Q = E = J_phi = None
        if turned:
            assert self.R is not None
            assert track.rotations is not None
            Q = self.G.T @ track.rotations @ (self.R.T @ self.G)
            E = Q if C is None else C @ Q
            e[:, 3:] = _log(E)
            J_phi = so3.left_jacobian_inverse(-e[:, 3:]) if derivatives else None
            if self.turns and J_phi is not None:
                by_a[:, 3:] = -(J_phi @ E[:, 2, :, None])[:, :, 0]
        if not derivatives:
            return e, by_a, np.empty((n, m, 0))
        J = np.zeros((n, m, self.size))
        k = {"rigid": 0, "prismatic": 2}.get(self.kind, 3)
        turn = so3.hat(y)[:, :, 3 - k :]  # y × δ
        J[:, :3, :k] = turn if C is None else C @ turn
        across = self.across
        j = k + across.shape[1]
        J[:, :3, k:j] = -across if C is None else -(C @ across)
        if turned:
            assert Q is not None
            assert J_phi is not None
            J[:, 3:, :k] = (J_phi @ (np.eye(3) - np.swapaxes(Q, -1, -2)))[:, :, 3 - k :]
            J[:, 3:, j : j + 3] = -J_phi
        if self.R is not None:
            j += 3
        if C is not None:
            J[:, :3, j] = -self.r * C[:, :, 1]
            J[:, 1, j] += self.r
            if self.kind == "screw":
                J[:, 2, j + 1] = -self.h * a
        return e, by_a, J

    def model(self, a: float = 0.0) -> JointModel:
        """The joint, with its configuration 0 where this motion has a."""
        R, p, axis, point = np.eye(3) if self.R is None else self.R, self.p, self.axis, np.zeros(3)
        if self.kind == "prismatic":
            p = p + a * axis
        if self.turns:
            point = self.p + self.r * self.G[:, 1]
            turn = so3.exp(a * axis)
            rise = self.h * a * axis
            p = point + turn @ (p - point) + rise
            point = point + rise  # stays nearest to the start
            R = turn @ R if self.R is not None else R
        return JointModel(self.kind, se3.transform(R, p), axis, point, self.h, self.R is not None)

    @property
    def axis(self) -> Array:
        """Direction (3,) of the axis, or of sliding."""
        axis = self.G[:, 2 if self.turns else 0]
        return axis / np.linalg.norm(axis)

    def gradients(self) -> dict[str, Array]:
        """How axis (3, size), point (3, size) and pitch (1, size) change with the parameters."""
        k = {"rigid": 0, "prismatic": 2}.get(self.kind, 3)
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


def _log(R: Array) -> Array:
    """Rotation vectors (n, 3) of rotations (n, 3, 3): by the sine where no angle is large, which is quicker."""
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    if not (cosine > -0.8).all():
        return so3.log(R)
    sine = np.sqrt((v * v).sum(axis=1))
    return v * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[:, None]


def _rotations_z(a: Array) -> Array:
    C = np.zeros((len(a), 3, 3))
    C[:, 0, 0] = C[:, 1, 1] = np.cos(a)
    C[:, 1, 0] = np.sin(a)
    C[:, 0, 1] = -C[:, 1, 0]
    C[:, 2, 2] = 1.0
    return C
