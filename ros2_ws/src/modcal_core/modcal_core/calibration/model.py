"""The model that is fitted: a chain, the frames it is watched from, and the tool that is watched."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward


@dataclass(frozen=True)
class Model:
    """Predicts ``T_frame_tool = T_frame_base · FK(q) · T_tip_tool``.

    chain: the arm. frames: names of the frames readings come in. T_frame_base: pose of the robot's base in each,
    (F, 4, 4) [m]. T_tip_tool: pose of what the instruments see, in the tip, (4, 4) [m].
    """

    chain: Chain
    frames: tuple[str, ...]
    T_frame_base: Array
    T_tip_tool: Array

    def predict(self, q: ArrayLike, frame: np.ndarray | int = 0) -> Array:
        """Poses of the tool in the frames with the given indices, (N, 4, 4), for joint positions q (N, n)."""
        return self.T_frame_base[frame] @ forward(self.chain, q) @ self.T_tip_tool

    def with_chain(self, chain: Chain) -> Model:
        """The same cell with another arm model."""
        return replace(self, chain=chain)


def place_model(chain: Chain, frames: tuple[str, ...]) -> Model:
    """A model with base and tool where nothing is known of them yet: at the frames' and the tip's origins."""
    return Model(chain, frames, np.tile(np.eye(4), (len(frames), 1, 1)), np.eye(4))
