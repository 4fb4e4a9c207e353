"""The links and joints of a URDF, checked, as plain values.

Only what kinematics and gravity need is read: what simulators, drivers and meshes add cannot break the reading. Of what
may stand once, the first counts.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from lxml import etree

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3, sealed, so3

# Moving joints that a chain may hold: True where the joint turns.
TURNS = {"revolute": True, "continuous": True, "prismatic": False}
FIX = "correct the URDF"
_WHOLE = "robot description"
_NO_XML = "give a URDF file; modcal import TABLE --out arm.urdf makes one of a DH or CPC table"
_ONE_ROBOT = "describe one robot, with meshes in files of their own"
_MAX_TURN = 4.0 * np.pi  # rad; an <origin rpy> beyond this was meant in degrees

# What is larger is no robot, and would hold up a node, or Python's stack, while it is read.
_MAX_TEXT = 5_000_000  # characters
_MAX_JOINTS, _DEEPEST = 2000, 250  # joints, in all and in a row

_KINDS = (*TURNS, "fixed", "floating", "planar")
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class Joint:
    """One joint. T_parent_joint (4, 4) [m]; axis (3,) as written; limits [rad or m]; ``mimic_offset`` is its position
    while the joint that it mimics stands at zero, ``mimic_factor`` what it moves by per unit of that. drive: what is
    written of effort, velocity, friction and damping, which only those read who need it.
    """

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Array
    axis: Array
    lower: float
    upper: float
    mimics: str | None
    mimic_offset: float
    mimic_factor: float = 1.0
    drive: Mapping[str, str] = field(default_factory=dict)

    @property
    def moves(self) -> bool:
        """Whether it is anything but fixed."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Inertial:
    """What a link weighs: mass [kg], centre (3,) [m], and inertia (3, 3) [kg m²] about the centre, in its link."""

    mass: float
    centre: Array
    inertia: Array


