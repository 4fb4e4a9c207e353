"""Whether a small recording, or what comes live, is one of the calibrated robot, in the convention of the calibration.

A base or a tool that was moved by any amount leaves a recording that the calibrated arm still explains, with base and
tool fitted again. One in other units or in another convention does not, and is refused where undoing the mistake
explains it: a change that is fitted to it would be calm and wrong. What then still misses by far is doubted: it is of
another robot, unless the search finds changes that explain it (``checking/accounted``). An inverse
pose is undone, as calibrate does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, NoiseModel, errors
from modcal_core.errors import BadRecording
from modcal_core.measurements import POINT, Samples
from modcal_core.plausibility.agreement import ANGLE
from modcal_core.plausibility.conventions import match, points_match, rough_scores
from modcal_core.plausibility.mistakes import (
    Mistake,
    inverse_pose,
    left_handed,
    mirror_image,
    of_axes,
    of_joints,
    of_rarer_units,
    of_rotations,
    of_units,
)
from modcal_core.plausibility.standing import standing
from modcal_core.robots import is_serial_arm

INVERTED = "pose inverted"
MIN = 6  # readings of a frame, from which base and tool of an arm that is known leave enough to judge it by
MISREAD = 0.01  # of the reach: what misses by more with base and tool fitted again is another arm, or not metres
_CANDIDATES = 6  # the likeliest by closed form, which are then fitted
_NEAR = 20.0  # standard deviations, within which nothing has to be asked
_OURS = 0.2  # of the miss as it is, by what is meant once a mistake is undone
_AT_MIN = 2e-3  # of the reach: what misses by less as it is may be an arm that bent, and is not refused for its words


@dataclass(frozen=True)
class ArmMiss:
    """How far the calibrated arm misses readings with base and tool fitted again: medians [m], [rad]."""

    position: float
    rotation: float

    def size(self, reach: float) -> float:
        """Size as one length [m]: position, and rotation times the reach."""
        return self.position + reach * self.rotation


@dataclass(frozen=True)
class Recognised:
    """samples: with an inverse pose undone. undone: what was, None where nothing was. doubt: the refusal of readings
    that base and tool fitted again leave far from the arm, unless changes of a joint or two account for them; None
    where they are near.
    """

    samples: Samples
    undone: str | None = None
    doubt: BadRecording | None = None


def recognised(model: Model, samples: Samples, noise: NoiseModel) -> Recognised:
    """What these samples are to the calibrated arm. Raises BadRecording, with the mistake, where undoing a mistake of
    recording explains them.
    """
    undone: str | None = None
    doubt: BadRecording | None = None
    if not is_serial_arm(model.chain):
        return Recognised(samples)
    plain = model.with_effects(())
    for f, frame in enumerate(samples.frames):
        rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == POINT)))
        if len(rows) < MIN or samples.is_same_point(f):
            continue
        part = samples.select(rows)
        off = errors(model, part)
        near = float(np.median(off.position_norm)) < max(_NEAR * noise.position, 1e-4)
        if near and (not part.is_pose.any() or float(np.median(off.rotation_norm)) < max(_NEAR * noise.rotation, 1e-3)):
            continue
        found = _mistaken(plain, part, frame)
        if isinstance(found, Mistake):
            samples, undone = _undone(samples, rows, found), INVERTED
        else:
            doubt = doubt or found
    return Recognised(samples, undone, doubt)


def _undone(samples: Samples, rows: np.ndarray, mistake: Mistake) -> Samples:
    part = mistake.undone(samples.select(rows))
    reading, R = samples.reading.copy(), samples.R.copy()
    reading[rows], R[rows] = part.reading, part.R
    return replace(samples, reading=reading, R=R)


def _mistaken(model: Model, part: Samples, frame: str) -> Mistake | BadRecording | None:
    """The inverse pose, where it is that; the refusal where the arm does not explain the readings, None where it does.
    Raises BadRecording where another mistake does.
    """
    chain = model.serial
    reach = chain.reach()
    poses = bool(part.is_pose.all())
    # a point alone does not say how far the arm should turn: what is small is then small for itself
    as_is = _miss(model, part, poses)
    if as_is.size(reach) < _AT_MIN * reach:
        return None
    # of points alone every left-handed frame is each other one, seen from another side
    axes = of_axes() if poses else (left_handed(),)
    mistakes = [*of_units(), *of_rarer_units(), *axes, *of_joints(part.names)]
    if poses:
        # orientations that fit mean what they should: to free them would only let positions have a base of their own
        turned = of_rotations(None) if as_is.rotation > ANGLE else ()
        mistakes = [inverse_pose(), mirror_image(), *turned, *mistakes]
        rough = rough_scores(part, chain, mistakes)[1:]
        mistakes = [mistakes[i] for i in np.argsort(rough)[::-1][:_CANDIDATES]]
    found = [(_miss(model, mistake.undone(part), poses).size(reach), i) for i, mistake in enumerate(mistakes)]
    best, i = min(found)
    if best < _OURS * as_is.size(reach) and best < MISREAD * reach:
        mistake = mistakes[i]
        if mistake.offender == inverse_pose().offender:
            return mistake
        said = (
            f"the calibrated arm misses by {1e3 * as_is.position:.3g} mm and {np.degrees(as_is.rotation):.3g}° with "
            f"base and tool fitted again, with that undone by {1e3 * best:.3g} mm in all"
        )
        raise BadRecording(f"readings in frame '{frame}': {mistake.offender}", said, mistake.remedy)
    if as_is.size(reach) < MISREAD * reach:
        return None
    said = (
        f"the calibrated arm misses them by {1e3 * as_is.position:.3g} mm and {np.degrees(as_is.rotation):.3g}° at the "
        f"median with base and tool fitted again, {1e3 * MISREAD * reach:.3g} mm in all is allowed, and no change "
        "of a joint or two explains it"
    )
    return standing(part, said) or BadRecording(
        f"readings in frame '{frame}'", said, "check that this is the calibrated robot, and calibrate it again if so"
    )


def _miss(model: Model, part: Samples, poses: bool) -> ArmMiss:
    chain = model.serial
    if poses:
        found = match(part, chain, parts=(1,))
        return ArmMiss(found.typical, found.typical_angle)
    found = points_match(chain, part.q, part.reading)
    return ArmMiss(found.typical, 0.0)
