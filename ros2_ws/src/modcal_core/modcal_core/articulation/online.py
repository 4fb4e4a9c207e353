"""Online estimate of an articulated object: its joint, whether its model is trusted, and whether it still moves so.

Poses are pooled into a bounded number of nodes, with bounded work at each (``model_selector``). A model is trusted once
its predictions hold (``prediction_check``), and no longer when one is far off or the handle leaves the path. Where two
rounds of refinement do not bring the model back, the hand holds something else, and the estimate restarts.

Evidence grows with the path, not with the number of poses on it: each centimetre gets the same number of steps, and
noise is no path. An arm that flies by is no handle that is pulled: steps in a second are limited.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation.conventions import ConventionCheck, OtherConvention
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.misfit import ASKED_EVERY, NONE, ShareCheck, Stretches, is_bend, rms, too_much, usual
from modcal_core.articulation.model_selector import ModelSelector
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.models.registry import STILL
from modcal_core.articulation.prediction_check import POSITIONS, PredictionCheck
from modcal_core.articulation.track import FARTHEST, FEWEST_NODES, RIGID, Nodes, Track
from modcal_core.articulation.two_motions import are_two
from modcal_core.errors import BadCommand
from modcal_core.geometry import Array, posed

_MARK = 4e-3  # m from mark to mark
_NOISE = 4.0  # deviations of noise on an axis from mark to mark, where that is more
_PER_STEP = 1e-3  # m: a hand at 5 cm/s, seen 50 times a second, makes one step due at each pose
_MAX = 60  # steps at one pose, some 40 ms: more than a whole round
_A_SECOND = 250.0  # steps, an eighth of a processor: what a hand at 25 cm/s makes due; a faster one is learned later
_AHEAD = 5.0  # steps that may be computed before they are due
_STEPS = 7  # of the last poses, whose median is the usual step


class Travel:
    """path: way from mark to mark [m]. step: from one pose to the next, the usual one [m, rad], zeros before there are
    some. doubly: whether each millimetre is worth two steps.
    """

    def __init__(self) -> None:
        self.path, self.doubly = 0.0, False
        self.step = (0.0, 0.0)
        self._mark: Array | None = None
        self._owed = 0.0
        self._allowed, self._stamp = float(_MAX), -math.inf
        self._steps: deque[tuple[float, float]] = deque(maxlen=_STEPS)

    @property
    def _per_step(self) -> float:
        return 0.5 * _PER_STEP if self.doubly else _PER_STEP

    def stepped(self, far: float, turn: float) -> None:
        """Note a step [m, rad] from one pose to the next that was accepted."""
        self._steps.append((far, turn))
        self.step = (statistics.median(s[0] for s in self._steps), statistics.median(s[1] for s in self._steps))

    def come(self, p: Array, noise: float) -> None:
        """Take a position (3,) [m] that was accepted. noise: of one, on an axis [m]."""
        if self._mark is None:
            self._mark = p
        far = math.dist(p, self._mark)
        if far >= max(_MARK, _NOISE * noise):
            self._mark = p
            self.path += far
            self._owed += far / self._per_step

    def steps_due(self, stamp: float) -> int:
        """How many steps of computation are due at this pose, by the path since the last; one, while few are ahead.

        stamp: of the pose [s].

        No more than the usual motion from pose to pose makes due, where no more than from mark to mark is left over:
        what falls due at a mark is spread over the poses up to the next one: as much as a mark is worth may come later.
        """
        self._allowed = min(self._allowed + _A_SECOND * max(stamp - self._stamp, 0.0), _MAX)
        self._stamp = stamp
        owed, usual = round(self._owed), math.ceil(self.step[0] / self._per_step)
        most, least = int(self._allowed), int(self._owed > -_AHEAD)
        due = max(min(max(min(owed, usual), owed - round(_MARK / self._per_step)), most), least)
        self._allowed = max(self._allowed - due, 0.0)
        self._owed = min(max(self._owed - due, -_AHEAD), _MAX)
        return due


Event = Literal["locked", "jammed", "changed"]


@dataclass(frozen=True)
class TrackerSettings:
    """ahead_m, ahead_rad: how far ahead a prediction must be right, whichever is less. tolerance_m: and how right.

    still_m: what a pulled handle moves by while it counts as not moving, within still_s. nodes: most of them.
    trust_after_m: path that must have been seen before a model is trusted, however well it predicts: what is no joint
    often moves like one for two or three decimetres, and of such things fewer are trusted the longer one waits.
    """

    ahead_m: float = 0.05
    ahead_rad: float = float(np.radians(10.0))
    tolerance_m: float = 4e-3
    still_m: float = 3e-3
    still_s: float = 1.0
    nodes: int = 12
    trust_after_m: float = 0.0


@dataclass(frozen=True)
class TrackerState:
    """The estimate after a pose. kind, probabilities: of the joint; the kind is "none" where the best one leaves
    too much of the path so far. model: None until something has moved, and of none.

    configuration: of this pose [rad or m], 0 where the handle began. trusted: whether the model has predicted well.
    ahead_m: error of the last prediction that could be checked [m], nan before. off_m: distance of this pose from the
    model's path [m]. event: locked (pulled and never moved), jammed (pulled and moves no more), changed (left the
    path).
    follows: whether rotations are the object's; else they are the grasp's. apart_m: way from one pose to the next, the
    usual one [m]; sparse: whether that is too much to learn from. left: what the best kind leaves of the path so far
    (m, rad), nan before it is known. path_m: length of the path that was seen since the start, or since it was left.
    written: in which other convention the poses seem to be written, None in none; nothing is trusted then. late,
    silent: whether the state is late, or too old to be used: never, it is of the pose that was taken last.
    """

    kind: Kind
    probabilities: dict[Kind, float]
    model: JointModel | None
    configuration: float
    trusted: bool
    ahead_m: float
    off_m: float
    event: Event | None
    samples: int
    follows: bool = True
    apart_m: float = 0.0
    sparse: bool = False
    left: tuple[float, float] = (math.nan, math.nan)
    path_m: float = 0.0
    written: OtherConvention | None = None
    late: bool = False
    silent: bool = False


_EYE = np.eye(3)
_TURNED = 0.05  # rad: a hand that was turned by less has told by its rotations neither of a drawer nor of a hinge
_JUMP = (0.02, 0.3)  # m, rad: more from one pose to the next is a gross outlier, or a handle that is flung
_FASTER = 2.5  # times the usual step from pose to pose is a jump as well, where poses come seldom
_AT_ONE_PATH = 0.05  # m; residuals farther off are no noise of one path
_WIDE = (2.0, 6.0)  # times the tolerance, and deviations of noise, beyond which a pose lies beside the path
_TURN_OF_TWO = 0.1  # rad; by so much more may the second of two poses after a leap be turned
_ON_THE_WAY = 0.7  # of two leaps, at most so much has either; two outliers seldom lie so
_SPARSE = 0.6  # of the distance ahead, from one pose to the next: fewer than two poses on what is predicted
_UNMOVED = 3.0  # times what counts as still; a handle that has never moved farther is locked, any other jammed
_BESIDE = 6  # poses beside the path after which it has been left
_RECOVERY = 2  # rounds of evaluation that a model gets to follow a handle that has left its path
_HELD = 20  # poses for which a model that was trusted lately is not bent by what lies beside its path


class Tracker:
    """Takes poses as they come, with rotations where the first one has one.

    measured: whether somebody else wrote the poses, maybe in another convention; those of an arm's joints are not.
    """

    def __init__(self, settings: TrackerSettings | None = None, measured: bool = True) -> None:
        self.settings = TrackerSettings() if settings is None else settings
        self._measured = measured
        self.reset()

    def reset(self, changes: int = 0) -> None:
        """Forget everything. changes: how often the path was left before, for which trust is earned more slowly."""
        chosen, self._changes = self.settings, changes
        self._oriented: bool | None = None
        self._nodes: Nodes | None = None
        self._selector = ModelSelector()
        self._check = PredictionCheck(chosen.ahead_m, chosen.ahead_rad, chosen.tolerance_m, changes)
        self._stretches = Stretches()
        self._share = ShareCheck(self._stretches, chosen.tolerance_m)
        self._convention = ConventionCheck()
        self._travel = Travel()
        self._asked = 0.0  # m of path after which two motions and a bend were asked for, and what was found
        self._bent = self._two = False
        self._samples = 0
        self._stamp = -np.inf
        self._first: Array | None = None
        self._held: Array | None = None  # the first rotation, while the hand has kept it
        self._moved = 0.0
        self._known: tuple[Array, Array | None] | None = None  # the last pose that was learned from
        self._waiting: tuple[Array, Array | None] | None = None  # one that jumped, and waits for another
        self._recent: deque[tuple[Array, Array | None]] = deque(maxlen=_BESIDE)
        self._pulled: deque[tuple[float, Array]] = deque(maxlen=400)
        self._residual: tuple[AxisMotion, Array] | None = None
        self._zero: tuple[AxisMotion, JointModel] | None = None
        self._beside = 0
        self._credit = 0
        self._doubt: int | None = None
        self._left = (math.nan, math.nan)
        self._judged = 0

    def update(
        self, position: ArrayLike, rotation: ArrayLike | None, stamp: float, pulled: bool = False
    ) -> TrackerState:
        """The estimate after one more pose: position (3,) [m], rotation (3, 3) or None, stamp [s].

        pulled: whether somebody pulls at this moment, which tells a handle that rests from one that is stuck.
        Raises BadCommand for a pose that is not finite, of the wrong shape, or older than the last one.
        """
        p, R = self._checked(position, rotation, stamp)
        self._samples += 1
        self._stamp = stamp
        self._recent.append((p, R))
        if self._first is None or self._nodes is None:
            self._first, self._nodes = p, Nodes(bool(self._oriented), self.settings.nodes)
            self._held = R
        if self._held is not None and R is not None and _between(p, self._held, p, R)[1] > _TURNED:
            self._held = None
        # a drawer, or a hinge in a ball grasp: until a model is trusted there is more to weigh
        self._travel.doubly = self._held is not None and not self._check.trusted
        motion = self._selector.motion
        a, off, twisted, event = self._compare(p, R)
        accepted = self._accepted(p, R, off, twisted)
        if accepted and motion is not None and motion is self._selector.motion:
            self._check.look(motion, a, p)  # not with a gross outlier: no model predicts where that lies
        for q, S in accepted:
            self._moved = max(self._moved, math.dist(q, self._first))
            self._travel.come(q, self._selector.scale[0])
            self._stretches.come(q, self._selector.scale[0])
            self._share.come(motion, self._selector.scale[0])
            if self._nodes.add(q, S):
                continue  # pooled again, which is enough for one pose
            due = self._travel.steps_due(stamp) if self._nodes.k >= FEWEST_NODES else 0
            for _ in range(due):
                if self._selector.advance(self._nodes):
                    self._check.begin(*self._reached())
            if self._stretches.path - self._asked >= ASKED_EVERY:
                self._asked = self._stretches.path
                if not self._changes:  # what was found before a change stays
                    self._two = are_two(self._stretches, self._selector.scale[0])
                self._bent = motion is not None and is_bend(self._stretches, motion)
        self._judge()
        if self._two and (motion is None or motion.flat):
            self._check.lose()
        return self._state(p, R, off, event or self._stuck(p, stamp, pulled))

    def _checked(self, position: ArrayLike, rotation: ArrayLike | None, stamp: float) -> tuple[Array, Array | None]:
        p = np.array(position, dtype=float)
        R = None if rotation is None else np.array(rotation, dtype=float)
        if self._oriented is None:
            self._oriented = R is not None
        if p.shape != (3,) or not np.isfinite(p).all() or np.abs(p).max() > FARTHEST:
            raise BadCommand(
                "pose of the handle", f"its position is not three finite numbers within {FARTHEST:g} m", "give metres"
            )
        if self._oriented and R is None:
            raise BadCommand("pose of the handle", "has no rotation, unlike earlier poses", "reset, or give both")
        if not self._oriented:
            R = None
        if R is not None and (R.shape != (3, 3) or not np.isfinite(R).all() or np.abs(R @ R.T - _EYE).max() > RIGID):
            raise BadCommand("pose of the handle", "its rotation is not a rotation matrix", "give a unit quaternion")
        if not np.isfinite(stamp) or stamp < self._stamp:
            raise BadCommand(
                "pose of the handle", f"its stamp {stamp:g} s is older than the last", "give poses in order"
            )
        return p, R

    def _compare(self, p: Array, R: Array | None) -> tuple[float, float, float, Event | None]:
        """Configuration, distance from the selected path [m], rotation against it [rad], and whether that was left."""
        motion, follows = self._selector.motion, self._selector.follows
        if motion is None:
            return 0.0, 0.0, 0.0, None
        a, e = motion.placed(p, R, (1e-2, 0.05 if follows else 1e9))
        off, twisted = math.sqrt(e[:3] @ e[:3]), math.sqrt(e[3:] @ e[3:]) if follows else 0.0
        if self._residual is not None and self._residual[0] is motion and off < _AT_ONE_PATH:
            self._selector.jitter(e - self._residual[1])
        self._residual = motion, e
        self._credit = _HELD if self._check.trusted else self._credit - 1
        wide = max(_WIDE[0] * self.settings.tolerance_m, _WIDE[1] * self._selector.scale[0])
        self._beside = self._beside + 1 if off > wide else max(self._beside - 2, 0)
        if self._beside == 0:
            self._doubt = None
        elif self._beside >= _BESIDE and self._doubt is None and self._credit > 0:
            self._check.doubt(motion, a)
            self._credit, self._doubt = 0, self._selector.rounds
        elif self._beside >= _BESIDE and self._doubt is not None and self._selector.rounds >= self._doubt + _RECOVERY:
            self._forget()
            return a, off, twisted, "changed"
        return a, off, twisted, None

    def _accepted(self, p: Array, R: Array | None, off: float, twisted: float) -> list[tuple[Array, Array | None]]:
        """What is to be learned from: this pose; nothing, if it jumps; or it and the one before, if both jumped alike.

        A gross outlier stands alone, while a handle that moves fast is followed by where it goes.
        """
        if self._credit > 0 and self._beside:
            return []  # a path that is trusted is not bent until it is clear that it has been left
        along = self._selector.motion is not None and self._selector.kind != STILL.name
        on_path = along and off < _JUMP[0] and twisted < _JUMP[1]
        here = (p, R)
        if self._known is not None:
            far, turn = _between(*self._known, p, R)
            leap, fling = (max(j, _FASTER * usual) for j, usual in zip(_JUMP, self._travel.step, strict=True))
            if not on_path and (far > leap or turn > fling):
                waiting, self._waiting = self._waiting, here
                if waiting is None or not _went_on(self._known, waiting, here):
                    return []
                self._travel.stepped(*_between(*waiting, p, R))
                self._known, self._waiting = here, None
                return [waiting, here]
            self._travel.stepped(far, turn)
        self._known, self._waiting = here, None
        return [here]

    def _forget(self) -> None:
        """Start over from here: what came before was another object, another grasp, or no joint."""
        samples, stamp, oriented, latest = self._samples, self._stamp, self._oriented, list(self._recent)
        two = self._two  # the whole path counts there: two joints, one after the other, are no joint
        convention = self._convention  # and there: another object's poses are written as this one's
        self.reset(self._changes + 1)
        self._samples, self._stamp, self._oriented = samples, stamp, oriented
        self._two, self._convention = two, convention
        self._recent.extend(latest)
        self._first, self._nodes = latest[0][0], Nodes(bool(oriented), self.settings.nodes)

    def _stuck(self, p: Array, stamp: float, pulled: bool) -> Event | None:
        if not pulled:
            self._pulled.clear()
            return None
        self._pulled.append((stamp, p))
        while len(self._pulled) > 1 and stamp - self._pulled[1][0] >= self.settings.still_s:
            self._pulled.popleft()
        since, where = self._pulled[0]
        if stamp - since < self.settings.still_s or math.dist(p, where) > self.settings.still_m:
            return None
        return "locked" if self._moved < _UNMOVED * self.settings.still_m else "jammed"

    def _judge(self) -> None:
        """Once a round: what the best motion leaves of the path so far. Where that is much, nothing is trusted."""
        motion, nodes, rounds = self._selector.motion, self._nodes, self._selector.rounds
        if motion is None or nodes is None or rounds == self._judged or (track := nodes.track()) is None:
            return
        self._judged = rounds
        follows = self._selector.follows
        if track.oriented and self._measured:
            self._convention.ask(track, self._selector.scale)
        seen = track if follows else Track.trusted(track.positions)
        e = motion.residuals(seen, motion.configurations(seen, (1e-2, 0.05 if follows else 1e9)))
        turn = rms(np.linalg.norm(e[:, 3:], axis=1)) if e.shape[1] == 6 else math.nan
        self._left = rms(np.linalg.norm(e[:, :3], axis=1)), turn
        if self._none or not (motion.flat or usual(*self._left, self._selector.scale)):
            self._check.lose()  # a thread has no play, and most smooth paths are about a screw's

    @property
    def _none(self) -> bool:
        return too_much(*self._left, self._selector.scale)

    def _reached(self) -> tuple[float, float]:
        """Path [m] that the nodes have reached, in the selected motion's configuration."""
        motion, nodes = self._selector.motion, self._nodes
        assert motion is not None
        assert nodes is not None
        path = motion.configurations(Track.trusted(nodes.means()[:, :3]), POSITIONS) * motion.length_per_unit
        return float(path.min()), float(path.max())

    def _state(self, p: Array, R: Array | None, off: float, event: Event | None) -> TrackerState:
        selector, path, apart = self._selector, self._stretches.path, self._travel.step[0]
        motion = selector.motion
        state = TrackerState(
            STILL.name,
            dict(selector.probabilities),
            model=None,
            configuration=0.0,
            trusted=False,
            ahead_m=self._check.error,
            off_m=off,
            event=event,
            samples=self._samples,
            apart_m=apart,
            sparse=apart > _SPARSE * self.settings.ahead_m,
            left=self._left,
            path_m=path,
            written=self._convention.written,
        )
        if motion is None or selector.kind == STILL.name:
            return state
        state = replace(state, kind=NONE, follows=selector.follows)
        if self._none:
            return state
        if self._zero is None or self._zero[0] is not motion:
            assert self._first is not None
            begin = motion.placed(self._first, None, POSITIONS)[0]
            self._zero = motion, (motion if selector.follows else replace(motion, R=None)).joint(begin)
        model, seen = self._zero[1], p
        if R is not None and selector.follows:
            seen = posed(R, p)
        trusted = self._check.trusted and not (self._share.fails or self._bent)
        trusted = trusted and path >= self.settings.trust_after_m and self._convention.written is None
        a = float(model.configuration(seen))
        return replace(state, kind=selector.kind, model=model, configuration=a, trusted=trusted)


def _went_on(
    known: tuple[Array, Array | None], waiting: tuple[Array, Array | None], here: tuple[Array, Array | None]
) -> bool:
    """Whether a handle leapt from the first to the second and is there still, or is on its way to the third."""
    far, turn = _between(*known, *here)
    step, turned = _between(*waiting, *here)
    if turned > turn + _TURN_OF_TWO:
        return False
    return step <= _JUMP[0] or max(step, _between(*known, *waiting)[0]) <= _ON_THE_WAY * far


def _between(p: Array, R: Array | None, q: Array, S: Array | None) -> tuple[float, float]:
    turn = 0.0 if R is None or S is None else math.dist(R.ravel(), S.ravel()) / math.sqrt(2.0)
    return math.dist(p, q), turn
