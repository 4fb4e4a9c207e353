"""A box in the gripper, measured by its calibrated range sensors, and where the arm must go to put it down.

Rays are calibrated in the frame of the tracked target, ``tool``. With ``T_tip_tool`` of the calibration they come into
the tip link, whose pose controllers command; every result names the frame that it is in. Whichever that is, the box's
axes are called as those of the tip that they are nearest to, unless somebody names the faces.

A placed point q of the box (a corner, or the middle of the lower face) is off by ``δt + ω × q + S δsize / 2``, with S
the signs of q along the box's axes: position and height are both uncertain, and together less so than apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from modcal_core.calibration import INSTRUMENT, Calibration, model_at
from modcal_core.correction.correction import Target
from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import FACES, RAY, Box, ReadingTrack, Scan, measure_box

_STEP = 1e-6  # m, rad; between which derivatives are taken
_ALONG = np.cos(np.radians(30.0))  # of a ray to an axis, above which it says which face it meets
_MOVED = 7.0  # standard deviations between two readings: five of their difference, beyond which the box is another
_RESTS = 3.0  # of a sensor's noise, that readings of a box at rest scatter by at most
_SETTLED = 0.2  # s that a box rests at least, where the sensors do not read at the same moments


@dataclass(frozen=True)
class GripperRays:
    """Calibrated rays of range sensors. names: of the sensors, N. frame: link or target that they are fixed to and
    given in. values: origin [m] and direction of each, (N, 6). covariance: of all of them, (6 N, 6 N). sigma: what a
    reading scatters by [m]. tip: link, and along: the directions in it, (N, 3), by which faces are named.
    """

    names: tuple[str, ...]
    frame: str
    values: Array
    covariance: Array
    sigma: float
    tip: str
    along: Array

    @classmethod
    def of(cls, calibration: Calibration, target: Target = "tip") -> GripperRays:
        """The rays in the tip link, or in the tracked target. Raises BadTable for a calibration without any."""
        model, known = calibration.calibrated, calibration.uncertainty
        number = [i for i, one in enumerate(model.instruments) if one.kind == RAY]
        if not number:
            raise BadTable("calibration", "has no range sensors of a gripper", "calibrate with gripper/range recorded")
        if known is None or RAY not in calibration.noise.others:
            raise BadTable("calibration", "does not say how well its rays are known", "calibrate again")
        parameters = known.parameters
        mine = [j for j, p in enumerate(parameters) if p.place in (INSTRUMENT, model.chain.tool_place)]

        def at(j: int, step: float) -> Array:
            values = np.zeros(len(parameters))
            values[j] = step
            moved = model_at(model, parameters, values) if step else model
            T = moved.T_tip_tool if target == "tip" else np.eye(4)
            rays = np.stack([moved.instruments[i].values for i in number])
            return np.concatenate([se3.apply(T, rays[:, :3]), rays[:, 3:] @ T[:3, :3].T], axis=1)

        J = np.stack([(at(j, _STEP) - at(j, -_STEP)).ravel() / (2.0 * _STEP) for j in mine], axis=1)
        return cls(
            tuple(model.instruments[i].frame for i in number),
            model.chain.tip if target == "tip" else "tool",
            at(0, 0.0),
            J @ known.covariance[np.ix_(mine, mine)] @ J.T,
            float(calibration.noise.others[RAY]),
            model.chain.tip,
            np.stack([model.T_tip_tool[:3, :3] @ model.instruments[i].values[3:] for i in number]),
        )

    def faces(self, said: Iterable[str]) -> dict[str, str]:
        """The face that each ray meets: as somebody said, SENSOR=FACE, else that it runs against. Raises BadTable."""
        named = {name: face for name, _, face in (text.rpartition("=") for text in said if text)}
        if unknown := sorted(set(named) - set(self.names)):
            raise BadTable(f"sensor '{unknown[0]}'", "is not calibrated", f"name one of {', '.join(self.names)}")
        out = {}
        for name, along in zip(self.names, self.along, strict=True):
            k = int(np.argmax(np.abs(along)))
            if name not in named and abs(along[k]) < _ALONG:
                steep = np.degrees(np.arccos(abs(along[k])))
                said = f"cannot tell which face it meets: its ray is {steep:.0f}° off the {'xyz'[k]} axis of {self.tip}"
                raise BadTable(f"sensor {name}", said, f"name it, as {name}=-x; faces: {', '.join(FACES)}")
            out[name] = named.get(name) or ("-" if along[k] > 0.0 else "+") + "xyz"[k]
        return out


@dataclass(frozen=True)
class HeldBox:
    """A box in a gripper. frame: link or target that T_frame_box is in. since, until: stamps of its readings [s].
    read, silent: sensors that read something, and those that met nothing.
    """

    frame: str
    box: Box
    since: float
    until: float
    read: tuple[str, ...]
    silent: tuple[str, ...]

    @property
    def pose_covariance(self) -> Array:
        """Of position [m] and orientation [rad] along the axes of the frame, (6, 6)."""
        turn = block_diag(*[self.box.T_frame_box[:3, :3]] * 2)
        return np.asarray(turn @ self.box.covariance[:6, :6] @ turn.T)

    def data(self) -> dict[str, Any]:
        """For a report."""
        std, pose = self.box.std, se3.to_pose(self.box.T_frame_box)
        return {
            "frame": self.frame,
            "position_m": pose[:3].tolist(),
            "quaternion": pose[3:].tolist(),
            "size_m": self.box.size.tolist(),
            "size_std_m": std[6:].tolist(),
            "pose_covariance": self.pose_covariance.tolist(),
            "covariance_of_shift_turn_size": self.box.covariance.tolist(),
            "spare_readings": self.box.spare,
            "since_s": self.since,
            "until_s": self.until,
            "sensors": list(self.read),
            "silent": list(self.silent),
        }


def rests(rays: GripperRays, readings: Sequence[ReadingTrack]) -> list[tuple[float, float]]:
    """Spans (first, last stamp) [s], in the order of time, in which no sensor saw another box than before.

    Raises BadRecording for readings of other sensors, NotEnoughData where no box rests.
    """
    tracks = {t.frame: t for t in readings if t.kind == RAY and len(t.stamps)}
    if unknown := sorted(set(tracks) - set(rays.names)):
        said = f"is not among the calibrated ones ({', '.join(rays.names)})"
        raise BadRecording(f"gripper/range of {unknown[0]}", said, "use the calibration of this gripper")
    if not tracks:
        raise BadRecording("gripper/range", "has no readings", "record the sensors while the box is held still")
    stamps = np.unique(np.concatenate([t.stamps for t in tracks.values()]))
    moved = [t.stamps[1:][np.abs(np.diff(t.values[:, 0])) > _MOVED * rays.sigma] for t in tracks.values()]
    pieces = np.split(stamps, np.unique(np.searchsorted(stamps, np.concatenate(moved))))
    whole = [p for p in pieces if p[-1] - p[0] >= _SETTLED or all(np.isin(p, t.stamps).all() for t in tracks.values())]
    if not whole:
        said = f"no box rests for {_SETTLED} s"
        raise NotEnoughData("gripper/range", said, "hold the box still while the sensors read")
    return [(float(p[0]), float(p[-1])) for p in whole]


def held_box(
    rays: GripperRays,
    readings: Sequence[ReadingTrack],
    span: tuple[float, float],
    faces: Mapping[str, str],
    size: ArrayLike | None = None,
) -> HeldBox:
    """The box that rested in the gripper in a span of :func:`rests`. faces: that the rays meet. size: as of
    :func:`measure_box`. Raises NotEnoughData where it cannot be told.
    """
    tracks = {t.frame: t for t in readings if t.kind == RAY}
    number, lengths, sigma = list[int](), list[float](), list[float]()
    for i, name in enumerate(rays.names):
        track = tracks.get(name)
        d = np.empty(0) if track is None else track.values[(track.stamps >= span[0]) & (track.stamps <= span[1]), 0]
        if not len(d):
            continue
        if (scatter := float(d.std())) > _RESTS * rays.sigma:
            said = f"scatters by {1e3 * scatter:.2g} mm, {1e3 * rays.sigma:.2g} mm is usual: the box moves"
            raise NotEnoughData(f"sensor {name} from {span[0]:.3f} s on", said, "hold the box still while it reads")
        number.append(i)
        lengths.append(float(d.mean()))
        sigma.append(float(np.hypot(rays.sigma, scatter / np.sqrt(len(d)))))
    read = tuple(rays.names[i] for i in number)
    silent = tuple(name for name in rays.names if name not in read)
    M = block_diag(*(np.c_[np.eye(3), length * np.eye(3)] for length in lengths))
    own = (6 * np.array(number)[:, None] + np.arange(6)).ravel()
    shared = M @ rays.covariance[np.ix_(own, own)] @ M.T
    scan = Scan(read, rays.values[number], np.array(lengths), [faces[n] for n in read], np.array(sigma), shared)
    try:
        return HeldBox(rays.frame, measure_box(scan, size), *span, read, silent)
    except NotEnoughData as error:
        if not silent:
            raise
        said = f"{error.limit}; {', '.join(silent)} read nothing: the box is too small for their rays, or they are off"
        raise NotEnoughData(error.offender, said, error.remedy) from error


# --- Putting it down


@dataclass(frozen=True)
class StackPlace:
    """Where a box shall stand. stack: pose x y z qx qy qz qw in the base of a frame on top of the stack, z up.
    covariance: of its position [m] and orientation [rad] along the base's axes, (6, 6). down: the face that shall lie
    on it. corner: whether the corner of least x and y comes to its origin, else the middle of the lower face. turn: of
    the box about z [rad]; at 0 its first axis that lies level points along x. Raises BadTable for what is no place.
    """

    stack: ArrayLike
    covariance: Array
    down: str = "+z"
    corner: bool = False
    turn: float = 0.0

    def __post_init__(self) -> None:
        pose = np.asarray(self.stack, dtype=float)
        if not (np.isfinite(pose).all() and abs(np.linalg.norm(pose[3:]) - 1.0) < 1e-2):
            raise BadTable("stack", "is not a pose", "give x y z [m] and a quaternion of length one")
        if self.down not in FACES:
            raise BadTable(f"face '{self.down}'", "is not a face of a box", f"name {', '.join(FACES)}")


@dataclass(frozen=True)
class Placing:
    """frame: link or target that shall be at T_base_frame, (4, 4), to put the box down. covariance: of where the placed
    point of the box then is, and of how the box is turned, along the base's axes [m, rad], (6, 6), the arm not counted.
    """

    frame: str
    T_base_frame: Array
    covariance: Array

    def data(self) -> dict[str, Any]:
        """For a report."""
        pose = se3.to_pose(self.T_base_frame)
        position, turn = pose[:3].tolist(), pose[3:].tolist()
        return {"frame": self.frame, "position_m": position, "quaternion": turn, "covariance": self.covariance.tolist()}


def placing(held: HeldBox, place: StackPlace) -> Placing:
    """The pose that puts a held box down where it shall stand."""
    k, end = divmod(FACES.index(place.down), 2)
    level = [a for a in range(3) if a != k]
    down = np.eye(3)[k] * (2.0 * end - 1.0)
    u = np.eye(3)[level[0]]
    v = np.cross(-down, u)
    R = so3.exp([0.0, 0.0, place.turn]) @ np.stack([u, v, -down])
    signs = down - (u + v if place.corner else 0.0)
    q = 0.5 * signs * held.box.size
    T_base_box = se3.from_pose(place.stack) @ se3.transform(R, -R @ q)
    J = np.zeros((6, 9))
    J[:3] = np.c_[np.eye(3), -so3.hat(q), 0.5 * np.diag(signs)]
    J[3:, 3:6] = np.eye(3)
    J = block_diag(*[T_base_box[:3, :3]] * 2) @ J
    covariance = J @ held.box.covariance @ J.T + place.covariance
    return Placing(held.frame, T_base_box @ se3.inverse(held.box.T_frame_box), covariance)
