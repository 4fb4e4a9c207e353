"""Where an arm ends when nobody says so: past its joints and its flange, short of a gripper's fingers."""

from __future__ import annotations

import re
from collections.abc import Collection

from modcal_core.errors import BadRobot
from modcal_core.robots.urdf_tree import TURNS, Joint, Tree

# Usual names of a tool frame, the best first.
_TOOL_NAMES = tuple(
    re.compile(pattern)
    for pattern in (r"(^|[_/-])tool0$", r"tcp$", r"(^|[_/-])(ee|eef|end_effector)([_/-]|$)", r"flange$")
)


def default_tip(tree: Tree, base: str, recorded: Collection[str] | None = None) -> str:
    """The end of the arm: the link behind most moving joints.

    Among several, one with a tool's usual name (tool0, tcp, ee, flange), then the one with the longest way, then the
    first by name. The way ends before joints that mimic or are mimicked, before those that a chain cannot hold, and
    where it forks into a hand. recorded: names of the joints that were recorded; of arms whose joints were all recorded
    the longest is taken, and where there is none the longest at all, so that the missing joints can be named. Raises
    BadRobot when nothing moves.
    """
    led = {joint.mimics for joint in tree.joints if joint.mimics is not None}
    ends: list[tuple[bool, int, int, int, str]] = []

    def follow(link: str, moving: int, length: int, unknown: bool) -> None:
        fingers = _fingers(tree, link, moving)
        further = [j for j in tree.below[link] if not j.moves or (_usable(j) and j.name not in led | fingers)]
        if moving and not further:
            ends.append((unknown, -moving, _rank(link), -length, link))
        for joint in further:
            missing = joint.moves and recorded is not None and joint.name not in recorded
            follow(joint.child, moving + joint.moves, length + 1, unknown or missing)

    follow(base, 0, 0, False)
    if not ends:
        raise BadRobot(f"link '{base}'", "no moving joint behind it", "give the --base of an arm")
    return min(ends)[4]


def _usable(joint: Joint) -> bool:
    return joint.kind in TURNS and joint.mimics is None


def _rank(link: str) -> int:
    return next((i for i, pattern in enumerate(_TOOL_NAMES) if pattern.search(link.lower())), len(_TOOL_NAMES))


def _fingers(tree: Tree, link: str, before: int) -> set[str]:
    """The joints of a hand's fingers on a link: two or more branches are the longest, and shorter than the arm before.

    None of them is the arm's continuation then. The two arms of a torso are longer than what carries them.
    """
    depth = {joint.name: _depth(tree, joint) for joint in tree.below[link]}
    deepest = max(depth.values(), default=0)
    forks = 0 < deepest < before and list(depth.values()).count(deepest) > 1
    return {name for name, d in depth.items() if d > 0} if forks else set()


def _depth(tree: Tree, joint: Joint) -> int:
    return int(joint.moves) + max((_depth(tree, j) for j in tree.below[joint.child]), default=0)
