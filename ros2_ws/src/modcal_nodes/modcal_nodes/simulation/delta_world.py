"""A Delta in MuJoCo whose constants are not those of its drawing. MuJoCo closes the chains, not modcal.

The posture is found from MuJoCo's own constraints and their Jacobian by Newton steps, on the way from the last one in
steps short enough that the platform stays on the same side of the arms.

Nothing here knows that a parallelogram keeps the platform upright, or that two rods can be taken for one: MuJoCo finds
that from the constraints. Bodies are drawn at a reference posture, roughly put together.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot, NotReachable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import (
    ARMS,
    AZIMUTH,
    DISTAL,
    LEAN,
    OFFSET,
    PROXIMAL,
    RATIO,
    STANDARD_GRAVITY,
    ZERO,
    Delta,
    reachable,
)
from modcal_nodes.simulation.mjcf import NO_MASS, PAYLOAD, Machine, placed, text, tracker_and_tool

PLATFORM_RADIUS = 0.05  # m; it may be anything, for only the difference of the radii shows
ROD_SPACING = 0.04  # m, from the middle of an elbow to a rod
PLATFORM_KG = 2.0
PLATFORM, SHAFT = "platform", "shaft"


def arm_joint(i: int) -> str:
    """MuJoCo's name of the joint of arm i."""
    return f"arm_{i}"


def delta_mjcf(true: Delta, T_tip_tool: Array, at: float, unequal: ArrayLike = 0.0) -> str:
    """MJCF text of a Delta with these constants, drawn with arms at an angle, or carriages at a height, ``at``.

    unequal: by how much the right rod of each arm is longer than the left one [m]; the constants have their mean.
    Gravity is along −z of the base; the arms and rods weigh nothing, the platform ``PLATFORM_KG``.
    """
    constants, L2 = true.constants, true.constants[DISTAL]
    arm = np.array([[0.0, 0.0, at]] * ARMS) if true.linear else np.array([[L1, 0.0, 0.0] for L1 in constants[PROXIMAL]])
    drawn = so3.exp(np.outer(constants[LEAN] if true.linear else np.full(ARMS, at), [0.0, 1.0, 0.0]))
    ends = np.einsum("aij,aj->ai", drawn, arm) + np.outer(
        constants[OFFSET], [1.0, 0.0, 0.0]
    )  # of the rods, each arm along x
    elbow, high = ends.mean(axis=0)[[0, 2]]
    height = float(high) - float(np.sqrt(np.mean(L2) ** 2 - elbow**2))
    inertia = f'<inertial pos="0 0 0" mass="{NO_MASS}" diaginertia="{NO_MASS} {NO_MASS} {NO_MASS}"/>'
    longer = np.broadcast_to(np.asarray(unequal, dtype=float), ARMS)
    joint = 'type="slide" axis="0 0 1"' if true.linear else 'type="hinge" axis="0 1 0"'
    bodies, anchors, links = [], [], []
    for i in range(ARMS):
        turn = so3.exp([0.0, 0.0, true.constants[AZIMUTH, i]])
        stand = turn @ drawn[i] if true.linear else turn
        shoulder = se3.transform(stand, turn @ [PLATFORM_RADIUS + true.constants[OFFSET, i], 0.0, 0.0])
        rods = []
        for side in (-1, 1):
            name = f"rod_{i}_{'left' if side < 0 else 'right'}"
            # the rod leads towards the platform from an arm turned by ``at`` about its y, or from a tower as it leans
            here = np.array([0.0 if true.linear else arm[i, 0], side * ROD_SPACING, 0.0])
            way = drawn[i].T @ ([0.0, 0.0, height] - ends[i])
            rods.append(
                f'<body name="{name}" {placed(se3.transform(_along(way), here))}><joint type="ball"/>{inertia}'
                f'<site name="{name}_end" pos="{L2[i] + 0.5 * side * longer[i]:.17g} 0 0"/></body>'
            )
            point = turn @ [PLATFORM_RADIUS, side * ROD_SPACING, 0.0]
            anchors.append(f'<site name="{name}_anchor" pos="{text(point)}"/>')
            links.append(f'<connect site1="{name}_end" site2="{name}_anchor"/>')
        bodies.append(
            f'<body {placed(shoulder)}><joint name="{arm_joint(i)}" {joint}/>{inertia}' + "".join(rods) + "</body>"
        )
    shaft = (
        f'<body name="{SHAFT}"><joint name="{SHAFT}" type="hinge" axis="0 0 1"/>{inertia}'
        f'<site name="tool" {placed(T_tip_tool)}/></body>'
    )
    platform = (
        f'<body name="{PLATFORM}" pos="0 0 {height:.17g}"><freejoint name="{PLATFORM}"/>'
        f'<inertial pos="0 0 0" mass="{PLATFORM_KG}" diaginertia="0.01 0.01 0.01"/>'
        + "".join(anchors)
        + shaft
        + f'<body name="{PAYLOAD}">{inertia}</body></body>'
    )
    opening = (
        '<mujoco model="delta"><compiler angle="radian" autolimits="true"/>'
        f'<option jacobian="dense" gravity="0 0 {-STANDARD_GRAVITY}"><flag contact="disable"/></option><worldbody>'
    )
    return opening + "".join(bodies) + platform + "</worldbody><equality>" + "".join(links) + "</equality></mujoco>"


def _along(way: Array) -> Array:
    x = way / np.linalg.norm(way)
    z = np.cross(x, [0.0, 1.0, 0.0])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


_LONGEST = 0.4  # rad, or carriages at a tenth of it in m, of a step towards another posture
_SHORTEST = 1e-3  # of that, below which a platform that does not follow is stuck
_CLOSED = 1e-12  # m, the largest gap of a closed chain
_MAX_STEPS = 30
_RIDGE = 1e-12  # m², against a platform that is loose


