"""Where an arm ends when nobody says so: past its joints and its flange, short of a gripper's fingers."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from modcal_core.errors import BadRobot
from modcal_core.robots.urdf_tree import TURNS, Joint, Tree

# Usual names of a tool frame, the best first.
_TOOL_NAMES = tuple(
    re.compile(pattern)
    for pattern in (r"(^|[_/-])tool0$", r"tcp$", r"(^|[_/-])(ee|eef|end_effector)([_/-]|$)", r"flange$")
)


# Words by which a gripper's own joint, or the link that it moves, is known; the second kind also names whole hands.
_FINGER = re.compile(r"finger|jaw|knuckle|thumb|claw|pincer")
_GRIPPER = re.compile(r"grip")


@dataclass(frozen=True)
class Tips:
    """tip: the link where the arm ends. others: where arms of as many joints end that might have been meant as well."""

    tip: str
    others: tuple[str, ...]


@dataclass(frozen=True)
class _End:
    """A link where a way ends: whether a joint of it was not recorded, names of its joints, its length in links."""

    link: str
    unknown: bool
    moving: tuple[str, ...]
    length: int

    @property
    def order(self) -> tuple[bool, int, int, int, str]:
        """The first is the best."""
        return self.unknown, -len(self.moving), _rank(self.link), -self.length, self.link


def default_tip(tree: Tree, base: str, recorded: Collection[str] | None = None) -> str:
    """The end of the arm, as :func:`tips` has it. Raises BadRobot when nothing moves."""
    return tips(tree, base, recorded).tip


def tips(tree: Tree, base: str, recorded: Collection[str] | None = None) -> Tips:
    """The end of the arm: the link behind most moving joints; and the ends of other arms with as many.

    Among several, one with a tool's usual name (tool0, tcp, ee, flange), then the one with the longest way, then the
    first by name. The way ends before joints that mimic or are mimicked, before those that a chain cannot hold, before
    a gripper's own, and where it forks into a hand. recorded: names of the joints that were recorded; of arms whose
    joints were all recorded the longest is taken, and where there is none the longest at all, so that the missing
    joints can be named. Raises BadRobot when nothing moves.
    """
    led = {joint.mimics for joint in tree.joints if joint.mimics is not None}
    ends: list[_End] = []

    def follow(link: str, moving: tuple[str, ...], length: int, unknown: bool) -> None:
        fingers = _fingers(tree, link, len(moving))
        further = [j for j in tree.below[link] if not j.moves or (_usable(j) and j.name not in led | fingers)]
        if moving and not further:
            ends.append(_End(link, unknown, moving, length))
        for joint in further:
            missing = joint.moves and recorded is not None and joint.name not in recorded
            follow(joint.child, (*moving, joint.name) if joint.moves else moving, length + 1, unknown or missing)

    follow(base, (), 0, False)
    if not ends:
        raise BadRobot(f"link '{base}'", "no moving joint behind it", "give the --base of an arm")
    best = min(ends, key=lambda end: end.order)
    rivals: dict[tuple[str, ...], _End] = {}
    for end in sorted(ends, key=lambda end: end.order):
        if end.unknown == best.unknown and len(end.moving) == len(best.moving) and end.moving != best.moving:
            rivals.setdefault(end.moving, end)
    return Tips(best.link, tuple(end.link for end in rivals.values()))


def _usable(joint: Joint) -> bool:
    return joint.kind in TURNS and joint.mimics is None


def _rank(link: str) -> int:
    return next((i for i, pattern in enumerate(_TOOL_NAMES) if pattern.search(link.lower())), len(_TOOL_NAMES))


def _fingers(tree: Tree, link: str, before: int) -> set[str]:
    """The joints of a hand's fingers on a link, behind so many joints; none of them is the arm's continuation.

    They are known by two or more branches that are the longest, and shorter than the arm before; the two arms of a
    torso are longer than what carries them. A single one is known by its name, or by that of the link that it moves.
    """
    depth = {joint.name: _depth(tree, joint) for joint in tree.below[link]}
    deepest = max(depth.values(), default=0)
    if 0 < deepest < before and list(depth.values()).count(deepest) > 1:
        return {name for name, d in depth.items() if d > 0}
    return {
        joint.name
        for joint in tree.below[link]
        if joint.moves and depth[joint.name] < before and _named_as_finger(joint, len(depth))
    }


def _named_as_finger(joint: Joint, beside: int) -> bool:
    """Whether a joint's names are a gripper's; beside: how many joints its parent carries.

    The joint before a whole hand may be named after it as well: a gripper's own stands on a palm, which carries more.
    """
    names = f"{joint.name} {joint.child}".lower()
    return bool(_FINGER.search(names)) or (beside > 1 and bool(_GRIPPER.search(names)))


def _depth(tree: Tree, joint: Joint) -> int:
    return int(joint.moves) + max((_depth(tree, j) for j in tree.below[joint.child]), default=0)
