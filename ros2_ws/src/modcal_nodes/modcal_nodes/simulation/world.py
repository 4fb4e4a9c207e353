"""An arm in MuJoCo whose bodies are not where its drawing puts them.

The truth of a test must not come from the model under test: here it comes from another engine. Every body is displaced
and turned by a random amount in all six directions, which is not how modcal writes errors (four directions at a joint).
"""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain


class World:
    """A MuJoCo arm with its tool, seen from a tracker.

    T_tracker_base, T_tip_tool: true poses [m]. The true arm is private; :meth:`tool_in_tracker` is all a tracker shows.
    """

    def __init__(
        self,
        nominal: Chain,
        rng: np.random.Generator,
        length_std: float = 5e-4,
        angle_std: float = 1e-3,
        T_tracker_base: Array | None = None,
        T_tip_tool: Array | None = None,
    ) -> None:
        """Displace every body of the nominal arm by these standard deviations per axis [m, rad]."""
        scale = np.array([length_std] * 3 + [angle_std] * 3)
        self.nominal = nominal
        self.T_tracker_base = np.eye(4) if T_tracker_base is None else T_tracker_base
        tool = np.eye(4) if T_tip_tool is None else T_tip_tool
        origins = nominal.origins @ se3.exp(scale * rng.standard_normal((nominal.n + 1, 6)))
        self.model = mujoco.MjModel.from_xml_string(mjcf(nominal, origins, tool))
        self.data = mujoco.MjData(self.model)
        self._site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, "tool")

    def tool_in_tracker(self, q: ArrayLike) -> Array:
        """True poses (..., 4, 4) of the tool in the tracker at joint positions q (..., n) [rad, m]."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        T = np.tile(np.eye(4), (len(flat), 1, 1))
        for i, posture in enumerate(flat):
            self.data.qpos[:] = posture
            mujoco.mj_kinematics(self.model, self.data)
            T[i, :3, :3] = self.data.site_xmat[self._site].reshape(3, 3)
            T[i, :3, 3] = self.data.site_xpos[self._site]
        return (self.T_tracker_base @ T).reshape((*q.shape[:-1], 4, 4))


def mjcf(chain: Chain, origins: Array, T_tip_tool: Array) -> str:
    """MJCF text of a chain with these constants: one body a joint, a site at the tool."""
    opening = [
        '<mujoco model="arm"><compiler angle="radian" autolimits="true"/>'
        '<option timestep="0.001"><flag contact="disable"/></option><worldbody>'
    ]
    for k, name in enumerate(chain.names):
        kind = "hinge" if chain.revolute[k] else "slide"
        axis = " ".join(f"{x:.17g}" for x in chain.axes[k])
        opening.append(
            f"<body name={quoteattr('body_' + name)} {_placed(origins[k])}>"
            f"<joint name={quoteattr(name)} type={quoteattr(kind)} axis={quoteattr(axis)}/>"
            '<geom type="sphere" size="0.03" mass="2"/>'
        )
    site = f'<site name="tool" {_placed(origins[-1] @ T_tip_tool)}/>'
    return "".join(opening) + site + "</body>" * chain.n + "</worldbody></mujoco>"


def _placed(T: Array) -> str:
    x, y, z, w = so3.to_quaternion(T[:3, :3])
    pos = " ".join(f"{v:.17g}" for v in T[:3, 3])
    quat = " ".join(f"{v:.17g}" for v in (w, x, y, z))
    return f"pos={quoteattr(pos)} quat={quoteattr(quat)}"
