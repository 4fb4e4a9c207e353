"""MJCF text of a chain: the true arm as MuJoCo simulates it."""

from __future__ import annotations

from html import escape

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.robots import STANDARD_GRAVITY, Chain, Inertias

PAYLOAD = "payload"
NO_MASS = 1e-9  # kg and kg m²; MuJoCo moves no body without either


def quoted(value: str) -> str:
    """An attribute's value in XML. xml.sax.saxutils does the same and imports urllib, http and ssl for it."""
    return f'"{escape(value)}"'


def body_name(joint: str) -> str:
    """The MuJoCo body that moves with a joint."""
    return f"body_{joint}"


def mjcf(chain: Chain, origins: Array, T_tip_tool: Array, inertias: Inertias | None = None) -> str:
    """MJCF text of a chain with these constants: one body a joint, a payload at the tip, a site at the tool.

    Gravity is along −z of the base. inertias: masses of the bodies; a ball of 2 kg at every joint where none are known.
    """
    opening = [
        '<mujoco model="arm"><compiler angle="radian" autolimits="true" balanceinertia="true"/>'
        f'<option timestep="0.001" gravity="0 0 {-STANDARD_GRAVITY}"><flag contact="disable"/></option><worldbody>'
    ]
    for k, name in enumerate(chain.names):
        kind = "hinge" if chain.revolute[k] else "slide"
        opening.append(
            f"<body name={quoted(body_name(name))} {placed(origins[k])}>"
            f"<joint name={quoted(name)} type={quoted(kind)} axis={quoted(text(chain.axes[k]))}/>"
            + ('<geom type="sphere" size="0.03" mass="2"/>' if inertias is None else inertial(inertias, k))
        )
    mass = f'<inertial pos="0 0 0" mass="{NO_MASS}" diaginertia="{NO_MASS} {NO_MASS} {NO_MASS}"/>'
    payload = f"<body name={quoted(PAYLOAD)} {placed(origins[-1])}>{mass}</body>"
    site = f'<site name="tool" {placed(origins[-1] @ T_tip_tool)}/>'
    return "".join(opening) + payload + site + "</body>" * chain.n + "</worldbody></mujoco>"


def inertial(inertias: Inertias, k: int) -> str:
    """MJCF of what joint k carries by itself."""
    tensor = inertias.inertia[k] + NO_MASS * np.eye(3)
    full = text(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    mass = max(float(inertias.mass[k]), NO_MASS)
    return f'<inertial pos="{text(inertias.com[k])}" mass="{mass:.17g}" fullinertia="{full}"/>'


def placed(T: Array) -> str:
    """MJCF attributes that put a body or a site at T (4, 4) [m]."""
    x, y, z, w = so3.to_quaternion(T[:3, :3])
    return f'pos="{text(T[:3, 3])}" quat="{text(np.array([w, x, y, z]))}"'


def text(values: Array) -> str:
    """Numbers as MJCF writes them, no digit lost."""
    return " ".join(f"{v:.17g}" for v in values)
