"""Which explanation fits, and is it sure? Proposers suggest, closed forms sift, the evidence of a full fit decides.

A state is what has been undone so far. Every round takes the likeliest states and asks what else may be so: of the
whole recording, of some stations, of one column, of the joints, of the description. It ends where a nominal arm agrees
with nearly all stations, or nothing gains any more. *Nothing* is the state that the search begins with; where no state
brings the arm near the readings, *none of these* is the answer, whatever gained.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import so3
from modcal_core.hypotheses import channels, conventions, description, joints, rows
from modcal_core.hypotheses.hand_eye import HandEye, HandEyeFit, placed, points
from modcal_core.hypotheses.hypothesis import Hypothesis
from modcal_core.measurements import spread_rows

SURE = 30.0  # nats over nothing; of a hundred stations at the errors of a nominal arm, which are not independent
ODDS = 3.0  # nats, odds of twenty to one, within which another explanation is a rival
AN_ARM = 0.05  # of the reach; what misses by more is explained by nothing
_BETTER = 4.0  # times, by which what is no explanation for a nominal arm must still be better
_AGREED = 0.9  # share of the stations; what is left then is single wrong readings, or asked of the arm itself
_FEW, _FITTED = 60, 8  # stations that tables are sifted on, and hypotheses of each that are fitted
_FEWEST = 12  # stations that can be asked by themselves, twice what base and tool ask for
_DEPTH, _BEAM = 3, 2  # mistakes at once, and states that are followed
_AT_ONCE = 96  # cases in a block, for memory

_Proposer = Callable[[HandEyeFit], Iterable[Hypothesis]]


@dataclass(frozen=True)
class SearchState:
    """What was undone so far, and the fit to what the readings then are."""

    fit: HandEyeFit
    said: tuple[Hypothesis, ...] = ()

    @property
    def score(self) -> float:
        """Log evidence with the price of every name [nats]."""
        return self.fit.evidence + sum(h.cost(len(self.fit.case)) for h in self.said)

    @property
    def ends(self) -> bool:
        """Whether nothing has to be asked any more."""
        return self.fit.explains and float(self.fit.agree(2.0).mean()) >= _AGREED


@dataclass(frozen=True)
class Answer:
    """said: what explains the readings together; empty where nothing does, or nothing has to be explained. before,
    after: the fits to the readings as they are, and with all of it undone. rivals: explanations nearly as likely.
    """

    said: tuple[Hypothesis, ...]
    before: HandEyeFit
    after: HandEyeFit
    gain: float = 0.0
    rivals: tuple[str, ...] = ()

    @property
    def what(self) -> str:
        """The explanation as a phrase; empty where there is none."""
        return ", and ".join(h.what for h in self.said) + "".join(f"; or {rival}" for rival in self.rivals)

    @property
    def remedy(self) -> str:
        """What to do."""
        return "; then ".join(dict.fromkeys(h.remedy for h in self.said))

    @property
    def stations(self) -> int:
        """How many stations are concerned."""
        return max((len(self.before.case) if h.stations is None else h.stations for h in self.said), default=0)


def explain(case: HandEye, table: Sequence[Hypothesis] | None = None, depth: int = _DEPTH) -> Answer:
    """What was written down wrongly, so that the readings do not agree with the arm.

    table: hypotheses to ask of alone; None: all.
    """
    root = SearchState(placed(case))
    if root.fit.clean or (table is None and root.ends):
        return Answer((), root.fit, root.fit)
    seen, beam = [root], [root]
    for _ in range(depth):
        trials = [t for state in beam for t in _followed(state, table)]
        seen += trials
        leading = [t for t in trials if t.score > root.score + SURE and _nearer(t.fit, root.fit)]
        beam = _different(sorted(leading, key=lambda t: -t.score))
        if not beam or any(t.ends for t in beam):
            break
    return _answered(root, seen)


def _answered(root: SearchState, seen: Sequence[SearchState]) -> Answer:
    """The likeliest explanation, where it is one."""
    likely = [s for s in seen if s.said and s.score > root.score + SURE]
    good = [s for s in likely if s.fit.explains] or [s for s in likely if _much_better(s.fit, root.fit)]
    if not good:
        return Answer((), root.fit, root.fit)
    best = max(good, key=lambda s: s.score)
    near = [s for s in good if s.score > best.score - ODDS and s is not best]
    own = {h.what for h in best.said}
    others = tuple(dict.fromkeys(s.said[-1].what for s in near if len(s.said) == len(best.said)))
    rivals = tuple(what for what in others if what not in own)[:3]
    return Answer(best.said, root.fit, best.fit, best.score - root.score, rivals)


def _much_better(after: HandEyeFit, before: HandEyeFit) -> bool:
    """Whether what is left is no nominal arm's error and still mostly gone."""
    limit = AN_ARM * after.case.chain.reach()
    size = max(after.usual[1] / after.case.limits[1], after.usual[0] / after.case.limits[0])
    was = max(before.usual[1] / before.case.limits[1], before.usual[0] / before.case.limits[0])
    return after.usual[1] <= min(limit, after.case.motion[1] / _BETTER) and _BETTER * size <= was


