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

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, so3
from modcal_core.planning import Site
from modcal_core.robots import CollisionShape, Tree, collision_shapes, parse

_ALWAYS = 0.9  # share of random postures from which a pair that touches is drawn touching
_DRAWN = 200  # random postures for that
_FAR = 50.0  # m; half of the floor's and larger than any arm
_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}


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
        self._xml = _mjcf(urdf, site, folder)
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
    return bool(collision_shapes(urdf))


def _mjcf(urdf: str, site: Site, folder: Path | None) -> str:
    tree, shapes = parse(urdf), collision_shapes(urdf)
    if not shapes:
        said = "has no collision shapes"
        raise BadRobot("robot_description", said, "give one that has, or allow no_self_collision at your risk")
    xml = ET.Element("mujoco")
    ET.SubElement(xml, "compiler", angle="radian", autolimits="false")
    assets, world = ET.SubElement(xml, "asset"), ET.SubElement(xml, "worldbody")
    _surroundings(world, site)
    waiting = [(tree.root(), _body(world, tree.root(), np.eye(4)))]
    while waiting:
        name, body = waiting.pop()
        for shape in shapes.get(name, ()):
            _geom(body, shape, site.margin, assets, folder)
        for joint in tree.below[name]:
            inner = _body(body, joint.child, joint.T_parent_joint)
            if joint.kind in _KINDS:
                low, high = np.nan_to_num([joint.lower, joint.upper], posinf=0.0, neginf=0.0)
                ET.SubElement(
                    inner, "joint", name=joint.name, axis=_text(joint.axis), limited="false", type=_KINDS[joint.kind],
                    range=f"{low} {high}",
                )  # fmt: skip
            waiting.append((joint.child, inner))
    _leave_out_neighbours(ET.SubElement(xml, "contact"), tree, shapes)
    return ET.tostring(xml, encoding="unicode")


def _leave_out_neighbours(contact: ET.Element, tree: Tree, shapes: Mapping[str, object]) -> None:
    """Links that meet at a joint, also over links that carry no shape of their own."""
    pairs = {("world", tree.root())}
    for name in tree.links:
        parent, near = name, True
        while near and parent in tree.above:
            joint = tree.above[parent]
            parent = joint.parent
            near = not joint.moves or parent not in shapes
            pairs.add((parent, name))
    for one, other in sorted(pairs):
        ET.SubElement(contact, "exclude", body1=one, body2=other)


def _body(parent: ET.Element, name: str, T: Array) -> ET.Element:
    body = ET.SubElement(parent, "body", {"name": name, **_place(T)})
    # MuJoCo wants a mass of whatever moves; nothing is made of it
    ET.SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    return body


def _geom(body: ET.Element, shape: CollisionShape, margin: float, assets: ET.Element, folder: Path | None) -> None:
    sizes, kind, more = shape.sizes, shape.kind, dict[str, str]()
    if kind == "box":
        more["size"] = _text([0.5 * float(v) for v in sizes.get("size", "0 0 0").split()])
    elif kind == "sphere":
        more["size"] = sizes.get("radius", "0")
    elif kind in ("cylinder", "capsule"):
        more["size"] = f"{sizes.get('radius', 0)} {0.5 * float(sizes.get('length', 0.0))}"
    elif kind == "mesh":
        file, scale = str(_file(sizes.get("filename", ""), folder)), sizes.get("scale", "1 1 1")
        known = next((a for a in assets if (a.get("file"), a.get("scale")) == (file, scale)), None)
        if known is None:
            known = ET.SubElement(assets, "mesh", name=f"mesh_{len(assets)}", file=file, scale=scale)
        more["mesh"] = str(known.get("name"))
    else:
        return
    ET.SubElement(body, "geom", {"type": kind, "margin": _text([margin]), **_place(shape.T_link_shape), **more})


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
    margin = _text([site.margin])
    if site.floor is not None:
        ET.SubElement(world, "geom", type="plane", size=f"{_FAR} {_FAR} 1", pos=f"0 0 {site.floor}", margin=margin)
    for ball in site.obstacles:
        ET.SubElement(world, "geom", type="sphere", size=str(ball.radius), pos=_text(ball.centre), margin=margin)
    for box in site.boxes:
        middle, half = 0.5 * (box[0] + box[1]), 0.5 * (box[1] - box[0])
        ET.SubElement(world, "geom", type="box", size=_text(half), pos=_text(middle), margin=margin)


def _place(T: Array) -> dict[str, str]:
    return {"pos": _text(T[:3, 3]), "quat": _text(np.roll(so3.to_quaternion(T[:3, :3]), 1))}


def _text(values: ArrayLike) -> str:
    return " ".join(f"{v:.12g}" for v in np.asarray(values))
