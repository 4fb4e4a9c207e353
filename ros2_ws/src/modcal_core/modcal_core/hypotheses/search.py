"""Which explanation fits, and is it sure? Proposers suggest, closed forms sift, the evidence of a full fit decides.

A state is what has been undone so far. Every round takes the likeliest states and asks what else may be so: of the
whole recording, of some stations, of one column, of the joints, of the description. It ends where a nominal arm agrees
with nearly all stations, or nothing gains any more. *Nothing* is the state that the search begins with; where no state
brings the arm near the readings, *none of these* is the answer, whatever gained.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import so3
from modcal_core.hypotheses import channels, conventions, description, joints, rows
from modcal_core.hypotheses.hand_eye import MANY, HandEye, HandEyeFit, placed, redrawn
from modcal_core.hypotheses.hypothesis import Hypothesis
from modcal_core.measurements import spread_rows

SURE = 30.0  # nats over nothing; of a hundred stations at the errors of a nominal arm, which are not independent
ODDS = 3.0  # nats, odds of twenty to one, within which another explanation is a rival
_AGREED = 0.9  # share of the stations; what is left then is single wrong readings, or asked of the arm itself
_SIEVES = (24, 32), (60, 8)  # stations that tables are sifted on, and how many hypotheses pass
_FITTED = 8  # hypotheses that one of several mistakes is exchanged for
_DRAWN = 6  # of them that are fitted from draws of stations as well
_FEWEST = 12  # stations that can be asked by themselves, twice what base and tool ask for
_HELD = 5  # stations that agree; fewer do so with any placement
_OF_ROWS = 1  # of the laborious ones, first, that ask whether rows stand elsewhere
_DEPTH, _BEAM = 3, 2  # mistakes at once, and states that are followed
_AT_ONCE = 96  # cases in a block, for memory
_ALTERNATIONS = 6  # between base and tool, of a hypothesis that is sifted

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
        trials = [(t, state) for state in beam for t in _followed(state, table)]
        seen += [t for t, _ in trials]
        leading = [t for t, before in trials if t.score > before.score + SURE and _nearer(t.fit, root.fit)]
        beam = _different(sorted(leading, key=lambda t: -t.score))
        if not beam or any(t.ends for t in beam):
            break
    return _answered(root, seen)


def _answered(root: SearchState, seen: Sequence[SearchState]) -> Answer:
    """The likeliest explanation, where it is one."""
    likely = [s for s in seen if s.said and s.score > root.score + SURE]
    many = max(MANY, 2.0 * float(root.fit.agree(2.0).mean()))  # another mistake may spoil the others
    good = [s for s in likely if s.fit.explains] or [s for s in likely if s.fit.agree(2.0).mean() >= many]
    if not good:
        return Answer((), root.fit, root.fit)
    good += _exchanged(root, max(good, key=lambda s: s.score), likely)
    best = max(good, key=lambda s: s.score)
    near = [s for s in good if s.score > best.score - ODDS and len(s.said) == len(best.said)]
    own = {h.what for h in best.said}
    rivals = tuple(dict.fromkeys(h.what for s in near for h in s.said if h.what not in own))[:3]
    return Answer(best.said, root.fit, best.fit, best.score - root.score, rivals)


def _exchanged(root: SearchState, best: SearchState, likely: Sequence[SearchState]) -> list[SearchState]:
    """Of several mistakes, each exchanged for others that gained by themselves: only the likeliest were followed."""
    if len(best.said) < 2:
        return []
    out, alone = [], sorted((s for s in likely if len(s.said) == 1), key=lambda s: -s.score)
    for k, h in enumerate(best.said):
        others = {s.said[0].what: s.said[0] for s in alone if s.said[0].touches == h.touches}
        others.pop(h.what, None)
        for other in [*others.values()][:_FITTED]:
            state = root
            for part in (*best.said[:k], other, *best.said[k + 1 :]):
                state = _followed_by(state, part, thorough=True) or root
            if len(state.said) == len(best.said) and state.fit.explains:
                out.append(state)
    return out


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
    if table is not None:  # where rows belong elsewhere cannot be asked of some stations
        by_row = [h for h in table if h.touches == "rows"]
        return _fitted(state, [*_sifted(case, [h for h in table if h.touches != "rows"]), *by_row])
    many = bool(state.fit.agree(2.0).mean() >= MANY)
    # else no more than rows may be other ones
    related = many or not (rows.unrelated(case) or rows.scattered(state.fit))
    trials = _fitted(state, _sifted(case, _whole(case))) if related else []
    laborious = many or not state.said  # else nonsense is followed for long
    held = int(state.fit.agree(2.0).sum()) > _HELD
    for proposers in (_BESIDE * held + _PLAIN, _LABORIOUS[:_OF_ROWS] if not related else _LABORIOUS * laborious):
        if any(t.ends for t in trials):
            break
        trials += _fitted(state, _proposed(state.fit, proposers))
    return trials


def _whole(case: HandEye) -> list[Hypothesis]:
    """What may be so of a whole recording, told in closed form."""
    whole = [*conventions.of_recording(case), *description.other_links(case), *description.axes(case)]
    return [*whole, *description.types(case), *channels.turned_frames(case)]


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


# of stations that do not agree with a placement as others do; what is told in closed form; what takes a search
_BESIDE: tuple[_Proposer, ...] = (
    lambda fit: rows.by_table(fit, conventions.of_some_rows(fit.case)),
    rows.of_the_rest,
    rows.elsewhere,
    rows.still,
    joints.of_one,
)
_PLAIN: tuple[_Proposer, ...] = (
    rows.stretches,
    lambda fit: [conventions.increments()],
    lambda fit: rows.orders(fit.case),
    lambda fit: rows.filters(fit.case),
    lambda fit: channels.channels(fit.case),
)
_LABORIOUS: tuple[_Proposer, ...] = (
    lambda fit: rows.permuted(fit.case),
    _of_themselves,
    joints.of_two,
    lambda fit: joints.orders(fit.case),
    lambda fit: joints.throughout(fit.case),
    lambda fit: description.links(fit.case),
    lambda fit: description.mixtures(fit.case),
)


def _proposed(fit: HandEyeFit, proposers: Sequence[_Proposer]) -> Iterator[Hypothesis]:
    for propose in proposers:
        try:
            yield from propose(fit)
        except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
            continue


def _fitted(state: SearchState, hypotheses: Iterable[Hypothesis]) -> list[SearchState]:
    """The states that these lead to, the likeliest from draws of stations as well."""
    quick: dict[str, SearchState] = {}
    for h in hypotheses:
        found = _followed_by(state, h, thorough=False)
        if found is not None and (h.what not in quick or found.score > quick[h.what].score):
            quick[h.what] = found  # the same may be proposed from several starts
    likely = sorted(quick.values(), key=lambda s: -s.score)
    return [replace(s, fit=redrawn(s.fit)) for s in likely[:_DRAWN]] + likely[_DRAWN:]


def _followed_by(state: SearchState, h: Hypothesis, thorough: bool) -> SearchState | None:
    """The state with one more hypothesis; None where it leaves nothing to fit."""
    try:
        fit = placed(h.undone(state.fit.case), thorough)
    except np.linalg.LinAlgError:
        return None
    return SearchState(fit, (*state.said, h)) if np.isfinite(fit.evidence) else None


def _sifted(case: HandEye, table: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The likeliest of a table, by closed forms on some stations; of many first on fewer."""
    kept = list(table)
    for stations, most in _SIEVES:
        few = case.select(spread_rows(len(case), stations))
        scores: list[float] = []
        for first in range(0, len(kept), _AT_ONCE):
            some = kept[first : first + _AT_ONCE]
            scores += [s + h.price for s, h in zip(rough([h.undone(few) for h in some]), some, strict=True)]
        kept = [kept[k] for k in np.argsort(scores, kind="stable")[::-1][:most] if np.isfinite(scores[k])]
    return kept


def rough(cases: Sequence[HandEye]) -> list[float]:
    """Log likelihood of cases of as many stations each, by closed forms without refinement."""
    A, p, R = (np.stack([getattr(c, name) for c in cases]) for name in ("A", "p", "R"))
    a = A[..., :3, :3]
    score = np.full(len(cases), -np.inf)
    try:
        Y = base_by_positions(A, p, _ALTERNATIONS)
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
