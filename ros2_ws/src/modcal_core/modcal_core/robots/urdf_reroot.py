"""The same robot hung up at another of its links, so that a chain may go from the tip of one arm to that of another.

A joint on the way from the root to that link is turned round: where its child was at O R(a, q) in its parent, the
parent is at R(−a, q) O⁻¹ in its child. A joint's origin stands before its motion, so O⁻¹ is a fixed joint of its own,
behind a link <joint>_frame.
"""

from __future__ import annotations

import numpy as np
from lxml import etree

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf_tree import Joint, document, parse

_REPLACED = ("origin", "axis", "parent", "child")


def rerooted(urdf_xml: str, link: str) -> str:
    """The URDF text with this link as its root; every two links stand to each other as before, at the same joint
    positions. Comments are lost. The text as it is where the link is its root. Raises BadRobot.
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
            _put(element, back, joint.child, joint.parent)
            continue
        frame = _free(f"{joint.name}_frame", taken)
        root.append(etree.Element("link", name=frame))
        _put(element, np.eye(4), joint.child, frame)
        etree.SubElement(element, "axis", xyz=_text(-_axis(joint)))
        fixed = etree.SubElement(root, "joint", name=_free(f"{joint.name}_origin", taken), type="fixed")
        _put(fixed, back, frame, joint.parent)
    return str(etree.tostring(root, encoding="unicode"))


def _axis(joint: Joint) -> Array:
    return np.asarray(joint.axis, dtype=float)


def _put(element: etree._Element, T: Array, parent: str, child: str) -> None:
    """Origin, parent and child of a joint."""
    etree.SubElement(element, "origin", xyz=_text(T[:3, 3]), rpy=_text(so3.to_rpy(T[:3, :3])))
    etree.SubElement(element, "parent", link=parent)
    etree.SubElement(element, "child", link=child)


def _free(name: str, taken: set[str]) -> str:
    """The name, with strokes behind it where it is taken; taken from now on."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _text(values: Array) -> str:
    return " ".join(repr(float(v) + 0.0) for v in values)
