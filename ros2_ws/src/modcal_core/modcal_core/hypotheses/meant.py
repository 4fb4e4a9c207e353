"""Whether readings mean what they are taken for: asked of every recording before anything is fitted to it.

Only conventions, units and joints of a whole recording are asked here, which no fit may come to terms with. An inverse
pose is undone; every other match is refused, by name. No limit is set to the residual itself: on real cubes a wrong
sequence leaves 1°, and the right one 0.1°.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, NoiseModel, distinct, errors
from modcal_core.errors import BadRecording
from modcal_core.hypotheses import conventions
from modcal_core.hypotheses.hand_eye import HandEye, HandEyeFit, placed
from modcal_core.hypotheses.hypothesis import COMMON, Hypothesis, family
from modcal_core.hypotheses.refusal import standing
from modcal_core.hypotheses.search import Answer, explain
from modcal_core.measurements import POINT, Samples, spread_rows
from modcal_core.robots import Chain, Mechanism, is_serial_arm

BEYOND_DOUBT = 50.0  # nats
INVERTED = "pose inverted"
MISREAD = 0.01  # of the reach: what misses by more with base and tool fitted again is another arm, or not metres
MIN = 6  # readings of a frame, from which base and tool of an arm that is known leave enough to judge it by
_LEAST = 12  # poses of a frame: six unknown turns, and as much again to tell
_MAX = 300  # stations say it all
_TURNED = 6e-3  # rad; orientations that are missed by less mean what they should
_SPOILED = 0.1  # of the stations that agree as they are, which a convention of all of them may not spoil
_NEAR = 20.0  # standard deviations, within which nothing has to be asked
_AT_MIN = 2e-3  # of the reach: what misses by less as it is may be an arm that bent, and is not refused for its words


def proved(samples: Samples, chain: Mechanism, stated: str | None = None) -> tuple[Samples, str | None]:
    """The samples with what can be undone undone, and what that was ("pose inverted"), None if nothing.

    stated: the Euler sequence that the readings were composed by, where it is known. Raises BadRecording, naming the
    match, where another convention is better beyond doubt. Readings without orientation, frames with few postures and
    robots other than serial arms pass unasked.
    """
    undone: str | None = None
    if not is_serial_arm(chain):
        return samples, undone
    for f, frame in enumerate(samples.frames):
        rows = np.flatnonzero((samples.frame == f) & samples.is_pose)
        different = rows[np.unique(distinct(samples.q[rows]), return_index=True)[1]]  # one posture proves one thing
        if len(different) < _LEAST:
            continue
        different = different[np.argsort(samples.stamps[different], kind="stable")]
        answer = _meant(samples.select(different[spread_rows(len(different), _MAX)]), chain, stated)
        if answer is None:
            continue
        # what nobody is told of is undone only where nothing else is nearly as likely
        if len(answer.said) == 1 and answer.said[0].what == conventions.INVERSE and not answer.rivals:
            samples, undone = inverted(samples, rows), INVERTED
            continue
        gain = f"better by {answer.gain:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides"
        raise BadRecording(f"readings in frame '{frame}': {answer.what}", f"{_missed(answer)} ({gain})", answer.remedy)
    return samples, undone


def _meant(samples: Samples, chain: Chain, stated: str | None) -> Answer | None:
    """The mistakes that were made of the whole recording beyond doubt; None where there are none."""
    case = HandEye.holding(samples, chain)
    quick = placed(case, thorough=False)
    if quick.clean or not len(case):
        return None
    turned = conventions.turns(stated) if np.sqrt(np.mean(quick.turn**2)) > _TURNED else ()
    others = [*conventions.units(), *conventions.axes(), *conventions.joints(case.names)]
    table = [conventions.inverse_pose(), *turned, *family(COMMON, others)]
    answer = explain(case, table, depth=1)
    if not answer.said or answer.gain <= BEYOND_DOUBT:
        return None
    if not _throughout(answer):  # it brings some back and spoils others: not a convention of the recording
        return None
    if answer.after.agree(2.0).mean() < 0.5:  # another mistake may hide behind it
        whole = explain(case)
        if whole.said and whole.gain > answer.gain and all(h.stations is None for h in whole.said):
            return whole
    return answer


def _throughout(answer: Answer) -> bool:
    before, after = answer.before, answer.after
    spoiled = before.agree(2.0) & ~after.agree(2.0)
    return bool(spoiled.mean() <= _SPOILED)


def _missed(answer: Answer) -> str:
    """By how much the nominal arm misses the usual station before and after."""
    (turn, gap), (turn_after, gap_after) = answer.before.usual, answer.after.usual
    return (
        f"the nominal arm misses by {np.degrees(turn):.3g}° and {1e3 * gap:.3g} mm at the median station, with that "
        f"undone by {np.degrees(turn_after):.3g}° and {1e3 * gap_after:.3g} mm"
    )


def inverted(samples: Samples, rows: np.ndarray) -> Samples:
    """The samples with the poses of some rows inverted."""
    R = samples.R.copy()
    position = samples.reading.copy()
    R[rows] = np.swapaxes(samples.R[rows], 1, 2)
    position[rows] = -conventions.turned(R[rows], samples.reading[rows])
    return replace(samples, reading=position, R=R)


# --- an arm that is known --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ArmMiss:
    """How far the calibrated arm misses readings with base and tool fitted again: medians [m], [rad]."""

    position: float
    rotation: float

    @classmethod
    def of(cls, fit: HandEyeFit) -> ArmMiss:
        """That of a fit."""
        return cls(fit.usual[1], fit.usual[0])

    def size(self, reach: float) -> float:
        """Size as one length [m]: position, and rotation times the reach."""
        return self.position + reach * self.rotation


@dataclass(frozen=True)
class Recognised:
    """samples: with an inverse pose undone. undone: what was, None if nothing was. doubt: the refusal of readings
    that base and tool fitted again leave far from the arm, unless changes of a joint or two account for them; None
    where they are near.
    """

    samples: Samples
    undone: str | None = None
    doubt: BadRecording | None = None


def recognised(model: Model, samples: Samples, noise: NoiseModel) -> Recognised:
    """Whether a small recording, or what comes live, is one of the calibrated robot, in the calibration's convention.

    A base or a tool that was moved by any amount leaves readings that the arm still explains. Raises BadRecording, with
    the mistake, where undoing one explains them: a change that is fitted to it would be calm and wrong.
    """
    undone: str | None = None
    doubt: BadRecording | None = None
    if not is_serial_arm(model.chain):
        return Recognised(samples)
    plain = model.with_effects(()).serial
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
        if isinstance(found, Hypothesis):
            samples, undone = inverted(samples, rows), INVERTED
        else:
            doubt = doubt or found
    return Recognised(samples, undone, doubt)


def _mistaken(chain: Chain, part: Samples, frame: str) -> Hypothesis | BadRecording | None:
    """The inverse pose, where it is that; the refusal where the arm does not explain the readings, None where it does.
    Raises BadRecording where another mistake does.
    """
    reach, case = chain.reach(), HandEye.holding(part, chain)
    as_is = ArmMiss.of(placed(case))
    # a point alone does not say how far the arm should turn: what is small is then small for itself
    if as_is.size(reach) < _AT_MIN * reach:
        return None
    answer = explain(case, conventions.of_recording(case), depth=1)
    left = ArmMiss.of(answer.after)
    if answer.said and left.size(reach) < MISREAD * reach and _throughout(answer):
        if answer.said[0].what == conventions.INVERSE and not answer.rivals:
            return answer.said[0]
        said = (
            f"the calibrated arm misses by {1e3 * as_is.position:.3g} mm and {np.degrees(as_is.rotation):.3g}° with "
            f"base and tool fitted again, with that undone by {1e3 * left.size(reach):.3g} mm in all"
        )
        raise BadRecording(f"readings in frame '{frame}': {answer.what}", said, answer.remedy)
    if as_is.size(reach) < MISREAD * reach:
        return None
    said = (
        f"the calibrated arm misses them by {1e3 * as_is.position:.3g} mm and {np.degrees(as_is.rotation):.3g}° at the "
        f"median with base and tool fitted again, {1e3 * MISREAD * reach:.3g} mm in all is allowed, and no change "
        "of a joint or two explains it"
    )
    if fact := standing(part):
        return BadRecording(fact[0], f"{fact[1]}; {said}", fact[2])
    return BadRecording(
        f"readings in frame '{frame}'", said, "check that this is the calibrated robot, and calibrate it again if so"
    )
