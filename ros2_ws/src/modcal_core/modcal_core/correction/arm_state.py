"""Everything beside the posture that an effect may depend on, at one moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.effects.drivers import NominalArm
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.approach import TRAVEL
from modcal_core.measurements.recording import POSE, SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism, gravity_wrench


@dataclass(frozen=True)
class ArmState:
    """One moment of an arm.

    stamp: [s]. q: where the joints were reported (n,), which efforts belong to. velocity: (n,) [rad/s, m/s]. approach:
    direction each joint last moved in, −1, 0 (unknown) or 1, (n,). effort: (n,) [N m, N], NaN where unknown. signals:
    what was received of everything else, up to now.
    """

    stamp: float
    q: Array
    velocity: Array
    approach: Array
    effort: Array
    signals: tuple[SignalTrack, ...] = ()

    @classmethod
    def at_rest(
        cls, q: ArrayLike, stamp: float, approach: ArrayLike | None = None, signals: tuple[SignalTrack, ...] = ()
    ) -> ArmState:
        """An arm that stands still at q (n,), with nothing known of its efforts."""
        q = np.array(q, dtype=float)
        came = np.zeros(len(q)) if approach is None else np.array(approach, dtype=float)
        return cls(stamp, q, np.zeros(len(q)), came, np.full(len(q), np.nan), signals)

    def arriving(self, q: Array) -> ArmState:
        """The moment of arrival at q (n,), straight from here: at rest, each joint from the side it comes from."""
        way = q - self.q
        approach = np.where(np.abs(way) > TRAVEL, np.sign(way), self.approach)
        return ArmState(self.stamp, self.q, np.zeros_like(self.velocity), approach, self.effort, self.signals)

    def samples(self, chain: Mechanism, postures: Array, arm: NominalArm) -> Samples:
        """Samples of postures (N, n) under these conditions, for a model to predict.

        What the actuators would have to exert there is what they exert now, but for the difference in weight.
        """
        N = len(postures)

        def same(row: Array) -> Array:
            return np.broadcast_to(row, postures.shape)

        effort = same(self.effort)
        if arm.inertias is not None and arm.weighed and np.isfinite(self.effort).any():
            both = gravity_wrench(arm.chain, arm.inertias, np.concatenate([self.q[None], postures]))
            weight = np.where(chain.revolute[:, None], both[:, 5], both[:, 2]).T
            effort = effort - (weight[1:] - weight[:1])
        return Samples(
            names=chain.names,
            frames=("",),
            q=postures,
            stamps=np.full(N, self.stamp),
            station=np.zeros(N, int),
            frame=np.zeros(N, int),
            kind=np.array([POSE] * N),
            reading=np.zeros((N, 3)),
            R=np.broadcast_to(np.eye(3), (N, 3, 3)),
            sigma_position=np.full(N, np.nan),
            sigma_rotation=np.full(N, np.nan),
            velocity=same(self.velocity),
            moving=np.zeros(N, bool),
            acceleration=np.zeros_like(postures),
            approach=same(self.approach),
            effort=effort,
            signals=self.signals,
        )
