"""Errors that are too small for a measurement: readings that were computed from the joints, or written with few digits.

No instrument leaves less than some micrometres, and no arm meets its drawing to its repeatability before it is
calibrated: real ones miss it by ten times :data:`_NOMINAL`. What writing readings and joints with so many digits leaves
by itself is known from the numbers. An error that is no more than that is none of an arm, at any number of stations:
the nominal arm is fitted to all of them once more, by base and tool alone, so that a few tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import FINEST, Calibration, Cell, Errors, Stated, errors, fit_cell
from modcal_core.errors import ModcalError
from modcal_core.geometry import Array
from modcal_core.hypotheses import last_step
from modcal_core.measurements import Samples, share_of_known, spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Mechanism, forward, is_serial_arm
from modcal_core.verdict.verdict import NotAsked

_MOVED = 1e-3  # rad or m; a joint that moved by more should be seen
_NOMINAL = 1.5e-4  # of the reach; nominal arms miss by ten times that, one calibrated by its maker by some 3e-4
_BETTERED = 0.64  # of the square; what a calibration takes away from a real arm's is more than a fifth in RMS
_FINE = 2e-5  # m; what writing leaves to be finer than any arm repeats
_NO_MORE = 1.6  # times what writing leaves: digits of a few stations, and a tool that reaches farther than the tip
_MOSTLY = 0.5  # of the squared error
_FEWEST = 3  # degrees of freedom beyond base and tool, from which a misfit says something
_MAX = 300  # samples; more are thinned evenly

_OWN = 0.05  # share of samples; the same posture and reading to the last digit may come again where digits are few
_COPIED = 0.75  # share of copies that are the same when rounded, at least
_AGAIN = 0.7  # the same of an arm and an instrument that repeat to 10 µm
_CHANCE = 0.01  # that readings of an instrument look so by chance
_FITTED_TO = (
    "It was fitted to them: their error is smaller than that of others, and shows no change. Evaluate another "
    "recording, or use the error that calibrate held out."
)

COMPUTED = "computed from the joints"


@dataclass(frozen=True)
class TooSmall:
    """contradictions: sentences on readings that are surely no measurement, or mostly digits. unproven: on those that
    may be none. not_asked: what could not be asked of so few.
    """

    contradictions: tuple[str, ...] = ()
    unproven: tuple[str, ...] = ()
    not_asked: tuple[NotAsked, ...] = ()


@dataclass(frozen=True)
class _Written:
    """What the last digits of readings and of joints leave by themselves, RMS over space [m], and how they are said."""

    readings: float
    joints: float
    rounded: str
    who: str
    step: float

    @property
    def both(self) -> float:
        return float(np.hypot(self.readings, self.joints))


def too_small(
    left: Mapping[str, Errors], scored: Samples, samples: Samples, chain: Mechanism, stated: Stated | None
) -> TooSmall:
    """What of the readings is too good to be measured.

    left: errors of the scored samples by stage (nominal, geometric, final). samples: all of the recording. stated:
    where both repeatability and instrument are, somebody knows the arm.
    """
    free = np.array([frame not in samples.sockets for frame in samples.frames])[samples.frame]  # a socket reads zero
    if not is_direct(samples.kinds) or not free.any() or not len(scored):
        return TooSmall()
    written = _written(samples.select(np.flatnonzero(free)), chain)
    nominal, freedom = _described(samples, chain)
    seen = {name: _rms(left[name].position_norm) for name in ("nominal", "final")}
    nominal = min(nominal, seen["nominal"])
    limit = _NOMINAL * chain.reach() if is_serial_arm(chain) else 0.0
    usual = min(nominal, float(np.median(left["nominal"].position_norm)))  # a few wrong ones do not hide the rest
    made = written.both
    for which, size in (("nominal", usual), ("fitted", float(np.median(left["final"].position_norm)))):
        most = _NO_MORE * made if made < (limit if which == "nominal" else _FINE) else 0.0
        if size < max(FINEST, most):
            return TooSmall((_computed(which, size, written),))
    digits = _digits(written, seen["final"])
    known = stated is not None and stated.rms_mm is not None and stated.instrument_mm is not None
    if known or digits or not is_serial_arm(chain):
        return TooSmall(digits)
    if freedom < _FEWEST:
        needs = "more different postures than base and tool have parameters"
        return TooSmall(not_asked=(NotAsked(f"whether readings were {COMPUTED}", needs),))
    if nominal > limit or _bettered(seen, nominal, scored.stations, freedom):
        return TooSmall()
    return TooSmall(
        unproven=(
            f"The robot description fits the readings to {1e3 * nominal:.3g} mm RMS before anything is calibrated, and "
            f"no calibration surely betters it ({1e3 * seen['final']:.3g} mm): few arms are built like that, and the "
            "controller's goals or its computed poses look like that. Check which column or topic the readings come "
            "from; if they are a tracker's, and the description was calibrated for this very arm, state its "
            "repeatability and the instrument's accuracy.",
        )
    )


def own_rows(samples: Samples, calibration: Calibration) -> TooSmall:
    """Whether samples are those that the calibration was fitted to, which make any fit look good; rounded ones, too."""
    share, _ = share_of_known(calibration.marks, samples)
    if share > _OWN:
        many = "All" if share == 1.0 else f"About {share:.0%}"
        return TooSmall(
            (
                f"{many} of these samples are of the calibration's own recording, with the same joints and readings to "
                f"the micrometre. {_FITTED_TO}",
            )
        )
    share, of = share_of_known(calibration.marks, samples, rounded=True)
    from scipy.special import bdtr, bdtrc

    same = round(share * of)
    if share <= _OWN or float(bdtr(same, of, _COPIED)) < _CHANCE:  # surely fewer
        return TooSmall()
    said = (
        f"{share:.0%} of these samples agree with the calibration's own recording to a tenth of a millimetre, at the "
        f"same postures: they look like copies with fewer digits. {_FITTED_TO}"
    )
    sure = float(bdtrc(same - 1, of, _AGAIN)) < _CHANCE
    return TooSmall((said,)) if sure else TooSmall(unproven=(said,))


def _described(samples: Samples, chain: Mechanism) -> tuple[float, float]:
    """By how much the nominal arm misses readings with the best base and tool, RMS over space [m], and the degrees of
    freedom of that; infinite and none where these cannot be fitted.
    """
    rows = np.flatnonzero(~samples.moving) if not samples.moving.all() else np.arange(len(samples))
    part = samples.select(rows[spread_rows(len(rows), _MAX)])
    try:
        fit = fit_cell(chain, part, Cell())
    except (ModcalError, np.linalg.LinAlgError):
        return np.inf, 0.0
    counted = 3.0 * len(part) + 3.0 * int(part.is_pose.sum())
    freedom = counted - len(fit.parameters)
    square = float(np.mean(errors(fit.model, part).position_norm ** 2))
    return float(np.sqrt(square * counted / max(freedom, 1e-9))), freedom * 3.0 * len(part) / counted


def _bettered(seen: Mapping[str, float], nominal: float, stations: int, freedom: float) -> bool:
    """Whether the final model is surely better than the nominal one."""
    from scipy.special import fdtri

    return bool(seen["final"] ** 2 < _BETTERED * float(fdtri(2.0 * stations, freedom, 0.01)) * nominal**2)


def _computed(which: str, size: float, written: _Written) -> str:
    remedy = "and are not a measurement. Record an instrument that looks at the arm from outside."
    if size >= FINEST and written.joints > written.readings:
        return (
            f"The {which} model misses by {1e6 * size:.2g} µm, and the last digits of the joint positions make "
            f"{1e6 * written.both:.2g} µm: the readings have no error of their own, so they were probably {COMPUTED} "
            f"(or commands) before these were rounded, {remedy}"
        )
    digit = f", their last digit ({1e3 * written.step:g} mm)," if size >= FINEST else ""
    return (
        f"The {which} model reproduces the readings to {1e6 * size:.2g} µm{digit} which no instrument does: they were "
        f"probably {COMPUTED} (a TCP topic, a pendant's column) or simulated without noise, {remedy}"
    )


def _digits(written: _Written, of: float) -> tuple[str, ...]:
    """Sentences where most of what is left is made by last digits."""
    out = []
    for made, said in (
        (written.readings, f"Positions are rounded to {written.rounded}"),
        (written.joints, written.who),
    ):
        if made and _MOSTLY * of**2 <= made**2 <= of**2 / _MOSTLY:
            out.append(
                f"{said}, which accounts for {1e3 * made:.3g} mm RMS of the {1e3 * of:.3g} mm that are left: that is "
                "the recording and neither arm nor instrument. Record or write more digits."
            )
    return tuple(out)


def _written(samples: Samples, chain: Mechanism) -> _Written:
    """The last digits of these samples. A number is as wrong as one between two steps, step / √12."""
    position = samples.reading
    each = np.array([last_step(column) for column in position.T])
    step, own = float(each.max()), " and ".join("xyz"[k] for k in np.flatnonzero(each))
    made, how = float(np.sqrt(np.sum(each**2) / 12.0)), f"{1e3 * step:.3g} mm{'' if each.all() else f' in {own}'}"
    steps = np.array([last_step(q) if np.ptp(q) > _MOVED else 0.0 for q in samples.q.T])
    if not steps.any() or not is_serial_arm(chain):
        return _Written(made, 0.0, how, "", step)
    q = samples.q[spread_rows(len(samples), _MAX)]
    tip = forward(chain, q)[:, :3, 3]
    moved = np.stack([forward(chain, q + row)[:, :3, 3] - tip for row in np.diag(steps)[steps > 0.0]])
    joints = float(np.sqrt(np.mean(np.sum(moved**2, axis=(0, 2))) / 12.0))
    names = [name for name, own in zip(samples.names, steps, strict=True) if own]
    who = "Joint positions are" if len(names) == chain.n else f"The positions of {' and '.join(names)} are"
    return _Written(made, joints, how, f"{who} rounded to {steps.max():.2g} rad", step)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0
