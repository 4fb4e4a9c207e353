"""The model that is fitted: a chain, the frames it is watched from, the tool that is watched, and its effects.

The geometry beside curves is not the best without them. Whether the geometry that is best alone does better where no
curve was seen is read from the calibration's own recording, the outermost postures of which are left out of a fit of
either (:mod:`modcal_core.calibration.final_fit`); and wherever outside the full model hardly knows itself, geometry
alone speaks too (:mod:`modcal_core.calibration.covariance`). It comes in over a twentieth of a radian, so that no
command jumps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modcal_core.calibration.instruments import Instrument
from modcal_core.effects import Drivers, Effect, NominalArm, claimed, drivers_at, motion
from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples
from modcal_core.robots import Chain, Inertias, Mechanism, forward, is_serial_arm, tool_frames

# --- Outside the joint ranges that were seen another model speaks

BLEND = 0.05  # rad or m beyond what was seen, over which the other model comes in


class Doubting(Protocol):
    """Says how much a model should be doubted."""

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much geometry alone should count instead at these samples, in [0, 1], (N,).

        drivers: of the samples, where they are known already.
        """
        ...


@dataclass(frozen=True)
class Fallback:
    """The model outside, with the same frames, and where that is.

    low, high: ends of the joint ranges that were seen, (n,). curved: joints that curves depend on, (n,). doubt: how
    much the full model should be doubted there; None: altogether.
    """

    model: Model
    low: Array
    high: Array
    curved: np.ndarray
    doubt: Doubting | None = None

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much of it counts at samples, in [0, 1], (N,): none inside, from BLEND beyond as much as is doubted.

        drivers: of the samples, where they are known already.
        """
        beyond = np.maximum(np.maximum(self.low - samples.q, samples.q - self.high), 0.0)[:, self.curved]
        u = np.clip(beyond.max(axis=1, initial=0.0) / BLEND, 0.0, 1.0)
        out = np.asarray(u * u * (3.0 - 2.0 * u))
        rows = np.flatnonzero(out > 0.0)
        if self.doubt is not None and len(rows):
            everywhere = len(rows) == len(out)
            some = (samples, drivers) if everywhere else (samples.select(rows), None)
            out[rows] *= self.doubt.share(*some)
        return out

    def blended(self, T: Array, samples: Samples) -> Array:
        """Poses (N, 4, 4) of the full model, replaced by this one in proportion to how far outside the samples are."""
        share = self.share(samples)
        rows = np.flatnonzero(share > 0.0)
        if not len(rows):
            return T
        return between(T, rows, share[rows], self.model.predict_samples(samples.select(rows)))


def between(T: Array, rows: np.ndarray, share: Array, other: Array) -> Array:
    """Poses T (N, 4, 4), those of these rows moved by a share (m,) towards others (m, 4, 4)."""
    out = np.array(T)
    out[rows] = T[rows] @ se3.exp(share[:, None] * se3.log(se3.inverse(T[rows]) @ other))
    return out


def curved_joints(effects: tuple[Effect, ...], names: tuple[str, ...]) -> np.ndarray:
    """Which joints curves depend on, (n,); not the small ones that no report names, which end by themselves."""
    named = [e for e in effects if claimed(e)]
    of = {part.partition(":")[2] for e in named for part in e.driver.split(",") if part.startswith("position:")}
    return np.array([name in of for name in names])


IntArray = NDArray[np.int_]


@dataclass(frozen=True)
class Model:
    """Predicts ``T_frame_tool = T_frame_base · FK(q) · T_tip_tool``, with the effects' small motions put in.

    chain: the robot, serial or a Delta. frames: names of the frames readings come in. T_frame_base: pose of the robot's
    base in each, (F, 4, 4) [m]. T_tip_tool: pose of what the instruments see, in the tip, (4, 4) [m]. effects: what
    geometry cannot say. arm: the nominal arm that loads are computed from; None where there are no effects.
    instruments: those whose readings are no positions. leaders: for each frame the one whose errors it shares, by
    index, where some are known relative to others; empty where each stands for itself. fallback: what counts outside
    the ranges that a frozen model has seen; None while it is fitted.
    """

    chain: Mechanism
    frames: tuple[str, ...]
    T_frame_base: Array
    T_tip_tool: Array
    effects: tuple[Effect, ...] = ()
    arm: NominalArm | None = None
    instruments: tuple[Instrument, ...] = ()
    leaders: tuple[int, ...] = ()
    fallback: Fallback | None = None

    def leader(self, frame: int) -> int:
        """The frame whose errors this one shares."""
        return self.leaders[frame] if self.leaders else frame

    def frames_led_by(self, frame: int) -> tuple[int, ...]:
        """The frames that share this one's errors, itself among them."""
        return tuple(f for f in range(len(self.frames)) if self.leader(f) == frame)

    def predict(self, q: ArrayLike, frame: IntArray | int = 0) -> Array:
        """Poses of the tool by geometry alone, (N, 4, 4), in the frames with these indices, for postures q (N, n)."""
        return self.T_frame_base[frame] @ forward(self.chain, q) @ self.T_tip_tool

    def predict_samples(self, samples: Samples) -> Array:
        """Poses of the tool, (N, 4, 4), as the readings of these samples should show them, effects included."""
        if not self.effects:
            return self.predict(samples.q, samples.frame)
        twists, scale = motion(self.effects, self.drivers(samples))
        T_root_tool = tool_frames(self.chain, self.T_tip_tool, samples.q, twists).transform(-1)
        T = (self.T_frame_base @ self.chain.T_base_root)[samples.frame] @ T_root_tool
        T[:, :3, 3] *= scale[:, None]
        return T if self.fallback is None else self.fallback.blended(T, samples)

    def drivers(self, samples: Samples) -> Drivers:
        """The drivers at these samples."""
        return drivers_at(samples, self.arm or NominalArm(self.chain))

    @property
    def serial(self) -> Chain:
        """The arm where it is a serial chain; raises BadRobot for what works on such only."""
        if is_serial_arm(self.chain):
            return self.chain
        names = ", ".join(self.chain.names)
        raise BadRobot(f"robot with joints {names}", "is a Delta", "give a serial arm: this works on no other")

    def with_chain(self, chain: Mechanism) -> Model:
        """The same cell with another arm model."""
        return replace(self, chain=chain)

    def with_effects(self, effects: tuple[Effect, ...]) -> Model:
        """The same geometry with other effects."""
        return replace(self, effects=effects)


def place_model(chain: Mechanism, frames: tuple[str, ...], inertias: Inertias | None = None) -> Model:
    """A model with base and tool where nothing is known of them yet: at the frames' and the tip's origins."""
    eye = np.eye(4)
    return Model(chain, frames, np.tile(eye, (len(frames), 1, 1)), eye, arm=NominalArm(chain, inertias))
