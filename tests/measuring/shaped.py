"""Descriptions with collision shapes, which those of the examples have not."""

from __future__ import annotations

import xml.etree.ElementTree as ET


def with_spheres(urdf: str, radius: float = 0.05) -> str:
    """The description with a ball at the origin of every link."""
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        geometry = ET.SubElement(ET.SubElement(link, "collision"), "geometry")
        ET.SubElement(geometry, "sphere", radius=str(radius))
    return ET.tostring(tree, encoding="unicode")
