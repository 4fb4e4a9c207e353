"""URDFs of builds that the other good recordings lack: a rail, a SCARA, a gantry, another seven axes."""

from __future__ import annotations

import re

from arm import DESCRIBED, FOLDER


def _link(name: str, mass: float) -> str:
    inertia = f'ixx="{0.01 * mass}" ixy="0" ixz="0" iyy="{0.01 * mass}" iyz="0" izz="{0.01 * mass}"'
    origin = '<origin xyz="0.05 0 0.02" rpy="0 0 0"/>'
    return f'<link name="{name}"><inertial>{origin}<mass value="{mass}"/><inertia {inertia}/></inertial></link>'


def _joint(name: str, type_: str, parent: str, child: str, xyz: str, axis: str, span: str = "") -> str:
    low, high = span.split() or ("", "")
    limit = f'<limit lower="{low}" upper="{high}" effort="200" velocity="1"/>' if span else ""
    inside = f'<origin xyz="{xyz}" rpy="0 0 0"/><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{type_}">{inside}{limit}</joint>'


def _chain(robot: str, text: str) -> tuple[str, str]:
    """The URDF of joints (name, type, origin, axis, range), one below the other, and its tip."""
    joints = [line.split(" | ") for line in text.split("\n")]
    links = ["base_link", *(f"link_{k + 1}" for k in range(len(joints))), "tool0"]
    parts = [_link(name, 6.0 - 0.7 * k) for k, name in enumerate(links[:-1])] + ['<link name="tool0"/>']
    parts += [_joint(j[0], j[1], links[k], links[k + 1], *j[2:]) for k, j in enumerate(joints)]
    parts.append(_joint("flange", "fixed", links[-2], "tool0", "0 0 0.08", "0 0 1"))
    return f'<?xml version="1.0"?>\n<robot name="{robot}">\n' + "\n".join(parts) + "\n</robot>\n", "tool0"


def _on_a_rail() -> tuple[str, str]:
    """The UR10 on a carriage that goes two metres."""
    text = (FOLDER / "ur10.urdf").read_text(encoding="utf-8")
    children = set(re.findall(r'<child link="([^"]*)"', text))
    root = next(name for name in re.findall(r'<link name="([^"]*)"', text) if name not in children)
    rail = _joint("rail_joint", "prismatic", "rail", root, "0 0 0.3", "1 0 0", "-1.0 1.0")
    return text.replace("</robot>", f"{_link('rail', 40.0)}\n{rail}\n</robot>"), "tool0"


SCARA = """shoulder | revolute | 0 0 0.35 | 0 0 1 | -2.2 2.2
elbow | revolute | 0.325 0 0 | 0 0 1 | -2.5 2.5
quill | prismatic | 0.275 0 0 | 0 0 -1 | 0.0 0.2
wrist | revolute | 0 0 -0.1 | 0 0 1 | -3.1 3.1"""
GANTRY = """bridge | prismatic | 0 0 1.2 | 1 0 0 | 0.0 2.5
trolley | prismatic | 0 0.1 0 | 0 1 0 | 0.0 1.5
column | prismatic | 0.1 0 0 | 0 0 -1 | 0.0 0.8
swivel | revolute | 0 0 -0.2 | 0 0 1 | -3.0 3.0
nod | revolute | 0.06 0 -0.05 | 0 1 0 | -1.6 1.6"""
DESCRIBED |= {"rail": _on_a_rail(), "scara": _chain("scara", SCARA), "gantry": _chain("gantry", GANTRY)}
DESCRIBED["iiwa14"] = (FOLDER / "iiwa14.urdf").read_text(encoding="utf-8"), "iiwa_link_ee"
