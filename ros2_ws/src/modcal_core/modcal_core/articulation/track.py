"""A track: what was seen of a handle, pose by pose or point by point, in the order in which it was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

FEWEST = 4  # samples: three lie on a circle whatever moved
_UNIT = 0.02  # by which the length of a quaternion may be off 1
RIGID = 1e-3  # by which a rotation matrix may be off one
_MAX_OF, _MANY = 0.98, 50  # share of samples that an extent is taken of, where there are more than so many
FARTHEST = 50.0  # m from the frame's origin; beyond, the unit is not metres or the reading is no arm's
_WIDEST = 5.0  # m from the middle of the track: a gate of 10 m; beyond, a handle was seen in centimetres or millimetres


@dataclass(frozen=True)
class Track:
    """positions: (n, 3) [m]. rotations: R_world_handle (n, 3, 3), or None. stamps: (n,) [s], or None.

    Raises NotEnoughData for fewer than four samples, and BadRecording for what cannot be a handle's track: a number
    that is not finite, millimetres, matrices that are no rotations, stamps that go back.
    """

    positions: Array
    rotations: Array | None = None
    stamps: Array | None = None

    def __post_init__(self) -> None:
        p = _frozen(self.positions)
        n = len(p) if p.ndim else 0
        if p.ndim != 2 or p.shape[1] != 3:
            raise BadRecording("track, positions", f"have shape {p.shape}, not (n, 3)", "give one position a row")
        if n < FEWEST:
            raise NotEnoughData("track", f"{n} samples, {FEWEST} are needed", "record while the handle moves")
        _finite("positions", p)
        farthest = float(np.abs(p).max())
        if farthest > FARTHEST:
            raise BadRecording("track, positions", f"{farthest:.4g} m from the origin, {FARTHEST:g} m is allowed",
                               "give metres, not millimetres")  # fmt: skip
        object.__setattr__(self, "positions", p)
        if float(np.ptp(p, axis=0).max()) > _WIDEST and self.extent() > _WIDEST:
            raise BadRecording("track, positions", f"lie {self.extent():.4g} m about their middle, {_WIDEST:g} m is "
                               "allowed", "give metres, not centimetres or millimetres")  # fmt: skip
        if self.rotations is not None:
            object.__setattr__(self, "rotations", _rotations(self.rotations, n))
        if self.stamps is not None:
            t = _frozen(self.stamps)
            if t.shape != (n,):
                raise BadRecording("track, stamps", f"have shape {t.shape}, not ({n},)", "give one stamp a sample")
            _finite("stamps", t)
            if (np.diff(t) < 0.0).any():
                raise BadRecording("track, stamps", f"go back at sample {int(np.argmin(np.diff(t))) + 1}",
                                   "give samples in the order of time")  # fmt: skip
            object.__setattr__(self, "stamps", t)

    @classmethod
    def trusted(cls, positions: Array, rotations: Array | None = None) -> Track:
        """Track of data that has been validated already, of any length; it is not checked again."""
        track = cls.__new__(cls)
        object.__setattr__(track, "positions", positions)
        object.__setattr__(track, "rotations", rotations)
        object.__setattr__(track, "stamps", None)
        return track

    @classmethod
    def of_poses(cls, poses: ArrayLike, stamps: ArrayLike | None = None) -> Track:
        """The track of poses x y z qx qy qz qw (n, 7), or of positions (n, 3) [m].

        Raises what Track raises, and BadRecording for a quaternion whose length is off 1 by more than 2 %.
        """
        poses = np.asarray(poses, dtype=float)
        times = None if stamps is None else np.asarray(stamps, dtype=float)
        if poses.ndim != 2 or poses.shape[1] not in (3, 7):
            raise BadRecording("track", f"has shape {poses.shape}, not (n, 3) or (n, 7)",
                               "give x y z or x y z qx qy qz qw")  # fmt: skip
        if poses.shape[1] == 3:
            return cls(poses, None, times)
        _finite("quaternions", poses[:, 3:])
        length = np.linalg.norm(poses[:, 3:], axis=1)
        worst = int(np.argmax(np.abs(length - 1.0))) if len(length) else 0
        if len(length) and abs(length[worst] - 1.0) > _UNIT:
            raise BadRecording(f"track, quaternion of sample {worst}", f"has length {length[worst]:.4g}, not 1",
                               "give unit quaternions x y z w")  # fmt: skip
        return cls(poses[:, :3], so3.from_quaternion(poses[:, 3:]) if len(poses) else None, times)

    @classmethod
    def from_arrays(
        cls, points: ArrayLike | None = None, poses: ArrayLike | None = None, stamps: ArrayLike | None = None
    ) -> Track:
        """The track of points (n, 3) [m], or of poses (n, 4, 4) or x y z qx qy qz qw (n, 7) [m], which are copied.

        stamps: [s], (n,). Raises what Track raises, and BadRecording unless one of points and poses is given.
        """
        if (points is None) == (poses is None):
            said = "neither points nor poses are given" if points is None else "points and poses are given"
            raise BadRecording("track", said, "give one of them")
        values = np.array(points if poses is None else poses, dtype=float)
        if values.ndim == 3 and values.shape[1:] == (4, 4):
            times = None if stamps is None else np.array(stamps, dtype=float)
            return cls(values[:, :3, 3], values[:, :3, :3], times)
        return cls.of_poses(values, stamps)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def oriented(self) -> bool:
        """Whether rotations were seen."""
        return self.rotations is not None

    def part(self, rows: ArrayLike) -> Track:
        """The track of these samples, a mask or indices."""
        rows = np.asarray(rows)
        return Track(
            self.positions[rows],
            None if self.rotations is None else self.rotations[rows],
            None if self.stamps is None else self.stamps[rows],
        )

    def points(self) -> Track:
        """The same track without its rotations."""
        return Track(self.positions, None, self.stamps)

    def extent(self) -> float:
        """How far the handle came [m]: largest distance from the median position, without the last 2 % of samples."""
        away = np.linalg.norm(self.positions - np.median(self.positions, axis=0), axis=1)
        return float(np.quantile(away, _MAX_OF)) if len(away) > _MANY else float(away.max())


def _frozen(values: ArrayLike) -> Array:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadRecording("track", f"is not an array of numbers ({error})", "give numbers") from error
    array.flags.writeable = False
    return array


def _finite(what: str, array: Array) -> None:
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array.reshape(len(array), -1)).all(axis=1)))
        raise BadRecording(f"track, {what}, sample {row}", "is not finite", "leave such samples out")


def _rotations(rotations: ArrayLike, n: int) -> Array:
    R = _frozen(rotations)
    if R.shape != (n, 3, 3):
        raise BadRecording("track, rotations", f"have shape {R.shape}, not ({n}, 3, 3)", "give one rotation a sample")
    _finite("rotations", R)
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(1, 2)) + (np.linalg.det(R) < 0.0)
    if off.max() > RIGID:
        raise BadRecording(f"track, rotation of sample {int(off.argmax())}", "is not a rotation matrix",
                           "give proper orthonormal matrices")  # fmt: skip
    return R
