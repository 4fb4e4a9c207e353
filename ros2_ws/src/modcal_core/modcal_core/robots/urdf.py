"""Reading a chain from a URDF.

Fixed joints are folded into the constants of the moving joints; everything off the way from base to tip is left out.
The frame of a joint is the frame of its child link, so joint k of the chain moves link k as the URDF has it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array
from modcal_core.robots.chain import Chain, Follower
from modcal_core.robots.urdf_tree import FIX, TURNS, Joint, Tree, parse

# --- Where an arm ends when nobody says so: past its joints and its flange, short of a gripper's fingers

# Usual names of a tool frame, the best first.
_TOOL_NAMES = tuple(
    re.compile(pattern)
    for pattern in (r"(^|[_/-])tool0$", r"tcp$", r"(^|[_/-])(ee|eef|end_effector)([_/-]|$)", r"flange$")
)

# Words by which a gripper's own joint, or the link that it moves, is known; the second kind also names whole hands.
_FINGER = re.compile(r"finger|jaw|knuckle|thumb|claw|pincer")
_GRIPPER = re.compile(r"grip")


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
        named = (i for i, pattern in enumerate(_TOOL_NAMES) if pattern.search(self.link.lower()))
        return self.unknown, -len(self.moving), next(named, len(_TOOL_NAMES)), -self.length, self.link


def tips(tree: Tree, base: str, recorded: Collection[str] | None = None) -> tuple[str, tuple[str, ...]]:
    """The end of the arm: the link behind most moving joints; and the ends of other arms with as many, which might have
    been meant as well.

    Among several, one with a tool's usual name (tool0, tcp, ee, flange), then the one with the longest way, then the
    first by name. The way ends before joints that mimic or that others mimic, unless the arm goes on behind them (a
    cylinder that balances a link mimics its joint; a parallelogram's joint is on the way), before those that a chain
    cannot hold, before a gripper's own, and where it forks into a hand. recorded: names of the joints that were
    recorded; of arms whose joints were all recorded the longest is taken, and where there is none the longest at all,
    so that the missing joints can be named. Raises BadRobot when nothing moves.
    """
    led = {joint.mimics for joint in tree.joints if joint.mimics is not None}
    ended = {j.name for j in tree.joints if (j.mimics is not None or j.name in led) and not _goes_on(tree, j, led)}
    ends: list[_End] = []

    def follow(link: str, moving: tuple[str, ...], length: int, unknown: bool, tooled: bool) -> None:
        tooled = tooled or any(_is_tool(name) for name in (link, *(j.child for j in tree.below[link] if not j.moves)))
        fingers = _fingers(tree, link, len(moving), tooled)
        further = [j for j in tree.below[link] if not j.moves or (j.kind in TURNS and j.name not in ended | fingers)]
        if moving and not further:
            ends.append(_End(link, unknown, moving, length))
        for joint in further:
            own = joint.moves and joint.mimics is None
            missing = own and recorded is not None and joint.name not in recorded
            follow(joint.child, (*moving, joint.name) if own else moving, length + 1, unknown or missing, tooled)

    follow(base, (), 0, False, False)
    if not ends:
        raise BadRobot(f"link '{base}'", "no moving joint behind it", "give the --base of an arm")
    best = min(ends, key=lambda end: end.order)
    rivals: dict[tuple[str, ...], _End] = {}
    for end in sorted(ends, key=lambda end: end.order):
        if end.unknown == best.unknown and len(end.moving) == len(best.moving) and end.moving != best.moving:
            rivals.setdefault(end.moving, end)
    return best.link, tuple(end.link for end in rivals.values())


def _is_tool(link: str) -> bool:
    return any(pattern.search(link.lower()) for pattern in _TOOL_NAMES)


def _goes_on(tree: Tree, joint: Joint, led: Collection[str | None]) -> bool:
    """Whether joints that nothing leads, or a tool's frame, are behind a joint."""
    if _is_tool(joint.child):
        return True
    return any(
        (j.moves and j.mimics is None and j.name not in led) or _goes_on(tree, j, led) for j in tree.below[joint.child]
    )


def _fingers(tree: Tree, link: str, before: int, tooled: bool) -> set[str]:
    """The joints of a hand's fingers on a link, behind so many joints; none of them is the arm's continuation.
    tooled: whether a tool's frame stands here or before.

    They are known by two or more branches that are the longest, and shorter than the arm before; the two arms of a
    torso are longer than what carries them. A single one is known by its name, or by that of the link that it moves.
    """
    branches = tree.below[link]
    depth = {joint.name: _depth(tree, joint) for joint in branches}
    deepest = max(depth.values(), default=0)
    if 0 < deepest < before and list(depth.values()).count(deepest) > 1:
        return {name for name, d in depth.items() if d > 0}
    # the joint before a whole hand may be named after it: a gripper's own stands on a palm, which carries more, or
    # behind a tool's frame
    named = (_FINGER, _GRIPPER) if tooled or len(branches) > 1 else (_FINGER,)
    texts = {joint.name: f"{joint.name} {joint.child}".lower() for joint in branches if joint.moves}
    return {name for name, text in texts.items() if depth[name] < before and any(one.search(text) for one in named)}


def _depth(tree: Tree, joint: Joint) -> int:
    return int(joint.moves) + max((_depth(tree, j) for j in tree.below[joint.child]), default=0)


_FARTHEST = 20.0  # m; an arm whose constants add up to more is suspected of millimetres


def read_chain(
    urdf_xml: str, base: str | None = None, tip: str | None = None, recorded: Collection[str] | None = None
) -> Chain:
    """The chain from base to tip link of a URDF; by default from the root to the first of :func:`tips`. recorded: names
    of the joints that were recorded; a default tip is sought behind those only. Raises BadRobot.
    """
    tree = parse(urdf_xml)
    base = tree.root() if base is None else tree.link(base)
    tip = tips(tree, base, recorded)[0] if tip is None else tree.link(tip)
    origins, moving = [np.eye(4)], []
    for joint in tree.path(base, tip):
        origins[-1] = origins[-1] @ joint.T_parent_joint
        if not joint.moves:
            continue
        if joint.kind not in TURNS:
            said = f"is {joint.kind}, which a chain cannot hold"
            raise BadRobot(f"joint {joint.name}", said, "give another --base or --tip")
        if not joint.lower <= joint.upper:
            raise BadRobot(f"joint {joint.name}", f"its limits run from {joint.lower:g} to {joint.upper:g}", FIX)
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
    long = float(np.linalg.norm(chain.origins[1:, :3, 3], axis=1).sum())
    if chain.revolute.any() and long > _FARTHEST:
        said = f"its links add up to {long:.0f} m, {_FARTHEST:g} m is the limit: it looks like millimetres"
        raise BadRobot(f"robot '{tree.name}'", said, "give <origin xyz> in metres")
    return replace(chain, links=tuple(joint.parent for joint in moving), follows=tuple(_follows(tree, moving)))


def _follows(tree: Tree, moving: Sequence[Joint]) -> Iterator[Follower]:
    """Which of these joints follow another one. Raises BadRobot where nothing leads it."""
    joints = {joint.name: joint for joint in tree.joints}
    for k, joint in enumerate(moving):
        leader, factor, offset, met = joint, 1.0, 0.0, set[str]()
        while leader.mimics is not None:  # of one that mimics itself, the first one leads
            factor, offset = factor * leader.mimic_factor, offset + factor * leader.mimic_offset
            if leader.mimics not in joints or leader.name in met:
                raise BadRobot(f"joint {joint.name}", f"mimics {leader.mimics}, which leads nothing", FIX)
            met.add(leader.name)
            leader = joints[leader.mimics]
        if leader is not joint:
            yield Follower(k, leader.name, factor, offset)


def other_tips(urdf_xml: str, base: str, recorded: Collection[str] | None = None) -> tuple[str, ...]:
    """Tips of other arms of as many joints, which :func:`read_chain` passes over where no tip is given."""
    return tips(parse(urdf_xml), base, recorded)[1]


def read_path(urdf_xml: str, base: str, tip: str) -> tuple[tuple[str, ...], ...]:
    """For each constant M_k of the chain from base to tip the URDF joints whose origins make it up, in order: fixed but
    for the last of segment k < n, which is joint k + 1. Raises BadRobot.
    """
    tree = parse(urdf_xml)
    segments: list[list[str]] = [[]]
    for joint in tree.path(tree.link(base), tree.link(tip)):
        segments[-1].append(joint.name)
        if joint.moves:
            segments.append([])
    return tuple(tuple(s) for s in segments)


def joint_origins(urdf_xml: str) -> dict[str, Array]:
    """``T_parent_joint`` (4, 4) [m] of every joint of a URDF, by its name. Raises BadRobot."""
    return {joint.name: joint.T_parent_joint for joint in parse(urdf_xml).joints}
