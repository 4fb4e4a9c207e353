"""A track: what was seen of a handle, pose by pose or point by point, in the order in which it was seen.

A sample joins the nearest node within reach, else it founds one; when there are too many, the reach grows and nodes are
pooled again. So an outlier stays apart, and a dwell, or a path that is gone over again, makes nodes surer, not more. A
whole track is pooled, drawn from and counted in the same order whether the door opened or closed.

An outlier is a sample that lies where neither of its neighbours in time lies; a stretch that departs from a model is
none. A handle that rests says the same with every sample, and a hundred of them must not outvote the motion.

One stamp that is seconds off is a fault of whoever stamped it, and must not wipe what was learned. When the next one
goes on from there, time itself has changed: ahead it is a pause, behind a recording that begins again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modcal_core.articulation.furniture import PLAY, SWAY
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array, so3

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
        """The track of poses x y z qx qy qz qw (n, 7) or (n, 4, 4), or of positions (n, 3) [m], which are copied.

        Raises what Track raises, and BadRecording for a quaternion whose length is off 1 by more than 2 %.
        """
        poses = np.array(poses, dtype=float)
        times = None if stamps is None else np.array(stamps, dtype=float)
        if poses.ndim == 3 and poses.shape[1:] == (4, 4):
            return cls(poses[:, :3, 3], poses[:, :3, :3], times)
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
        """:meth:`of_poses` of points or poses. Raises BadRecording unless one of them is given."""
        if (points is None) == (poses is None):
            said = "neither points nor poses are given" if points is None else "points and poses are given"
            raise BadRecording("track", said, "give one of them")
        return cls.of_poses(points if poses is None else poses, stamps)  # type: ignore[arg-type]

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


_LENGTH = 0.1  # m: a turn of 1 rad is as far as this shift
_FIRST_REACH = 4e-3  # m
_OF_EXTENT, _OF_NOISE = 1.0 / 8.0, 4.0  # of a small path's extent, and deviations of noise, that a node reaches
FEWEST_NODES = 6  # while more are coming: a circle in space has six parameters


class Nodes:
    """A track of any length as at most ``most`` pooled samples, in the order of their first sample."""

    def __init__(self, oriented: bool, most: int = 32, reach: float = _FIRST_REACH) -> None:
        """Empty. reach: how far from a node samples join it, at first [m]."""
        self.oriented, self.most, self.reach = oriented, most, reach
        self._width = 12 if oriented else 3
        self._sums = np.zeros((most, self._width))
        self.counts = np.zeros(most)
        self.k = 0

    def add(self, position: Array, rotation: Array | None, weight: float = 1.0) -> bool:
        """Pool one sample; whether there were too many nodes, so that all were pooled again, which takes its time."""
        row = np.empty(self._width)
        row[:3] = position
        if self.oriented:
            assert rotation is not None
            row[3:] = rotation.ravel() * (_LENGTH / np.sqrt(2.0))
        return self._pool(row * weight, weight)

    def _pool(self, row: Array, weight: float) -> bool:
        if self.k:
            apart = self.means() - row / weight
            squared = (apart * apart).sum(axis=1)
            nearest = int(squared.argmin())
            if squared[nearest] <= self.reach**2:
                self._sums[nearest] += row
                self.counts[nearest] += weight
                return False
        if self.k == self.most:
            self._coarsen()
            self._pool(row, weight)
            return True
        self._sums[self.k], self.counts[self.k] = row, weight
        self.k += 1
        return False

    def _coarsen(self) -> None:
        rows, counts, k = self._sums[: self.k].copy(), self.counts[: self.k].copy(), self.k
        while True:
            self.reach *= 1.2
            self.k = 0
            self.counts[:] = 0.0
            for i in range(k):
                self._pool(rows[i], float(counts[i]))
            if self.k <= 0.75 * self.most:
                return

    def means(self) -> Array:
        """Means (k, 3), or (k, 12) with the rotation's matrix scaled to a length [m]."""
        return self._sums[: self.k] / self.counts[: self.k, None]

    def apart(self) -> Array:
        """Distances (k, k) [m] between nodes, turns counted as the shift of a hand's length."""
        m = self.means()
        squares = (m * m).sum(axis=1)
        return np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * m @ m.T, 0.0))

    def track(self, fewest: int = FEWEST_NODES) -> Track | None:
        """The nodes as a track; None where they are fewer than that."""
        if self.k < fewest:
            return None
        m = self.means()
        if not self.oriented:
            return Track.trusted(m)
        return Track.trusted(m[:, :3], so3.nearest_rotation(m[:, 3:].reshape(-1, 3, 3)))


def pooled(track: Track, most: int, noise: float) -> Nodes:
    """The nodes of a whole track. noise: of one sample on an axis [m]; nodes of a short path lie closer."""
    reach = min(_FIRST_REACH, max(_OF_EXTENT * track.extent(), _OF_NOISE * noise))
    nodes, ordered = Nodes(track.oriented, most, reach), one_way(track)
    for i in range(len(track)):
        nodes.add(ordered.positions[i], None if ordered.rotations is None else ordered.rotations[i])
    return nodes


def backwards(positions: Array) -> bool:
    """Whether positions (n, 3) are to be taken from the last to the first: they end nearer to their middle than begin.

    The reverse of a track gives the opposite, a moved or mirrored one the same. A track that is its own mirror image
    has no direction, and none matters to it.
    """
    away = ((positions - positions.mean(axis=0)) ** 2).sum(axis=1)
    late = np.arange(len(away)) - 0.5 * (len(away) - 1)
    return float(late @ away) < 0.0


