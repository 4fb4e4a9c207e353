"""The arm that images are of: between two links of a URDF, also from the tip of one arm to that of another."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from modcal_core.errors import BadRobot, about
from modcal_core.measurements.recording import Recording
from modcal_core.robot import Robot
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import held_behind
from modcal_core.robots.urdf_reroot import rerooted
from modcal_core.robots.urdf_tree import Tree, parse


def arm_of_file(
    urdf: Path, base: str | None, tip: str | None, recorded: Collection[str]
) -> tuple[Robot, tuple[str, ...]]:
    """As arm_between, of a file."""
    with about(str(urdf)):
        return arm_between(urdf.read_text(encoding="utf-8", errors="replace"), base, tip, recorded)


def arm_recorded(
    recording: Recording, urdf: Path | None, base: str | None, tip: str | None
) -> tuple[Robot, tuple[str, ...]]:
    """As arm_between, of a recording, which holds the description where no file is given."""
    recorded = frozenset(name for track in recording.joints for name in track.names)
    if urdf is not None:
        return arm_of_file(urdf, base, tip, recorded)
    if recording.robot_description is None:
        raise BadRobot(recording.source, "holds no robot_description", "give --urdf, or record the topic")
    with about(f"{recording.source}, robot_description"):
        return arm_between(recording.robot_description, base, tip, recorded)


def arm_between(
    urdf: str, base: str | None, tip: str | None, recorded: Collection[str]
) -> tuple[Robot, tuple[str, ...]]:
    """(the arm, what is to be said of it, in sentences): where the tip is not carried by the base, both arms as one.

    urdf: text. recorded: names of the joints whose positions are known. The second is empty where the arm is one.
    Raises ModcalError.
    """
    if base is None or tip is None:
        return Robot.from_urdf(urdf, base, tip, recorded), ()
    tree = parse(urdf)
    over = _above_both(tree, tree.link(base), tree.link(tip))
    if over == base:
        return Robot.from_urdf(urdf, base, tip, recorded), ()
    turned = rerooted(urdf, base)
    robot = Robot.from_urdf(turned, base, tip)
    said = (
        f"{tip} is not carried by {base}: both arms are calibrated as one chain of {robot.n} joints from {base} over "
        f"{over} to {tip}, and calibrated.urdf has {base} as its root."
    )
    if over == tip or robot.inertias is None:
        return replace(robot, inertias=None), (said,)
    carrying = read_chain(urdf, tree.root(), base)
    down = -forward(carrying, np.zeros((1, carrying.n)))[0, 2, :3]
    own = sum(joint.moves and joint.mimics is None for joint in tree.path(over, tree.link(base)))
    return replace(robot, inertias=held_behind(turned, robot.inertias, robot.chain, own, down)), (said,)


def _above_both(tree: Tree, base: str, tip: str) -> str:
    """The link that carries both, or is one of them."""
    above, link = {base}, base
    while link in tree.above:
        link = tree.above[link].parent
        above.add(link)
    link = tip
    while link not in above:
        link = tree.above[link].parent
    return link
