"""The object while it is moved: what it is, whether to trust that, whether it still behaves; constant time a pose.

Poses are pooled into a bounded number of nodes. Each update weighs one kind at one play of the evidence's table anew,
beginning where it was left, so that the whole table is never older than its size in updates.

Trust is earned by predicting, not by a parameter that settles: a hinge's centre may be 50 mm off while the next ten
degrees are right. Every few millimetres of new path the model is kept, with how far the handle had come. When the
handle is ``ahead`` beyond that (5 cm or 10°, whichever is less), it is asked how far the path that it told is from
where the handle is. Two answers in a row within tolerance make trust; one far outside, or a handle that leaves the
path, ends it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation.evidence import LOOSE, PLAYS, SWAYS, Row, Scene, glance, weigh
from modcal_core.articulation.joints import KINDS, JointModel, Kind
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.nodes import Nodes
from modcal_core.articulation.seeds import rough
from modcal_core.articulation.track import FEWEST, Track
from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array

Event = Literal["locked", "jammed", "changed"]


@dataclass(frozen=True)
class Settings:
    """ahead_m, ahead_rad: how far ahead a prediction must be right, whichever is less. tolerance_m: and how right.

    still_m: what a pulled handle moves by while it counts as not moving, within still_s. nodes: most of them.
    """

    ahead_m: float = 0.05
    ahead_rad: float = float(np.radians(10.0))
    tolerance_m: float = 4e-3
    still_m: float = 3e-3
    still_s: float = 1.0
    nodes: int = 12


@dataclass(frozen=True)
class State:
    """What is believed after a pose. kind, probabilities: of the joint. model: None until something has moved.

    configuration: of this pose [rad or m], 0 where the handle began. trusted: whether the model has predicted well.
    ahead_m: error of the last prediction that could be checked [m], nan before. off_m: distance of this pose from the
    model's path [m]. event: locked (pulled and never moved), jammed (pulled and moves no more), changed (left the
    path).
    follows: whether rotations are the object's; else they are the grasp's.
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


@dataclass(frozen=True, eq=False)
class _Kept:
    """A model as it was when the handle had come to a frontier, and the configuration at which to ask it."""

    motion: Motion
    side: float  # direction in which the frontier was passed
    until: float  # path beyond which to ask, in this motion's own configuration


FEW = (1, 2, 3)  # of the plays: the least and the largest are rare, and each costs as much as the others
_SURELY_MOVED = 0.05  # m from which nothing is rigid
_EVEN: dict[Kind, float] = {"rigid": 0.98, "prismatic": 0.0098, "revolute": 0.0098, "screw": 0.0004}


