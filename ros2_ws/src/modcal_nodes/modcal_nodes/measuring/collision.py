"""Whether an arm touches itself or what is around it, by the shapes of its URDF. MuJoCo says so.

Every link is a body with the collision shapes of the description (box, sphere, cylinder and mesh files that are there),
moved by its joint. Neighbours in the tree may touch, and so may pairs that touch in nearly every posture, for they are
drawn that way. Around it are a floor, boxes and spheres.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array
from modcal_core.planning import Site
from modcal_core.robots import document

_ALWAYS = 0.9  # share of random postures from which a pair that touches is drawn touching
_DRAWN = 200  # random postures for that
_FAR = 50.0  # m; half of the floor's and larger than any arm
_TURNING, _SLIDING = ("revolute", "continuous"), ("prismatic",)


@dataclass(frozen=True)
class LinkContact:
    """Two things that touch, by name, and how deep [m]."""

    one: str
    other: str
    depth: float


class CollisionModel:
    """The shapes of one robot at one site. margin: [m] that is kept free."""

    def __init__(self, urdf: str, names: Sequence[str], site: Site, folder: Path | None = None) -> None:
        """names: of the joints, in the order of all postures; other joints stand at zero. folder: where mesh files are
        looked for beside absolute paths. Raises BadRobot for a description without collision shapes, or one whose mesh
        files are not there.
        """
        self.names, self._margin = tuple(names), site.margin
        tree = document(urdf)
        self._xml = _mjcf(tree, site, folder)
        self._load([])
        joints = [self._model.joint(name) for name in self.names]
        self._at = np.array([j.qposadr[0] for j in joints])
        self._allow_what_is_drawn_touching()

    def _load(self, excluded: Sequence[tuple[str, str]]) -> None:
        xml = ET.fromstring(self._xml)
        contact = ET.SubElement(xml, "contact")
        for one, other in excluded:
            ET.SubElement(contact, "exclude", body1=one, body2=other)
        self._model = mujoco.MjModel.from_xml_string(ET.tostring(xml, encoding="unicode"))
        self._data = mujoco.MjData(self._model)

    def _allow_what_is_drawn_touching(self) -> None:
        low, high = self._model.jnt_range[self._at].T if len(self._at) else (np.zeros(0), np.zeros(0))
        low, high = np.where(high > low, low, -np.pi), np.where(high > low, high, np.pi)
        rng = np.random.default_rng(0)  # the same pairs every time
        counts: dict[tuple[str, str], int] = {}
        for q in rng.uniform(low, high, (_DRAWN, len(self.names))):
            for touch in self.touches(q):
                pair = (touch.one, touch.other)
                counts[pair] = counts.get(pair, 0) + 1
        always = [pair for pair, count in counts.items() if count > _ALWAYS * _DRAWN and "world" not in pair]
        if always:
            self._load(always)

    def touches(self, q: Array) -> list[LinkContact]:
        """What touches at a posture (n,), each pair of links once."""
        self._data.qpos[:] = 0.0
        self._data.qpos[self._at] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        found: dict[tuple[str, str], float] = {}
        for k in range(self._data.ncon):
            contact = self._data.contact[k]
            pair = tuple(sorted(self._body(int(g)) for g in (contact.geom1, contact.geom2)))
            depth = self._margin - float(contact.dist)
            found[pair] = max(found.get(pair, -np.inf), depth)  # type: ignore[index,arg-type]
        return [LinkContact(one, other, depth) for (one, other), depth in found.items()]

    def _body(self, geom: int) -> str:
        return str(self._model.body(int(self._model.geom_bodyid[geom])).name)

    def free(self, q: Array) -> np.ndarray:
        """True for postures (N, n) at which nothing touches, (N,)."""
        return np.array([not self.touches(row) for row in q], dtype=bool)


def has_shapes(urdf: str) -> bool:
    """Whether any link of a description has a collision shape."""
    return any(link.find("collision/geometry") is not None for link in document(urdf).iter("link"))


def _mjcf(tree: ET.Element, site: Site, folder: Path | None) -> str:
    links = {str(e.get("name")): e for e in tree.findall("link")}
    if not any(link.find("collision/geometry") is not None for link in links.values()):
        raise BadRobot(
            "robot_description", "has no collision shapes", "give one that has, or allow no_self_collision at your risk"
        )
    joints = tree.findall("joint")
    children: dict[str, list[ET.Element]] = {}
    for joint in joints:
        children.setdefault(_link(joint, "parent"), []).append(joint)
    below = {_link(joint, "child") for joint in joints}
    root = next(name for name in links if name not in below)
    xml = ET.Element("mujoco")
    ET.SubElement(xml, "compiler", angle="radian", autolimits="false")
    assets = ET.SubElement(xml, "asset")
    world = ET.SubElement(xml, "worldbody")
    _surroundings(world, site)
    meshes: dict[str, str] = {}
    body = _body(world, root, np.zeros(3), Rotation.identity())
    waiting = [(root, body)]
    while waiting:
        name, body = waiting.pop()
        for collision in links[name].findall("collision"):
            _shape(body, collision, site.margin, assets, meshes, folder)
        for joint in children.get(name, ()):
            xyz, turn = _origin(joint)
            child = _link(joint, "child")
            inner = _body(body, child, xyz, turn)
            kind = str(joint.get("type"))
            if kind in _TURNING or kind in _SLIDING:
                axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
                limit = joint.find("limit")
                low, high = (float(limit.get(k, 0.0)) if limit is not None else 0.0 for k in ("lower", "upper"))
                ET.SubElement(
                    inner, "joint", name=str(joint.get("name")), axis=_text(axis), limited="false",
                    type="hinge" if kind in _TURNING else "slide", range=f"{low} {high}",
                )  # fmt: skip
            waiting.append((child, inner))
    _leave_out_neighbours(xml, joints, links, root)
    return ET.tostring(xml, encoding="unicode")


def _leave_out_neighbours(
    xml: ET.Element, joints: Sequence[ET.Element], links: Mapping[str, object], root: str
) -> None:
    """Links that meet at a joint, also over links that carry no shape of their own."""
    contact = ET.SubElement(xml, "contact")
    above = {_link(j, "child"): (_link(j, "parent"), str(j.get("type"))) for j in joints}
    pairs = set()
    for name in links:
        parent, fixed = name, True
        while parent in above and fixed:
            parent, kind = above[parent]
            fixed = kind == "fixed" or not _has_shape(links[parent])  # type: ignore[arg-type]
            pairs.add((parent, name))
    for one, other in sorted(pairs):
        ET.SubElement(contact, "exclude", body1=one, body2=other)
    ET.SubElement(contact, "exclude", body1="world", body2=root)


def _has_shape(link: ET.Element) -> bool:
    return link.find("collision/geometry") is not None


def _body(parent: ET.Element, name: str, xyz: Array, turn: Rotation) -> ET.Element:
    body = ET.SubElement(parent, "body", name=name, pos=_text(xyz), quat=_text(np.roll(turn.as_quat(), 1)))
    # MuJoCo wants a mass of whatever moves; nothing is made of it
    ET.SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    return body


def _shape(
    body: ET.Element,
    collision: ET.Element,
    margin: float,
    assets: ET.Element,
    meshes: dict[str, str],
    folder: Path | None,
) -> None:
    xyz, turn = _origin(collision)
    geometry = collision.find("geometry")
    if geometry is None or not len(geometry):
        return
    shape = geometry[0]
    quat = _text(np.roll(turn.as_quat(), 1))
    place: dict[str, Any] = {"pos": _text(xyz), "quat": quat, "margin": _text(np.array([margin]))}
    if shape.tag == "box":
        ET.SubElement(body, "geom", type="box", size=_text(0.5 * _numbers(shape, "size", "0 0 0")), attrib=place)
    elif shape.tag == "sphere":
        ET.SubElement(body, "geom", type="sphere", size=str(shape.get("radius")), attrib=place)
    elif shape.tag in ("cylinder", "capsule"):
        size = f"{shape.get('radius')} {0.5 * float(shape.get('length', 0.0))}"
        ET.SubElement(body, "geom", type=shape.tag, size=size, attrib=place)
    elif shape.tag == "mesh":
        file = _file(str(shape.get("filename")), folder)
        name = meshes.setdefault(f"{file} {shape.get('scale', '1 1 1')}", f"mesh_{len(meshes)}")
        if assets.find(f"mesh[@name='{name}']") is None:
            ET.SubElement(assets, "mesh", name=name, file=str(file), scale=str(shape.get("scale", "1 1 1")))
        ET.SubElement(body, "geom", type="mesh", mesh=name, attrib=place)


def _file(name: str, folder: Path | None) -> Path:
    plain = name.removeprefix("file://")
    if plain.startswith("package://"):
        plain = plain.removeprefix("package://").partition("/")[2]
    path = Path(plain) if Path(plain).is_absolute() or folder is None else folder / plain
    if not path.is_file() or path.suffix.lower() not in (".stl", ".obj"):
        said = "is not a file that can be read" if not path.is_file() else "is neither an .stl nor an .obj"
        raise BadRobot(f"collision shape {name}", said, "set meshes to the folder of the package, or use plain shapes")
    return path.resolve()


def _surroundings(world: ET.Element, site: Site) -> None:
    margin = _text(np.array([site.margin]))
    if site.floor is not None:
        ET.SubElement(world, "geom", type="plane", size=f"{_FAR} {_FAR} 1", pos=f"0 0 {site.floor}", margin=margin)
    for ball in site.obstacles:
        ET.SubElement(world, "geom", type="sphere", size=str(ball.radius), pos=_text(ball.centre), margin=margin)
    for box in site.boxes:
        middle, half = 0.5 * (box[0] + box[1]), 0.5 * (box[1] - box[0])
        ET.SubElement(world, "geom", type="box", size=_text(half), pos=_text(middle), margin=margin)


def _origin(element: ET.Element) -> tuple[Array, Rotation]:
    origin = element.find("origin")
    return _numbers(origin, "xyz", "0 0 0"), Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0"))


def _numbers(element: ET.Element | None, key: str, default: str) -> Array:
    return np.array([float(v) for v in (default if element is None else element.get(key, default)).split()])


def _text(values: Array) -> str:
    return " ".join(f"{v:.12g}" for v in np.atleast_1d(values))


def _link(joint: ET.Element, which: str) -> str:
    found = joint.find(which)
    return "" if found is None else str(found.get("link"))
