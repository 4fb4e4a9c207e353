"""A handle that turns about an axis and rises along it: the lid of a jar, a rising hinge, a spiral slide."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from modcal_core.articulation import furniture
from modcal_core.articulation.joint_motion import KEEP, ROUGH, InUrdf, Kind, Motion, best_of, few, scaled
from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.models.axis import AxisModel, or_fallback
from modcal_core.articulation.models.revolute import Revolute, RevoluteJoint, RevoluteMotion, best_circles
from modcal_core.articulation.scene import LOG_2PI
from modcal_core.articulation.track import Track
from modcal_core.geometry import Array

PITCH = (1e-5, 2.0)  # m/rad
_CIRCLES = 6  # that are tried as threads
_SLOPES = (-0.4, -0.15, -0.04, 0.04, 0.15, 0.4)  # rad, of a thread against its circle


@dataclass(frozen=True)
class ScrewJoint(RevoluteJoint):
    """ξ = (point × axis + pitch axis, axis)."""

    kind: ClassVar[str] = "screw"
    rises: ClassVar[bool] = True

    def on_thread(self, a: Array, x: Array, rise0: float, r: float, weight: float) -> Array:
        """Configurations nearest to points beside the helix: the right turn of it, then Newton's method."""
        if self.pitch == 0.0:
            return a
        angle, rise = a, x @ self.axis - rise0
        turns = np.round((rise / self.pitch - angle) / (2.0 * np.pi))
        # Another turn only where it lies much nearer: half a thread is otherwise what play and noise may do.
        far = np.abs(rise - self.pitch * angle) > 1.5 * np.pi * abs(self.pitch)
        angle = angle + 2.0 * np.pi * np.where(far, turns, 0.0)
        out = np.hypot(np.linalg.norm(x - (x @ self.axis)[..., None] * self.axis, axis=-1), 1e-9)
        stiff = r * out + weight / (1.0 - weight + 1e-12) * r * r + 1e-12
        a = angle.copy()
        for _ in range(6):  # minimise stiff (1 − cos(a − angle)) + (rise − pitch a)² / 2
            gradient = stiff * np.sin(a - angle) - self.pitch * (rise - self.pitch * a)
            a = a - gradient / (stiff * np.maximum(np.cos(a - angle), 0.2) + self.pitch**2)
        return a

    def sentence(self, a: Array, extent: float, std: Mapping[str, float]) -> str:
        """Sentence of a revolute joint, and the rise of a turn [mm]."""
        return f"{super().sentence(a, extent, std)}, rising {2e3 * np.pi * self.pitch:.0f} mm a turn"


@dataclass(frozen=True)
class ScrewMotion(RevoluteMotion):
    """It rises by h a radian."""

    kind: ClassVar[str] = "screw"
    flat: ClassVar[bool] = False
    made: ClassVar[type[JointModel]] = ScrewJoint
    sizes: ClassVar[int] = 2
    radius_at: ClassVar[int] = -2
    first_rise: ClassVar[float] = 0.01

    def resized(self, z: Array) -> tuple[float, float]:
        """Radius and pitch changed by their logarithms' steps; the pitch keeps its sign."""
        return super().resized(z)[0], math.copysign(scaled(abs(self.h), z[1], PITCH), self.h)

    def along_thread(self, a: Array, x: Array, w: Array, u: float, sigma: float) -> Array:
        """Configurations (n,) nearest on the thread, for whom the angles are followed from sample to sample."""
        far = len(a) > 1 and float(np.abs(a[1:] - a[:-1]).max()) > np.pi
        a0 = np.unwrap(a) if far else a
        # Which turn of the thread: the same for all samples, as they were unwrapped one after the other.
        a = (
            a0 - 2.0 * np.pi * np.round(np.median(a0 - x[:, 2] / self.h) / (2.0 * np.pi))
            if np.ptp(a0) > 2.0 * np.pi
            else a0
        )
        angle, v = a, (self.h / sigma) ** 2
        for _ in range(3):
            slope = (w + u) * np.sin(a - angle) - self.h * (x[:, 2] - self.h * a) / sigma**2
            a = a - slope / ((w + u) * np.maximum(np.cos(a - angle), 0.2) + v)
        return a

    def unwind(self, part: Array, a: Array, both: Array, by_a: Array, derivatives: bool) -> Array:
        """Write what positions leave; Rz(−a) (n, 3, 3)."""
        C = super().unwind(part, a, both, by_a, derivatives)
        if derivatives:
            both[:, 2, -1] = -self.h * a
        return C

    def apart(self, both: Array, by_a: Array) -> Array:
        """Across the helix (k, 2, 1 + size)."""
        super().apart(both, by_a)
        return self.across.T @ both[:, :3]

    def priors(self) -> list[tuple[float, tuple[float, float]]]:
        """Logarithms of radius and pitch with their priors."""
        return [*super().priors(), (math.log(abs(self.h)), furniture.PITCH)]

    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in the coordinates of the motion."""
        return super().log_prior() + (-math.log(furniture.PITCH[1]) - 0.5 * LOG_2PI - math.log(2.0))

    def own_gradients(self, turn: Array, shift: Array) -> dict[str, Array]:
        """Gradients of the point on the axis (3, size) and of the pitch (1, size)."""
        pitch = np.zeros((1, self.size))
        pitch[0, -1] = self.h
        return {**super().own_gradients(turn, shift), "pitch": pitch}


class Screw(AxisModel):
    """Rare: 2 in 100 of what moves."""

    name = "screw"
    share = 0.02
    slots = (1,)
    urdf = InUrdf("revolute", 8.0 * np.pi, rises=True)
    joint = ScrewJoint

    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """Threads along the best circles."""
        some = few(track)
        threads = (thread for circle in best_circles(some, rng, _CIRCLES) for thread in _threads(circle, some))
        return or_fallback(best_of(threads, some, KEEP + 1), some, ScrewMotion)

    def quick_guess(self, track: Track, known: Mapping[Kind, Motion], turn: int) -> Motion | None:
        """A thread along the circle that is known, with a rise whose sign and size change with turn."""
        circle = known.get(Revolute.name)
        return _thread(circle, _SLOPES[turn % len(_SLOPES)]) if isinstance(circle, RevoluteMotion) else None


def _thread(circle: RevoluteMotion, slope: float) -> ScrewMotion:
    """The helix that touches a circle at this slope, and bends as it does."""
    t, n, b = circle.G.T
    s, c = np.sin(slope), np.cos(slope)
    r = circle.r * c * c
    return ScrewMotion(circle.p, np.stack([c * t - s * b, n, s * t + c * b], axis=1), circle.R, r, _pitch(r * s / c))


def _threads(circle: RevoluteMotion, track: Track) -> Iterator[ScrewMotion]:
    """Helices that touch a circle and bend as it does, for a few slopes; and the circle with the rise that is seen."""
    yield from (_thread(circle, slope) for slope in _SLOPES)
    a = circle.configurations(track, ROUGH)
    rise = ((track.positions - circle.p) @ circle.G)[:, 2]
    i = np.arange(len(a))
    j = (i + len(a) // 2) % len(a)
    apart = np.abs(a[i] - a[j]) > 1e-3
    if apart.any():
        h = float(np.median((rise[i] - rise[j])[apart] / (a[i] - a[j])[apart]))
        yield ScrewMotion(circle.p, circle.G, circle.R, circle.r, _pitch(h))


def _pitch(h: float) -> float:
    return float(np.copysign(np.clip(abs(h), *PITCH), h))


MODEL = Screw()
