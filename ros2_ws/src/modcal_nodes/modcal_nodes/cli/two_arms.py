"""The arm that images are of: between two links of a URDF, also from the tip of one arm to that of another."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from modcal_core.robot import Robot
from modcal_core.robots.urdf_reroot import rerooted
from modcal_core.robots.urdf_tree import parse


def arm_between(
    urdf: Path, base: str | None, tip: str | None, recorded: Collection[str]
) -> tuple[Robot, tuple[str, ...]]:
    """(the arm, what is to be said of it, in sentences): where the tip is not carried by the base, both arms as one.

    recorded: columns of the table of joints. The second is empty where the arm is one. Raises ModcalError.
    """
    if base is not None and tip is not None:
        text = urdf.read_text(encoding="utf-8", errors="replace")
        tree = parse(text)
        above, link = {tree.link(base)}, tree.link(tip)
        while link in tree.above and link not in above:
            link = tree.above[link].parent
        if link not in above:
            robot = Robot.from_urdf(rerooted(text, base), base, tip)
            said = (
                f"{tip} is not carried by {base}: both arms are calibrated as one chain of {robot.n} joints from "
                f"{base} over {link} to {tip}, and calibrated.urdf has {base} as its root. Effects are not looked for: "
                "loads of an arm whose first link moves are not modelled."
            )
            return replace(robot, inertias=None), (said,)
    return Robot.from_urdf(urdf, base, tip, recorded), ()
