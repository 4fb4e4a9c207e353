"""Healthy cells of builds the other good recordings lack: rail, SCARA, gantry, another seven axes, few poses.

Bodies are displaced as everywhere here, so that a geometry explains all of it down to the noise.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from arm import DESCRIBED, FOLDER
from case import Case, kind
from good import good
from workcell import Works

SLIDE, HINGE = "prismatic", "revolute"


def _link(name: str, mass: float) -> str:
    inertia = f'ixx="{0.01 * mass}" ixy="0" ixz="0" iyy="{0.01 * mass}" iyz="0" izz="{0.01 * mass}"'
    origin = '<origin xyz="0.05 0 0.02" rpy="0 0 0"/>'
    return f'<link name="{name}"><inertial>{origin}<mass value="{mass}"/><inertia {inertia}/></inertial></link>'


def _joint(name: str, type_: str, parent: str, child: str, xyz: str, axis: str, span: tuple[float, float]) -> str:
    limit = f'<limit lower="{span[0]}" upper="{span[1]}" effort="200" velocity="1"/>' if type_ != "fixed" else ""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    inside = f'<origin xyz="{xyz}" rpy="0 0 0"/>{ends}<axis xyz="{axis}"/>{limit}'
    return f'<joint name="{name}" type="{type_}">{inside}</joint>'


def _chain(robot: str, *joints: tuple[str, str, str, str, tuple[float, float]]) -> tuple[str, str]:
    """The URDF of joints (name, type, origin, axis, range), one after the other, and its tip."""
    links = ["base_link", *(f"link_{k + 1}" for k in range(len(joints))), "tool0"]
    parts = [_link(name, 6.0 - 0.7 * k) for k, name in enumerate(links[:-1])] + ['<link name="tool0"/>']
    for k, (name, type_, xyz, axis, span) in enumerate(joints):
        parts.append(_joint(name, type_, links[k], links[k + 1], xyz, axis, span))
    parts.append(_joint("flange", "fixed", links[-2], "tool0", "0 0 0.08", "0 0 1", (0.0, 0.0)))
    return f'<?xml version="1.0"?>\n<robot name="{robot}">\n' + "\n".join(parts) + "\n</robot>\n", "tool0"


def _on_a_rail() -> tuple[str, str]:
    """The UR10 on a carriage that goes two metres."""
    text = (Path(FOLDER) / "ur10.urdf").read_text(encoding="utf-8")
    children = set(re.findall(r'<child link="([^"]*)"', text))
    root = next(name for name in re.findall(r'<link name="([^"]*)"', text) if name not in children)
    rail = _joint("rail_joint", SLIDE, "rail", root, "0 0 0.3", "1 0 0", (-1.0, 1.0))
    return text.replace("</robot>", f"{_link('rail', 40.0)}\n{rail}\n</robot>"), "tool0"


Z, Y = "0 0 1", "0 1 0"
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


@kind("good_fifth")
def healthy_on_a_rail(w: Works, rng: np.random.Generator) -> Case:
    """A UR10 on a rail of two metres whose carriage is one of the joints."""
    return good(Works("rail", rng).clean(140))


@kind("good_fifth")
def healthy_scara(w: Works, rng: np.random.Generator) -> Case:
    """Four joints, all axes upright."""
    return good(Works("scara", rng).clean(110))


@kind("good_fifth")
def healthy_gantry(w: Works, rng: np.random.Generator) -> Case:
    """Three slides and a wrist of two joints."""
    return good(Works("gantry", rng).clean(120))


@kind("good_fifth")
def healthy_seven_axes(w: Works, rng: np.random.Generator) -> Case:
    """An iiwa, measured by points alone."""
    return good(Works("iiwa14", rng).clean(170, kind="point"))


@kind("good_fifth")
def healthy_at_few_stations(w: Works, rng: np.random.Generator) -> Case:
    """Twenty-six poses, six of them second visits."""
    return good(w.clean(26))
