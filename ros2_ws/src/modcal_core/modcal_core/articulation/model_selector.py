"""Incremental selection of the joint type, bounded work per pose.

A round weighs every kind at several plays on the nodes as they were when it began, one of them a pose; only what was
weighed on the same nodes is compared. Between rounds the best motion is improved on the nodes of now. Another kind is
selected when it has won two rounds in a row. Of distortion the usual size alone is tried.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from typing import Literal

import numpy as np

from modcal_core.articulation.evidence import EvidenceRow, glance, improved, weigh
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.models.registry import AXES, STILL, log_shares
from modcal_core.articulation.scene import FIRST, LOG_PLAYS, LOOSE, PLAYS, SWAYS, NodeScene
from modcal_core.articulation.track import FEWEST_NODES, Nodes
from modcal_core.geometry import Array

FEW = (1, 2, 3)  # of the plays: the least and the largest are rare, and each costs as much as the others
_MODELS = {kind: model for kind, model in AXES.items() if model.slots}
_GUESSED: dict[int, Kind] = {slot: kind for kind, model in _MODELS.items() for slot in model.slots}
_USUAL = {kind for kind, model in _MODELS.items() if model.usual}
_LOG_SHARES = log_shares(_MODELS.values())
_Stage = Literal["again", "fresh", "climb", "judge"]
_CLIMBS = 2  # steps of a new guess before it is compared with one that has had many
_MIN_JITTER = 12  # changes of a residual, of which a median tells the noise
_MOVES = 0.02  # probability that the handle moves at all, before it has
EVEN: dict[Kind, float] = {STILL.name: 1.0 - _MOVES, **{kind: _MOVES * m.share for kind, m in _MODELS.items()}}


class ModelSelector:
    """kind: the most probable. motion: of the most probable of those that move, None at first.

    follows: whether rotations are the handle's. probabilities: of kinds. scale: noise of one pose that the next does
    not share [m, rad]. rounds: how many began.
    """

    def __init__(self) -> None:
        self.kind: Kind = STILL.name
        self.motion: AxisMotion | None = None
        self.follows = True
        self.probabilities = dict(EVEN)
        self.scale = (1e-3, 0.01)
        self.rounds = 0
        self._rows: dict[tuple[Kind, int], EvidenceRow] = {}
        self._left: list[tuple[Kind, int, _Stage]] = []
        self._fresh: EvidenceRow | None = None
        self._scene: NodeScene | None = None
        self._play, self._column = FEW[1], 0
        self._turn = 0
        self._won: Kind = STILL.name
        self._jitter: deque[tuple[float, float]] = deque(maxlen=48)

    def jitter(self, step: Array) -> None:
        """Take the change (3,) or (6,) of a residual from one pose to the next, which tells of noise."""
        turn = float(step[3:] @ step[3:]) if len(step) == 6 else 0.0
        self._jitter.append((float(step[:3] @ step[:3]), turn))

    def advance(self, nodes: Nodes) -> bool:
        """A slot of the round, or a step on the nodes of now, or both; whether another kind is selected now."""
        self._turn += 1
        if self._turn % 2 == 0 and nodes.k >= FEWEST_NODES and self.motion is not None:
            if nodes.oriented:  # both together would take too long
                self._improve(self.motion, nodes)
                return False
            if self._left:  # else a motion is chosen anyway
                self._improve(self.motion, nodes)
        if self._left and self._scene is not None:
            self._slot(*self._left.pop(), self._scene)
            return False
        other = self._scene is not None and self._conclude(self._scene)
        if nodes.k >= FEWEST_NODES:
            self._begin(nodes)
        return other

    def _improve(self, motion: AxisMotion, nodes: Nodes) -> None:
        better = improved(self._now(nodes), motion, float(PLAYS[self._play]), self._column)
        assert isinstance(better, AxisMotion)
        self.motion = better

    def _now(self, nodes: Nodes) -> NodeScene:
        if len(self._jitter) >= _MIN_JITTER:
            shift, turn = (statistics.median(some) for some in zip(*self._jitter, strict=True))
            self.scale = math.sqrt(shift / 2.77), math.sqrt(turn / 4.73)
        track = nodes.track()
        assert track is not None
        return NodeScene.of(track, nodes.apart(), nodes.counts[: nodes.k], self.scale)

    def _begin(self, nodes: Nodes) -> None:
        self._scene = self._now(nodes)
        self.rounds += 1
        # One new guess a round, early, so that what takes its place is weighed with the rest; but after what it may
        # replace was weighed on the nodes of now: evidence grows with nodes, and what is older always looks worse.
        kind, i = _GUESSED[self.rounds % len(_GUESSED)], FEW[self.rounds % len(FEW)]
        slots: list[tuple[Kind, int, _Stage]] = [(kind, i, "again")] if (kind, i) in self._rows else []
        slots.append((kind, i, "fresh"))
        slots += [(other, k, "again") for other in _MODELS for k in FEW if (other, k) != (kind, i)]
        self._left = slots[::-1]

    def _slot(self, kind: Kind, i: int, stage: _Stage, scene: NodeScene) -> None:
        """Weigh one kind at one play: where it was left, or from a new guess, which stays if it is better."""
        known, play = self._rows.get((kind, i)), float(PLAYS[i])
        if stage == "judge" and self._fresh is not None:
            found = glance(scene, self._fresh, play, self.rounds)
            if known is None or found.evidence.max() > known.evidence.max() + 1.0:
                for j in FEW if known is not None else (i,):
                    self._rows[kind, j] = found
        elif stage == "climb" and self._fresh is not None:
            self._fresh = glance(scene, self._fresh, play, self.rounds)
        elif stage == "again" and known is not None:
            self._rows[kind, i] = glance(scene, known, play, self.rounds)
        else:
            others = {other: row.motion for (other, j), row in self._rows.items() if j == i}
            guess = _MODELS[kind].quick_guess(scene.track, others, self.rounds)
            if guess is None:
                return
            level = np.full(len(SWAYS) if scene.track.oriented else 1, -1e9)
            self._fresh = glance(scene, EvidenceRow(guess, level, FIRST if scene.track.oriented else 0), play, -1)
            climbs: list[tuple[Kind, int, _Stage]] = [(kind, i, "climb")] * _CLIMBS
            self._left += [(kind, i, "judge"), *climbs]

    def _conclude(self, scene: NodeScene) -> bool:
        known: dict[Kind, list[EvidenceRow]] = {}
        for kind in _MODELS:
            rows = [self._rows[kind, i] for i in FEW if (kind, i) in self._rows]
            if rows:
                known[kind] = rows if len(rows) == len(FEW) else [rows[0]] * len(FEW)
        if not set(known) >= _USUAL:
            return False
        self.probabilities, best, i, j = weigh(known, LOG_PLAYS[list(FEW)], _LOG_SHARES, scene)
        won, self._won = self._won, best
        old = None if self.motion is None else self.motion.kind
        if old is not None and best not in (old, won) and old in known:
            best, rows = old, known[old]  # the old kind, at its own best play
            i = int(np.argmax([row.evidence.max() for row in rows]))
            j = int(np.argmax(rows[i].evidence))
        self.follows = not (scene.track.oriented and bool(LOOSE[j]))
        chosen = known[best][i]
        self._play, self._column = FEW[i], j
        self.kind = STILL.name if self.probabilities[STILL.name] > 0.5 else best
        assert isinstance(chosen.motion, AxisMotion)
        self.motion = chosen.motion
        return old != best
