"""Writing corrected origins back into a URDF, and nothing else.

People keep comments, order and spacing in these files, and tools keep hashes of them, so the text is not parsed and
printed again. A real XML parser says where an ``<origin>`` stands; the values of its ``xyz`` and ``rpy`` are put over
the old ones, and every other character stays.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree as ET
from xml.parsers import expat

import numpy as np
from lxml import etree

from modcal_core.errors import BadRobot, NotRepresentable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import joint_origins, read_path
from modcal_core.robots.urdf_tree import document, parse

_SAME = 1e-15  # a constant that differs by less was not corrected
# An attribute inside a start tag that is known to be well formed: its name, its quote, its value.
_ATTRIBUTE = re.compile(rb"""([^\s=<>"'/]+)\s*=\s*("|')(.*?)\2""", re.DOTALL)


def calibrated_urdf(urdf_xml: str, nominal: Chain, calibrated: Chain) -> str:
    """The URDF in which the moving joints' origins give the calibrated chain; reloading it gives the same kinematics.

    nominal: the chain as read from this URDF. The constant before a joint changes through that joint's own origin. What
    comes after the last joint belongs to the tool; where it changed, the last fixed joint before the tip takes it, and
    NotRepresentable is raised if there is none. Raises BadRobot when the chain is not of this URDF.
    """
    segments = read_path(urdf_xml, nominal.base, nominal.tip)
    moving = tuple(segment[-1] for segment in segments[:-1])
    if not moving == nominal.names == calibrated.names:
        said = f"moves by {', '.join(moving)} and not by {', '.join(calibrated.names)}"
        raise BadRobot(f"robot from {nominal.base} to {nominal.tip}", said, "give the URDF the chain came from")
    old = joint_origins(urdf_xml)
    new: dict[str, Array] = {}
    for k, segment in enumerate(segments):
        if np.abs(nominal.origins[k] - calibrated.origins[k]).max() <= _SAME:
            continue
        if not segment:
            said = f"no fixed joint lies between joint {nominal.names[-1]} and it to absorb the change"
            raise NotRepresentable(f"link '{nominal.tip}'", said, "keep the change in the tool")
        before = np.eye(4)
        for name in segment[:-1]:
            before = before @ old[name]
        new[segment[-1]] = se3.inverse(before) @ calibrated.origins[k]
    return write_origins(urdf_xml, new)


def write_origins(urdf_xml: str, origins: Mapping[str, Array]) -> str:
    """The same text with the origins (4, 4) [m] of the named joints put in; a value that already says the same is kept
    as it is written. Raises BadRobot for a joint that the URDF does not have.
    """
    raw = urdf_xml.encode("utf-8", errors="surrogatepass")
    places = _find_joints(raw)
    edits: list[tuple[int, int, bytes]] = []
    for name, T in origins.items():
        if name not in places:
            raise BadRobot(f"joint '{name}'", "is not in the robot description", "write into the URDF it came from")
        edits += _edits(raw, places[name], np.asarray(T, dtype=float))
    for start, end, new in sorted(edits, reverse=True):
        raw = raw[:start] + new + raw[end:]
    return raw.decode("utf-8", errors="surrogatepass")


@dataclass
class _OriginSpan:
    """Where things stand in the bytes of one joint: the end of its start tag, and its origin's start tag."""

    inside: int
    origin: tuple[int, int] | None = None


def _edits(raw: bytes, place: _OriginSpan, T: Array) -> list[tuple[int, int, bytes]]:
    """Replacements (from, to, new bytes) that give one joint its origin."""
    values = {b"xyz": _numbers(T[:3, 3]).encode(), b"rpy": _numbers(so3.to_rpy(T[:3, :3])).encode()}
    if place.origin is None:
        if np.array_equal(T, np.eye(4)):
            return []
        # set off from the start tag as the next child is
        space = re.compile(rb"\s*").match(raw, place.inside)
        indent = space.group() if space else b""
        element = b'<origin xyz="%s" rpy="%s"/>' % (values[b"xyz"], values[b"rpy"])
        return [(place.inside, place.inside, indent + element)]
    start, end = place.origin
    edits = []
    for attribute in _ATTRIBUTE.finditer(raw, start, end):
        key = attribute.group(1)
        if key in values:
            new = values.pop(key)
            if not _says(key, attribute.group(3), T):
                edits.append((attribute.start(3), attribute.end(3), new))
    behind_tag = start + len(b"<origin")
    nothing = np.zeros(3), np.eye(3)  # what a missing attribute stands for
    for key, new in values.items():
        if not np.array_equal(T[:3, 3] if key == b"xyz" else T[:3, :3], nothing[key == b"rpy"]):
            edits.append((behind_tag, behind_tag, b' %s="%s"' % (key, new)))
    return edits


def _says(key: bytes, text: bytes, T: Array) -> bool:
    """Whether an attribute's text already gives this value, to the last bit."""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:  # written through an entity
        return False
    if numbers.shape != (3,):
        return False
    return np.array_equal(numbers, T[:3, 3]) if key == b"xyz" else np.array_equal(so3.from_rpy(numbers), T[:3, :3])


def _find_joints(raw: bytes) -> dict[str, _OriginSpan]:
    """The place of every joint of the robot, by its name."""
    # what stands before the XML declaration is against the rules but common; ROS's parsers pass over it
    skip = len(raw) - len(raw.removeprefix(b"\xef\xbb\xbf").lstrip())
    parser = expat.ParserCreate("utf-8")
    stack: list[str] = []
    places: dict[str, _OriginSpan] = {}
    joint = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal joint
        at = skip + parser.CurrentByteIndex
        if tag == "joint" and stack == ["robot"]:
            joint = attributes.get("name", "")
            places[joint] = _OriginSpan(_end_of_tag(raw, at))
        elif tag == "origin" and stack == ["robot", "joint"] and places[joint].origin is None:
            places[joint].origin = (at, _end_of_tag(raw, at))
        stack.append(tag)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(raw[skip:], True)
    except expat.ExpatError as error:
        raise BadRobot("robot description", f"is not XML ({error})", "give a URDF file") from error
    return places


def _end_of_tag(raw: bytes, start: int) -> int:
    """Index behind the ``>`` of the tag that starts here; one inside an attribute's quotes does not count."""
    for match in re.compile(rb""""[^"]*"|'[^']*'|(>)""").finditer(raw, start):
        if match.group(1):
            return match.end()
    return len(raw)


# --- Pieces of a URDF that is made from nothing: joints, origins, numbers; and a bare chain as a whole


def chain_urdf(chain: Chain, name: str = "arm") -> str:
    """The URDF text of a chain: links without bodies, moving joints, whose torques and speeds stand as 0, and a fixed
    one to the tip. Reading it gives the same kinematics, names and limits.
    """
    robot = ET.Element("robot", name=name)
    taken = {chain.base, chain.tip}
    above = chain.base
    added(robot, "link", name=above)
    for k, joint in enumerate(chain.names):
        link = _free(f"{joint}_link", taken)
        limited = bool(np.isfinite([chain.lower[k], chain.upper[k]]).all())
        kind = "prismatic" if not chain.revolute[k] else "revolute" if limited else "continuous"
        element = joint_element(robot, joint, kind, above, link, chain.origins[k])
        added(element, "axis", xyz=_numbers(chain.axes[k]))
        ends = {"lower": number(chain.lower[k]), "upper": number(chain.upper[k])} if limited else {}
        added(element, "limit", **ends, effort="0.0", velocity="0.0")  # a reader must find both; 0: nobody knows
        added(robot, "link", name=link)
        above = link
    joint_element(robot, f"to_{chain.tip}", "fixed", above, chain.tip, chain.origins[-1])
    added(robot, "link", name=chain.tip)
    return urdf_text(robot)


def added(parent: Any, tag: str, **attributes: str) -> Any:
    """A new element with these attributes, the last of its parent, which is of xml.etree or of lxml."""
    element = parent.makeelement(tag, attributes)
    parent.append(element)
    return element


def joint_element(robot: Any, name: str, kind: str, parent: str, child: str, T: Array) -> Any:
    """A joint of this kind between two links, added to the robot."""
    joint = added(robot, "joint", name=name, type=kind)
    _place(joint, parent, child, T)
    return joint


def _place(joint: Any, parent: str, child: str, T: Array) -> None:
    origin_element(joint, T)
    added(joint, "parent", link=parent)
    added(joint, "child", link=child)


def origin_element(element: Any, T: Array) -> None:
    """An origin at T (4, 4) [m], added to the element."""
    added(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(so3.to_rpy(T[:3, :3])))


def _free(name: str, taken: set[str]) -> str:
    """The name, with strokes behind it where it is taken; taken from now on."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def urdf_text(robot: ET.Element) -> str:
    """The text of a whole robot."""
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def number(value: float) -> str:
    """A number with every digit, and no −0."""
    return repr(float(value) + 0.0)


# --- The same robot hung up at another of its links, so that a chain may go from one arm's tip to another's

_REPLACED = ("origin", "axis", "parent", "child")


def rerooted(urdf_xml: str, link: str) -> str:
    """The URDF text with this link as its root; every two links stand to each other as before, at the same joint
    positions. Comments are lost. The text as it is where the link is its root. Raises BadRobot.

    A joint on the way from the root to that link is turned round: where its child was at O R(a, q) in its parent, the
    parent is at R(−a, q) O⁻¹ in its child. A joint's origin stands before its motion, so O⁻¹ is a fixed joint of its
    own, behind a link <joint>_frame.
    """
    tree = parse(urdf_xml)
    path = tree.path(tree.root(), tree.link(link))
    if not path:
        return urdf_xml
    root = document(urdf_xml)
    taken = {*tree.links, *(joint.name for joint in tree.joints)}
    for joint in path:
        element = next(e for e in root if e.tag == "joint" and e.get("name") == joint.name)
        for part in [e for e in element if e.tag in _REPLACED]:
            element.remove(part)
        back = se3.inverse(joint.T_parent_joint)
        if not joint.moves:
            _place(element, joint.child, joint.parent, back)
            continue
        frame = _free(f"{joint.name}_frame", taken)
        added(root, "link", name=frame)
        _place(element, joint.child, frame, np.eye(4))
        added(element, "axis", xyz=_numbers(-joint.axis))
        joint_element(root, _free(f"{joint.name}_origin", taken), "fixed", frame, joint.parent, back)
    return str(etree.tostring(root, encoding="unicode"))


# --- A robot's joint origins as a file that xacro includes, for descriptions that are written in xacro

_NAME = "calibrated"
# what may stand in a Python text in single quotes, in XML, inside xacro's ${…}
_WRITABLE = re.compile(r"[\w.:/ -]+")


def xacro_origins(origins: Mapping[str, Array], notes: Sequence[str] = ()) -> str:
    """The text of a xacro file with one property, ``calibrated``, that holds xyz [m] and rpy [rad] by joint name.

    origins: ``T_parent_joint`` (4, 4). A description that includes the file writes
    ``<origin xyz="${calibrated['JOINT']['xyz']}" rpy="${calibrated['JOINT']['rpy']}"/>``; numbers keep every digit.
    notes become comments. Raises NotRepresentable for a joint whose name cannot stand in a xacro expression.

    xacro ends an expression at its first closing brace, so the mapping is written by calls of ``dict``.
    """
    odd = next((name for name in origins if not _WRITABLE.fullmatch(name)), None)
    if odd is not None:
        raise NotRepresentable(f"joint '{odd}'", "has a name that no xacro expression holds", "use the URDF itself")
    rows = [
        f"      ('{name}', dict(xyz='{_numbers(T[:3, 3])}', rpy='{_numbers(so3.to_rpy(T[:3, :3]))}'))"
        for name, T in origins.items()
    ]
    listed = ",\n".join(rows)
    comments = "".join(f"  <!-- {note.replace('--', '—')} -->\n" for note in notes)
    return (
        '<?xml version="1.0"?>\n'
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
        f"{comments}"
        f'  <xacro:property name="{_NAME}" value="${{dict([\n{listed}\n    ])}}"/>\n'
        "</robot>\n"
    )


def ros2_control_offsets(offsets: Mapping[str, float], notes: Sequence[str] = ()) -> str:
    """The text of ros2_control's transmissions with these offsets [rad or m] by joint, which are added to positions of
    the actuator. notes become comments.
    """
    robot = ET.Element("ros2_control")
    for note in notes:
        robot.append(ET.Comment(f" {note.replace('--', '—')} "))
    for name, offset in offsets.items():
        transmission = added(robot, "transmission", name=f"{name}_transmission")
        added(transmission, "plugin").text = "transmission_interface/SimpleTransmission"
        added(transmission, "actuator", name=f"{name}_actuator", role="actuator1")
        joint = added(transmission, "joint", name=name, role="joint1")
        added(joint, "mechanical_reduction").text = "1.0"
        added(joint, "offset").text = number(offset)
    return urdf_text(robot)


def _numbers(values: Array) -> str:
    return " ".join(map(number, values))
