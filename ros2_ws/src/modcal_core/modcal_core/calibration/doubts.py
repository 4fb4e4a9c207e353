"""When even the fitted model misses by far, the input is wrong: find out in which way, and say it.

Each doubt is a mistake that people make, undone: two joints swapped, degrees taken for radians, one joint turning the
other way, readings paired with the wrong stations. The nominal arm is fitted again with the mistake undone; the one
that brings the error down several times is named. When none does, the robot or the pairing as a whole is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.score import errors
from modcal_core.errors import BadRecording, ModcalError
from modcal_core.measurements.samples import Samples

LIMIT_OF_REACH = 0.01  # a fitted arm that misses by more than this share of its reach is not an arm with small errors
_BETTER = 4.0  # how many times smaller the error must get before a mistake is named
_MOST = 300  # samples are enough to tell


def require_plausible(nominal: Fit, fitted: Fit, samples: Samples) -> None:
    """Raises BadRecording, naming the likely mistake, when the fitted model misses by more than an arm's errors can."""
    chain = nominal.model.chain
    limit = LIMIT_OF_REACH * chain.reach()
    missed = _miss(fitted, samples)
    if missed <= limit:
        return
    rows = np.linspace(0, len(samples) - 1, min(len(samples), _MOST)).astype(int)
    few = samples.select(np.unique(rows))
    usual = _miss(nominal, few)
    best: tuple[float, str, str] = (usual / _BETTER, "", "")
    for offender, remedy, undone in _mistakes(few):
        try:
            miss = _miss(fit_cell(chain, undone, Cell()), undone)
        except ModcalError:
            continue
        if miss < best[0]:
            best = (miss, offender, remedy)
    said = f"the model misses by {1e3 * missed:.0f} mm, {1e3 * limit:.0f} mm is the limit"
    if best[1]:
        raise BadRecording(best[1], f"{said}; undone, it misses by {1e3 * best[0]:.1f} mm", best[2])
    raise BadRecording(
        "joint states and readings",
        said,
        "check that the URDF, --base and --tip are those of this robot, and that joint and tracker clocks agree",
    )


def _miss(fit: Fit, samples: Samples) -> float:
    return float(np.median(errors(fit.model, samples).position_norm))


def _mistakes(samples: Samples) -> Iterator[tuple[str, str, Samples]]:
    """(offender, remedy, samples with the mistake undone)."""
    names, q = samples.names, samples.q
    for i, j in combinations(range(len(names)), 2):
        swapped = q.copy()
        swapped[:, [i, j]] = q[:, [j, i]]
        yield (
            f"joints {names[i]} and {names[j]} look swapped",
            "correct the names in joint_states",
            replace(samples, q=swapped),
        )
    for i, name in enumerate(names):
        turned = q.copy()
        turned[:, i] = -q[:, i]
        yield f"joint {name} looks reversed", "correct its sign, or the axis in the URDF", replace(samples, q=turned)
    yield "joint positions look like degrees", "record radians", replace(samples, q=np.radians(q))
    for shift in (-3, -2, -1, 1, 2, 3):
        rows = np.arange(max(0, -shift), len(q) - max(0, shift))
        yield (
            f"readings look late by {shift} stations" if shift > 0 else f"readings look early by {-shift} stations",
            "the tracker's clock is off: synchronise it with the joints' and record again",
            replace(samples.select(rows), **_reading_of(samples.select(rows + shift))),
        )
    inverse = np.swapaxes(samples.R, 1, 2)
    if samples.is_pose.all():
        undone = replace(samples, R=inverse, position=-(inverse @ samples.position[..., None])[..., 0])
        yield "readings look like inverse poses (tracker in tool)", "record the tool in the tracker's frame", undone


def _reading_of(samples: Samples) -> dict[str, Any]:
    return {"position": samples.position, "R": samples.R, "frame": samples.frame, "kind": samples.kind}