@dataclass(frozen=True)
class Tree:
    """Links and joints of one robot, connected and free of doubles. notes: a sentence for each thing that it lacks."""

    name: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    inertials: Mapping[str, Inertial]
    notes: tuple[str, ...] = ()

    @cached_property
    def above(self) -> dict[str, Joint]:
        """The joint that carries each link but the roots."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def below(self) -> dict[str, list[Joint]]:
        """The joints that each link carries."""
        return {link: [j for j in self.joints if j.parent == link] for link in self.links}

    def root(self) -> str:
        """The one link that no joint carries. Raises BadRobot when there is none, or more than one."""
        roots = [link for link in self.links if link not in self.above]
        if len(roots) != 1:
            said = f"has {len(roots)} root links" + (f" ({', '.join(roots[:4])})" if roots else "")
            raise BadRobot(_WHOLE, said, "connect its links to one tree, or give --base")
        return roots[0]

    def joint(self, name: str) -> Joint:
        """The joint of this name. Raises BadRobot."""
        found = next((joint for joint in self.joints if joint.name == name), None)
        if found is None:
            raise BadRobot(f"joint {name}", f"is not in robot '{self.name}'", "give the URDF the chain came from")
        return found

    def link(self, name: str) -> str:
        """The name, if there is such a link. Raises BadRobot, with the names that come closest."""
        if name not in self.links:
            close = ", ".join(difflib.get_close_matches(name, self.links, n=3, cutoff=0.3) or self.links[:5])
            raise BadRobot(f"link '{name}'", "is not in the robot description", f"choose one such as {close}")
        return name

    def path(self, base: str, tip: str) -> list[Joint]:
        """The joints from base to tip. Raises BadRobot when the tip is not carried by the base."""
        path: list[Joint] = []
        link = tip
        while link != base:
            if link not in self.above or len(path) > len(self.joints):
                raise BadRobot(f"link '{tip}'", f"is not behind link '{base}'", "give --base and --tip of one arm")
            path.append(self.above[link])
            link = path[-1].parent
        return path[::-1]


@lru_cache(maxsize=2)  # chain, tips and masses are asked for one after the other
def parse(urdf_xml: str) -> Tree:
    """The checked tree of a URDF text, its arrays read-only. Raises BadRobot for anything that is not one."""
    root = document(urdf_xml)
    for tag in ("link", "joint"):
        if (count := sum(_local(child) == tag for child in root)) > _MAX_JOINTS:
            raise BadRobot(_WHOLE, f"has {count} {tag}s, {_MAX_JOINTS} is the limit", _ONE_ROBOT)
    name, version = _required(root, "name", _WHOLE), root.get("version") or "1.0"
    if version != "1.0":
        raise BadRobot(_WHOLE, f"is of version {version}, only 1.0 is supported", FIX)
    joints = tuple(_joint(e) for e in root if _local(e) == "joint")
    links = tuple((_required(e, "name", _WHOLE), _child(e, "inertial")) for e in root if _local(e) == "link")
    bodies = {link: _inertial(own, link) for link, own in links if own is not None}
    inertials = {link: own for link, own in bodies.items() if own is not None}
    bare = (link for link, own in bodies.items() if own is None)
    notes = [f"Link {link} has an <inertial> without mass: it weighs nothing." for link in bare]
    notes += [f"Joint {j.name} has limits from {j.lower:g} to {j.upper:g}." for j in joints if not j.lower <= j.upper]
    tree = sealed(Tree(name, tuple(link for link, _ in links), joints, inertials, tuple(notes)))
    _check(tree)
    return tree


def document(urdf_xml: str) -> Any:
    """The root element of a URDF text, whatever it holds. Raises BadRobot for what is not XML, no URDF, or xacro."""
    if len(urdf_xml) > _MAX_TEXT:
        said = f"has {1e-6 * len(urdf_xml):.0f} million characters, {1e-6 * _MAX_TEXT:.0f} million is the limit"
        raise BadRobot(_WHOLE, said, _ONE_ROBOT)
    text = urdf_xml.lstrip("\ufeff \t\r\n")
    if not text:
        raise BadRobot(_WHOLE, "is not XML (it is empty)", "give a URDF file")
    try:
        root = _element(text.encode("utf-8", errors="replace"))
    except (etree.XMLSyntaxError, ValueError) as error:
        if "<xacro:" in text:
            raise _unexpanded() from error
        said = getattr(error, "msg", None) or str(error)
        remedy = "give a URDF file" if text.startswith("<") else _NO_XML
        raise BadRobot(_WHOLE, f"is not XML ({said})", remedy) from error
    if _local(root) != "robot":
        raise BadRobot(_WHOLE, f"is <{_local(root)}>, not <robot>", "give a URDF file")
    if any(isinstance(e.tag, str) and "xacro" in (e.prefix, *re.split("[}/:]", e.tag)[:-1]) for e in root.iter()):
        raise _unexpanded()
    return root


def _element(text: bytes) -> Any:
    """The root element. Elements whose prefix is not declared are passed over, as the parsers of ROS do."""
    # A declared encoding was true of the bytes; this is text already. Outside entities are nobody's business here.
    parser = etree.XMLParser(encoding="utf-8", resolve_entities=False, remove_comments=True, recover=True)
    root = etree.fromstring(text, parser)
    faults = [e for e in parser.error_log if e.domain != etree.ErrorDomains.NAMESPACE]
    if faults:
        raise ValueError(f"{faults[0].message}, line {faults[0].line}, column {faults[0].column}")
    return root


def _unexpanded() -> BadRobot:
    return BadRobot(_WHOLE, "holds xacro commands", "expand it first: xacro FILE > robot.urdf")


def _local(element: Any) -> str:
    """The name of an element; one with a prefix is somebody else's and has none."""
    if not isinstance(element.tag, str) or element.prefix is not None or ":" in element.tag.rpartition("}")[2]:
        return ""
    return str(etree.QName(element).localname)


def _child(element: Any, tag: str) -> Any:
    """The first child of this name; None where there is none."""
    return next((child for child in element if _local(child) == tag), None)


def _required(element: Any, key: str, what: str) -> str:
    """An attribute that must be there; what: the element's owner, in a refusal."""
    if not element.get(key):
        raise BadRobot(f"{what}: <{_local(element)}>", f"has no {key}", FIX)
    return str(element.get(key))


def _numbers(element: Any, key: str, default: Sequence[float], what: str, finite: bool = True) -> Array:
    """The numbers in an attribute, as many as in the default, which counts where it is missing."""
    text = None if element is None else element.get(key)
    if not text:
        return np.array(default, dtype=float)
    what = f"{what} <{_local(element)} {key}>"
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        if "${" in text or "$(" in text:
            raise _unexpanded() from error
        raise BadRobot(what, f"'{text}' holds what is not a number", FIX) from error
    if len(values) != len(default) or (finite and not np.isfinite(values).all()):
        raise BadRobot(what, f"needs {len(default)} finite number{'s' * (len(default) > 1)}", FIX)
    return values


