"""Reading a chain from a URDF.

Fixed joints are folded into the constants of the moving joints; everything off the way from base to tip is left out.
The frame of a joint is the frame of its child link, so joint k of the chain moves link k as the URDF has it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_tip import default_tip, tips
from modcal_core.robots.urdf_tree import TURNS, Tree, parse

_FARTHEST = 20.0  # m; an arm whose constants add up to more is suspected of millimetres


@dataclass(frozen=True)
class UrdfPath:
    """The joints between base and tip.

    segments: for each constant M_k of the chain, the names of the URDF joints whose origins make it up, in order; the
    last of segment k < n is the moving joint k + 1, all others are fixed.
    """

    base: str
    tip: str
    segments: tuple[tuple[str, ...], ...]


def read_chain(
    urdf_xml: str, base: str | None = None, tip: str | None = None, recorded: Collection[str] | None = None
) -> Chain:
    """The chain from base to tip link of a URDF.

    base: default the root link. tip: default see :func:`modcal_core.robots.urdf_tip.default_tip`. recorded: names of
    the joints that were recorded; a default tip is sought behind those only. Raises BadRobot.
    """
    tree = parse(urdf_xml)
    base = tree.root() if base is None else tree.link(base)
    tip = default_tip(tree, base, recorded) if tip is None else tree.link(tip)
    origins, moving = [np.eye(4)], []
    for joint in tree.path(base, tip):
        origins[-1] = origins[-1] @ joint.T_parent_joint
        if not joint.moves:
            continue
        if joint.kind not in TURNS:
            said = f"is {joint.kind}, which a chain cannot hold"
            raise BadRobot(f"joint {joint.name}", said, "give another --base or --tip")
        if joint.mimics is not None:
            raise BadRobot(f"joint {joint.name}", f"mimics {joint.mimics}", "give a --tip before it")
        moving.append(joint)
        origins.append(np.eye(4))
    chain = Chain.build(
        names=[joint.name for joint in moving],
        origins=origins,
        axes=[joint.axis for joint in moving],
        revolute=[TURNS[joint.kind] for joint in moving],
        lower=[joint.lower for joint in moving],
        upper=[joint.upper for joint in moving],
        base=base,
        tip=tip,
    )
    _check_unit(chain, tree)
    return replace(chain, links=tuple(joint.parent for joint in moving))


def other_tips(urdf_xml: str, base: str, recorded: Collection[str] | None = None) -> tuple[str, ...]:
    """Tips of other arms of as many joints, which :func:`read_chain` passes over where no tip is given."""
    return tips(parse(urdf_xml), base, recorded).others


def read_path(urdf_xml: str, base: str, tip: str) -> UrdfPath:
    """Which URDF joints make up each constant of the chain from base to tip. Raises BadRobot."""
    tree = parse(urdf_xml)
    segments: list[list[str]] = [[]]
    for joint in tree.path(tree.link(base), tree.link(tip)):
        segments[-1].append(joint.name)
        if joint.moves:
            segments.append([])
    return UrdfPath(base, tip, tuple(tuple(s) for s in segments))


def joint_origins(urdf_xml: str) -> dict[str, Array]:
    """``T_parent_joint`` (4, 4) [m] of every joint of a URDF, by its name. Raises BadRobot."""
    return {joint.name: joint.T_parent_joint for joint in parse(urdf_xml).joints}


def _check_unit(chain: Chain, tree: Tree) -> None:
    long = float(np.linalg.norm(chain.origins[1:, :3, 3], axis=1).sum())
    if chain.revolute.any() and long > _FARTHEST:
        said = f"its links add up to {long:.0f} m, {_FARTHEST:g} m is the limit: it looks like millimetres"
        raise BadRobot(f"robot '{tree.name}'", said, "give <origin xyz> in metres")
