"""What a kind of reading is: everything that other packages ask of it, in one class to derive from.

A reading says something of one point that is fixed to the tool, the *target*. What it says is linear in a small motion
δp of that point: the prediction changes by ``S δp``. For a point reading S is the identity; for a distance it is u uᵀ,
with u the line of sight; for a bearing (1 − u uᵀ) / distance. Residuals are therefore vectors with three components for
every kind, written along the directions that it sees and zero along the others, and all that is known of how an arm
moves its tool serves every kind alike.

A kind may have constants of its own, which are fitted (the zero of a wire, the ray of a sensor), and where its frame
stands: the anchor, the station, the plane. Everything is seen from the root, the frame of the first joint before it
moves, and component-major: vectors of m readings are (3, m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.measurements.recording import ReadingTrack

MESSAGES = (  # types of messages whose numbers can be readings
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/Vector3Stamped",
    "sensor_msgs/msg/Range",
)
KIND_NAMES = np.dtype("U32")  # of the column of kinds in samples; a kind with a longer name is refused
ORIGIN, POSE_OF_FRAME, PLANE = "origin", "pose", "plane"
UNIT = 1e-3  # how far from 1 the length of a direction, or of a quaternion, may be
FARTHEST_OF_REACH = 20.0  # times the arm's reach, the same for arms so large that 50 m is near
FARTHEST = 50.0  # m from the tracker; beyond it, or far beyond the arm's reach, positions are suspected of millimetres


@dataclass(frozen=True)
class Constant:
    """One constant of an instrument. name: as in "frame NAME/zero". unit: m or rad. prior_std: how far from where the
    start puts it, in that unit.
    """

    name: str
    unit: str
    prior_std: float


@dataclass(frozen=True)
class Scene:
    """Where the target of one instrument is at m readings. T_root_frame: pose of the instrument's frame, (4, 4).
    target: (3, m) [m]. tool: origin of the tool, (3, m) [m]. axes: directions of the tool's axes, (3, 3, m), axis
    first.
    """

    T_root_frame: Array
    target: Array
    tool: Array
    axes: Array


@dataclass(frozen=True)
class Sight:
    """What m readings say. residual: measured minus predicted, (3, m), in the kind's unit. through: change of the
    prediction per motion of the watched point, (3, 3, m). watched: the point, fixed to the tool, that counts, (3, m).
    constants: change of the prediction per constant, (V, 3, m). scale: the same per unit of an error of scale, (3, m);
    a length grows with it, a direction does not. lever: metres at the tool per unit of residual, (m,).
    """

    residual: Array
    through: Array
    watched: Array
    constants: Array
    scale: Array
    lever: Array


class Kind:
    """A kind of reading. Derive from it, set what differs, and register the instance (see :mod:`registry`).

    name: as in samples and reports. topic, message: that carry it, one of MESSAGES. width: numbers in a reading.
    dimensions: directions in which a reading sees, of six. unit: of residuals and noise, m or rad. frame: what is to be
    known of its frame: its origin, its pose, or its plane z = 0. constants: fitted with it. target: whether it watches
    a point of the tool. counts_as: kind whose parameters are fitted, where it is another, because nothing but priors
    tells what this one cannot see. least: readings in a frame that it can be placed from. direct: whether readings
    are positions in the frame, which need none of the rest.
    """

    name: str
    topic: str
    message: str
    width: int
    dimensions: int
    unit: str = "m"
    frame: str = POSE_OF_FRAME
    constants: tuple[Constant, ...] = ()
    target: bool = True
    counts_as: str = ""
    least: int = 3
    direct: bool = False

    def start(self) -> Array:
        """The constants before anything is known, (V,)."""
        return np.zeros(len(self.constants))

    def moved(self, values: Array, change: Array) -> Array:
        """The constants (V,) changed by the fitted parameters (k,), one for each of ``constants``."""
        return np.asarray(values + change)

    def moved_by(self, values: Array, change: Array) -> Array:
        """d(constants)/d(parameters), (V, k), at this change."""
        return np.eye(len(values))

    def see(self, scene: Scene, values: Array, reading: Array) -> Sight:
        """What readings (m, 3) say of a scene, with the constants at these values."""
        raise NotImplementedError

    def predict(self, scene: Scene, values: Array) -> Array:
        """Readings (m, 3), padded with zeros, that an exact instrument would give."""
        raise NotImplementedError

    def place(self, T_base_tool: Array, reading: Array, known: Array | None = None) -> tuple[Array, Array]:
        """(T_frame_base (4, 4), constants (V,)) that roughly meet the readings, from no guess.

        T_base_tool: poses of the target in the base, (m, 4, 4). reading: (m, 3). known: T_frame_base where it is known.
        """
        raise NotImplementedError

    def usable(self, scene: Scene, values: Array) -> np.ndarray:
        """Whether an instrument could read there at all, (m,)."""
        return np.ones(scene.target.shape[1], bool)

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """True for readings (m, width), all finite, that no instrument of an arm with this reach [m] gives, (m,).

        They are left out where they are few; where most are, ``complaint`` says what is wrong with all of them.
        """
        return np.zeros(len(values), dtype=np.bool_)

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """(limit, remedy) of readings that cannot be used, None where they can. reach: of the arm [m]."""
        return None


class Length(Kind):
    """A kind whose reading is one length. noun: what readings are called in refusals. lacks: what was not seen where
    the instrument reads nothing; "": a length may be zero and less.
    """

    message = "sensor_msgs/msg/Range"
    width = 1
    dimensions = 1
    noun: str = "ranges"
    lacks: str = ""

    def length(self, scene: Scene, values: Array) -> Array:
        """What an exact instrument would read, (m,)."""
        raise NotImplementedError

    def most(self, reach: float) -> float:
        """The largest length [m] that it reads of an arm with this reach [m]."""
        return farthest(reach)

    def predict(self, scene: Scene, values: Array) -> Array:
        """Lengths, then two zeros."""
        return np.pad(self.length(scene, values)[:, None], ((0, 0), (0, 2)))

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """Readings of nothing, and lengths that no arm of this reach comes to."""
        d = values[:, 0]
        return np.asarray((np.abs(d) > self.most(reach)) | (bool(self.lacks) & (d <= 0.0)))

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """Zeros, negative readings, millimetres."""
        d = track.values[:, 0]
        bad = np.flatnonzero(d <= 0.0)
        if self.lacks and len(bad):
            first = f"first at stamp {track.stamps[bad[0]]:.3f} s"
            said = f"{len(bad)} of {len(d)} {self.noun} are zero or negative, {first}"
            return said, f"leave out readings without {self.lacks}"
        return millimetres(f"{self.noun} reach", float(np.abs(d).max()), self.most(reach))


def plane_of(T_root_frame: Array) -> tuple[Array, Array]:
    """(normal (3,), a point (3,)) of the plane z = 0 of a frame."""
    return T_root_frame[:3, 2], T_root_frame[:3, 3]


def frame_on_plane(normal: Array, offset: float) -> Array:
    """T_frame_base (4, 4) of a frame whose z = 0 is the plane ``normal · p = offset`` of the base."""
    n = normal / np.linalg.norm(normal)
    x = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
    x /= np.linalg.norm(x)
    return se3.transform(np.stack([x, np.cross(n, x), n]), [0.0, 0.0, -offset])


def scene_in(T_frame_base: Array, T_base_tool: Array, target: Array | None = None) -> Scene:
    """The scene of a frame, seen from the base, for poses (m, 4, 4). target: in the tool [m]; None: its origin."""
    p, axes = T_base_tool[:, :3, 3].T, T_base_tool[:, :3, :3].transpose(2, 1, 0)
    return Scene(se3.inverse(T_frame_base), p if target is None else p + np.einsum("dim,d->im", axes, target), p, axes)


def farthest(reach: float) -> float:
    """Distance [m] from its tracker beyond which nothing that an arm of this reach [m] holds can be."""
    return max(FARTHEST, FARTHEST_OF_REACH * reach)


def lengths(vectors: Array) -> Array:
    """Lengths (m,) of vectors (m, k), whatever they hold: infinite where a square overflows."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=1))


def not_unit(name: str, vectors: Array, stamps: Array, remedy: str) -> tuple[str, str] | None:
    """The complaint of vectors (m, k) that are not all of length one."""
    length = lengths(vectors)
    worst = int(np.argmax(np.abs(length - 1.0)))
    if abs(length[worst] - 1.0) <= UNIT:
        return None
    return f"a {name} has length {length[worst]:.3f} at {stamps[worst]:.3f} s, 1 ± {UNIT:g} is allowed", remedy


def millimetres(name: str, largest: float, limit: float) -> tuple[str, str] | None:
    """The complaint of lengths that no arm of this reach can make."""
    if largest <= limit:
        return None
    return f"{name} {largest:.0f} m, {limit:.1f} m is the limit: it looks like millimetres", "record metres"
