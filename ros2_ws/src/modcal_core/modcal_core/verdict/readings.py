"""Readings that contradict themselves: too good for an instrument, repeated while the arm moves, turned by nobody."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from modcal_core.calibration import FINEST, Errors, Stated
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Mechanism, forward, is_serial_arm

# Powers of ten of a metre that tables and pendants round to; an instrument has errors of its own beside its last digit
_STEPS = (1e-3, 1e-4, 1e-5, 1e-6)
_TELLING = 1e-4  # m; no arm's description is met to half of this, and some are met to half of the next step
_LAST_DIGIT = 0.6  # of a step; rounding to it leaves 0.48 at the usual station, and joints of few digits some more
_SAME = 0.01  # of a step; readings this close to its multiples are rounded to it
_MIN = 12  # samples from which a median is taken for the usual
# rad RMS; any instrument that measures orientation does so better, and no arm in order turns its tool by more
_TURNED = np.radians(2.0)
_LEVER = 0.1  # of the reach; an error of the arm that turns the tool moves it by the angle times this, at least
_MAX_BY_ARM = np.radians(5.0)
_FINE = 2e-5  # m; what rounding may make to be finer than any arm repeats
_BY_ROUNDING = 1.6  # times what rounding makes: the tool reaches farther than the tip
_MOSTLY = 0.5  # of the squared error
_MOVED = 1e-3  # rad or m; a joint that moved by more should be seen
_REPEATED = 3  # readings in a row that are the same to the last digit
_PILED, _PILED_SHARE = 5, 0.03  # stations, and share of them, at which a coordinate is the same to the last digit
_ROUNDED = 0.2  # share of values that occur more than once, from which a column is rounded and repeats by itself
_MAX_BITS = 16  # binary digits; single precision has 23, which is finer than instruments are
_FINEST_STEP = 1e-7  # m or rad; what numbers are apart by less is no last digit
_SEEN = 0.005  # m; readings that moved by more while the joints were the same

_NOMINAL = 1.5e-4  # of the reach; nominal arms miss by ten times that, one calibrated by its maker by some 3e-4
_BETTERED = 0.8  # times the nominal error; what a calibration takes away from a real arm's is more than a fifth

COMPUTED = "computed from the joints"


def doubtful(errors: Mapping[str, Errors], scored: Samples, samples: Samples, chain: Mechanism) -> tuple[str, ...]:
    """A sentence for each thing that makes the readings doubtful.

    errors: of the scored samples by stage (nominal, geometric, final). samples: all of the recording.
    """
    made = computed(errors, scored) or rounded(errors, scored, chain)
    return (
        *made,
        *(coarse(errors["final"], scored) if not made else ()),
        *(coarse_joints(errors["final"], scored, samples, chain) if not made else ()),
        *repeated(samples),
        *cut_off(samples),
        *turned(errors["final"], scored, chain),
    )


def computed(errors: Mapping[str, Errors], samples: Samples) -> tuple[str, ...]:
    """Whether a model reproduces the readings to what no instrument resolves (:data:`FINEST`, 2 µm).

    The nominal model is not met better than to repeatability by any arm, so rounded readings that it reproduces but for
    their last digit were computed as well; those in whole millimetres tell nothing, for some arms are as good as that.
    """
    if len(samples) < _MIN or not is_direct(samples.kinds) or all(f in samples.sockets for f in samples.frames):
        return ()
    step = _step(samples.reading)
    by_digit = _LAST_DIGIT * step if step <= _TELLING else 0.0
    for stage, model, limit in (("nominal", "nominal model", max(FINEST, by_digit)), ("final", "fitted model", FINEST)):
        left = float(np.median(errors[stage].position_norm))
        if left < limit:
            digit = f", their last digit ({1e3 * step:g} mm)," if step > FINEST else ""
            return (
                f"The {model} reproduces the readings to {1e6 * left:.2g} µm{digit} which no instrument does: they "
                f"were probably {COMPUTED} (a TCP topic, a pendant's column) or simulated without noise, "
                "and are not a measurement. Record an instrument that looks at the arm from outside.",
            )
    return ()


def too_good(
    errors: Mapping[str, Errors], samples: Samples, chain: Mechanism, stated: Stated | None
) -> tuple[str, ...]:
    """Whether the description fits as few arms' do before they are calibrated, and nothing betters it: goals do so.

    A controller's goals, or poses that it computed, miss the arm's joints by what these lag or were rounded by, and
    follow its nominal model. Not asked where both repeatability and instrument are stated: then somebody knows the arm.
    """
    known = stated is not None and stated.rms_mm is not None and stated.instrument_mm is not None
    sockets = all(frame in samples.sockets for frame in samples.frames)
    if known or sockets or len(samples) < _MIN or not is_direct(samples.kinds) or not is_serial_arm(chain):
        return ()
    nominal, final = (_rms(errors[stage].position_norm) for stage in ("nominal", "final"))
    if nominal > _NOMINAL * chain.reach() or final < _BETTERED * nominal or computed(errors, samples):
        return ()
    return (
        f"The robot description fits the readings to {1e3 * nominal:.3g} mm RMS before anything is calibrated, and no "
        f"calibration betters it ({1e3 * final:.3g} mm): few arms are built like that, and the controller's goals or "
        "its computed poses look like that. Check which column or topic the readings come from; if they are a "
        "tracker's, and the description was calibrated for this very arm, state its repeatability and the "
        "instrument's accuracy.",
    )


def rounded(errors: Mapping[str, Errors], samples: Samples, chain: Mechanism) -> tuple[str, ...]:
    """Whether nothing is left but what rounding the joint positions makes, where that is finer than instruments are.

    Each joint's last digit is as wrong as a number between two steps is, step / √12, and moves the tip by its lever.
    """
    step = _step_of_joints(samples.q)
    if not step or len(samples) < _MIN or not is_direct(samples.kinds) or not is_serial_arm(chain):
        return ()
    tip = forward(chain, samples.q)[:, :3, 3]
    moved = np.stack([forward(chain, samples.q + step * e)[:, :3, 3] - tip for e in np.eye(chain.n)])
    made = float(np.sqrt(np.mean(np.sum(moved**2, axis=(0, 2))) / 12.0))
    for stage, called in (("nominal", "nominal"), ("final", "fitted")):
        left = _rms(errors[stage].position_norm)
        if made < _FINE and left < _BY_ROUNDING * made:
            return (
                f"The {called} model misses by {1e6 * left:.2g} µm RMS, and joint positions rounded to {step:.2g} rad "
                f"make {1e6 * made:.2g} µm: the readings have no error of their own, so they were probably computed "
                "from the joints (or commands) before these were rounded, and are not a measurement. Record an "
                "instrument that looks at the arm from outside.",
            )
    return ()


def coarse(left: Errors, samples: Samples) -> tuple[str, ...]:
    """Whether most of what is left is made by the last digit of the positions.

    Each coordinate is as wrong as a number between two steps is, step / √12, which is step / 2 over three axes.
    """
    free = np.array([frame not in samples.sockets for frame in samples.frames])[samples.frame]  # a socket reads zero
    if free.sum() < _MIN or not is_direct(samples.kinds):
        return ()
    position = samples.reading[free]
    step = max(_step(position), min(_lattice(column) for column in position.T))
    made, of = step / 2.0, _rms(left.position_norm[free])
    how = f"{1e3 * step:.3g} mm"
    if bits := _bits(position):
        last = 2.0 ** (np.floor(np.log2(np.maximum(np.abs(position), 1e-12))) - bits)
        by_bits = float(np.sqrt(np.mean(np.sum(last**2, axis=1)) / 12.0))
        if by_bits > made:
            made, how = by_bits, f"{bits + 1} binary digits (numbers of low precision)"
    if not made or not _MOSTLY * of**2 <= made**2 <= of**2 / _MOSTLY:
        return ()
    return (
        f"Positions are rounded to {how}, which accounts for {1e3 * made:.3g} mm RMS of the {1e3 * of:.3g} mm "
        "that are left: that is the export and not the instrument. Write more digits.",
    )


def _bits(x: np.ndarray) -> int:
    """Binary digits after the first that numbers are written with, 0 where they are many."""
    mantissa, _ = np.frexp(x)
    for bits in range(4, _MAX_BITS + 1):
        u = mantissa * 2.0 ** (bits + 1)
        if np.abs(u - np.round(u)).max() < 1e-6:
            return bits
    return 0


def _lattice(x: np.ndarray) -> float:
    """Common step of numbers (N,), all of which differ by multiples of it; 0 where it is below :data:`_FINEST_STEP`."""
    size = 0.0
    for gap in np.diff(np.unique(x)):
        a, b = max(size, float(gap)), min(size, float(gap))
        while b > _FINEST_STEP:
            a, b = b, abs(a - b * round(a / b))
        size = a
        if size < 10.0 * _FINEST_STEP:
            return 0.0
    return size


def coarse_joints(left: Errors, scored: Samples, samples: Samples, chain: Mechanism) -> tuple[str, ...]:
    """Whether most of what is left is made by the last digit of joint positions, each moving the tool by its lever.

    samples: all of the recording, which tell better than the scored ones what is rounded.
    """
    if len(scored) < _MIN or not is_direct(samples.kinds) or not is_serial_arm(chain):
        return ()
    steps = np.array([_step_of_joints(q) if np.ptp(q) > _MOVED else 0.0 for q in samples.q.T])
    if not steps.any():
        return ()
    tip = forward(chain, scored.q)[:, :3, 3]
    moved = np.stack([forward(chain, scored.q + row)[:, :3, 3] - tip for row in np.diag(steps)])
    made, of = float(np.sqrt(np.mean(np.sum(moved**2, axis=(0, 2))) / 12.0)), _rms(left.position_norm)
    if not _MOSTLY * of**2 <= made**2 <= of**2 / _MOSTLY:
        return ()
    names = [name for name, step in zip(samples.names, steps, strict=True) if step]
    who = "Joint positions are" if len(names) == chain.n else f"The positions of {' and '.join(names)} are"
    return (
        f"{who} rounded to {steps.max():.2g} rad, which accounts for {1e3 * made:.3g} mm RMS of the {1e3 * of:.3g} mm "
        "that are left: that is the recording and not the arm. Record or write more digits.",
    )


def _step_of_joints(q: np.ndarray) -> float:
    """The power of ten of a radian or a degree that joint positions are rounded to [rad]; 0 where there is none."""
    for unit in (1.0, np.pi / 180.0):
        for digits in range(1, 6):
            u = q / (unit * 10.0**-digits)
            if len(u) and np.abs(u - np.round(u)).max() < _SAME:
                return float(unit * 10.0**-digits)
    return _lattice(q) if q.ndim == 1 else 0.0


def _step(position: np.ndarray) -> float:
    """The power of ten [m] that the readings are rounded to; 0 where there is none."""
    for step in _STEPS:
        u = position / step
        if len(u) and np.abs(u - np.round(u)).max() < _SAME:
            return step
    return 0.0


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
        if frame in samples.sockets or len(rows) < _MIN:
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
    if len(left.rotation_norm) < _MIN:
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
