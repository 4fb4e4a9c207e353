"""An arm in three dimensions, for pages that are not about errors: a plan, a study, limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.robots.delta import ARMS
from modcal_core.robots.mechanism import Mechanism, is_delta, tool_frames

MAX_POSTURES, MAX_POINTS = 60, 500  # that a page can show and a person look through


@dataclass(frozen=True)
class RobotScene:
    """All in the arm's base [m]. arms: polylines (k, 3), one a posture. said: a sentence for each posture. points: of
    the target (N, 3), at the postures ``shown`` (indices). route: whether they are connected in order. cloud: others
    (M, 3). marks: named places. weights: for each joint how large it is drawn, 0 … 1; empty: alike. base: its link.
    alt: for those who do not see it.
    """

    arms: tuple[Array, ...]
    said: tuple[str, ...]
    points: Array
    shown: np.ndarray
    base: str
    alt: str
    route: bool = False
    cloud: Array | None = None
    marks: tuple[tuple[str, Array], ...] = ()
    weights: tuple[float, ...] = ()

    def to_data(self) -> dict[str, Any]:
        """What the page's script draws."""
        cloud = np.empty((0, 3)) if self.cloud is None else self.cloud
        return {
            "points": np.round(self.points, 4).tolist(),
            "stages": [],
            "arms": [[np.round(path, 3).tolist()] for path in self.arms],
            "shown": self.shown.tolist(),
            "said": list(self.said),
            "route": self.route,
            "cloud": np.round(cloud, 3).tolist(),
            "marks": [{"name": name, "at": np.round(at, 3).tolist()} for name, at in self.marks],
            "weights": [round(weight, 4) for weight in self.weights],
            "base": self.base,
        }


def arm_paths(chain: Mechanism, q: Array, T_tip_tool: Array | None = None) -> Array:
    """Polylines from base over every joint to the tool at postures q (N, n), (N, n + 2, 3) [m], in the base."""
    frames = tool_frames(chain, np.eye(4) if T_tip_tool is None else T_tip_tool, q, {})
    p = np.moveaxis(frames.p, -1, 0)  # (N, places, 3)
    if is_delta(chain):  # one line over all three arms
        shoulders = [p[:, i] for i in range(1, 1 + ARMS)]
        elbows = [s + frames.loops[i].lever.T for i, s in enumerate(shoulders, 1)]
        tip = p[:, -2] if chain.has_shaft else p[:, -1]
        around = [
            p[:, 0],
            shoulders[0],
            elbows[0],
            tip,
            elbows[1],
            shoulders[1],
            shoulders[2],
            elbows[2],
            tip,
            p[:, -1],
        ]
        return np.stack(around, axis=1)
    T = chain.T_base_root
    return np.concatenate([np.zeros((len(q), 1, 3)), p @ T[:3, :3].T + T[:3, 3]], axis=1)


def joints_in_words(chain: Mechanism, q: Array) -> str:
    """A posture (n,) in degrees, and millimetres of sliding joints."""
    turning = chain.revolute
    values = (f"{np.degrees(x):.1f}°" if turns else f"{1e3 * x:.1f} mm" for x, turns in zip(q, turning, strict=True))
    return ", ".join(f"{name} {value}" for name, value in zip(chain.names, values, strict=True))
