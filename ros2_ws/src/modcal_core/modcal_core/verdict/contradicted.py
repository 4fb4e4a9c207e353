"""What data contradict: known distances, stated places, readings that are none, quantities that no arm has.

Readings contradict themselves where they are repeated while the arm moves, cut off, or turned by nobody.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from modcal_core.calibration import Cell, Errors, Fit, KnownDistance, Model, contradicted_places, contradicted_together
from modcal_core.calibration import contradictions as contradictions_of_distances
from modcal_core.hypotheses import computed_in_part
from modcal_core.measurements import Samples
from modcal_core.robots import Inertias, Mechanism

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
    """The place that several of some positions (N, 3) share to the last digit, and how many; None if all differ."""
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
    mm, deg = left.size_mm(), left.size_deg()
    if mm is None or deg is None:
        return ()
    # known scatter of the readings, and what an arm whose positions miss by so much could turn
    known = 3.0 * float(np.sqrt(3.0) * np.nan_to_num(np.nanmedian(np.r_[0.0, samples.sigma_rotation[samples.is_pose]])))
    by_arm = min(1e-3 * mm.rms / (_LEVER * chain.reach()), float(_MAX_BY_ARM))
    if np.radians(deg.rms) <= max(float(_TURNED), known, by_arm):
        return ()
    return (
        f"Orientations miss by {deg.rms:.3g}° RMS beside {mm.rms:.3g} mm: more than "
        "an arm or an instrument does, and no convention of quaternions or Euler angles explains it. Check that the "
        "target was not turned on the tool, and that all readings are of one target.",
    )


_MAX_KG = 5000.0  # the heaviest serial arms weigh three tonnes in all


def sane_inertias(inertias: Inertias | None, chain: Mechanism) -> tuple[Inertias | None, tuple[str, ...]]:
    """The bodies of the arm, None where some are absurd, and a sentence that names each of these."""
    if inertias is None or not inertias.known:
        return inertias, ()
    reach = chain.reach()
    said = []
    for name, mass, com in zip(chain.names, inertias.mass, inertias.com, strict=True):
        away = float(np.linalg.norm(com))
        if not np.isfinite(mass) or not np.isfinite(away) or not 0.0 <= mass <= _MAX_KG:
            said.append(f"behind {name} a mass of {mass:.3g} kg")
        elif mass > 0.0 and away > reach:
            said.append(f"behind {name} a centre of mass {away:.3g} m away, where the arm reaches {reach:.2f} m")
    if not said:
        return inertias, ()
    return None, (
        f"The robot description states {'; '.join(said)}. Its masses were not used, so loads are per kg at the tip: "
        "correct <inertial> in the URDF (metres and kilograms).",
    )


def long_tool(model: Model) -> tuple[str, ...]:
    """A sentence where the tool was found farther from the flange than the arm is long."""
    length, reach = float(np.linalg.norm(model.T_tip_tool[:3, 3])), model.chain.reach()
    if length <= reach:
        return ()
    return (
        f"The tool was found {length:.2f} m from {_tip(model)}, and the arm reaches {reach:.2f} m: check that the "
        "URDF, --base and --tip are those of this robot, and turn the wrist more while recording.",
    )


def _tip(model: Model) -> str:
    return str(getattr(model.chain, "tip", "") or "the flange")


def contradictions(
    fit: Fit,
    train: Samples,
    samples: Samples,
    scored: Samples,
    wrong: np.ndarray,
    errors: Mapping[str, Errors],
    distances: Sequence[KnownDistance],
    cell: Cell,
    chain: Mechanism,
) -> tuple[str, ...]:
    """A sentence for each contradiction; each makes the verdict *open*.

    fit: of the samples ``train``. samples: all of them. scored: those that the ``errors`` of nominal, geometric and
    final model are of. wrong (N,): samples that were rejected. distances: of the cell, as the fit has them. chain: the
    nominal arm.
    """
    return (
        *contradictions_of_distances(distances),
        *contradicted_together(fit, train, cell.distances),
        *contradicted_places(fit, cell.tool, cell.known),
        *doubtful(errors, scored, samples, chain),
        *computed_in_part(samples, chain, wrong),
        *samples.origin.doubts,
        *long_tool(fit.model),
    )
