"""Range sensors on the gripper: how far it is, along a ray fixed to the tool, to a plane.

The ray leaves o in direction d, both in the tool's frame and unknown: five numbers, for d has length one. The plane is
z = 0 of the frame that ``frame_id`` names, with normal n and point c. The reading is

    λ = n · (c − p_o) / (n · d),          p_o and d seen from the root,

and with the hit point p_o + λ d carried along by the tool, ∂λ/∂p_hit = −nᵀ / (n · d): a turn of the tool counts with
its lever at the place that is hit. ∂λ/∂o = −nᵀR / (n · d), ∂λ/∂d = λ times that.

Place: with the plane known, ``n·R o + λ n·R d − c = −n·x`` is linear in o, d and the plane's offset; normals all over
the half sphere are tried and the best ones polished by least squares on the readings.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.kinds.kind import (
    PLANE,
    Constant,
    Length,
    Scene,
    Sight,
    frame_on_plane,
    plane_of,
    scene_in,
)
from modcal_core.measurements.recording import RAY

_GRAZING = 0.05  # cosine to the normal below which a ray is taken to run along the plane
_CLEAR = 0.3  # the same for postures from which parameters are chosen
_NORMALS = 120  # over the half sphere: some 13° apart
_POLISHED = 4  # of the best, that are fitted
_FARTHEST = 5.0  # m that such a sensor sees
_OF_REACH = 4.0  # times the arm's reach, where that is more: the arm's diameter, and as much again for tool and plane


class Ray(Length):
    """Distance along a ray of the tool to a plane of unknown pose."""

    name = RAY
    topic = "gripper/range"
    lacks = "a plane in front of the sensor"
    frame = PLANE
    constants = (
        *(Constant(f"ray_{axis}", "m", 0.05) for axis in "xyz"),
        *(Constant(f"ray_tilt_{i}", "rad", 0.1) for i in (1, 2)),
    )
    target = False
    least = 10

    def start(self) -> Array:
        """A ray along the tool's z from its origin: origin [m], direction, (6,)."""
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

    def moved(self, values: Array, change: Array) -> Array:
        """The ray with its origin shifted and its direction tilted across itself."""
        tilted = values[3:] + change[3:] @ _across(values[3:])
        return np.r_[values[:3] + change[:3], tilted / np.linalg.norm(tilted)]

    def moved_by(self, values: Array, change: Array) -> Array:
        """(6, 5)."""
        tilted = values[3:] + change[3:] @ _across(values[3:])
        size = float(np.linalg.norm(tilted))
        d = tilted / size
        out = np.zeros((6, 5))
        out[:3, :3] = np.eye(3)
        out[3:, 3:] = (np.eye(3) - np.outer(d, d)) @ _across(values[3:]).T / size
        return out

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """Residuals of the length, written along the plane's normal."""
        n, _ = plane_of(scene.T_root_frame)
        length, hit, slope, across = _hits(scene, values)
        by_origin = -across / slope
        constants = np.concatenate([by_origin, length * by_origin])[:, None] * n[:, None]
        return Sight(
            n[:, None] * (reading[:, 0] - length),
            -np.outer(n, n)[:, :, None] / slope,
            hit,
            constants,
            n[:, None] * reading[:, 0],
            np.ones(len(length)),
        )

    def length(self, scene: Scene, values: Array) -> Array:
        """Along the ray to the plane."""
        return _hits(scene, values)[0]

    def most(self, reach: float) -> float:
        """What such a sensor sees, or more of a large arm."""
        return max(_FARTHEST, _OF_REACH * reach)

    def usable(self, scene: Scene, values: Array) -> np.ndarray:
        """Where the ray meets the plane steeply, not far away."""
        length, _, slope, _ = _hits(scene, values)
        return (np.abs(slope) > _CLEAR) & (np.abs(length) < _FARTHEST)

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """By a linear solution for each of many normals."""
        from scipy.optimize import least_squares  # slow to import, and not for looking into a bag

        d = reading[:, 0]
        if known is not None:
            n = known[2, :3]
            return known, _ray_of(_linear(T_base_tool, d, n, -float(known[2, 3]))[0])
        tried = sorted((_tried(T_base_tool, d, n) for n in _half_sphere(_NORMALS)), key=lambda t: t[0])
        best: tuple[float, Array, Array] | None = None
        for _, n, x in tried[:_POLISHED]:
            ray, across = _ray_of(x), _across(n)

            def at(x: Array, n: Array = n, ray: Array = ray, across: Array = across) -> tuple[Array, Array]:
                normal = n + x[5:7] @ across
                return frame_on_plane(normal, float(x[7])), self.moved(ray, x[:5])

            def miss(x: Array, at=at) -> Array:  # type: ignore[no-untyped-def]
                T, values = at(x)
                return np.asarray(_hits(scene_in(T, T_base_tool), values)[0] - d)

            found = least_squares(miss, np.r_[np.zeros(7), x[6]], loss="soft_l1", f_scale=0.01)
            if best is None or found.cost < best[0]:
                best = (float(found.cost), *at(found.x))
        assert best is not None
        return best[1], best[2]


def _hits(scene: Scene, values: Array) -> tuple[Array, Array, Array, Array]:
    """(lengths (m,), hit points (3, m), n · d (m,), normal in the tool's frame (3, m))."""
    n, c = plane_of(scene.T_root_frame)
    across = np.einsum("dim,i->dm", scene.axes, n)
    slope = values[3:] @ across
    slope = np.where(np.abs(slope) < _GRAZING, np.where(slope < 0.0, -_GRAZING, _GRAZING), slope)
    origin = scene.tool + np.einsum("dim,d->im", scene.axes, values[:3])
    length = (n @ (c[:, None] - origin)) / slope
    return length, origin + length * np.einsum("dim,d->im", scene.axes, values[3:]), slope, across


def _across(d: Array) -> Array:
    """Two unit vectors across d and each other, (2, 3)."""
    a = np.cross(d, np.eye(3)[int(np.argmin(np.abs(d)))])
    a /= np.linalg.norm(a)
    return np.stack([a, np.cross(d, a)])


def _half_sphere(count: int) -> Array:
    """Directions spread evenly over a half sphere (golden angle), (count, 3)."""
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def _linear(T: Array, d: Array, n: Array, offset: float | None = None) -> tuple[Array, float]:
    """(o, d and, where it is not given, the plane's offset; sum of squares left) for a plane of this normal."""
    turned = np.einsum("i,mij->mj", n, T[:, :3, :3])
    design = np.c_[turned, d[:, None] * turned, -np.ones(len(d))]
    right = -T[:, :3, 3] @ n
    if offset is not None:
        design, right = design[:, :6], right + offset
    x = np.asarray(np.linalg.lstsq(design, right, rcond=1e-9)[0], dtype=float)
    return x, float(np.sum((design @ x - right) ** 2))


def _tried(T: Array, d: Array, n: Array) -> tuple[float, Array, Array]:
    """(how badly it fits, the normal, the linear solution): a direction must have length one too."""
    x, left = _linear(T, d, n)
    return left / len(d) + 0.01 * float(np.log(max(float(np.linalg.norm(x[3:6])), 1e-6))) ** 2, n, x


def _ray_of(x: Array) -> Array:
    return np.r_[x[:3], x[3:6] / max(float(np.linalg.norm(x[3:6])), 1e-9)]
