"""URDFs of builds that the other good recordings lack: a rail, a SCARA, a gantry, another seven axes."""

from __future__ import annotations

import re

from arm import DESCRIBED, FOLDER

SLIDE, HINGE = "prismatic", "revolute"
Y, Z = "0 1 0", "0 0 1"


def _link(name: str, mass: float) -> str:
    inertia = f'ixx="{0.01 * mass}" ixy="0" ixz="0" iyy="{0.01 * mass}" iyz="0" izz="{0.01 * mass}"'
    origin = '<origin xyz="0.05 0 0.02" rpy="0 0 0"/>'
    return f'<link name="{name}"><inertial>{origin}<mass value="{mass}"/><inertia {inertia}/></inertial></link>'


def _joint(name: str, type_: str, parent: str, child: str, xyz: str, axis: str, span: tuple[float, float]) -> str:
    limit = f'<limit lower="{span[0]}" upper="{span[1]}" effort="200" velocity="1"/>' if type_ != "fixed" else ""
    inside = f'<origin xyz="{xyz}" rpy="0 0 0"/><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{type_}">{inside}{limit}</joint>'


def _chain(robot: str, *joints: tuple[str, str, str, str, tuple[float, float]]) -> tuple[str, str]:
    """The URDF of joints (name, type, origin, axis, range), one after the other, and its tip."""
    links = ["base_link", *(f"link_{k + 1}" for k in range(len(joints))), "tool0"]
    parts = [_link(name, 6.0 - 0.7 * k) for k, name in enumerate(links[:-1])] + ['<link name="tool0"/>']
    parts += [_joint(j[0], j[1], links[k], links[k + 1], *j[2:]) for k, j in enumerate(joints)]
    parts.append(_joint("flange", "fixed", links[-2], "tool0", "0 0 0.08", Z, (0.0, 0.0)))
    return f'<?xml version="1.0"?>\n<robot name="{robot}">\n' + "\n".join(parts) + "\n</robot>\n", "tool0"


def _on_a_rail() -> tuple[str, str]:
    """The UR10 on a carriage that goes two metres."""
    text = (FOLDER / "ur10.urdf").read_text(encoding="utf-8")
    children = set(re.findall(r'<child link="([^"]*)"', text))
    root = next(name for name in re.findall(r'<link name="([^"]*)"', text) if name not in children)
    rail = _joint("rail_joint", SLIDE, "rail", root, "0 0 0.3", "1 0 0", (-1.0, 1.0))
    return text.replace("</robot>", f"{_link('rail', 40.0)}\n{rail}\n</robot>"), "tool0"


DESCRIBED["rail"] = _on_a_rail()
DESCRIBED["scara"] = _chain(
    "scara",
    ("shoulder", HINGE, "0 0 0.35", Z, (-2.2, 2.2)),
    ("elbow", HINGE, "0.325 0 0", Z, (-2.5, 2.5)),
    ("quill", SLIDE, "0.275 0 0", "0 0 -1", (0.0, 0.2)),
    ("wrist", HINGE, "0 0 -0.1", Z, (-3.1, 3.1)),
)
DESCRIBED["gantry"] = _chain(
    "gantry",
    ("bridge", SLIDE, "0 0 1.2", "1 0 0", (0.0, 2.5)),
    ("trolley", SLIDE, "0 0.1 0", Y, (0.0, 1.5)),
    ("column", SLIDE, "0.1 0 0", "0 0 -1", (0.0, 0.8)),
    ("swivel", HINGE, "0 0 -0.2", Z, (-3.0, 3.0)),
    ("nod", HINGE, "0.06 0 -0.05", Y, (-1.6, 1.6)),
)
DESCRIBED["iiwa14"] = (FOLDER / "iiwa14.urdf").read_text(encoding="utf-8"), "iiwa_link_ee"
