"""What may be so of some stations only, beside a base and a tool that others agree on; and rows in another order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses.hand_eye import (
    ANYWHERE,
    MANY,
    SPREAD,
    HandEye,
    HandEyeFit,
    Placement,
    at,
    closed,
    likelihood_at,
    placed,
    points,
)
from modcal_core.hypotheses.hypothesis import (
    COMMON,
    RARE,
    ROWS_REMEDY,
    Hypothesis,
    cost_of_rows,
    where,
)
from modcal_core.hypotheses.joint_columns import unexplained
from modcal_core.measurements import spread_rows

_FEW = 40  # stations at which hypotheses are screened
_KEPT = 8  # of them that are then asked of all stations
_LEAST = 3  # stations; fewer are single wrong readings
_TELLING = 200  # stations, from which readings that depend on joints are told from those that do not
_SHUFFLES = 99  # other orders of the rows, that theirs is compared with
_CHANCE = 0.1  # share of them that may be as good where readings depend on joints
_NEAR = 4.0  # limits of an arm, that neighbours may miss in closed form and agree once refined
_UNITS = {
    "millimetres": 1e3,
    "centimetres": 1e2,
    "inches": 1.0 / 0.0254,
    "feet": 1.0 / 0.3048,
    "kilometres": 1e-3,
}  # of a metre
_BEFORE, _AFTER, _FILTERS = 8, 3, 2  # rows that a filter reaches; filters that are fitted


def astray(fit: HandEyeFit) -> np.ndarray:
    """The stations that do not agree with the placement, row numbers."""
    return np.flatnonzero(~fit.agree(2.0))


def likelihood(case: HandEye, placement: Placement) -> Array:
    """Log likelihood of each station, (N,), by a placement, at twice a nominal arm's usual error."""
    turns, gaps = (np.sum(left**2, axis=1) for left in placement.left(case))
    total = case.volume + likelihood_at(gaps, 2.0 * case.scale.position, case.scale.volume)
    return total + likelihood_at(turns, 2.0 * SPREAD[0], ANYWHERE) if case.poses else total


def by_table(fit: HandEyeFit, table: Sequence[Hypothesis]) -> Iterator[Hypothesis]:
    """Those of a table that are likely of some rows, each with its rows."""
    case, placement, rest = fit.case, fit.placement, astray(fit)
    if len(rest) < _LEAST:
        return
    some = case.select(rest[spread_rows(len(rest), _FEW)])
    before = likelihood(some, placement)
    gains = [float(np.maximum(likelihood(h.undone(some), placement) - before, 0.0).sum()) + h.price for h in table]
    as_they_are = likelihood(case, placement)
    for k in np.argsort(gains)[::-1][:_KEPT]:
        if gains[k] <= 0.0:
            return
        other = table[k].undone(case)
        rows = stretch_or_scattered(likelihood(other, placement) - as_they_are)
        if len(rows) >= _LEAST:
            yield on_rows(table[k], case, rows)


def on_rows(h: Hypothesis, case: HandEye, rows: np.ndarray) -> Hypothesis:
    """A hypothesis of some rows alone."""
    whole = len(rows) == len(case)
    return replace(
        h,
        what=h.what if whole else f"{h.what}{where(case, rows)}, and not at the others",
        undone=lambda c: c.of_rows(h.undone(c), rows),
        price=h.price - (0.0 if whole else cost_of_rows(rows, len(case))),
        stations=len(rows),
    )


def stretch_or_scattered(gain: Array) -> np.ndarray:
    """The rows of which something is true, by the gain of each (N,) [nats]: a stretch, or scattered ones."""
    N = len(gain)
    total = np.r_[0.0, np.cumsum(gain)]
    start = np.array([int(np.argmin(total[: k + 1])) for k in range(N + 1)])
    end = int(np.argmax(total - np.minimum.accumulate(total)))
    sets = [np.arange(start[end], end), np.arange(int(np.argmax(total))), np.arange(int(np.argmin(total)), N)]
    sets += [np.flatnonzero(gain > 0.0), np.flatnonzero(gain > 10.0)]
    return max(sets, key=lambda rows: float(gain[rows].sum()) - (cost_of_rows(rows, N) if 0 < len(rows) < N else 0.0))


# --- the rest, whatever it is ----------------------------------------------------------------------------------------


