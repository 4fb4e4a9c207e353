"""Which of the :mod:`mistakes` explains best why an arm is missed by far: each is undone, and the arm fitted again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.calibration import Cell, Model, errors, fit_cell, usual_miss
from modcal_core.errors import ModcalError
from modcal_core.measurements import Samples
from modcal_core.plausibility.mistakes import (
    Mistake,
    inverse_pose,
    left_handed,
    mirror_image,
    of_joints,
    of_pairing,
    of_several_joints,
    of_units,
)
from modcal_core.plausibility.screening import most_likely
from modcal_core.robots import Mechanism, forward, is_serial_arm

_BETTER = 4.0  # how many times smaller the error must get before a mistake is named
_TURNED = 0.05  # rad that orientations may be missed by: nominal arms turn tips 3 mrad too far ...
NO_HELP = 0.5  # ... or, up to this, as much as without it: what is missed by more agrees with no posture of the arm
_MOST = 0.9  # share of the orientations; single ones may be wrong
_PLAINLY = 0.8  # times what the best single mistake leaves, by which one of several joints must be better
_SCREENED = 4  # mistakes of several joints that are fitted


def explaining(nominal: Model, samples: Samples) -> tuple[float, str, str]:
    """By how much the arm misses with the best mistake undone [m], its offender and remedy; empty texts for none.

    nominal: the arm placed by these samples, as they are.
    """
    chain = nominal.chain
    missed = missed_angle(nominal, samples)
    turned = max(missed if missed < NO_HELP else 0.0, _TURNED)
    best: tuple[float, str, str] = (usual_miss(nominal, samples) / _BETTER, "", "")
    for mistake in _mistakes(samples.names, bool(samples.is_pose.all())):
        best = _weighed(mistake, samples, chain, best, turned)
    if is_serial_arm(chain) and len(samples.frames) == 1:  # of several joints, which must explain plainly more
        several = (_PLAINLY * best[0], "", "")
        for mistake in most_likely(samples, chain, list(of_several_joints(samples.names)), _SCREENED):
            several = _weighed(mistake, samples, chain, several, turned)
        best = several if several[1] else best
    return best


def missed_angle(model: Model, samples: Samples) -> float:
    """By which a model misses no more than nine tenths of the orientations [rad], 0 where there are none.

    A mistake is one of the whole recording: where one half of it is of another convention, each joint that makes the
    other half fit would explain the median.
    """
    angles = errors(model, samples).rotation_norm
    return float(np.quantile(angles, _MOST)) if len(angles) else 0.0


def _weighed(
    mistake: Mistake, samples: Samples, chain: Mechanism, best: tuple[float, str, str], turned: float
) -> tuple[float, str, str]:
    """The better of the best so far and this mistake: by how much the arm misses with it undone, and what to say.

    turned: what orientations may be missed by [rad]; what makes positions fit and not them is no explanation.
    """
    undone = mistake.undone(samples)
    try:
        model = fit_cell(chain, undone, Cell()).model
    except ModcalError:
        return best
    if missed_angle(model, undone) > turned:
        return best
    miss = usual_miss(model, undone)
    if samples.sockets and mistake.touches == "joints":
        miss *= max(1.0, _extent(chain, samples) / max(_extent(chain, undone), 1e-12))
    return (miss, mistake.offender, mistake.remedy) if miss < best[0] else best


def _extent(chain: Mechanism, samples: Samples) -> float:
    """RMS distance of the flange between postures [m]: an arm that hardly moved returns to any socket."""
    return float(np.sqrt(forward(chain, samples.q)[:, :3, 3].var(axis=0).sum()))


def _mistakes(names: tuple[str, ...], poses: bool) -> Iterator[Mistake]:
    """The mistakes that are weighed here; conventions of orientation have been settled before."""
    yield from of_joints(names)
    yield from of_pairing()
    yield from of_units()
    yield left_handed()
    if poses:
        yield inverse_pose()
        yield mirror_image()