def _joint(element: Any) -> Joint:
    name, kind = _required(element, "name", _WHOLE), element.get("type")
    what = f"joint {name}"
    if kind not in _KINDS:
        raise BadRobot(what, f"Invalid joint type: {kind}", f"choose {', '.join(_KINDS)}")
    ends = []
    for tag in ("parent", "child"):
        if (end := _child(element, tag)) is None:
            raise BadRobot(what, f"has no <{tag}>", FIX)
        ends.append(_required(end, "link", what))
    limit, mimic = _child(element, "limit"), _child(element, "mimic")
    parts = limit, _child(element, "dynamics")
    drive = {key: text for part in parts if part is not None for key, text in part.items()}
    lower, upper = -np.inf, np.inf
    if kind != "continuous" and limit is not None and (limit.get("lower") or limit.get("upper")):
        lower, upper = (float(_numbers(limit, key, [0.0], f"{what}:", False)[0]) for key in ("lower", "upper"))
    axis = _child(element, "axis") if kind != "fixed" else None
    if axis is not None:
        _required(axis, "xyz", what)
    return Joint(
        name=name,
        kind=kind,
        parent=ends[0],
        child=ends[1],
        T_parent_joint=_origin(_child(element, "origin"), f"{what}:"),
        axis=_numbers(axis, "xyz", (1.0, 0.0, 0.0), f"{what}:"),
        lower=lower,
        upper=upper,
        mimics=None if mimic is None else _required(mimic, "joint", what),
        mimic_offset=float(_numbers(mimic, "offset", [0.0], f"{what}:")[0]),
        mimic_factor=float(_numbers(mimic, "multiplier", [1.0], f"{what}:")[0]),
        drive=drive,
    )


def _inertial(element: Any, link: str) -> Inertial | None:
    """What an <inertial> says; None where its mass has no value."""
    what, mass = f"link {link}: <inertial>", _child(element, "mass")
    if mass is None or not mass.get("value"):
        return None
    weight = float(_numbers(mass, "value", [0.0], what)[0])
    if weight < 0.0:
        raise BadRobot(f"{what} <mass>", f"{weight:g} kg is below 0", FIX)
    T, inertia = _origin(_child(element, "origin"), what), _child(element, "inertia")
    if inertia is not None:
        for key in _INERTIA:
            _required(inertia, key, what)
    xx, xy, xz, yy, yz, zz = (float(_numbers(inertia, key, [0.0], what)[0]) for key in _INERTIA)
    R = T[:3, :3]
    return Inertial(weight, T[:3, 3], R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T)


@dataclass(frozen=True)
class CollisionShape:
    """A shape of a link. kind: box, sphere, cylinder, mesh, as written. T_link_shape: (4, 4) [m]. sizes: as written."""

    kind: str
    T_link_shape: Array
    sizes: Mapping[str, str]


def collision_shapes(urdf_xml: str) -> dict[str, list[CollisionShape]]:
    """The collision shapes of every link that has any. Raises BadRobot."""
    found: dict[str, list[CollisionShape]] = {}
    for link in (e for e in document(urdf_xml) if _local(e) == "link"):
        name = str(link.get("name"))
        for collision in (e for e in link if _local(e) == "collision"):
            geometry = _child(collision, "geometry")
            if geometry is not None and len(geometry):
                T = _origin(_child(collision, "origin"), f"link {name}: <collision>")
                found.setdefault(name, []).append(CollisionShape(_local(geometry[0]), T, dict(geometry[0].attrib)))
    return found


def _origin(element: Any, what: str) -> Array:
    xyz, rpy = (_numbers(element, key, (0.0, 0.0, 0.0), what) for key in ("xyz", "rpy"))
    if np.abs(rpy).max() > _MAX_TURN:
        said = f"{rpy[np.argmax(np.abs(rpy))]:g} rad is beyond {_MAX_TURN:.1f}: it looks like degrees"
        raise BadRobot(f"{what} <origin rpy>", said, "give it in radians")
    return se3.transform(so3.from_rpy(rpy), xyz)


def _check(tree: Tree) -> None:
    for kind, names in (("link", tree.links), ("joint", [joint.name for joint in tree.joints])):
        name, count = Counter(names).most_common(1)[0] if names else ("", 1)
        if count > 1:
            raise BadRobot(f"{kind} '{name}'", f"occurs {count} times in robot '{tree.name}'", "name each once")
    links, carried = set(tree.links), dict[str, str]()
    for joint in tree.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                close = difflib.get_close_matches(link, tree.links, n=1, cutoff=0.3)
                hint = f"add it, or name {close[0]}" if close else "add it"
                raise BadRobot(f"joint {joint.name}", f"names link '{link}', which does not exist", hint)
        if joint.child in carried:
            said = f"is the child of joints {carried[joint.child]} and {joint.name}"
            raise BadRobot(f"link '{joint.child}'", said, "give each link one parent")
        carried[joint.child] = joint.name
    reached, level, depth = set[str](), [link for link in tree.links if link not in carried], 0
    while level:
        reached.update(level)
        level = [joint.child for link in level for joint in tree.below[link]]
        depth += bool(level)
    if looped := next((joint.name for joint in tree.joints if joint.child not in reached), None):
        raise BadRobot(f"joint {looped}", "closes a loop", "give a tree of links")
    if depth > _DEEPEST:  # more than Python's stack should be asked for
        raise BadRobot(_WHOLE, f"has {depth} joints in a row, {_DEEPEST} is the limit", _ONE_ROBOT)
