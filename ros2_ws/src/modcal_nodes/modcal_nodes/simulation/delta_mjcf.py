"""MJCF text of a Delta as it is built: six rods with ball joints at both ends, a free platform, a shaft in it.

Nothing here knows that a parallelogram keeps the platform upright, or that two rods can be taken for one: MuJoCo finds
that from the constraints. Bodies are drawn at a reference posture, roughly put together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.delta import ARMS, AZIMUTH, DISTAL, OFFSET, PROXIMAL, Delta
from modcal_core.robots.gravity import STANDARD_GRAVITY
from modcal_nodes.simulation.mjcf import NO_MASS, PAYLOAD, placed, text

PLATFORM_RADIUS = 0.05  # m; it may be anything, for only the difference of the radii shows
ROD_SPACING = 0.04  # m, from the middle of an elbow to a rod
PLATFORM_KG = 2.0
PLATFORM, SHAFT = "platform", "shaft"


def arm_joint(i: int) -> str:
    """MuJoCo's name of the joint of arm i."""
    return f"arm_{i}"


def delta_mjcf(true: Delta, T_tip_tool: Array, at: float, unequal: ArrayLike = 0.0) -> str:
    """MJCF text of a Delta with these constants, drawn with all three arms at an angle ``at`` [rad].

    unequal: by how much the right rod of each arm is longer than the left one [m]; the constants have their mean.
    Gravity is along −z of the base; the arms and rods weigh nothing, the platform ``PLATFORM_KG``.
    """
    L1, L2 = true.constants[PROXIMAL], true.constants[DISTAL]
    elbow = float(np.mean(true.constants[OFFSET] + L1 * np.cos(at)))
    height = -float(np.mean(L1)) * np.sin(at) - float(np.sqrt(np.mean(L2) ** 2 - elbow**2))
    inertia = f'<inertial pos="0 0 0" mass="{NO_MASS}" diaginertia="{NO_MASS} {NO_MASS} {NO_MASS}"/>'
    longer = np.broadcast_to(np.asarray(unequal, dtype=float), ARMS)
    bodies, anchors, links = [], [], []
    for i in range(ARMS):
        turn = so3.exp([0.0, 0.0, true.constants[AZIMUTH, i]])
        shoulder = se3.transform(turn, turn @ [PLATFORM_RADIUS + true.constants[OFFSET, i], 0.0, 0.0])
        rods = []
        for side in (-1, 1):
            name = f"rod_{i}_{'left' if side < 0 else 'right'}"
            # nominal, each arm turned by ``at`` about its y: the rod leads from the elbow towards the platform
            here = np.array([L1[i], side * ROD_SPACING, 0.0])
            drawn = so3.exp([0.0, at, 0.0])
            towards = np.array([-true.constants[OFFSET, i], side * ROD_SPACING, height])
            way = drawn.T @ (towards - drawn @ here)
            rods.append(
                f'<body name="{name}" {placed(se3.transform(_along(way), here))}><joint type="ball"/>{inertia}'
                f'<site name="{name}_end" pos="{L2[i] + 0.5 * side * longer[i]:.17g} 0 0"/></body>'
            )
            point = turn @ [PLATFORM_RADIUS, side * ROD_SPACING, 0.0]
            anchors.append(f'<site name="{name}_anchor" pos="{text(point)}"/>')
            links.append(f'<connect site1="{name}_end" site2="{name}_anchor"/>')
        bodies.append(
            f'<body {placed(shoulder)}><joint name="{arm_joint(i)}" type="hinge" axis="0 1 0"/>{inertia}'
            + "".join(rods)
            + "</body>"
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
    """A rotation (3, 3) whose first column points along a way (3,)."""
    x = way / np.linalg.norm(way)
    z = np.cross(x, [0.0, 1.0, 0.0])
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)