class DeltaWorld(Machine):
    """A Delta with these true constants. T_tracker_base, T_tip_tool: true poses [m]."""

    def __init__(
        self,
        true: Delta,
        T_tracker_base: Array | None = None,
        T_tip_tool: Array | None = None,
        compliance: ArrayLike = 0.0,
        unequal: ArrayLike = 0.0,
    ) -> None:
        """compliance: of the arms and the shaft, one number or one a joint [rad/(N m)].

        unequal: by how much the two rods of each arm differ [m].
        """
        first = float(np.clip(0.3, true.lower[:ARMS].max(), true.upper[:ARMS].min()))
        tool = true.T_tip_tool if T_tip_tool is None else T_tip_tool
        super().__init__(true.names, delta_mjcf(true, tool, first, unequal), T_tracker_base, compliance)
        self._true, self._longest = true, 0.1 * _LONGEST if true.linear else _LONGEST
        joints = [self.model.joint(arm_joint(i)) for i in range(ARMS)] + [self.model.joint(SHAFT)]
        self._at = np.array([j.qposadr[0] for j in joints])
        driven = np.array([j.dofadr[0] for j in joints])
        self._driven = driven[:ARMS]
        self._free = np.setdiff1d(np.arange(self.model.nv), driven)
        self._lift = self.model.joint(PLATFORM).dofadr[0] + 2
        at = self.model.joint(PLATFORM).qposadr[0]
        self._platform = slice(at, at + 3)
        half = 0.5 * true.constants[DISTAL]
        self._farthest = float(
            (half if true.linear else true.constants[PROXIMAL]).mean()
        )  # that the platform goes in one step on its own side
        self.data.qpos[self._at[:ARMS]] = first
        self._close()

    def _place(self, q: Array) -> None:
        true = self._true
        theta = np.zeros(ARMS + 1)
        theta[:ARMS] = true.constants[RATIO] * q[:ARMS] + true.constants[ZERO]
        if true.has_shaft:
            theta[ARMS] = true.shaft_ratio * q[ARMS]
        kept = self.data.qpos.copy()
        here = kept[self._at]
        steps = max(int(np.ceil(np.abs(theta - here)[:ARMS].max() / self._longest)), 1)
        done, step = 0.0, 1.0 / steps
        while done < 1.0:
            before = self.data.qpos.copy()
            share = min(done + step, 1.0)
            self.data.qpos[self._at] = here + share * (theta - here)
            gap = self._close()
            moved = np.linalg.norm(self.data.qpos[self._platform] - before[self._platform])
            if gap < _CLOSED and moved < self._farthest:
                done = share
                continue
            self.data.qpos[:] = before
            step *= 0.5
            if step * steps < _SHORTEST:
                self.data.qpos[:] = kept
                said = f"its rods miss the platform by at least {1e3 * gap:.3g} mm"
                raise NotReachable("posture of the simulated Delta", said, "send it where its platform fits")

    def _close(self) -> float:
        """Move rods and platform, the arms held, until every rod meets the platform; the gap that is left [m]."""
        model, data = self.model, self.data
        step = np.zeros(model.nv)
        for _ in range(_MAX_STEPS):
            mujoco.mj_fwdPosition(model, data)
            gap = data.efc_pos
            if np.abs(gap).max() < _CLOSED:
                break
            J = data.efc_J.reshape(-1, model.nv)[:, self._free]
            # the shortest step: rods may spin about themselves as they like
            step[self._free] = -J.T @ np.linalg.solve(J @ J.T + _RIDGE * np.eye(len(J)), gap)
            mujoco.mj_integratePos(model, data.qpos, step, 1.0)
        return float(np.abs(gap).max())

    def _held(self, q: Array) -> Array:
        """By virtual work: what the arms' motions lift, found from MuJoCo's constraints."""
        self._place(q)
        J = self.data.efc_J.reshape(-1, self.model.nv)
        moved = np.linalg.lstsq(J[:, self._free], -J[:, self._driven], rcond=1e-10)[0]
        lifted = moved[int(np.searchsorted(self._free, self._lift))]
        mass = self.model.body(PLATFORM).mass[0] + self.model.body(PAYLOAD).mass[0]
        weight = -float(mass) * float(self.model.opt.gravity[2])
        out = np.zeros(len(self._names))
        out[:ARMS] = weight * lifted * self._true.constants[RATIO]
        return out


def make_delta_world(
    nominal: Delta, rng: np.random.Generator, length_std: float, angle_std: float, compliance: ArrayLike = 0.0
) -> DeltaWorld:
    """The true cell of a seed: every constant off by these standard deviations, tracker and tool somewhere."""
    T_tracker_base, T_tip_tool = tracker_and_tool(rng)
    return DeltaWorld(displaced(nominal, rng, length_std, angle_std), T_tracker_base, T_tip_tool, compliance)


def require_drivable(delta: Delta) -> None:
    """Raises BadRobot for a Delta that cannot begin with its joints at zero, or as near to it as limits allow."""
    if not reachable(delta, np.clip(np.zeros((1, delta.n)), delta.lower, delta.upper))[0]:
        name = f"delta {', '.join(delta.names)}"
        raise BadRobot(name, "has no valid posture with its joints at zero", "correct its constants or limits")


def displaced(nominal: Delta, rng: np.random.Generator, length_std: float, angle_std: float) -> Delta:
    """A Delta as it may have been built: every constant off by these standard deviations [m; rad, and for ratios 1]."""
    scale = np.array([length_std if unit == "m" else angle_std for unit in nominal.units.values()])
    return nominal.moved(scale[:, None] * rng.standard_normal((len(scale), ARMS)))
