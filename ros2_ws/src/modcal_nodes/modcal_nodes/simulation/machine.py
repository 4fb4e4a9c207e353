"""What any simulated robot is to the cell around it: a tool that a tracker sees, a tracker, a payload, soft joints.

An arm in MuJoCo whose bodies are not where its drawing puts them, and that deflects where its joints are elastic.

The truth of a test must not come from the model under test: here it comes from another engine. Every body is displaced
and turned by a random amount in all six directions, which is not how modcal writes errors (four directions at a joint).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import Chain, Inertias
from modcal_nodes.simulation.mjcf import NO_MASS, PAYLOAD, body_name, mjcf

_SETTLED = 1e-12  # rad or m, the last step of a spring that has found its balance
_MAX_STEPS = 60


def tracker_and_tool(rng: np.random.Generator) -> tuple[Array, Array]:
    """(T_tracker_base, T_tip_tool), (4, 4): a tracker a few metres away, a tool a hand's length from the tip."""
    T_tracker_base = se3.transform(so3.exp(rng.normal(size=3)), rng.uniform(-3.0, 3.0, 3))
    return T_tracker_base, se3.transform(so3.exp(0.5 * rng.normal(size=3)), [0.06, -0.04, 0.15])


class Machine(ABC):
    """A MuJoCo robot with its tool, seen from a tracker.

    T_tracker_base: true pose [m]. compliance: of each joint [rad/(N m), or m/N where it slides], (n,). The true robot
    is private; :meth:`tool_in_tracker` is all a tracker shows.
    """

    def __init__(self, names: tuple[str, ...], xml: str, T_tracker_base: Array | None, compliance: ArrayLike) -> None:
        """names: of the joints. xml: MJCF text with a site "tool" and a body for the payload."""
        self.T_tracker_base = np.eye(4) if T_tracker_base is None else T_tracker_base
        self._T_tracker_base = self.T_tracker_base  # where the tracker stood at first
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self._names = names
        self._site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, "tool")
        self._payload = self.model.body(PAYLOAD).id
        self._bump = np.eye(4)
        self.compliance = np.broadcast_to(np.asarray(compliance, dtype=float), (len(names),)).copy()
        self._elastic = bool(self.compliance.any())

    def tool_in_tracker(self, q: ArrayLike) -> Array:
        """True poses (..., 4, 4) of the tool in the tracker at joint positions q (..., n) [rad, m]."""
        return self.T_tracker_base @ self.tool_in_base(q)

    def tool_in_base(self, q: ArrayLike) -> Array:
        """True poses (..., 4, 4) of the tool in the base link, the joints at q (..., n) before springs deflect."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        T = np.zeros((len(flat), 4, 4))
        T[:, 3, 3] = 1.0
        for i, posture in enumerate(flat):
            self._place(self._settled(posture) if self._elastic else posture)
            T[i, :3, :3] = self.data.site_xmat[self._site].reshape(3, 3)
            T[i, :3, 3] = self.data.site_xpos[self._site]
        return (T @ self._bump).reshape((*q.shape[:-1], 4, 4))

    def settle(self, q: ArrayLike) -> Array:
        """Where the joints come to rest (..., n) when they are sent to q (..., n): gravity and springs in balance.

        Raises BadRobot when the joints are too soft to hold the arm.
        """
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        return np.array([self._settled(posture) for posture in flat]).reshape(q.shape)

    def holding(self, q: ArrayLike) -> Array:
        """Torques (..., n) that hold the arm up when it is sent to q (..., n) [N m; N where a joint slides]."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        return np.array([self._held(self._settled(posture)).copy() for posture in flat]).reshape(q.shape)

    def carry(self, mass: float) -> None:
        """Hang a mass [kg] at the tip, a point at its origin."""
        here = self.data.qpos.copy()
        self.model.body_mass[self._payload] = mass + NO_MASS
        mujoco.mj_setConst(self.model, self.data)  # leaves every joint at zero, where closed chains are open
        self.data.qpos[:] = here

    def bump(self, move: ArrayLike, turn: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Displace the tool by move (3,) [m] and the rotation vector turn (3,) [rad], along the axes that it had.

        Always from where the tool was at first, so that zeros put it back.
        """
        self._bump = se3.transform(so3.exp(np.asarray(turn, dtype=float)), np.asarray(move, dtype=float))

    def move_tracker(self, move: ArrayLike) -> None:
        """Displace the tracker along its own axes (3,) [m] from where it stood at first."""
        back = se3.transform(np.eye(3), -np.asarray(move, dtype=float))
        self.T_tracker_base = back @ self._T_tracker_base

    @abstractmethod
    def length(self, link: str) -> float:
        """How long a link is, from its joint to the next one [m]. Raises BadRobot for one that cannot grow."""

    @abstractmethod
    def grow(self, link: str, metres: float) -> None:
        """Make a link this much longer than it was at first [m], along the line from its joint to the next."""

    @abstractmethod
    def _place(self, q: Array) -> None:
        """Bring MuJoCo's robot to a posture (n,)."""

    @abstractmethod
    def _held(self, q: Array) -> Array:
        """What holds it there at rest, (n,); the array may be used again by the next call."""

    def _settled(self, q: Array) -> Array:
        """A spring's torque equals gravity's at the posture that is reached, not at the one that was meant."""
        if not self._elastic:
            return q
        reached = q
        for _ in range(_MAX_STEPS):
            moved = q - self.compliance * self._held(reached)
            step = np.abs(moved - reached).max()
            reached = moved
            if step < _SETTLED:
                return reached
        softest = self._names[int(np.argmax(self.compliance))]
        raise BadRobot(f"joint {softest}", "is too soft to hold the arm", "lower joint_compliance or the payload")


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
