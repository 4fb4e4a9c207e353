"""A block with markers on an arm in MuJoCo, watched by fixed cameras through OpenCV's projection.

Nothing of it is the model's: bodies of the arm are displaced in all six directions, markers glued on by hand, each
where its own face lets it be; a marker is seen where its face looks at the camera. Truth of the arm is MuJoCo's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from camera.boards import seen
from camera.scenes import panda
from scipy.optimize import least_squares

from modcal_core.camera.bundle import BoardView, BundleMarker, MarkerBundle, body_scale
from modcal_core.camera.fit import CameraImages
from modcal_core.camera.lens import Lens
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_nodes.simulation.mjcf import World

RADIUS = 0.09  # of the block, from its middle to its faces [m]
SIDE = 0.04  # of a marker [m]
BODY_ON_TIP = se3.transform(so3.exp([0.3, -0.2, 0.5]), [0.01, -0.02, 0.14])
STEEPEST = np.cos(np.radians(62.0))  # at which a marker is still read
SIZE = (2400, 1600)
CAMERAS = ((1.7, 0.75, 1.1), (1.6, -0.85, 0.9))  # where they stand [m], looking at the middle of the work
MIDDLE = np.array([0.45, 0.0, 0.5])


def icosahedron() -> MarkerBundle:
    """The drawing: a marker on each of the twenty faces, numbered from 1."""
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = np.array([[0.0, a, b * golden] for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if max(distance[i, j], distance[j, k], distance[i, k]) < 2.1
    ]
    markers = []
    for number, face in enumerate(faces, start=1):
        out = corners[list(face)].mean(axis=0)
        z = out / np.linalg.norm(out)
        y = corners[face[0]] - out
        y = y / np.linalg.norm(y)
        R = np.stack([np.cross(y, z), y, z], axis=1)
        a, b, c = (float(v) for v in RADIUS * z)
        qx, qy, qz, qw = (float(v) for v in so3.to_quaternion(R))
        markers.append(BundleMarker(number, (a, b, c), (qx, qy, qz, qw), SIDE))
    return MarkerBundle(tuple(markers), body_scale(None))


@dataclass(frozen=True)
class Faults:
    """arm_m, arm_rad: of every body of the arm. place_m, place_rad: of every marker. normal_m: of it along its normal.
    grow: of the block, relative.
    shift_m, joint_rad: of every image. noise: of corners [px]. misread: share of markers with another's number, or
    turned by a quarter. late: images whose joints are another's. periodic: of joint 2, amplitude [rad].
    """

    arm_m: float = 1e-3
    arm_rad: float = 2e-3
    place_m: float = 7e-4
    place_rad: float = 1e-2
    normal_m: float = 1.5e-4
    grow: float = 0.0
    shift_m: float = 2e-5
    joint_rad: float = 3e-5
    noise: float = 0.15
    misread: float = 0.01
    late: int = 2
    periodic: float = 0.0


@dataclass(frozen=True)
class BodyScene:
    """chain: nominal. drawing: nominal. glued: true poses of the markers on the body, (K, 4, 4). q: as reported,
    (N, n). as_moved: as they were when the images were taken. cameras: T_base_camera of each. lenses: theirs. images: what
    each saw.
    """

    chain: Chain
    drawing: MarkerBundle
    glued: Array
    q: Array
    as_moved: Array
    cameras: tuple[Array, ...]
    lenses: tuple[Lens, ...]
    images: tuple[CameraImages, ...]
    world: World
    faults: Faults = field(default_factory=Faults)

    def tip(self, q: Array) -> Array:
        """True poses of the arm's last link in the base, (M, 4, 4)."""
        return self.world.tool_in_tracker(self._moved(q)) @ se3.inverse(BODY_ON_TIP)

    def _moved(self, q: Array) -> Array:
        return _with_gear(q, self.faults)

    def true_body(self) -> Array:
        """The body's frame as its markers stand, from the drawing's: in it their offsets from the drawing, in units of
        what is stated of them, are least together. Turns count where corners were read.
        """
        turning = any((np.concatenate([v.ids for v in one.views]) % 5 < 4).any() for one in self.images)
        drawn = np.stack([m.T_body_marker for m in self.drawing.markers])
        across = self.drawing.place_m
        normal = across if self.drawing.normal_m is None else self.drawing.normal_m

        def off(x: Array) -> Array:
            there = se3.inverse(se3.exp(x)) @ self.glued
            shift = np.einsum("kji,kj->ki", drawn[:, :3, :3], there[:, :3, 3] - drawn[:, :3, 3])
            shift /= [across, across, normal]
            turn = so3.log(there[:, :3, :3] @ np.swapaxes(drawn[:, :3, :3], 1, 2)) / self.drawing.turn_rad
            return np.concatenate([shift, turn if turning else 0.0 * turn]).ravel()

        return np.asarray(se3.exp(least_squares(off, np.zeros(6)).x))


def _with_gear(q: Array, faults: Faults) -> Array:
    out = q.copy()
    out[:, 1] += faults.periodic * np.sin(q[:, 1] * 40.0 + 0.7)
    return out


def looking(at: Array, middle: Array) -> Array:
    """T_base_camera of a camera at a place that looks at another, upright."""
    z = (middle - at) / np.linalg.norm(middle - at)
    x = np.cross([0.0, 0.0, -1.0], z)
    x = -x / np.linalg.norm(x) if x @ np.cross([0.0, 0.0, 1.0], z) < 0.0 else x / np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(z, x), z], axis=1), at)


