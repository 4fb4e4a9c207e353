"""An arm in MuJoCo whose bodies are not where its drawing puts them, and that deflects where its joints are elastic.

The truth of a test must not come from the model under test: here it comes from another engine. Every body is displaced
and turned by a random amount in all six directions, which is not how modcal writes errors (four directions at a joint).
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3
from modcal_core.robots import Chain, Inertias
from modcal_nodes.simulation.machine import Machine
from modcal_nodes.simulation.mjcf import body_name, mjcf

SHORTEST_LINK = 1e-3  # m; a shorter one has no direction to grow in


class World(Machine):
    """A serial arm. T_tracker_base, T_tip_tool: true poses [m]."""

    def __init__(
        self,
        nominal: Chain,
        rng: np.random.Generator,
        length_std: float = 5e-4,
        angle_std: float = 1e-3,
        T_tracker_base: Array | None = None,
        T_tip_tool: Array | None = None,
        inertias: Inertias | None = None,
        compliance: ArrayLike = 0.0,
    ) -> None:
        """Displace every body of the nominal arm by these standard deviations per axis [m, rad].

        inertias: of the bodies; where none are known, each is a ball of 2 kg. compliance: one number, or one a joint.
        """
        scale = np.array([length_std] * 3 + [angle_std] * 3)
        self.nominal = nominal
        tool = np.eye(4) if T_tip_tool is None else T_tip_tool
        origins = nominal.origins @ se3.exp(scale * rng.standard_normal((nominal.n + 1, 6)))
        known = inertias if inertias is not None and inertias.known else None
        super().__init__(nominal.names, mjcf(nominal, origins, tool, known), T_tracker_base, compliance)
        self._bodies = {
            link: self.model.body(body_name(j)).id for link, j in zip(nominal.links, nominal.names, strict=False)
        }
        self._at_rest = self.model.body_pos.copy()
        self._force = np.empty(nominal.n)

    def length(self, link: str) -> float:
        """How long a link is, from its joint to the next one [m]. Raises BadRobot for one that cannot grow."""
        if link not in self._bodies:
            raise BadRobot(f"link '{link}'", "does not belong to a joint", f"name one of {', '.join(self._bodies)}")
        length = float(np.linalg.norm(self._at_rest[self._bodies[link]]))
        if length < SHORTEST_LINK:
            raise BadRobot(f"link '{link}'", "has no length that can grow", "name a longer link")
        return length

    def grow(self, link: str, metres: float) -> None:
        """Make a link this much longer than it was at first [m], along the line from its joint to the next."""
        rest = self._at_rest[self._bodies[link]]
        self.model.body_pos[self._bodies[link]] = rest * (1.0 + metres / self.length(link))

    def _place(self, q: Array) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def _held(self, q: Array) -> Array:
        """What MuJoCo's inverse dynamics asks for at rest; the array is used again by the next call."""
        self._place(q)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        mujoco.mj_rne(self.model, self.data, 0, self._force)
        return self._force
