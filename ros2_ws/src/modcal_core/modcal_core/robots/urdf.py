"""Reading a chain from a URDF, through the parser that ROS itself uses.

Fixed joints are folded into the constants of the moving joints; everything off the path from base to tip is left out of
the chain, but its mass is carried by the joint that moves it.
"""

from __future__ import annotations

import contextlib
import difflib
import io
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from lxml import etree
from urdf_parser_py.urdf import URDF
from urdf_parser_py.xml_reflection.core import ParseError

from modcal_core.errors import BadRobot
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain

_TOOL_NAMES = ("tool0", "_tcp", "tcp", "ee", "flange")
_FINGER_JOINTS = 4  # a branch with more is an arm
_FARTHEST = 20.0  # m; a revolute arm with a longer reach is suspected of millimetres
_MOVING = {"revolute": True, "continuous": True, "prismatic": False}


@dataclass(frozen=True)
class UrdfPath:
    """The joints between base and tip. segments: for each constant M_k of the chain, the names of the URDF joints whose
    origins make it up, in order; the last of segment k < n is the moving joint k + 1.
    """

    base: str
    tip: str
    segments: tuple[tuple[str, ...], ...]


def read_chain(
    urdf_xml: str, base: str | None = None, tip: str | None = None, recorded: Collection[str] | None = None
) -> Chain:
    """The chain from base to tip link of a URDF.

    base: default the root link. tip: default the link behind most moving joints, a tool's usual name breaking ties.
    recorded: names of the joints that were recorded; a default tip is sought behind those only. Raises BadRobot.
    """
    robot = _parse(urdf_xml)
    base = _root(robot) if base is None else _link(robot, base)
    tip = _default_tip(robot, base, recorded) if tip is None else _link(robot, tip)
    origins, axes, revolute, lower, upper, names = [np.eye(4)], [], [], [], [], []
    for joint in _path(robot, base, tip):
        origins[-1] = origins[-1] @ _origin(joint)
        if joint.type == "fixed":
            continue
        if joint.type not in _MOVING:
            raise BadRobot(
                f"joint {joint.name}", f"type {joint.type} cannot be in a chain", "choose another base or tip"
            )
        if joint.mimic is not None:
            raise BadRobot(f"joint {joint.name}", f"mimics {joint.mimic.joint}", "choose another base or tip")
        limit = joint.limit if joint.type != "continuous" else None
        names.append(joint.name)
        axes.append(_axis(joint))
        revolute.append(_MOVING[joint.type])
        lower.append(-np.inf if limit is None or limit.lower is None else float(limit.lower))
        upper.append(np.inf if limit is None or limit.upper is None else float(limit.upper))
        if lower[-1] >= upper[-1]:
            lower[-1], upper[-1] = -np.inf, np.inf
        origins.append(np.eye(4))
    chain = Chain.build(names, origins, axes, revolute, lower, upper, base, tip)
    if chain.reach() > _FARTHEST and chain.revolute.all():
        said = f"reaches {chain.reach():.0f} m, {_FARTHEST:g} m is the limit: it looks like millimetres"
        raise BadRobot(f"robot '{robot.name}'", said, "give <origin xyz> in metres")
    return chain


def read_path(urdf_xml: str, base: str, tip: str) -> UrdfPath:
    """Which URDF joints make up each constant of the chain from base to tip."""
    robot = _parse(urdf_xml)
    segments: list[list[str]] = [[]]
    for joint in _path(robot, _link(robot, base), _link(robot, tip)):
        segments[-1].append(joint.name)
        if joint.type != "fixed":
            segments.append([])
    return UrdfPath(base, tip, tuple(tuple(s) for s in segments))


def joint_origins(urdf_xml: str) -> dict[str, Array]:
    """``T_parent_joint`` (4, 4) of every joint of a URDF [m]."""
    return {joint.name: _origin(joint) for joint in _parse(urdf_xml).joints}


def _parse(urdf_xml: str) -> Any:
    try:
        root = etree.fromstring(urdf_xml.encode(), etree.XMLParser(encoding="utf-8", remove_comments=True))
    except etree.XMLSyntaxError as error:
        raise BadRobot("robot description", f"is not XML ({error.msg})", "give a URDF file") from error
    if root.tag != "robot":
        raise BadRobot("robot description", f"is <{root.tag}>, not <robot>", "give a URDF file")
    if any(isinstance(e.tag, str) and "xacro" in e.tag for e in root.iter()):
        raise BadRobot("robot description", "holds xacro commands", "expand it first: xacro FILE > robot.urdf")
    # what simulators and drivers add is not ours to read, and the parser speaks of it on stderr
    for element in list(root):
        if element.tag not in ("link", "joint"):
            root.remove(element)
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        try:
            robot = URDF.from_xml_string(etree.tostring(root))
        except (ParseError, AssertionError, KeyError, ValueError, TypeError, AttributeError) as error:
            said = " ".join(str(error).split()) or type(error).__name__
            raise BadRobot("robot description", f"is not a URDF ({said})", "check it with check_urdf") from error
    return robot


