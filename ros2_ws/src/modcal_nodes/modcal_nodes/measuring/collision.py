"""Whether an arm touches itself or what is around it, by the shapes of its URDF. MuJoCo says so.

Every link is a body with the collision shapes of the description (box, sphere, cylinder and mesh files that are there),
moved by its joint. Neighbours in the tree may touch, and so may pairs that touch in nearly every posture, for they are
drawn that way. Around it are a floor, boxes and spheres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, so3
from modcal_core.planning import Site
from modcal_core.robots import CollisionShape, Tree, collision_shapes, parse

_ALWAYS = 0.9  # share of random postures from which a pair that touches is drawn touching
_DRAWN = 200  # random postures for that
_FAR = 50.0  # m; half of the floor's and larger than any arm
_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_JOINTS = {"revolute": _HINGE, "continuous": _HINGE, "prismatic": _SLIDE}
_BOX, _SPHERE, _PLANE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_PLANE
_ROUND = {"cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE}


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
        looked for beside absolute paths. Raises BadRobot where they are not there.
        """
        tree, shapes = parse(urdf), collision_shapes(urdf)
        self.names, self._margin = tuple(names), site.margin
        self._spec = _drawn(tree, shapes, site, folder)
        self._allow(_neighbours(tree, shapes))
        joints = [self._model.joint(name) for name in self.names]
        self._at = np.array([j.qposadr[0] for j in joints])
        low, high = np.array([j.range for j in joints]).reshape(-1, 2).T
        low, high = np.where(high > low, low, -np.pi), np.where(high > low, high, np.pi)
        drawn = np.random.default_rng(0).uniform(low, high, (_DRAWN, len(self.names)))  # the same pairs every time
        counts = Counter((touch.one, touch.other) for q in drawn for touch in self.touches(q))
        self._allow({pair for pair, count in counts.items() if count > _ALWAYS * _DRAWN and "world" not in pair})

    def _allow(self, pairs: Collection[tuple[str, str]]) -> None:
        """Let these links touch each other."""
        for one, other in sorted(pairs):
            self._spec.add_exclude(bodyname1=one, bodyname2=other)
        self._model = self._spec.compile()
        self._data = mujoco.MjData(self._model)

    def touches(self, q: Array) -> list[LinkContact]:
        """What touches at a posture (n,), each pair of links once."""
        self._data.qpos[:] = 0.0
        self._data.qpos[self._at] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        found: dict[tuple[str, str], float] = {}
        for contact in self._data.contact:
            one, other = sorted(self._model.body(self._model.geom_bodyid[geom]).name for geom in contact.geom)
            found[one, other] = max(found.get((one, other), -np.inf), self._margin - float(contact.dist))
        return [LinkContact(one, other, depth) for (one, other), depth in found.items()]

    def free(self, q: Array) -> np.ndarray:
        """True for postures (N, n) at which nothing touches, (N,)."""
        return np.array([not self.touches(row) for row in q], dtype=bool)


def _drawn(tree: Tree, shapes: Mapping[str, Sequence[CollisionShape]], site: Site, folder: Path | None) -> Any:
    """MuJoCo's drawing of the robot and of what stands around it."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = spec.compiler.autolimits = False
    world, margin = spec.worldbody, {"margin": site.margin}
    if site.floor is not None:
        world.add_geom(type=_PLANE, size=[_FAR, _FAR, 1.0], pos=[0.0, 0.0, site.floor], **margin)
    for ball in site.obstacles:
        world.add_geom(type=_SPHERE, size=[ball.radius, 0.0, 0.0], pos=ball.centre, **margin)
    for low, high in site.boxes:
        world.add_geom(type=_BOX, size=0.5 * (high - low), pos=0.5 * (low + high), **margin)
    # MuJoCo wants a mass of whatever moves; nothing is made of it
    solid = {"mass": 1.0, "inertia": [1.0, 1.0, 1.0], "explicitinertial": True}
    bodies = {tree.root(): world.add_body(name=tree.root(), **solid)}
    waiting = [tree.root()]
    while waiting:
        name = waiting.pop()
        for shape in shapes.get(name, ()):
            if form := _form(shape, spec, folder):
                bodies[name].add_geom(**form, **_placed(shape.T_link_shape), **margin)
        for joint in tree.below[name]:
            bodies[joint.child] = bodies[name].add_body(name=joint.child, **_placed(joint.T_parent_joint), **solid)
            if joint.kind in _JOINTS:
                ends = np.nan_to_num([joint.lower, joint.upper], posinf=0.0, neginf=0.0)
                kind = _JOINTS[joint.kind]
                bodies[joint.child].add_joint(name=joint.name, type=kind, axis=joint.axis, limited=0, range=ends)
            waiting.append(joint.child)
    return spec


def _neighbours(tree: Tree, shapes: Collection[str]) -> set[tuple[str, str]]:
    """Links that meet at a joint, also over links that carry no shape of their own."""
    pairs = {("world", tree.root())}
    for name in tree.links:
        parent, near = name, True
        while near and parent in tree.above:
            joint = tree.above[parent]
            parent = joint.parent
            near = not joint.moves or parent not in shapes
            pairs.add((parent, name))
    return pairs


def _form(shape: CollisionShape, spec: Any, folder: Path | None) -> dict[str, Any] | None:
    """Type and size of a shape; None for one that MuJoCo does not know."""
    sizes = shape.sizes
    if shape.kind == "box":
        return {"type": _BOX, "size": [0.5 * float(v) for v in sizes.get("size", "0 0 0").split()]}
    if shape.kind == "sphere":
        return {"type": _SPHERE, "size": [float(sizes.get("radius", 0.0)), 0.0, 0.0]}
    if shape.kind in _ROUND:
        size = [float(sizes.get("radius", 0.0)), 0.5 * float(sizes.get("length", 0.0)), 0.0]
        return {"type": _ROUND[shape.kind], "size": size}
    if shape.kind != "mesh":
        return None
    file, scale = str(_file(sizes.get("filename", ""), folder)), sizes.get("scale", "1 1 1")
    name = f"{file} {scale}"
    if spec.mesh(name) is None:
        spec.add_mesh(name=name, file=file, scale=[float(v) for v in scale.split()])
    return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}


def _file(name: str, folder: Path | None) -> Path:
    plain = name.removeprefix("file://")
    if plain.startswith("package://"):
        plain = plain.removeprefix("package://").partition("/")[2]
    path = Path(plain) if Path(plain).is_absolute() or folder is None else folder / plain
    if not path.is_file() or path.suffix.lower() not in (".stl", ".obj"):
        said = "is not a file that can be read" if not path.is_file() else "is neither an .stl nor an .obj"
        raise BadRobot(f"collision shape {name}", said, "set meshes to the folder of the package, or use plain shapes")
    return path.resolve()


def _placed(T: Array) -> dict[str, Array]:
    return {"pos": T[:3, 3], "quat": np.roll(so3.to_quaternion(T[:3, :3]), 1)}