def body_scene(
    seed: int,
    count: int = 60,
    cameras: int = 1,
    faults: Faults | None = None,
    corners: bool = False,
    most_markers: int | None = None,
    drawing: MarkerBundle | None = None,
) -> BodyScene:
    """A Panda with the block on its last link. most_markers: read in an image, the others are not."""
    faults = faults or Faults()
    rng = np.random.default_rng([77, seed])
    chain = panda()
    drawing = drawing or icosahedron()
    world = World(chain, rng, faults.arm_m, faults.arm_rad, None, BODY_ON_TIP)
    glue = np.array([faults.place_m] * 2 + [faults.normal_m] + [faults.place_rad] * 3)
    glued = np.stack([m.T_body_marker for m in drawing.markers])
    glued[:, :3, 3] *= 1.0 + faults.grow
    glued = glued @ se3.exp(glue * rng.standard_normal((len(glued), 6)))
    home = np.array([0.0, -0.3, 0.0, -1.9, 0.0, 1.9, 0.8])
    span = np.array([0.8, 0.5, 0.5, 0.5, 1.2, 0.8, 1.5])
    q = np.empty((0, 7))
    while len(q) < count:
        some = home + rng.uniform(-1.0, 1.0, (4 * count, 7)) * span
        tip = world.tool_in_tracker(some)[:, :3, 3]
        q = np.concatenate([q, some[(tip[:, 2] > 0.15) & (np.linalg.norm(tip - MIDDLE, axis=1) < 0.5)]])[:count]
    stand = [looking(np.array(CAMERAS[k]) + rng.normal(0.0, 0.05, 3), MIDDLE) for k in range(cameras)]
    lenses = []
    for _ in range(cameras):
        f = rng.uniform(1.1, 1.3) * SIZE[0]
        middle = 0.5 * np.array(SIZE) + rng.normal(0.0, 15.0, 2)
        lenses.append(Lens(np.r_[f, f, middle, -0.1, 0.05, rng.normal(0.0, 3e-4, 2), 0.0], SIZE))
    real = _with_gear(q, faults) + faults.joint_rad * rng.standard_normal(q.shape)
    T_body = world.tool_in_tracker(real)
    T_body[:, :3, 3] += faults.shift_m * rng.standard_normal((len(q), 3))
    reported = q.copy()
    for i in rng.choice(len(q), faults.late, replace=False):
        reported[i] = q[(i + 7) % len(q)]
    images = []
    for T_base_camera, lens in zip(stand, lenses, strict=True):
        views = [
            _view(rng, f"{i}", se3.inverse(T_base_camera) @ T, drawing, glued, lens, corners, faults, most_markers)
            for i, T in enumerate(T_body)
        ]
        rows = [i for i, v in enumerate(views) if len(v)]
        name = f"camera_{len(images) + 1}"
        images.append(CameraImages(reported[rows], [views[i] for i in rows], drawing, lens.size, name=name))
    return BodyScene(chain, drawing, glued, reported, q, tuple(stand), tuple(lenses), tuple(images), world, faults)


def _view(
    rng: np.random.Generator,
    name: str,
    T: Array,
    drawing: MarkerBundle,
    glued: Array,
    lens: Lens,
    corners: bool,
    faults: Faults,
    most: int | None,
) -> BoardView:
    """The markers whose faces look at the camera, some of them misread. T: of the body in the camera's frame."""
    ids: list[int] = []
    pixels: list[Array] = []
    numbers = [m.id for m in drawing.markers]
    square = 0.5 * SIDE * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    found = []
    for k in rng.permutation(len(glued)):
        at = T @ glued[k]
        away = at[:3, 3] / np.linalg.norm(at[:3, 3])
        if -at[:3, 2] @ away > STEEPEST:
            found.append(int(k))
    for k in found[:most]:
        at = se3.apply(glued[k], square if corners else np.zeros((1, 3)))
        exact = seen(T, at, lens)
        if not ((exact > 0.0) & (exact < np.array(lens.size) - 1.0)).all():
            continue
        number, turn = numbers[k], 0
        if rng.uniform() < faults.misread:
            free = [n for j, n in enumerate(numbers) if j not in found]
            number, turn = (int(rng.choice(free)), 0) if not corners or rng.uniform() < 0.5 else (number, 1)
        for c, p in enumerate(np.roll(exact, turn, axis=0)):
            point = drawing.point(number, c if corners else None)
            assert point is not None
            if point not in ids:
                ids.append(point)
                pixels.append(p + faults.noise * rng.standard_normal(2))
    cov = np.tile(0.1**2 * np.eye(2), (len(ids), 1, 1))
    return BoardView(name, np.array(ids, dtype=int), np.array(pixels).reshape(-1, 2), cov)


def measured(drawing: MarkerBundle, size: float = 5e-4) -> MarkerBundle:
    """The same drawing, the body measured across with a calliper, to a tenth of a millimetre, its labels of paper."""
    return replace(drawing, scale=body_scale(size), normal_m=2e-4)


def bundle_to_data(target: MarkerBundle) -> dict[str, Any]:
    """The body as nested dictionaries, in our form."""
    body, printed = (float(v) for v in np.sqrt(np.diag(target.scale.covariance)))
    out: dict[str, Any] = {"modcal_target": 1, "type": "bundle"}
    out |= {"name": target.name} if target.name else {}
    out |= {"tolerance_m": target.place_m, "tolerance_rad": target.turn_rad, "corner_order": list(target.corners)}
    out |= {} if target.normal_m is None else {"tolerance_normal_m": target.normal_m}
    out |= {"size_tolerance": body} if target.scale.measured else {}
    out["print_tolerance"] = printed
    out |= {"dictionary": target.dictionary} if target.dictionary else {}
    out["markers"] = [
        {"id": m.id, "size_m": m.size, "xyz": list(m.xyz), "quaternion": list(m.quaternion)}
        for m in target.markers
        if m.size
    ]
    out["points"] = [{"id": m.id, "xyz": list(m.xyz)} for m in target.markers if not m.size]
    return out
