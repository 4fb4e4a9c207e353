"""The model that is fitted: a chain, the frames it is watched from, the tool that is watched, and its effects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modcal_core.calibration.fallback import Fallback
from modcal_core.calibration.instruments import Instrument
from modcal_core.effects.drivers import Drivers, NominalArm, drivers_at
from modcal_core.effects.effect import Effect, motion
from modcal_core.errors import BadRobot
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism, forward, is_serial_arm, tool_frames
from modcal_core.robots.urdf_inertias import Inertias

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
