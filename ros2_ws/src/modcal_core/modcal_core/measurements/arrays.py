"""Samples from plain arrays: the same checks, the same dwells and the same directions of approach as of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.origin import Origin
from modcal_core.measurements.recording import (
    ORDER_ONLY,
    POINT,
    POSE,
    RANGE,
    JointTrack,
    ReadingTrack,
    Recording,
    SignalTrack,
)
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.stations import cut_stations

APART = 10.0  # s between rows without stamps: far more than a window of dwells, so that each is a station
_UNIT = 0.02  # by which the length of a quaternion may be off 1


def samples_from_arrays(
    q: ArrayLike,
    points: ArrayLike | None = None,
    poses: ArrayLike | None = None,
    ranges: Mapping[str, ArrayLike] | None = None,
    names: Sequence[str] | None = None,
    stamps: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
    sigma_rad: ArrayLike | None = None,
    temperatures: Mapping[str, ArrayLike] | None = None,
    signals: Mapping[str, ArrayLike] | None = None,
    efforts: ArrayLike | None = None,
    frame: str = "tracker",
) -> Samples:
    """Samples of N postures; see :meth:`modcal_core.measurements.samples.Samples.from_arrays`."""
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
    recording = Recording(
        joints=(JointTrack(columns, t, positions, unknown, effort, np.full(N, np.nan)),),
        readings=tuple(_readings(points, poses, ranges, t, frame)),
        signals=(*_signals("temperature", temperatures, t), *_signals("signal", signals, t)),
        source="arrays",
        warnings=(ORDER_ONLY,) if stamps is None else (),
    )
    if not any(len(track.stamps) for track in recording.readings):
        raise BadRecording("arrays", "hold no reading that is finite", "give what the instrument saw")
    samples = cut_stations(recording, columns)
    began = None if stamps is None else float(t[0])
    instrument = "; ".join(dict.fromkeys(f"{track.kind} in {track.frame}" for track in recording.readings))
    return replace(
        samples,
        names=columns if names is not None else (),
        sigma_position=_sigma("sigma", sigma, samples, t, samples.sigma_position),
        sigma_rotation=_sigma("sigma_rad", sigma_rad, samples, t, samples.sigma_rotation),
        origin=Origin("arrays", began=began, instrument=instrument, checked=False),
    )


def as_recording(samples: Samples, names: tuple[str, ...]) -> Recording:
    """Joint states and readings of samples of these joints, in the form that checks ask for."""
    unknown = np.full(len(samples), np.nan)
    joints = JointTrack(names, samples.stamps, samples.q, samples.velocity, samples.effort, unknown)
    readings = []
    for f, frame in enumerate(samples.frames):
        for kind in samples.kinds:
            rows = (samples.frame == f) & (samples.kind == kind)
            T = se3.transform(samples.R[rows], samples.reading[rows])
            values = se3.to_pose(T) if kind == POSE else samples.reading[rows]
            readings.append(ReadingTrack(kind, frame, samples.stamps[rows], values, unknown[rows], "readings"))
    return Recording((joints,), tuple(readings), samples.signals, source="arrays")


def _readings(
    points: ArrayLike | None, poses: ArrayLike | None, ranges: Mapping[str, ArrayLike] | None, t: Array, frame: str
) -> list[ReadingTrack]:
    """The readings, rows of which that are not finite are left out."""
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


def _signals(kind: str, given: Mapping[str, ArrayLike] | None, t: Array) -> list[SignalTrack]:
    return [
        SignalTrack(f"{kind}:{name}", t, _numbers(f"{kind} {name}", values, 1, len(t))[:, None], kind)
        for name, values in (given or {}).items()
    ]


def _sigma(name: str, given: ArrayLike | None, samples: Samples, t: Array, found: Array) -> Array:
    """Standard deviations (N,) of the samples: as given, one for all or one a row, or as found."""
    if given is None:
        return found
    values = np.asarray(given, dtype=float)
    if not (np.isfinite(values).all() and (values > 0.0).all() and values.shape in ((), t.shape)):
        raise BadRecording(name, "is neither one positive number nor one for each row", "give standard deviations")
    if values.shape == ():
        return np.full(len(samples), float(values))
    rows = np.searchsorted(t, samples.stamps)
    if not np.array_equal(t[np.minimum(rows, len(t) - 1)], samples.stamps):
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
