"""Writing corrected origins back into a URDF, and nothing else.

People keep comments, order and spacing in these files, and tools keep hashes of them, so the text is not parsed and
printed again: the corrected ``<origin .../>`` is put over the old one, byte by byte, where a real XML parser says it
is.
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.parsers import expat

import numpy as np

from modcal_core.errors import BadRobot, NotRepresentable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import joint_origins, read_path

_SAME = 1e-15


def calibrated_urdf(urdf_xml: str, nominal: Chain, calibrated: Chain) -> str:
    """The URDF in which the moving joints' origins give the calibrated chain; reloading it gives the same kinematics.

    The constant before a joint changes through that joint's own origin. What comes after the last joint belongs to the
    tool; where it changed, the last fixed joint before the tip takes it, and NotRepresentable is raised if there is
    none.
    """
    path = read_path(urdf_xml, nominal.base, nominal.tip)
    old = joint_origins(urdf_xml)
    new: dict[str, Array] = {}
    for k, segment in enumerate(path.segments):
        if np.abs(nominal.origins[k] - calibrated.origins[k]).max() <= _SAME:
            continue
        if not segment:
            raise NotRepresentable(
                f"tip '{nominal.tip}'", "no joint of the URDF lies before it to take the change", "keep it in the tool"
            )
        before = np.eye(4)
        for name in segment[:-1]:
            before = before @ old[name]
        new[segment[-1]] = se3.inverse(before) @ calibrated.origins[k]
    return write_origins(urdf_xml, new)


def write_origins(urdf_xml: str, origins: Mapping[str, Array]) -> str:
    """The same text with the origins (4, 4) [m] of the named joints put in; every other byte is kept.

    Raises BadRobot for a joint that the URDF does not have.
    """
    raw = urdf_xml.encode()
    places = _find_origins(raw)
    edits = []
    for name, T in origins.items():
        if name not in places:
            raise BadRobot(f"joint '{name}'", "is not in the robot description", "write into the URDF it came from")
        start, end, indent = places[name]
        element = f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers(so3.to_rpy(T[:3, :3]))}"/>'
        edits.append((start, end, indent + element.encode()))
    for start, end, new in sorted(edits, reverse=True):
        raw = raw[:start] + new + raw[end:]
    return raw.decode()


def _numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def _find_origins(raw: bytes) -> dict[str, tuple[int, int, bytes]]:
    """For each joint, the bytes from and to which its origin stands, and what to put before a new one.

    A joint without an origin gets one just behind its start tag.
    """
    parser = expat.ParserCreate("utf-8")
    stack: list[str] = []
    places: dict[str, tuple[int, int, bytes]] = {}
    joint = ""
    open_origin = -1

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal joint, open_origin
        if tag == "joint" and stack == ["robot"]:
            joint = attributes.get("name", "")
            after = _end_of_tag(raw, parser.CurrentByteIndex)
            if raw[after - 2 : after] != b"/>":
                places[joint] = (after, after, b"\n    ")
        elif tag == "origin" and stack == ["robot", "joint"]:
            open_origin = parser.CurrentByteIndex
        stack.append(tag)

    def end(tag: str) -> None:
        nonlocal open_origin
        stack.pop()
        if tag == "origin" and stack == ["robot", "joint"] and open_origin >= 0:
            after = _end_of_tag(raw, open_origin)
            if raw[after - 2 : after] != b"/>":
                after = _end_of_tag(raw, parser.CurrentByteIndex)
            places[joint] = (open_origin, after, b"")
            open_origin = -1

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        raise BadRobot("robot description", f"is not XML ({error})", "give a URDF file") from error
    return places


def _end_of_tag(raw: bytes, start: int) -> int:
    """Index behind the ``>`` of the tag that starts here; one inside an attribute's quotes does not count."""
    quote = 0
    for i in range(start, len(raw)):
        c = raw[i]
        if quote:
            quote = 0 if c == quote else quote
        elif c in b"\"'":
            quote = c
        elif c == ord(">"):
            return i + 1
    return len(raw)
