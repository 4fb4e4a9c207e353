"""Arms with bodies beside their chain: a UR10 on a lifting column, and on a torso that carries another arm as well."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import workcell  # noqa: F401 (puts bench/undeclared on the path)
from scipy.spatial.transform import Rotation

from arm import DESCRIBED, FOLDER  # isort: skip

Array = np.ndarray
GRAVITY = 9.81
# Of the other arm: joints, their axes and origins, and the masses [kg] behind them
OTHER = (("right_1", "0 1 0", (0.05, -0.3, 0.3), 6.0), ("right_2", "1 0 0", (0.0, 0.0, 0.4), 7.0))


def inertial(mass: float, xyz: str) -> str:
    """A link's mass [kg] at a point [m], as URDF."""
    i = 0.01 * mass
    return (
        f'<inertial><origin xyz="{xyz}" rpy="0 0 0"/><mass value="{mass}"/>'
        f'<inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial>'
    )


def behind_a_joint(
    robot: str, joint: str, kind: str, xyz: str, axis: str, span: tuple[float, float], mass: float
) -> None:
    """The UR10 on a link that moves by one joint more, of this mass [kg]."""
    text = (Path(FOLDER) / "ur10.urdf").read_text(encoding="utf-8")
    children = set(re.findall(r'<child link="([^"]*)"', text))
    root = next(name for name in re.findall(r'<link name="([^"]*)"', text) if name not in children)
    limit = f'<limit lower="{span[0]}" upper="{span[1]}" effort="900" velocity="1"/>'
    foot = f'<link name="foot"/><link name="{joint}_link">{inertial(mass, "0.02 0 0.1")}</link>'
    moves = (
        f'<joint name="{joint}" type="{kind}"><origin xyz="{xyz}" rpy="0 0 0"/><parent link="foot"/>'
        f'<child link="{joint}_link"/><axis xyz="{axis}"/>{limit}</joint>'
    )
    fixed = (
        f'<joint name="{joint}_mount" type="fixed"><origin xyz="0.1 0.1 0.2" rpy="0.3 0 0.2"/>'
        f'<parent link="{joint}_link"/><child link="{root}"/></joint>'
    )
    DESCRIBED[robot] = text.replace("</robot>", f"{foot}\n{moves}\n{fixed}\n</robot>"), "tool0"


def with_other_arm(urdf: str) -> str:
    """The description with the other arm on the torso's link."""
    parts, parent = [], "torso_link"
    for name, axis, xyz, mass in OTHER:
        limit = '<limit lower="-2" upper="2" effort="99" velocity="1"/>'
        at = " ".join(str(v) for v in xyz)
        parts.append(f'<link name="{name}_link">{inertial(mass, "0.03 0 0.2")}</link>')
        parts.append(
            f'<joint name="{name}" type="revolute"><origin xyz="{at}" rpy="0 0 0"/><parent link="{parent}"/>'
            f'<child link="{name}_link"/><axis xyz="{axis}"/>{limit}</joint>'
        )
        parent = f"{name}_link"
    return urdf.replace("</robot>", "\n".join(parts) + "\n</robot>")


def other_torque(torso: Array, turns: Array) -> Array:
    """Torque of the other arm's weight about the torso's axis (N,) [N m], by moments about it."""
    lean = Rotation.from_rotvec(np.outer(torso, [0.0, 1.0, 0.0]))
    first = Rotation.from_rotvec(np.outer(turns[:, 0], [0.0, 1.0, 0.0]))
    second = first * Rotation.from_rotvec(np.outer(turns[:, 1], [1.0, 0.0, 0.0]))
    centre = np.array([0.03, 0.0, 0.2])
    shoulder, elbow = (np.array(xyz) for _, _, xyz, _ in OTHER)
    at = [shoulder + first.apply(centre), shoulder + first.apply(elbow) + second.apply(centre)]
    weights = [mass * GRAVITY * np.array([0.0, 0.0, -1.0]) for *_, mass in OTHER]
    return np.sum([np.cross(lean.apply(p), w)[:, 1] for p, w in zip(at, weights, strict=True)], axis=0)


behind_a_joint("lifted", "lift", "prismatic", "0.1 0 0.3", "0 0 1", (0.0, 0.6), 25.0)
behind_a_joint("torso", "torso", "revolute", "0 0 0.8", "0 1 0", (-0.6, 0.6), 12.0)