def one_way(track: Track) -> Track:
    """The track, or its reverse: of both the same. Stamps are left out."""
    p, R = track.positions, track.rotations
    if not backwards(p):
        return Track.trusted(p, R)
    return Track.trusted(p[::-1], None if R is None else R[::-1])


_NEAR = (-2, -1, 1, 2)  # neighbours in time; an outlier may have one or two that are outliers as well
_AROUND = 7  # samples either way, whose steps are the usual ones there
_LEAP = 4.0  # times the usual step, and the usual play of furniture
_PLACE = 3e-3  # m: samples within it, or within three deviations of noise, are in one place
_CROWD = 2.0  # times as many samples in one place as is usual on this track are enough
_FEW = 5  # samples of a place that are kept in any case
_LEAST = 6  # samples that are left; of fewer, which are outliers nobody can say
_MARK = 0.01  # m of path between marks
_Rows = NDArray[np.intp]


def telling(track: Track) -> _Rows:
    """Rows of the samples that tell of the path, in their order; all of them where too few would be left."""
    rows = np.flatnonzero(~lone(track))
    if len(rows) < _LEAST:
        return np.arange(len(track))
    moving = track.part(rows)
    kept = _without_rests(one_way(moving))
    rows = rows[np.sort(len(rows) - 1 - kept) if backwards(moving.positions) else kept]
    return rows if len(rows) >= _LEAST else np.arange(len(track))


def lone(track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) are far from both their neighbours in time."""
    p, R = track.positions, track.rotations
    out = _apart(len(track), lambda i, j: np.linalg.norm(p[i] - p[j], axis=1), _LEAP * float(np.exp(PLAY[0])))
    if R is not None:
        out |= _apart(len(track), lambda i, j: _turn(R[i], R[j]), _LEAP * float(np.exp(SWAY[0])))
    return out


def _apart(n: int, distance: Callable[[_Rows, _Rows], Array], slack: float) -> NDArray[np.bool_]:
    i = np.arange(n)
    to = np.full((len(_NEAR), n), np.inf)
    for row, k in zip(to, _NEAR, strict=True):
        known = (i + k >= 0) & (i + k < n)
        row[known] = distance(i[known], i[known] + k)
    second = np.sort(to, axis=0)[1]
    steps = distance(i[:-1], i[1:])
    usual = np.array([np.median(steps[max(0, k - _AROUND) : k + _AROUND]) for k in range(n)])
    return np.asarray(second > _LEAP * usual + slack)


def _turn(R: Array, S: Array) -> Array:
    """About the angles [rad] between rotations (n, 3, 3)."""
    return np.linalg.norm((R - S).reshape(len(R), 9), axis=1) / np.sqrt(2.0)


def white(positions: Array) -> float:
    """White noise on an axis [m], from second differences, which no steady motion has."""
    bend = np.diff(positions, 2, axis=0)
    return float(np.sqrt(np.median((bend**2).sum(axis=1)) / 2.366 / 6.0)) if len(bend) else 0.0


def _without_rests(track: Track) -> _Rows:
    """Rows of a track with long stops thinned to the usual number of samples at one place."""
    p, R = track.positions, track.rotations
    reach = max(_PLACE, 3.0 * white(p))
    places, begin = [], 0
    for i in range(1, len(p)):
        away = float(np.linalg.norm(p[i] - p[begin]))
        if R is not None:
            away = max(away, _LENGTH * float(_turn(R[i : i + 1], R[begin : begin + 1])[0]))
        if away > reach:
            places.append(np.arange(begin, i))
            begin = i
    places.append(np.arange(begin, len(p)))
    most = max(_FEW, int(_CROWD * np.median([len(rows) for rows in places])))
    return np.concatenate(
        [rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))] for rows in places]
    )


def travelled(track: Track) -> Array:
    """How far the handle had come along its path at each sample (n,) [m]; noise is no path."""
    p = track.positions
    if backwards(p):
        way = _way(p[::-1])
        return np.asarray(way[-1] - way[::-1])
    return _way(p)


def _way(p: Array) -> Array:
    mark = max(_MARK, 5.0 * white(p))
    at, way, out = p[0], 0.0, np.zeros(len(p))
    for i, here in enumerate(p):
        step = float(np.linalg.norm(here - at))
        if step >= mark:
            at, way = here, way + step
        out[i] = way + (0.0 if step >= mark else min(step, mark))
    return np.maximum.accumulate(out)


_STAMP_LEAP = 1.0  # s beyond the time that passed between two arrivals
Order = Literal["next", "late", "alone", "restart"]


class StampOrder:
    """The stamps so far. last: of the last pose that was taken, −inf before [s]."""

    def __init__(self) -> None:
        self.last = -math.inf
        self._heard = -math.inf
        self._alone: float | None = None

    def judge(self, stamp: float, heard: float) -> Order:
        """What to do with a pose of a stamp [s] that arrived at ``heard`` on a clock that only goes on [s].

        next: take it. late: older than the last by less than a second, leave it out. alone: it leaps, and the next has
        to say whether that is the time now; leave it out. restart: time has restarted; forget, and take it.
        """
        gap = stamp - self.last
        usual = -_STAMP_LEAP <= gap <= _STAMP_LEAP + max(heard - self._heard, 0.0)
        leaps = math.isfinite(self.last) and not usual
        if leaps:
            alone, self._alone = self._alone, stamp
            together = alone is not None and stamp >= alone and (stamp > self.last) == (alone > self.last)
            if not together:
                return "alone"
        elif gap < 0.0:
            return "late"
        self.last, self._heard, self._alone = stamp, heard, None
        return "restart" if leaps and gap < 0.0 else "next"
