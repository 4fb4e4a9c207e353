"""Readings that contradict themselves: repeated while the arm moves, cut off, turned by nobody."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from modcal_core.calibration import Errors
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism

# rad RMS; any instrument that measures orientation does so better, and no arm in order turns its tool by more
_TURNED = np.radians(2.0)
_LEVER = 0.1  # of the reach; an error of the arm that turns the tool moves it by the angle times this, at least
_MAX_BY_ARM = np.radians(5.0)
_MOVED = 1e-3  # rad or m; a joint that moved by more should be seen
_REPEATED = 3  # readings in a row that are the same to the last digit
_PILED, _PILED_SHARE = 5, 0.03  # stations, and share of them, at which a coordinate is the same to the last digit
_ROUNDED = 0.2  # share of values that occur more than once, from which a column is rounded and repeats by itself
_COPIES = 0.5  # share of the stations; where digits are few, some may read alike
_SEEN = 0.005  # m; readings that moved by more while the joints were the same


def doubtful(errors: Mapping[str, Errors], scored: Samples, samples: Samples, chain: Mechanism) -> tuple[str, ...]:
    """A sentence for each thing that makes the readings doubtful.

    errors: of the scored samples by stage (nominal, geometric, final). samples: all of the recording.
    """
    return (*copied(samples), *repeated(samples), *cut_off(samples), *turned(errors["final"], scored, chain))


def copied(samples: Samples) -> tuple[str, ...]:
    """A sentence where most stations are there several times, with the same joints and readings to the last digit."""
    read = np.array([frame not in samples.sockets for frame in samples.frames])[samples.frame]
    rows = np.flatnonzero(read & ~samples.moving & (samples.is_pose | (samples.kind == "point")))
    if not len(rows):
        return ()
    table = np.column_stack([samples.q[rows], samples.reading[rows], samples.R[rows].reshape(-1, 9)])
    _, of = np.unique(table, axis=0, return_inverse=True)
    pairs = np.unique(np.column_stack([of.ravel(), samples.station[rows]]), axis=0)  # within a station nothing moved
    twice = np.bincount(pairs[:, 0])[pairs[:, 0]] > 1
    if twice.mean() <= _COPIES:
        return ()
    return (
        f"{int(twice.sum())} of {len(pairs)} stations are there several times, with the same joints and readings to "
        "the last digit: no instrument reads the same twice. Leave the copies out.",
    )


def repeated(samples: Samples) -> tuple[str, ...]:
    """Readings, or joint positions, that stand still over several stations while the others move."""
    out = []
    for f, frame in enumerate(samples.frames):
        rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")))
        if frame in samples.sockets or len(rows) < _REPEATED:
            continue
        rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
        q, p = samples.q[rows], samples.reading[rows]
        moved = np.abs(np.diff(q, axis=0)).max(axis=1)
        seen = np.linalg.norm(np.diff(p, axis=0), axis=1)
        stale, frozen = (seen == 0.0) & (moved > _MOVED), (moved == 0.0) & (seen > _SEEN)
        for what, other, runs in (("readings", "joints", stale), ("joint positions", "readings", frozen)):
            count = _in_runs(runs)
            if count:
                out.append(
                    f"In frame '{frame}' {what} stand still over {count} stations while the {other} move: one of the "
                    "two topics repeats what it said before."
                )
    return tuple(out)


def cut_off(samples: Samples) -> tuple[str, ...]:
    """Coordinates that are exactly the same at many stations, being different to the last digit at the others."""
    out = []
    for f, frame in enumerate(samples.frames):
        rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")))
        if frame in samples.sockets or len(rows) < _PILED:
            continue
        lost = _same_everywhere(samples.reading[rows])
        if lost is not None:
            where, count = lost
            out.append(
                f"In frame '{frame}' positions are exactly ({', '.join(f'{x:.4g}' for x in where)}) m at {count} of "
                f"{len(rows)} stations: that is not a measurement (a lost beam, a default). Leave these stations out."
            )
            continue
        for axis, column in zip("xyz", samples.reading[rows].T, strict=True):
            values, counts = np.unique(column, return_counts=True)
            most = int(np.argmax(counts))
            if counts[most] < max(_PILED, _PILED_SHARE * len(rows)) or (np.delete(counts, most) > 1).mean() > _ROUNDED:
                continue
            end = "largest" if most == len(values) - 1 else "smallest" if most == 0 else ""
            which = f", its {end} value: it looks cut off (the end of the instrument's range)" if end else ""
            out.append(
                f"In frame '{frame}' coordinate {axis} of the readings is exactly {values[most]:.6g} m at "
                f"{counts[most]} of {len(rows)} stations{which or ': that is not a measurement'}. "
                "Leave these stations out."
            )
    return tuple(out)


def _same_everywhere(position: np.ndarray) -> tuple[np.ndarray, int] | None:
    """The place that several of some positions (N, 3) share to the last digit, and how many; None where none does."""
    places, counts = np.unique(position, axis=0, return_counts=True)
    most = int(np.argmax(counts))
    few = counts[most] < max(_PILED, _PILED_SHARE * len(position))
    return None if few or (np.delete(counts, most) > 1).mean() > _ROUNDED else (places[most], int(counts[most]))


def _in_runs(same: np.ndarray) -> int:
    """Number of samples in runs of at least a minimum length of equal ones. same: whether each equals the one before,
    (N - 1,).
    """
    edges = np.flatnonzero(np.diff(np.r_[False, same, False].astype(int)))
    runs = edges[1::2] - edges[::2] + 1
    return int(runs[runs >= _REPEATED].sum())


def turned(left: Errors, samples: Samples, chain: Mechanism) -> tuple[str, ...]:
    """Whether orientations miss by more than instrument and arm can, while positions fit."""
    angle = _rms(left.rotation_norm)
    if not len(left.rotation_norm):
        return ()
    # known scatter of the readings, and what an arm whose positions miss by so much could turn
    known = 3.0 * float(np.sqrt(3.0) * np.nan_to_num(np.nanmedian(np.r_[0.0, samples.sigma_rotation[samples.is_pose]])))
    by_arm = min(_rms(left.position_norm) / (_LEVER * chain.reach()), float(_MAX_BY_ARM))
    if angle <= max(float(_TURNED), known, by_arm):
        return ()
    return (
        f"Orientations miss by {np.degrees(angle):.3g}° RMS beside {1e3 * _rms(left.position_norm):.3g} mm: more than "
        "an arm or an instrument does, and no convention of quaternions or Euler angles explains it. Check that the "
        "target was not turned on the tool, and that all readings are of one target.",
    )


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0