class Tracker:
    """Takes poses as they come. oriented: whether rotations come too; None: as the first pose has it."""

    def __init__(self, settings: Settings | None = None, oriented: bool | None = None) -> None:
        self.settings = Settings() if settings is None else settings
        self._wanted = oriented
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._oriented = self._wanted
        self._nodes: Nodes | None = None
        self._rows: dict[tuple[Kind, int], Row] = {}
        self._left: list[tuple[Kind, int, bool]] = []
        self._scene: Scene | None = None
        self._round = 0
        self._turn = 0
        self._jitter: deque[tuple[float, float]] = deque(maxlen=48)
        self._last: tuple[Array, Array | None, float] | None = None
        self._residual: tuple[Motion, Array] | None = None
        self._kept: deque[_Kept] = deque(maxlen=6)
        self._checks: deque[float] = deque(maxlen=3)
        self._range = [0.0, 0.0]
        self._pulled: deque[tuple[float, Array]] = deque(maxlen=400)
        self._recent: deque[tuple[Array, Array | None]] = deque(maxlen=24)
        self._beside = 0
        self._moved = 0.0
        self._first: Array | None = None
        self._best: tuple[Kind, Motion, bool] | None = None
        self._zero: tuple[Motion, JointModel] | None = None
        self._probabilities = dict(_EVEN)
        self._scale = (1e-3, 0.01)
        self._trusted = False
        self._play, self._column, self._level = FEW[1], 0, np.zeros(1)
        self._samples = 0

    def update(self, position: ArrayLike, rotation: ArrayLike | None, stamp: float, pulled: bool = False) -> State:
        """What is believed after one more pose: position (3,) [m], rotation (3, 3) or None, stamp [s].

        pulled: whether somebody pulls at this moment, which tells a handle that rests from one that is stuck.
        Raises BadCommand for a pose that is not finite, of the wrong shape, or older than the last one.
        """
        p, R = self._checked(position, rotation, stamp)
        self._samples += 1
        jump = 0.0 if self._last is None else float(np.linalg.norm(p - self._last[0]))
        self._last = p, R, stamp
        self._recent.append((p, R))
        if self._first is None:
            self._first = p
        self._moved = max(self._moved, float(np.linalg.norm(p - self._first)))
        if self._nodes is None:
            self._nodes = Nodes(bool(self._oriented), self.settings.nodes)
        off, event = self._compare(p, R)
        if not self._is_gross(off, jump):
            self._nodes.add(p, R)
            self._think()
        return self._state(p, R, off, event or self._stuck(p, stamp, pulled))

    def _checked(self, position: ArrayLike, rotation: ArrayLike | None, stamp: float) -> tuple[Array, Array | None]:
        p = np.array(position, dtype=float)
        R = None if rotation is None else np.array(rotation, dtype=float)
        if self._oriented is None:
            self._oriented = R is not None
        if p.shape != (3,) or not np.isfinite(p).all() or np.abs(p).max() > 50.0:
            raise BadCommand(
                "pose of the handle", "its position is not three finite numbers within 50 m", "give metres"
            )
        if self._oriented and R is None:
            raise BadCommand("pose of the handle", "comes without a rotation, unlike before", "reset, or give both")
        if not self._oriented:
            R = None
        if R is not None and (
            R.shape != (3, 3) or not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3
        ):
            raise BadCommand("pose of the handle", "its rotation is no rotation matrix", "give a unit quaternion")
        if not np.isfinite(stamp) or (self._last is not None and stamp < self._last[2]):
            raise BadCommand(
                "pose of the handle", f"its stamp {stamp:g} s is older than the last", "give poses in order"
            )
        return p, R

    # what the model that is believed says of this pose

    def _compare(self, p: Array, R: Array | None) -> tuple[float, Event | None]:
        """Distance from the believed path [m], and whether that path has been left."""
        if self._best is None:
            return 0.0, None
        _, motion, follows = self._best
        few = _one(p, R)
        used = (1.0, 0.05) if follows else (1.0, 1e9)
        a = motion.configurations(few, (1e-2, used[1]))
        e = motion.residuals(few, a)[0]
        off = float(np.linalg.norm(e[:3]))
        if self._residual is not None and self._residual[0] is motion and off < 0.05:
            step = e - self._residual[1]
            turn = float(step[3:] @ step[3:]) if len(step) == 6 else 0.0
            self._jitter.append((float(step[:3] @ step[:3]), turn))
        self._residual = motion, e
        if motion.kind == "rigid":
            return off, None
        length = float(np.linalg.norm(motion.tangent[:3]))
        self._ask(motion, float(a[0]), few, length)
        wide = max(3.0 * self.settings.tolerance_m, 6.0 * self._scale[0])
        self._beside = self._beside + 1 if off > wide else max(self._beside - 2, 0)
        if self._trusted and self._beside >= 6:
            self._forget()
            return off, "changed"
        return off, None

    def _ask(self, motion: Motion, a: float, few: Track, length: float) -> None:
        """Ask the models that were kept and whose time has come; keep this one when the handle has come further."""
        ahead = min(self.settings.ahead_m, self.settings.ahead_rad * length if motion.turns else np.inf)
        for kept in list(self._kept):
            b = float(kept.motion.configurations(few, (1.0, 1e9))[0])
            if kept.side * (b - kept.until) < 0.0:
                continue
            self._kept.remove(kept)
            error = float(np.linalg.norm(kept.motion.residuals(few, np.array([b]))[0][:3]))
            if error > 25.0 * self.settings.tolerance_m:
                continue  # a gross outlier says nothing of the model
            self._checks.append(error)
            if error > 2.0 * self.settings.tolerance_m:
                self._trusted = False
            elif len(self._checks) >= 2 and max(list(self._checks)[-2:]) <= self.settings.tolerance_m:
                self._trusted = True
        for side, end in ((1.0, 1), (-1.0, 0)):
            if side * (a * length - self._range[end]) > 0.2 * ahead:
                self._range[end] = a * length
                if not any(k.motion is motion and k.side == side for k in self._kept):
                    self._kept.append(_Kept(motion, side, a + side * ahead / max(length, 1e-6)))

    def _is_gross(self, off: float, jump: float) -> bool:
        """Whether a pose is off by more than play and noise may do, and far from where the handle was just before."""
        return self._best is not None and min(off, jump) > max(0.02, 8.0 * self._scale[0])

    def _forget(self) -> None:
        """Begin anew with the latest poses: what came before was another object, or another grasp."""
        latest = list(self._recent)[-6:]
        samples, last, first = self._samples, self._last, latest[0][0]
        self.reset()
        self._oriented = latest[0][1] is not None
        self._samples, self._last, self._first = samples, last, first
        self._nodes = Nodes(bool(self._oriented), self.settings.nodes)
        for p, R in latest:
            self._recent.append((p, R))

    def _stuck(self, p: Array, stamp: float, pulled: bool) -> Event | None:
        if not pulled:
            self._pulled.clear()
            return None
        self._pulled.append((stamp, p))
        while len(self._pulled) > 1 and stamp - self._pulled[1][0] >= self.settings.still_s:
            self._pulled.popleft()
        since, where = self._pulled[0]
        if stamp - since < self.settings.still_s or np.linalg.norm(p - where) > self.settings.still_m:
            return None
        return "locked" if self._moved < 3.0 * self.settings.still_m else "jammed"

    # thinking, a little at a time

    def _think(self) -> None:
        """One slot of the round on the nodes as they were when it began; and now and then a step on those of now."""
        nodes = self._nodes
        assert nodes is not None
        if self._left:
            self._slot(*self._left.pop())
            if not self._left:
                self._conclude()
        elif nodes.k >= FEWEST:
            self._begin(nodes)
        self._turn += 1
        if self._best is not None and self._turn % 2 and nodes.k >= FEWEST:
            kind, motion, follows = self._best
            live = glance(
                self._now(nodes), Row(motion, self._level, self._column), float(PLAYS[self._play]), self._turn
            )
            self._best = kind, live.motion, follows

    def _now(self, nodes: Nodes) -> Scene:
        if len(self._jitter) >= 12:
            jitter = np.median(np.array(self._jitter), axis=0)
            self._scale = float(np.sqrt(jitter[0] / 2.77)), float(np.sqrt(jitter[1] / 4.73))
        track = nodes.track()
        assert track is not None
        return Scene.of(track, nodes.apart(), nodes.counts[: nodes.k], self._scale)

    def _begin(self, nodes: Nodes) -> None:
        """A new round, on the nodes of now."""
        self._scene = self._now(nodes)
        self._round += 1
        fresh = [(kind, FEW[self._round % len(FEW)], True) for kind in KINDS[1:]]
        slots = [(kind, i, False) for kind in KINDS[1:3] for i in FEW]
        slots += [("screw", FEW[(self._round + k) % len(FEW)], False) for k in range(2)]
        if self._moved < _SURELY_MOVED:
            slots.append(("rigid", FEW[1], False))
        self._left = list(reversed(slots + fresh))

    def _slot(self, kind: Kind, i: int, fresh: bool) -> None:
        """Weigh one kind at one play: where it was left, or from a new guess, which stays if it is better."""
        scene = self._scene
        assert scene is not None
        level = np.full(len(SWAYS) if scene.track.oriented else 1, -1e9)
        known = self._rows.get((kind, i))
        if known is not None and not fresh:
            self._rows[kind, i] = glance(scene, known, float(PLAYS[i]), self._round)
            return
        other = self._rows.get(("revolute", i))
        guess = rough(scene.track, kind, None if other is None else other.motion, self._round)
        if guess is None:
            return
        found = glance(scene, Row(guess, level, 2 if scene.track.oriented else 0), float(PLAYS[i]), self._round)
        if known is None or found.evidence.max() > known.evidence.max() + 1.0:
            self._rows[kind, i] = found
            if known is not None:
                for j in FEW:
                    self._rows[kind, j] = Row(found.motion, found.evidence, found.column)

    def _conclude(self) -> None:
        scene = self._scene
        assert scene is not None
        known: dict[Kind, list[Row]] = {}
        for kind in KINDS:
            rows = [self._rows[kind, i] for i in FEW if (kind, i) in self._rows]
            if rows and not (kind == "rigid" and self._moved >= _SURELY_MOVED):
                known[kind] = rows if len(rows) == len(FEW) else [rows[0]] * len(FEW)
        if not {"prismatic", "revolute"} <= set(known):
            return
        logs, best, i, j = weigh(known, len(scene.track), FEW)
        total = float(np.logaddexp.reduce(list(logs.values())))
        self._probabilities = {kind: float(np.exp(logs[kind] - total)) if kind in logs else 0.0 for kind in KINDS}
        follows = not (scene.track.oriented and bool(LOOSE[j]))
        chosen = known[best][i]
        self._play, self._column, self._level = FEW[i], j, chosen.evidence
        other = self._best is None or self._best[0] != best
        self._best = best, chosen.motion, follows
        if other:
            self._range = self._reached(chosen.motion)

    def _reached(self, motion: Motion) -> list[float]:
        """Path [m] that the nodes have reached, in this motion's configuration."""
        assert self._nodes is not None
        track = self._nodes.track()
        assert track is not None
        path = motion.configurations(track, (1.0, 1e9)) * float(np.linalg.norm(motion.tangent[:3]))
        return [float(path.min()), float(path.max())]

    def _state(self, p: Array, R: Array | None, off: float, event: Event | None) -> State:
        ahead = self._checks[-1] if self._checks else np.nan
        if self._best is None:
            return State("rigid", dict(self._probabilities), None, 0.0, False, ahead, off, event, self._samples)
        kind, motion, follows = self._best
        if self._zero is None or self._zero[0] is not motion:
            assert self._nodes is not None
            begin = float(motion.configurations(_one(self._nodes.means()[0, :3], None), (1.0, 1e9))[0])
            self._zero = motion, motion.model(begin)
        model = self._zero[1]
        seen = p
        if R is not None and follows:
            seen = np.eye(4)
            seen[:3, :3], seen[:3, 3] = R, p
        a = float(model.configuration(seen))
        return State(kind, dict(self._probabilities), model, a, self._trusted and kind != "rigid", ahead, off, event,
                     self._samples, follows)  # fmt: skip


def _one(p: Array, R: Array | None) -> Track:
    """One sample, which is no track to the door but is one to a motion."""
    track = Track.__new__(Track)
    object.__setattr__(track, "positions", p[None])
    object.__setattr__(track, "rotations", None if R is None else R[None])
    return track
