"""Regimes: base or tool, or both, were moved during the recording, by any angle and distance.

They are looked for before anything is rejected and before effects are blamed, for a robust fit takes the stations of a
regime for wrong readings. Stretches come from :mod:`setups`, with the arm as nominal and then as fitted. What moved
between two of them, and whether anything did, is decided as in a check. Beside a fit in which base and tool moved at
all of these times, steps of either are rows, and so are a base or a tool that drifts or settles and joints that err
with their position. A step that the readings do not ask for beside the others is no regime.

A regime's base or tool is a *step* in the model: six values of any size, 0 after the move and its inverse before, so
that the model's base and tool are those that hold in the end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from modcal_core.calibration import (
    Cell,
    Fit,
    Model,
    ModelParameter,
    Move,
    What,
    choose_parameters,
    fit_cell,
    fit_geometry,
    free_cell,
    identify_moved,
    outlying,
    runs_of,
    usual_miss,
    views_of,
)
from modcal_core.effects import ALL, EXPECTED_ANGLE, EXPECTED_LENGTH, SHIFT, Effect, Shape, is_move
from modcal_core.effects.families import axis_wobble, drift, gear_harmonic, step
from modcal_core.geometry import error_values, se3
from modcal_core.hypotheses import LIMIT_OF_REACH, HandEye, unrelated
from modcal_core.measurements import Samples, explained_by_posture, spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves.likelihood import FrozenKnowledge
from modcal_core.moves.rows import DRIFT, GEAR, READING, STEP, CellChange
from modcal_core.moves.searching import MoveSearch
from modcal_core.moves.setups import Setup, SetupReadings, stretches
from modcal_core.moves.state import CheckState
from modcal_core.robots import Inertias, Mechanism

_MAX = 3000  # samples; a longer recording is thinned evenly
_ROUNDS = 3  # of stretches and a fit of the arm
_TOLERANCE = 0.05  # standard deviations to which a fit is brought while searching
_STEPS = 12  # of a fit that tells times; where nothing fits, weights go to and fro for long
_MIN = 4  # stations in a stretch, from which there are two for each half
_ROOM = 0.5  # of what an effect is expected to be; half of a move is what a fit without it has in its spread
_FEW = 120  # samples that are asked, as many of each stretch
_PRICE = 30.0  # nats for anything beside one base and one tool, as over nothing where readings do not agree with an arm
_PATTERN = 0.25  # share of the variance that neighbouring postures have in common: what an arm has beside its geometry
_SETTLING = 0.12  # time constant to begin from, as a share of the recording
_WAVES = 4  # a turn, of a joint that errs with its position
_ALTERNATING = 8  # rounds of base and tool, each in closed form


def find_regimes(
    samples: Samples, chain: Mechanism, cell: Cell, inertias: Inertias | None = None, stated: Sequence[Move] = ()
) -> Model | None:
    """A nominal model with base, tool and steps about where the regimes have them, to begin fits from; None for none.

    stated: moves that are known of.
    """
    places = _movable(samples, cell)
    if not places:
        return None
    stated = [move for move in stated if samples.stamps.min() < move.at < samples.stamps.max()]
    if len(samples) > _MAX:
        samples = samples.select(spread_rows(len(samples), _MAX))
    nominal = fit_cell(chain, samples, cell, inertias)
    choice = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances)
    parameters = free_cell(choice.parameters, cell)
    geometric = fit_geometry(nominal.model, samples, parameters, cell, tolerance=_TOLERANCE)
    if not stated and (not _suspicious(geometric, samples) or _nonsense(geometric.model, samples)):
        return None
    search = _RegimeSearch(nominal.model, samples, geometric.parameters, cell, places)
    cuts = search.cuts([nominal.model, geometric.model])
    moves = search.decided(cuts, tuple(stated))
    if not moves:
        return None
    found = search.start(moves)
    return found if is_possible(found) else None


def is_possible(model: Model) -> bool:
    """Whether no tool has moved by more than the arm reaches: where tools hardly turn, base and tool are one motion."""
    sizes = [float(np.linalg.norm(e.values[:3])) for e in model.effects if is_move(e) and e.place == "tool"]
    return bool(max(sizes, default=0.0) < model.chain.reach())


def moves_of(model: Model) -> tuple[Move, ...]:
    """The moves of base and tool that a model knows of, in order of time."""
    return _moves(effect for effect in model.effects if is_move(effect))


def _moves(steps: Iterable[Effect]) -> tuple[Move, ...]:
    at: dict[float, set[str]] = {}
    for effect in steps:
        at.setdefault(effect.shape.settings["at"], set()).add(effect.place)
    return tuple(Move(t, "both" if len(p) == 2 else _place(p.pop())) for t, p in sorted(at.items()))


def _place(name: str) -> What:
    return "base" if name == "base" else "tool"


def _movable(samples: Samples, cell: Cell) -> set[str]:
    """What may have moved: not what is held fixed, and nothing where readings are no positions or show fixed points."""
    if not is_direct(samples.kinds) or any(samples.is_same_point(f) for f in range(len(samples.frames))):
        return set()
    names = {"base": "frame", "tool": "tool/x"}
    return {
        place
        for place, name in names.items()
        if not any(fnmatchcase(name, fixed) or fixed.startswith(name.partition("/")[0]) for fixed in cell.kept)
    }


def _suspicious(fit: Fit, samples: Samples) -> bool:
    """Whether a fit without moves leaves room for one that the diagnosis of small effects would not find.

    Where fewer stations than half have moved far, the fit rejects them, in runs. Otherwise they are in its spread, at
    half of what they moved by at the least.
    """
    noise = fit.noise
    if noise.position > _ROOM * EXPECTED_LENGTH or noise.rotation > _ROOM * EXPECTED_ANGLE:
        return True
    return bool(runs_of(samples, outlying(fit.model, noise, samples)))


def _nonsense(model: Model, samples: Samples) -> bool:
    """Whether readings that an arm misses by far do not depend on its joints, whatever moved."""
    if usual_miss(model, samples) <= LIMIT_OF_REACH * model.chain.reach():
        return False
    case = HandEye.of(samples, model.chain)
    return case is not None and unrelated(case)


@dataclass(frozen=True)
class _RegimeSearch:
    """What is looked through. arm: nominal, with base and tool somewhere. places: that may move."""

    arm: Model
    samples: Samples
    parameters: Sequence[ModelParameter]
    cell: Cell
    places: set[str]

    def cuts(self, arms: Sequence[Model]) -> tuple[float, ...]:
        """Times [s] between stretches with a base or tool of their own, as these arms show them, fitted in between."""
        found: tuple[float, ...] = ()
        for arm in arms:
            found = found or self._times(arm)
        missed = usual_miss(arms[-1], self.samples)
        for _ in range(_ROUNDS if found else 0):
            moved = self.fit([Move(at, "both") for at in found], _STEPS).model
            before, missed = missed, usual_miss(moved, self.samples)
            if missed > max(0.5 * before, LIMIT_OF_REACH * moved.chain.reach()):
                return ()  # whatever moved, these are no readings of this arm
            again = self._times(moved)
            if again == found or not again:
                break
            found = again
        return found

    def _times(self, arm: Model) -> tuple[float, ...]:
        """Times between stretches by this arm; what is shorter than two stations joins its neighbour."""
        sights = SetupReadings.of(arm, self.samples)
        ends = [b for a, b in stretches(sights) if b - a >= _MIN]
        return tuple(float(0.5 * (sights.stamps[b - 1] + sights.stamps[b])) for b in ends if b < len(sights))

    def start(self, moves: Sequence[Move]) -> Model:
        """The arm with base, tool and steps as these moves show them, in closed form."""
        sights = SetupReadings.of(self.arm, self.samples)
        part = np.searchsorted([move.at for move in moves], sights.stamps, side="right")
        base = np.r_[0, np.cumsum([move.what != "tool" for move in moves])].astype(int)
        tool = np.r_[0, np.cumsum([move.what != "base" for move in moves])].astype(int)
        largest = int(np.argmax(np.bincount(part)))
        rows = np.flatnonzero(part == largest)
        still = Setup(np.eye(4), sights.tool(rows, np.eye(4)))
        first = sights.both(rows) if "base" in self.places else still
        D = np.tile(first.D, (base[-1] + 1, 1, 1))
        X = np.tile(first.X, (tool[-1] + 1, 1, 1))
        for _ in range(_ALTERNATING):
            for g in range(len(X)):
                rows = np.flatnonzero(tool[part] == g)
                X[g] = sights.tool(rows, D[base[part[rows]]])
            for g in range(len(D)):
                if g != base[largest]:
                    rows = np.flatnonzero(base[part] == g)
                    D[g] = sights.base(rows, X[tool[part[rows]]])
        return self._with_steps(moves, D[base], X[tool])

    def _with_steps(self, moves: Sequence[Move], D: np.ndarray, X: np.ndarray) -> Model:
        """The arm with the last base and tool of these (moves + 1, 4, 4), and the earlier ones as steps."""
        root = self.arm.chain.T_base_root
        frames = self.arm.T_frame_base @ root @ D[-1] @ se3.inverse(root)
        base, tool = (error_values(se3.inverse(T[-1]) @ T) for T in (D, X))
        turn, count = (ALL, 6) if self.samples.is_pose.all() else (SHIFT, 3)
        effects = []
        for k, move in reversed(list(enumerate(moves))):
            if move.what != "tool":
                effects.append(step.moved("base", ALL, move.at).with_values(base[k + 1] - base[k]))
            if move.what != "base":
                effects.append(step.moved("tool", turn, move.at).with_values((tool[k + 1] - tool[k])[:count]))
        return replace(self.arm, T_frame_base=frames, T_tip_tool=X[-1], effects=tuple(effects))

    def fit(self, moves: Sequence[Move], most: int | None = None) -> Fit:
        """The fit of arm and moves, in so many steps at most."""
        start, known = self.start(moves), self.cell.distances
        return identify_moved(start, self.samples, self.parameters, known, _TOLERANCE, most=most)

    def decided(self, cuts: Sequence[float], stated: tuple[Move, ...]) -> list[Move]:
        """What moved at these times, as far as the readings ask for it beside what drifts or settles and joints that
        err with their position; and all that is stated.
        """
        every: What = "both" if len(self.places) == 2 else _place(next(iter(self.places)))
        new = [Move(at, every) for at in cuts if not any(self._same(at, move.at) for move in stated)]
        if not new:
            return list(stated)
        moves = sorted([*stated, *new], key=lambda m: m.at)
        fit = self.fit(moves)
        if usual_miss(fit.model, self.samples) > LIMIT_OF_REACH * fit.model.chain.reach():
            return list(stated)  # whatever moved, these are no readings of this arm
        known: dict[bool, list[CellChange]] = {True: [], False: []}
        for effect in filter(is_move, fit.model.effects):
            at = effect.shape.settings["at"]
            known[at in {move.at for move in stated}].append(CellChange(STEP, f"{effect.place} at {at}", (), (effect,)))
        given, asked = known[True], known[False]
        joints = {joint for move in new for joint in explained_by_posture(self.samples, move.at)}
        state = self._without(fit, [move.at for move in moves], [*given, *asked])
        engine = MoveSearch(state, given, [*asked, *self._rivals(sorted(joints))], _PRICE, len(asked))
        found = engine.needed(list(engine.explained(without=(READING,)).picked))
        own = _moves(j.hypothesis.effect for j in found if j.hypothesis.kind == STEP)
        return sorted([*stated, *own], key=lambda m: m.at)

    def _without(self, fit: Fit, times: Sequence[float], rows: Sequence[CellChange]) -> CheckState:
        """The fit beside some stations of each stretch, none of them wrong, with what its moves do taken back."""
        part = np.searchsorted(times, self.samples.stamps)
        each = [np.flatnonzero(part == k) for k in range(len(times) + 1)]
        few = np.concatenate([some[spread_rows(len(some), _FEW // len(each))] for some in each])
        few = few[~outlying(fit.model, fit.noise, self.samples.select(few))]
        own = np.diag([p.prior_std**2 for p in self.parameters])
        known = FrozenKnowledge(fit.noise, tuple(self.parameters), own, pattern=_PATTERN)
        state = CheckState(fit.model, self.samples.select(few), known)
        moved = sum((state.columns(h) @ h.effect.amplitudes for h in rows), np.zeros(len(state.view.residual)))
        null = replace(state.null, residual=state.view.residual + moved)
        return CheckState(fit.model, state.samples, known, null, linear=True)

    def _rivals(self, joints: Sequence[str]) -> Iterator[CellChange]:
        """A base or a tool that drifts or settles; joints that err with their position, about their axis and across."""
        low, high = float(self.samples.stamps.min()), float(self.samples.stamps.max())
        settling = Shape("settle", {"since": low, "tau": _SETTLING * (high - low)})
        for place in sorted(self.places):
            turn, count = (ALL, 6) if place == "base" or self.samples.is_pose.all() else (SHIFT, 3)
            for shape in (drift.slow_curve(low, high), settling):
                effect = drift.drifting(place, turn, shape)
                yield CellChange(DRIFT, place, effects=(effect.started(np.zeros(count * shape.size)),))
        for name in joints:
            waves = [e.started(np.zeros(e.shape.size)) for e in gear_harmonic.whole(name, _WAVES)]
            waves += [e.started(np.zeros(2 * e.shape.size)) for e in axis_wobble.whole(name, _WAVES)]
            yield CellChange(GEAR, name, effects=tuple(waves))

    def _same(self, a: float, b: float) -> bool:
        """Whether no station lies between two times."""
        stamps = self.samples.stamps
        return not ((stamps > min(a, b)) & (stamps < max(a, b))).any()