def of_the_rest(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """What the stations that do not agree may have in common: a scale, a turn, a base or a tool of their own."""
    case, rest = fit.case, astray(fit)
    if len(rest) < _LEAST or len(rest) > 0.9 * len(case):
        return
    yield from _scale(fit, rest)
    if case.poses:
        yield from _turn(fit, rest)
    yield from moved(fit, rest)


def _scale(fit: HandEyeFit, rest: np.ndarray) -> Iterator[Hypothesis]:
    """Positions of the rest that are one number times as long as they should be."""
    expected, seen = fit.placement.expected(fit.case.A[rest])[1], fit.case.p[rest]
    factor = float(np.median(np.sum(seen * expected, axis=1) / np.sum(expected**2, axis=1)))
    if abs(factor) < 1e-9 or abs(abs(factor) - 1.0) < 1e-6:
        return
    unit = next((f" ({name})" for name, size in _UNITS.items() if abs(factor / size - 1.0) < 0.02), "")
    volume = -3.0 * float(np.log(abs(factor)))
    what = f"positions look {factor:.4g} times as long as the others, in another unit{unit},"
    h = Hypothesis(what, "write all positions in metres", lambda c: c.read(c.p / factor, volume=volume), RARE, 1)
    h = on_rows(h, fit.case, rest)
    yield replace(h, what=h.what.removesuffix(", and not at the others"))


def _turn(fit: HandEyeFit, rest: np.ndarray) -> Iterator[Hypothesis]:
    """Orientations of the rest that are turned by one angle about one axis."""
    R, (expected, _) = fit.case.R[rest], fit.placement.expected(fit.case.A[rest])
    for frame, off in (
        ("the tracker", R @ np.swapaxes(expected, 1, 2)),
        ("the tool", np.swapaxes(expected, 1, 2) @ R),
    ):
        alike = np.einsum("nij,kij->nk", off, off) > 1.0 + 2.0 * np.cos(2.0 * fit.case.limits[0])
        S = so3.mean(off[alike[:, int(np.argmax(alike.mean(axis=0)))]])
        turn = so3.log(S)
        angle = float(np.linalg.norm(turn))
        axis = ", ".join(f"{v:.2f}" for v in turn / max(angle, 1e-12) + 0.0)
        what = f"orientations look turned by {np.degrees(angle):.4g}° about ({axis}) of {frame}"
        remedy = (
            "check how orientations are computed (an angle that is folded or of which the sign is lost), and whether "
            "the target looks alike from several sides"
        )

        def undone(c: HandEye, S: Array = S, left: bool = frame == "the tracker") -> HandEye:
            return c.read(R=S.T @ c.R if left else c.R @ S.T)

        h = on_rows(Hypothesis(what, remedy, undone, RARE, 3, "orientations"), fit.case, rest)
        yield replace(h, what=f"{h.what.removesuffix(', and not at the others')}, and positions agree")


def moved(fit: HandEyeFit, rest: np.ndarray) -> Iterator[Hypothesis]:
    """A base, a tool, or both of the rest's own."""
    case = fit.case
    if len(rest) < (4 if case.poses else 6):
        return
    own = placed(case.select(rest))
    rows = rest[own.agree(2.0)]
    if len(rows) < _LEAST:
        return
    here = fit.placement
    remedy = "check whether two trackers or targets publish under one name; give each part its own frame or recording"
    for what, kept, values in (
        ("the base (or the tracker) is displaced", "tool", 6),
        ("the tool (or the target on it) is displaced", "base", 6 if case.poses else 3),
        ("base and tool are both displaced", "", 12 if case.poses else 9),
    ):
        other = _sharing(case.select(rows), own.placement, here, kept)

        def undone(c: HandEye, other: Placement = other) -> HandEye:
            return _as_seen(c, other, here)

        h = on_rows(Hypothesis(what, remedy, undone, COMMON, values, "rows"), case, rows)
        yield replace(h, what=h.what.removesuffix(", and not at the others"))


def with_own_placement(h: Hypothesis, own: Placement, fit: HandEyeFit, rest: np.ndarray) -> Hypothesis:
    """A hypothesis of the rest, whose readings have a base and a tool of their own."""
    here = fit.placement
    return on_rows(
        replace(h, undone=lambda c: _as_seen(h.undone(c), own, here), values=h.values + (12 if fit.case.poses else 9)),
        fit.case,
        rest,
    )


def still(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """Joints, or readings, that stand to the last digit while the others move, at stations that do not agree."""
    case = fit.case
    joints, readings = (np.r_[False, (np.diff(x, axis=0) == 0.0).all(axis=1)] for x in (case.q, case.p))
    for rows, what, remedy in (
        (
            joints & ~readings,
            "all joint positions stand still while the readings move: they look stale",
            "check how joint states get into the recording",
        ),
        (
            readings & ~joints,
            "readings stand still while the joints move: they look stale",
            "see whether the tracker lost its target and repeats its last reading",
        ),
    ):
        at_rows = np.flatnonzero(rows & ~fit.agree(2.0))
        if len(at_rows) < _LEAST:
            continue
        R, p = fit.placement.expected(case.A)
        lost = case.scale.volume + (ANYWHERE if case.poses else 0.0)  # they say nothing
        other = case.read(p, R if case.poses else case.R)
        other = replace(other, volume=other.volume - lost - likelihood(other, fit.placement) + other.volume)
        h = Hypothesis(what, remedy, lambda c, other=other: other, RARE, touches="rows")  # type: ignore[misc]
        yield on_rows(h, case, at_rows)


def _as_seen(c: HandEye, other: Placement, here: Placement) -> HandEye:
    """Readings as they would be by one placement, with what they miss another by."""
    R_there, p_there = other.expected(c.A)
    R_here, p_here = here.expected(c.A)
    turn = np.swapaxes(R_there, 1, 2) @ c.R
    return c.read(p_here + (c.p - p_there), R_here @ turn if c.poses else c.R)


def stretches(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """Several stretches, each with a base or a tool of its own: of each, one after the other, what moved."""
    case, first, N = fit.case, 0, len(fit.case)
    parts: list[tuple[int, int, Placement]] = []
    window = 6 if case.poses else 10
    near = _near_by_windows(case, window)
    while first + window <= N and len(parts) <= 12:
        own = placed(case.select(np.arange(first, first + window)), thorough=False) if near[first] else None
        if own is None or not own.explains:
            first += 1
            continue
        end = first + window
        while end < N:
            ahead = at(case.select(np.arange(end, N)), own.placement).agree(2.0)
            lost = np.flatnonzero(np.convolve(~ahead, np.ones(3), "valid") == 3)
            stop = end + (int(lost[0]) if len(lost) else len(ahead))
            if stop == end:
                break
            rows = np.arange(first, stop)
            own, end = placed(case.select(rows), thorough=False), stop
        parts.append((first, end, own.placement))
        first = end
    if len(parts) < 2 or len(parts) > 12 or sum(b - a for a, b, _ in parts) < 0.5 * N:
        return
    here = max(parts, key=lambda part: part[1] - part[0])[2]
    ranges = ", ".join(f"{case.station[a]} to {case.station[b - 1]}" for a, b, _ in parts)
    for who, do, kept, values in (
        ("the base (or the tracker's zero)", "keep the tracker's zero", "tool", 6),
        ("the tool (or the target on it)", "keep the target where it is", "base", 6 if case.poses else 3),
        ("the base (or the tracker's zero), or the tool,", "keep tracker and target as they are", "", 12),
    ):
        each = [(np.arange(a, b), _sharing(case.select(np.arange(a, b)), own, here, kept)) for a, b, own in parts]

        def undone(c: HandEye, each: list[tuple[np.ndarray, Placement]] = each) -> HandEye:
            for rows, own in each:
                c = c.of_rows(_as_seen(c, own, here), rows)
            return c

        yield Hypothesis(
            f"{who} changed {len(parts) - 1} times: stations {ranges} agree in themselves and not with each other",
            f"{do} over the whole recording, or give each part its own frame or recording",
            undone,
            COMMON - 2.0 * len(parts) * float(np.log(N)),
            values * (len(parts) - 1),
            "rows",
        )


def _near_by_windows(case: HandEye, length: int) -> np.ndarray:
    """Whether a base and a tool in closed form bring so many neighbours near, for each that may be the first."""
    rows = np.arange(max(len(case) - length + 1, 0))[:, None] + np.arange(length)
    windows = replace(case, A=case.A[rows], p=case.p[rows], R=case.R[rows], mixed=None)
    left = np.median(np.linalg.norm(closed(windows).left(windows), axis=-1), axis=-1)
    return np.asarray((left < _NEAR * np.array(case.limits)[:, None]).all(axis=0))


def _sharing(part: HandEye, own: Placement, here: Placement, kept: str) -> Placement:
    """The placement of a part with the tool, or the base, of another."""
    if not kept:
        return own
    a = part.A[:, :3, :3]
    if kept == "tool":
        other = replace(here, Y=so3.mean(part.R @ np.swapaxes(a @ here.X, 1, 2)) if part.poses else own.Y)
        return replace(other, t=other.t + np.median(other.left(part)[1], axis=0))
    other = replace(here, X=so3.mean(np.swapaxes(here.Y @ a, 1, 2) @ part.R) if part.poses else own.X)
    off = np.einsum("nji,nj->ni", here.Y @ a, other.left(part)[1])
    return replace(other, x=other.x + np.median(off, axis=0))


# --- rows that belong elsewhere --------------------------------------------------------------------------------------


def orders(case: HandEye) -> Iterator[Hypothesis]:
    """Whole recordings in another order than the joints': slipped, reversed, or by a shuffle that names sort into."""
    N = len(case)
    if N < 8:
        return
    numbers = np.array(sorted(range(N), key=lambda k: str(k + 1)))
    said = [("readings stand in reverse order", np.arange(N)[::-1])]
    said += [("readings stand in the order of file names (1, 10, 100, …)", numbers)]
    said += [("readings were put in the order of file names (1, 10, 100, …)", np.argsort(numbers))]
    said += [(_slipped(shift, N), (np.arange(N) + shift) % N) for shift in range(1, N)]
    design = np.concatenate([case.A[:, :3, :3].reshape(N, 9), case.A[:, :3, 3]], axis=1)
    U, size, _ = np.linalg.svd(design - design.mean(axis=0), full_matrices=False)
    U = U[:, size > 1e-6 * size[0]]
    p = case.p - case.p.mean(axis=0)
    explained = [float(np.sum((U[order].T @ p) ** 2)) for _, order in said]
    # so few rows fit any order by a linear map: the plainest are asked then
    for k in np.argsort(explained)[::-1][:2] if N >= 16 else (0, 3, N + 1):
        what, order = said[k]
        yield Hypothesis(
            what,
            ROWS_REMEDY,
            lambda c, o=order: replace(c, q=c.q[o], A=c.A[o]),  # type: ignore[misc]
            RARE - float(np.log(len(said))),
            0,
            "rows",
        )


def _slipped(shift: int, of: int) -> str:
    """Readings that belong to the posture ``shift`` rows later, or ``of - shift`` earlier."""
    if min(shift, of - shift) > 0.2 * of:
        return f"readings stand in two parts that are exchanged: the first row's belongs to row {shift + 1}"
    if 2 * shift < of:
        return f"readings look early by {_count(shift)}: each stands {shift} row{'s' * (shift > 1)} too high"
    back = of - shift
    return f"readings look late by {_count(back)}: each stands {back} row{'s' * (back > 1)} too low"


def _count(stations: int) -> str:
    return f"{stations} station{'s' if stations > 1 else ''}"


def unrelated(case: HandEye) -> bool:
    """Whether the joints of other rows tell as much of the readings as those of their own.

    Ranks of what is read, by each joint alone and by the elements of tip poses or their inverses; False as well where
    stations are too few to tell.
    """
    N, turns = len(case), case.A[:, :3, :3]
    if N < _TELLING:
        return False
    place = np.c_[case.A[:, :3, 3], np.einsum("nij,ni->nj", turns, case.A[:, :3, 3])]
    groups = [
        np.c_[np.sin(q), np.cos(q)] if r else q[:, None] for q, r in zip(case.q.T, case.chain.revolute, strict=True)
    ]
    far = np.linalg.norm(case.p - np.median(case.p, axis=0), axis=1)
    shown = np.c_[case.p, far, case.R.reshape(N, 9)] if case.poses else np.c_[case.p, far]
    ranks = np.argsort(np.argsort(shown, axis=0), axis=0) - 0.5 * (N - 1)
    rng = np.random.default_rng(0)
    ranks = ranks[np.stack([np.arange(N), *(rng.permutation(N) for _ in range(_SHUFFLES))])]
    sides = (np.linalg.qr(g - g.mean(axis=0))[0] for g in (*groups, np.c_[turns.reshape(N, 9), place]))
    best = np.max([np.sum((Q.T @ ranks) ** 2, axis=1).max(axis=1) / Q.shape[1] for Q in sides], axis=0)
    return bool(best[0] <= np.quantile(best[1:], 1.0 - _CHANCE))


def scattered(fit: HandEyeFit) -> bool:
    """Whether what stations miss a placement by, in what misses it by far, depends on no joint."""
    turns, gaps = fit.placement.left(fit.case)
    left = fit.case.read(gaps, so3.exp(turns))
    return unrelated(left if fit.usual[0] > fit.case.limits[0] else points(left))


def elsewhere(fit: HandEyeFit) -> Iterator[Hypothesis]:
    """Readings of the rest that belong to other postures of the recording."""
    case, rest = fit.case, astray(fit)
    N = len(case)
    if len(rest) < 2 or N < 8:  # two that are exchanged tell each other
        return
    turns, places = fit.placement.expected(case.A)
    gap = np.linalg.norm(case.p[rest, None] - places, axis=2) / case.limits[1]
    if case.poses:
        gap = np.maximum(gap, np.arccos(_cosine(case.R[rest, None], turns)) / case.limits[0])
    same = gap < 2.0
    offsets = Counter(int(k - i) for i, row in zip(rest, same, strict=True) for k in np.flatnonzero(row))
    if not offsets:
        return
    found = rest[same.any(axis=1)]
    belongs = np.arange(N)
    belongs[found] = np.argmin(gap[same.any(axis=1)], axis=1)
    offset, count = offsets.most_common(1)[0]
    which = where(case, found)
    if count >= 0.9 * len(found):  # the whole stretch, its edges too
        belongs[found] = np.clip(found + offset, 0, N - 1)
        early = "early" if offset > 0 else "late"
        what = f"readings{which} look {early} by {_count(abs(offset))}: each stands {abs(offset)} "
        what += f"row{'s' * (abs(offset) > 1)} too {'high' if offset > 0 else 'low'}, or joint states the other way"
        told = float(np.log(2 * N))
    else:
        first = f"that at station {case.station[found[0]]} to station {case.station[belongs[found[0]]]}"
        what = f"readings{which} belong to other stations, in another order of rows ({first})"
        told = len(found) * float(np.log(N))
    yield Hypothesis(
        what,
        ROWS_REMEDY,
        lambda c: replace(c, q=c.q[belongs], A=c.A[belongs]),
        RARE - told - cost_of_rows(found, N),
        0,
        "rows",
        len(found),
    )


def permuted(case: HandEye) -> Iterator[Hypothesis]:
    """Readings that belong to other postures, in whatever order.

    How far an orientation is turned to each of the others tells it from them, whatever base and tool are.
    """
    if len(case) < 16 or not case.poses:
        return
    a, R = (np.sort(np.arccos(_cosine(turns[:, None], turns)), axis=1) for turns in (case.A[:, :3, :3], case.R))
    nearest = np.argmax(R @ a.T - 0.5 * np.sum(a**2, axis=1), axis=1)
    own = placed(replace(case, q=case.q[nearest], A=case.A[nearest]))
    if own.agree(2.0).mean() >= MANY:
        yield from elsewhere(at(case, own.placement))


def _cosine(A: Array, B: Array) -> Array:
    """Cosines (…) of the angles between orientations (…, 3, 3)."""
    return np.asarray(np.clip(0.5 * (np.einsum("...ij,...ij->...", A, B) - 1.0), -1.0, 1.0))


def filters(case: HandEye) -> list[Hypothesis]:
    """Readings that a filter mixed with those of rows before or after: a mean of several, or a slow settling."""
    rows = np.arange(-_BEFORE, _AFTER + 1)
    if len(case) < 3 * len(rows):
        return []
    made: list[tuple[str, Array]] = []
    for half in range(1, _AFTER + 1):
        made.append((f"the mean of {2 * half + 1} rows about its own", (np.abs(rows) <= half).astype(float)))
    for count in range(2, 6):
        said = f"the mean of its own row and the {count - 1} before"
        made.append((said, ((rows <= 0) & (rows > -count)).astype(float)))
    for kept in (0.2, 0.35, 0.5, 0.65, 0.8):
        said = f"if {100 * kept:.0f}% of the reading before were still in it"
        made.append((said, np.where(rows <= 0, kept ** np.maximum(-rows, 0.0), 0.0)))

    def mixed(c: HandEye, weights: Array) -> Array:
        around = np.concatenate([c.A[:1].repeat(_BEFORE, axis=0), c.A, c.A[-1:].repeat(_AFTER, axis=0)])
        A = np.moveaxis(sliding_window_view(around, len(rows), axis=0), -1, 1)  # (N, rows, 4, 4)
        return np.asarray(np.einsum("k,nkij->nij", weights / weights.sum(), A))

    def undone(c: HandEye, weights: Array, turns: bool) -> HandEye:
        return replace(points(c) if turns else c, mixed=mixed(c, weights))

    B = np.stack([mixed(case, w) for _, w in made])
    left = unexplained(B[..., :3, :3], B[..., :3, 3], case.p - case.p.mean(axis=0)).sum(axis=1)
    remedy = (
        "turn the instrument's filter or averaging off, or wait at each station until it has settled, and record again"
    )
    price = RARE - float(np.log(2 * len(made)))
    return [
        Hypothesis(
            f"readings look filtered: each as {said}",
            remedy,
            lambda c, w=w, turns=turns: undone(c, w, turns),  # type: ignore[misc]
            price,
            1,
            "rows",
        )
        for said, w in (made[k] for k in np.argsort(left)[:_FILTERS])
        for turns in ((False, True) if case.poses else (False,))
    ]