def _different(states: Sequence[SearchState]) -> list[SearchState]:
    """The likeliest states that touch different things, best first: of two mistakes either may come first."""
    first: dict[str, SearchState] = {}
    for state in states:
        first.setdefault(state.said[-1].touches, state)
    return list(first.values())[:_BEAM]


def _nearer(after: HandEyeFit, before: HandEyeFit) -> bool:
    """Whether turns or places are missed by half as much, or many more stations agree: else it leads nowhere."""
    both = tuple(zip(after.usual, before.usual, strict=True))
    asked = both if after.case.poses == before.case.poses else both[1:]  # turns are zero where nobody asks for them
    halved = any(now <= 0.5 * was for now, was in asked if was > 0.0)
    return halved or float(after.agree(2.0).mean() - before.agree(2.0).mean()) > 0.1


def _followed(state: SearchState, table: Sequence[Hypothesis] | None) -> list[SearchState]:
    """The states that one more hypothesis leads to; what takes a search is asked where nothing else ends it."""
    case = state.fit.case
    if table is not None:
        return _fitted(state, _sifted(case, table))
    trials = _fitted(state, _sifted(case, _whole(case)))
    for proposers in (_PLAIN, _LABORIOUS):
        if any(t.ends for t in trials):
            break
        trials += _fitted(state, _proposed(state.fit, proposers))
    return trials


def _whole(case: HandEye) -> list[Hypothesis]:
    """What may be so of a whole recording, told in closed form."""
    whole = [*conventions.of_recording(case), *description.other_links(case), *description.axes(case)]
    return [*whole, *joints.types(case), *channels.turned_frames(case)]


def _of_themselves(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """What the stations that do not agree look like by themselves, with a base and a tool of their own."""
    rest = rows.astray(fit)
    if not _FEWEST <= len(rest) <= 0.9 * len(fit.case):
        return
    part = fit.case.select(rest)
    likely = [(h, placed(h.undone(part))) for h in _sifted(part, _whole(part))[:_BEAM]]
    if not any(own.explains for _, own in likely):
        likely += [(h, placed(h.undone(part))) for h in description.mixtures(part)]
    for h, own in likely:
        if own.explains:
            yield rows.with_own_placement(h, own.placement, fit, rest)


# what is told in closed form, and what takes a search
_PLAIN: tuple[_Proposer, ...] = (
    lambda fit: rows.by_table(fit, conventions.of_some_rows(fit.case)),
    rows.of_the_rest,
    rows.elsewhere,
    rows.still,
    _of_themselves,
    rows.stretches,
    lambda fit: [conventions.increments()],
    lambda fit: rows.orders(fit.case),
    lambda fit: rows.filters(fit.case),
    lambda fit: channels.channels(fit.case),
    joints.of_one,
)
_LABORIOUS: tuple[_Proposer, ...] = (
    joints.of_two,
    lambda fit: joints.orders(fit.case),
    lambda fit: joints.throughout(fit.case),
    lambda fit: description.links(fit.case),
    lambda fit: description.mixtures(fit.case),
    lambda fit: description.mixtures(points(fit.case)) if fit.case.poses else (),  # whatever orientations mean
)


def _proposed(fit: HandEyeFit, proposers: Sequence[_Proposer]) -> Iterator[Hypothesis]:
    for propose in proposers:
        try:
            yield from propose(fit)
        except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
            continue


def _fitted(state: SearchState, hypotheses: Iterable[Hypothesis]) -> list[SearchState]:
    out = []
    for h in hypotheses:
        try:
            fit = placed(h.undone(state.fit.case))
        except np.linalg.LinAlgError:
            continue
        if np.isfinite(fit.evidence):
            out.append(SearchState(fit, (*state.said, h)))
    return out


def _sifted(case: HandEye, table: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The likeliest of a table, by closed forms on some stations."""
    few = case.select(spread_rows(len(case), _FEW))
    scores: list[float] = []
    for first in range(0, len(table), _AT_ONCE):
        some = table[first : first + _AT_ONCE]
        scores += [s + h.price for s, h in zip(rough([h.undone(few) for h in some]), some, strict=True)]
    good = [k for k in np.argsort(scores, kind="stable")[::-1][:_FITTED] if np.isfinite(scores[k])]
    return [table[k] for k in good]


def rough(cases: Sequence[HandEye]) -> list[float]:
    """Log likelihood of cases of as many stations each, by closed forms without refinement."""
    A, p, R = (np.stack([getattr(c, name) for c in cases]) for name in ("A", "p", "R"))
    a = A[..., :3, :3]
    score = np.full(len(cases), -np.inf)
    try:
        Y = base_by_positions(A, p)
        ways = [(Y, so3.nearest_rotation(np.sum(np.swapaxes(Y[:, None] @ a, -1, -2) @ R, axis=1)))]
        if any(c.poses for c in cases):
            ways.append(base_and_tool_turns(a, R))
    except np.linalg.LinAlgError:
        return score.tolist()
    for base, tool in ways:
        turns, gaps = turns_left(base, a, tool, R), tool_and_place(base, A, p)[0]
        each = [c.scale.rows(t, g).sum() for c, t, g in zip(cases, turns, gaps, strict=True)]
        score = np.fmax(score, each)
    return [float(s + c.volume.sum()) for s, c in zip(score, cases, strict=True)]
