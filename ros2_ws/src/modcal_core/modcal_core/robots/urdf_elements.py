"""Pieces of a URDF that is made from nothing: joints, origins, numbers; and a bare chain as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain


def chain_urdf(chain: Chain, name: str = "arm") -> str:
    """The URDF text of a chain: links without bodies, moving joints, and a fixed one to the tip.

    Reading it gives the same kinematics, names and limits; torques and speeds are not known and stand as 0.
    """
    robot = ET.Element("robot", name=name)
    taken = {chain.base, chain.tip}
    above = chain.base
    ET.SubElement(robot, "link", name=above)
    for k, joint in enumerate(chain.names):
        link = f"{joint}_link"
        while link in taken:
            link += "_"
        taken.add(link)
        limited = bool(np.isfinite([chain.lower[k], chain.upper[k]]).all())
        kind = "prismatic" if not chain.revolute[k] else "revolute" if limited else "continuous"
        element = joint_element(robot, joint, kind, above, link, chain.origins[k])
        ET.SubElement(element, "axis", xyz=" ".join(map(number, chain.axes[k])))
        limits: Mapping[str, float] = {"lower": chain.lower[k], "upper": chain.upper[k]} if limited else {}
        # a reader must find both numbers; 0 says that nobody knows
        ET.SubElement(
            element, "limit", {key: number(v) for key, v in {**limits, "effort": 0.0, "velocity": 0.0}.items()}
        )
        ET.SubElement(robot, "link", name=link)
        above = link
    joint_element(robot, f"to_{chain.tip}", "fixed", above, chain.tip, chain.origins[-1])
    ET.SubElement(robot, "link", name=chain.tip)
    return urdf_text(robot)


def joint_element(robot: ET.Element, name: str, kind: str, parent: str, child: str, T: Array) -> ET.Element:
    """A joint of this kind between two links, added to the robot."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    origin_element(joint, T)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def origin_element(element: ET.Element, T: Array) -> None:
    """An origin at T (4, 4) [m], added to the element."""
    xyz, rpy = (" ".join(map(number, v)) for v in (T[:3, 3], so3.to_rpy(T[:3, :3])))
    ET.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def urdf_text(robot: ET.Element) -> str:
    """The text of a whole robot."""
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def number(value: float) -> str:
    """A number with every digit, and no −0."""
    return repr(float(value) + 0.0)
