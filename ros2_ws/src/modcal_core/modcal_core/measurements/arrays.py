"""Tracks of a recording from plain arrays, checked, with the row in every refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE, RANGE, JointTrack, ReadingTrack, SignalTrack

APART = 10.0  # s between rows without stamps: far more than a window of dwells, so that each is a station
_UNIT = 0.02  # by which the length of a quaternion may be off 1


def joints_of(
    q: ArrayLike, names: Sequence[str] | None, stamps: ArrayLike | None, efforts: ArrayLike | None
) -> JointTrack:
    """Joint states: one row a posture, APART seconds between them where no stamps are given. Raises BadRecording."""
    positions = _numbers("q", q, 2)
    N, n = positions.shape
    if N == 0:
        raise NotEnoughData("arrays", "hold no row", "give one posture and one reading a row")
    if names is not None and (len(names) != n or len(set(names)) != n):
        raise BadRecording("names", f"{len(set(names))} names for {n} columns of q", "give each column a name")
    columns = tuple(f"column_{j}" for j in range(n)) if names is None else tuple(names)
    t: Array = APART * np.arange(N, dtype=float) if stamps is None else _numbers("stamps", stamps, 1, N)
    if not (np.diff(t) > 0.0).all():
        row = int(np.argmax(np.diff(t) <= 0.0)) + 1
        raise BadRecording("stamps", f"do not increase at row {row}", "give rows in the order of time")
    unknown = np.full((N, n), np.nan)
    effort = unknown if efforts is None else _numbers("efforts", efforts, 2, N)
    if effort.shape != (N, n):
        raise BadRecording("efforts", f"have shape {effort.shape}, not {(N, n)}", "give one number a joint")
    return JointTrack(columns, t, positions, unknown, effort, np.full(N, np.nan))


def commands_of(commanded: ArrayLike | None, joints: JointTrack) -> tuple[JointTrack, ...]:
    """Commanded positions beside these joint states, row by row; none where none are given. Raises BadRecording."""
    if commanded is None:
        return ()
    told, wanted = _numbers("commanded", commanded, 2, len(joints.stamps)), joints.position.shape
    if told.shape != wanted:
        raise BadRecording("commanded", f"have shape {told.shape}, not {wanted}", "give one number a joint")
    unknown = np.full(wanted, np.nan)
    return (JointTrack(joints.names, joints.stamps, told, unknown, unknown, joints.received, "arrays"),)


def readings_of(
    points: ArrayLike | None, poses: ArrayLike | None, ranges: Mapping[str, ArrayLike] | None, t: Array, frame: str
) -> list[ReadingTrack]:
    """The readings at these stamps; rows that are not finite are left out. Raises BadRecording unless some are left."""
    given = [name for name, x in (("points", points), ("poses", poses), ("ranges", ranges)) if x is not None]
    if len(given) != 1:
        said = "none of points, poses and ranges is given" if not given else f"{' and '.join(given)} are given"
        raise BadRecording("arrays", said, "give one of them; join samples of several with followed_by")
    tracks: list[tuple[str, str, Array]] = []
    if points is not None:
        values = _numbers("points", points, 2, len(t), finite=False)
        if values.shape[1] != 3:
            raise BadRecording("points", f"have shape {values.shape}, not ({len(t)}, 3)", "give x y z [m] in each row")
        tracks.append((POINT, frame, values))
    elif poses is not None:
        tracks.append((POSE, frame, _poses(poses, len(t))))
    else:
        for anchor, distances in (ranges or {}).items():
            tracks.append((RANGE, anchor, _numbers(f"ranges to {anchor}", distances, 1, len(t), finite=False)[:, None]))
    out = []
    for kind, name, values in tracks:
        good = np.isfinite(values).all(axis=1)
        out.append(ReadingTrack(kind, name, t[good], values[good], np.full(int(good.sum()), np.nan), "arrays"))
    if not any(len(track.stamps) for track in out):
        raise BadRecording("arrays", "hold no reading that is finite", "give what the instrument saw")
    return out


def _poses(poses: ArrayLike, N: int) -> Array:
    """Poses x y z qx qy qz qw (N, 7) from these or from matrices (N, 4, 4). Raises BadRecording."""
    values = np.asarray(poses, dtype=float)
    if values.shape == (N, 4, 4):
        R = values[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) + (np.linalg.det(R) < 0.0)
        if (off > 1e-3).any():
            raise BadRecording(
                f"pose of row {int(np.argmax(off))}", "is not a rotation matrix", "give proper rotations"
            )
        out = np.full((N, 7), np.nan)
        good = np.isfinite(values).all(axis=(1, 2))
        out[good] = se3.to_pose(values[good])
        return out
    if values.shape != (N, 7):
        said = f"have shape {values.shape}, not ({N}, 4, 4) or ({N}, 7)"
        raise BadRecording("poses", said, "give matrices, or x y z qx qy qz qw")
    length = np.linalg.norm(values[:, 3:], axis=1)
    if (np.abs(length - 1.0) > _UNIT).any():
        row = int(np.argmax(np.abs(length - 1.0)))
        raise BadRecording(f"quaternion of row {row}", f"has length {length[row]:.4g}, not 1", "give unit quaternions")
    return values


def signals_of(kind: str, given: Mapping[str, ArrayLike] | None, t: Array) -> list[SignalTrack]:
    """Temperatures or signals at these stamps, by name. Raises BadRecording."""
    return [
        SignalTrack(f"{kind}:{name}", t, _numbers(f"{kind} {name}", values, 1, len(t))[:, None], kind)
        for name, values in (given or {}).items()
    ]


def sigma_of(name: str, given: ArrayLike | None, stamps: Array, t: Array, found: Array) -> Array:
    """Standard deviations of samples with these stamps, (N,): as given, one for all or one for each t, or as found."""
    if given is None:
        return found
    values = np.asarray(given, dtype=float)
    if not (np.isfinite(values).all() and (values > 0.0).all() and values.shape in ((), t.shape)):
        raise BadRecording(name, "is neither one positive number nor one for each row", "give standard deviations")
    if values.shape == ():
        return np.full(len(stamps), float(values))
    rows = np.searchsorted(t, stamps)
    if not np.array_equal(t[np.minimum(rows, len(t) - 1)], stamps):
        raise BadRecording(name, "is given by row, but rows were averaged over dwells", "give one number")
    return values[rows]


def _numbers(name: str, values: ArrayLike, dimensions: int, count: int | None = None, finite: bool = True) -> Array:
    """An array of finite numbers with this number of dimensions and rows. Raises BadRecording."""
    try:
        out = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadRecording(name, f"is not an array of numbers ({error})", "give numbers") from error
    if out.ndim != dimensions or (count is not None and len(out) != count):
        wanted = "(N, n)" if count is None else f"{count} rows" + (f" of {dimensions} dimensions" * (dimensions > 1))
        raise BadRecording(name, f"has shape {out.shape}, not {wanted}", "give one row a posture")
    if finite and not np.isfinite(out).all():
        row = int(np.argmin(np.isfinite(out.reshape(len(out), -1)).all(axis=1)))
        raise BadRecording(f"{name}, row {row}", "is not finite", "leave such rows out")
    return out
