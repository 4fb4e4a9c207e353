"""How well a repaired model is known beside the calibration before, and how many stations more would make them alike.

A calibration from many stations averages their noise; what a few new ones say of a base or a tool has that of the few.
The covariances hold both: of a change of six numbers ten stations leave about twice the error that a calibration from
160 had. The part that the new stations leave falls with their number, the part that was kept stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Calibration, Model
from modcal_core.checking.known import frozen
from modcal_core.checking.noise import parameter_rows
from modcal_core.checking.state import state_at
from modcal_core.errors import ModcalError
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

ALIKE = 1.3  # times the error before: what a repair should cost at most, since joints and readings vary by as much


@dataclass(frozen=True)
class RepairAccuracy:
    """before, repaired: RMS error [m] of predicted positions at the recorded postures, by the covariances of the
    calibration before the change and of the repaired one. more: stations like these, beside them, with which the
    repaired one would be within :data:`ALIKE` times the other; None where that is more than a check looks at.
    """

    before: float
    repaired: float
    more: int | None

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        said = f"By its covariance the repaired model is known to {1e3 * self.repaired:.3f} mm RMS at the recorded "
        said += f"postures, the calibration before to {1e3 * self.before:.3f} mm."
        if self.more == 0:
            return said
        if self.more is None:
            return f"{said} To know it as well again takes a new calibration."
        return f"{said} {self.more} more stations like these would bring it within {ALIKE:g} times that."


def accuracy_of(
    before: tuple[Calibration, Model], repaired: tuple[Calibration, Model], samples: Samples, most: int
) -> RepairAccuracy | None:
    """How well both are known.

    before, repaired: calibrations with their models for these samples. most: stations that a check looks at. None where
    either keeps no covariance or no postures, or where their effects depend on what is not known there.
    """
    known = [expected_error(*one, samples, before[0].postures) for one in (before, repaired)]
    if known[0] is None or known[1] is None:
        return None
    old, now = known[0] ** 2, known[1] ** 2
    added = max(now - old, 0.0)
    wanted = (ALIKE**2 - 1.0) * max(old, 1e-300)
    more = 0 if added <= wanted else int(np.ceil(samples.stations * (added / wanted - 1.0)))
    return RepairAccuracy(known[0], known[1], more if samples.stations + more <= most else None)


def expected_error(calibration: Calibration, model: Model, samples: Samples, q: Array) -> float | None:
    """RMS error [m] of positions predicted at postures q (k, n), by a calibration's covariance; None without one."""
    if not len(q) or calibration.uncertainty is None:
        return None
    try:
        state = state_at(q, frozen(calibration, model, samples, 0.0).model, samples, calibration.noise)
        known = frozen(calibration, model, state.samples, 0.0).known
        J = parameter_rows(state.model, state.view, state.drivers, known.parameters, known.effects)[:, : 3 * len(q)]
    except ModcalError:
        return None
    return float(np.sqrt(np.sum(J * (known.covariance @ J)) / len(q)))