def _root(robot: Any) -> str:
    children = {joint.child for joint in robot.joints}
    roots = [link.name for link in robot.links if link.name not in children]
    if len(roots) != 1:
        raise BadRobot(
            "robot description", f"has {len(roots)} root links", "connect its links to one tree, or give --base"
        )
    return str(roots[0])


def _link(robot: Any, name: str) -> str:
    names = [link.name for link in robot.links]
    if name not in names:
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.3) or names[:5]
        raise BadRobot(f"link '{name}'", "is not in the robot description", f"choose one such as {', '.join(close)}")
    return name


def _path(robot: Any, base: str, tip: str) -> list[Any]:
    parent = {joint.child: joint for joint in robot.joints}
    path: list[Any] = []
    link = tip
    while link != base:
        if link not in parent or len(path) > len(robot.joints):
            raise BadRobot(f"link '{tip}'", f"is not behind link '{base}'", "give --base and --tip of one arm")
        path.append(parent[link])
        link = parent[link].parent
    return path[::-1]


def _leaves(robot: Any, base: str) -> Iterator[tuple[str, list[Any]]]:
    parents = {joint.parent for joint in robot.joints}
    for link in robot.links:
        if link.name not in parents and link.name != base:
            with contextlib.suppress(BadRobot):
                yield link.name, _path(robot, base, link.name)


def _default_tip(robot: Any, base: str, recorded: Collection[str] | None) -> str:
    """The end of the longest arm; fingers are not part of it.

    Of arms whose joints were all recorded the longest is taken; where there is none, the longest at all, so that the
    joints that are missing can be named.
    """
    best: tuple[tuple[bool, int, int, int], str] | None = None
    for _, path in _leaves(robot, base):
        arm = path
        for i, joint in enumerate(path):
            if joint.type != "fixed" and (joint.type not in _MOVING or joint.mimic or _opens_gripper(robot, joint)):
                arm = path[:i]
                break
        moving = [joint.name for joint in arm if joint.type != "fixed"]
        if not moving:
            continue
        tip = arm[-1].child
        known = recorded is None or set(moving) <= set(recorded)
        named = max((len(_TOOL_NAMES) - i for i, name in enumerate(_TOOL_NAMES) if tip.endswith(name)), default=0)
        rank = (known, len(moving), named, len(arm))
        if best is None or rank > best[0]:
            best = (rank, tip)
    if best is None:
        raise BadRobot(f"link '{base}'", "no moving joint behind it", "give the --base of an arm")
    return best[1]


def _opens_gripper(robot: Any, joint: Any) -> bool:
    """Whether a moving joint begins a finger: one of several short moving branches at the same link."""
    children: dict[str, list[Any]] = {}
    for j in robot.joints:
        children.setdefault(j.parent, []).append(j)

    def depth(j: Any) -> int:
        return (j.type != "fixed") + max((depth(c) for c in children.get(j.child, [])), default=0)

    moving = [d for d in map(depth, children[joint.parent]) if d > 0]
    return len(moving) > 1 and max(moving) <= _FINGER_JOINTS


def _numbers(values: Any, count: int, what: str) -> Array:
    try:
        out = np.array([float(v) for v in values])
    except (TypeError, ValueError):
        out = np.empty(0)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise BadRobot(what, f"needs {count} finite numbers", "correct the URDF")
    return out


def _origin(joint: Any) -> Array:
    if joint.origin is None:
        return np.eye(4)
    xyz = _numbers(joint.origin.xyz or (0, 0, 0), 3, f"joint {joint.name}: <origin xyz>")
    rpy = _numbers(joint.origin.rpy or (0, 0, 0), 3, f"joint {joint.name}: <origin rpy>")
    return se3.transform(so3.from_rpy(rpy), xyz)


def _axis(joint: Any) -> Array:
    return np.array([1.0, 0.0, 0.0]) if joint.axis is None else _numbers(joint.axis, 3, f"joint {joint.name}: <axis>")
