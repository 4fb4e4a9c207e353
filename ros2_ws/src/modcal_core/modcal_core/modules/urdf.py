"""The URDF of an assembly: one link for every module, two for a joint, fixed joints where flanges are bolted.

A module's link has its input frame; a joint module has a second one, in the same place while the joint is at zero,
which moves. So quarter turns and ways through modules stand in the file as they are, and a reader that folds fixed
joints gets the constants of the chain. The tip is ``tool0``, the gripper's output frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

import numpy as np

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.assembly import Assembly, Module
from modcal_core.modules.bodies import body
from modcal_core.modules.library import JOINT, Library, ModuleType
from modcal_core.modules.poe import BASE_LINK, FROM_AXIS, TIP_LINK, TO_AXIS, TURN, WHOLE
from modcal_core.robots.urdf_elements import joint_element, number, origin_element, urdf_text

_COLOURS = {
    "base": "0.25 0.27 0.30 1",
    "joint": "0.12 0.44 0.92 1",
    "link": "0.75 0.77 0.80 1",
    "gripper": "0.90 0.55 0.15 1",
}


def urdf_of(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> str:
    """The URDF text of the arm that an assembly makes; reading it gives ``chain_of`` the same three.

    errors: as there. Raises BadTable where the assembly cannot be built.
    """
    assembly.checked(library)
    robot = ET.Element("robot", name=assembly.name)
    for role, rgba in _COLOURS.items():
        ET.SubElement(ET.SubElement(robot, "material", name=role), "color", rgba=rgba)
    errors = errors or {}

    def error(module: Module, part: str) -> Array:
        found = errors.get((module.serial, part)) if module.serial else None
        return np.eye(4) if found is None else se3.exp(found)

    above, T = "", np.eye(4)  # the link that the next module hangs on, and where
    for link, module in zip(link_names(assembly), assembly.modules, strict=True):
        kind = library.types[module.kind]
        moving = kind.role == JOINT
        _link(robot, f"{link}_housing" if moving else link, kind, module.size, empty=moving)
        if above:
            below = f"{link}_housing" if moving else link
            joint_element(robot, f"{above}_to_{below}", "fixed", above, below, T @ TURN[module.turn])
        if moving:
            _link(robot, link, kind, module.size)
            name = link.removesuffix("_module")
            joint = joint_element(
                robot,
                name,
                "revolute" if kind.revolute else "prismatic",
                f"{link}_housing",
                link,
                error(module, TO_AXIS),
            )
            ET.SubElement(joint, "axis", xyz="0 0 1")
            if not (np.isfinite(kind.lower) and np.isfinite(kind.upper)):
                joint.set("type", "continuous")
            limit = {"effort": kind.effort, "velocity": kind.velocity}
            if joint.get("type") != "continuous":
                limit |= {"lower": kind.lower, "upper": kind.upper}
            ET.SubElement(joint, "limit", {key: number(value) for key, value in limit.items()})
        above = link
        T = kind.T_in_out[module.size] @ error(module, FROM_AXIS if moving else WHOLE)
    ET.SubElement(robot, "link", name=TIP_LINK)
    joint_element(robot, f"{above}_to_{TIP_LINK}", "fixed", above, TIP_LINK, T)
    return urdf_text(robot)


def link_names(assembly: Assembly) -> list[str]:
    """Names of the modules' links, base to gripper: base_link, joint_1_module, link_1 … gripper."""
    out = [BASE_LINK]
    for k in range(assembly.n):
        out += [f"joint_{k + 1}_module", f"link_{k + 1}"]
    return [*out, "gripper"]


def _link(robot: ET.Element, name: str, kind: ModuleType, size: int, empty: bool = False) -> None:
    """One link. A joint's housing is empty: module and motor are taken to move with the joint."""
    link = ET.SubElement(robot, "link", name=name)
    if empty:
        return
    made = body(kind, size)
    inertial = ET.SubElement(link, "inertial")
    origin_element(inertial, se3.transform(p=made.centre))
    ET.SubElement(inertial, "mass", value=number(made.mass))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: number(made.inertia[at]) for key, at in names.items()})
    for tag in ("visual", "collision"):
        for tube in made.tubes:
            shape = ET.SubElement(link, tag)
            origin_element(shape, tube.T)
            geometry = ET.SubElement(shape, "geometry")
            ET.SubElement(geometry, "cylinder", radius=number(tube.radius), length=number(tube.length))
            if tag == "visual":
                ET.SubElement(shape, "material", name=kind.role)
