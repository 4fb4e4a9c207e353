"""Readings beside the tip poses that the joints give, and how well one base and one tool join them.

Everything that may have been written down wrongly changes either side: the readings, or the tip poses (by joints, by
the description, by the link that is followed). So every explanation is a changed :class:`HandEye` problem, and one
number compares them: the log evidence of the raw readings [nats], for the nominal arm with base and tool fitted.

Turns and places of a station count by themselves, each Gaussian with a spread of at least what a nominal arm misses by,
and one in twenty may say anything in the volume that is worked in. Nominal errors are alike in neighbouring postures,
so that no more than a hundred stations count as independent. Fitted values cost half of log N each (BIC).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place, turns_left
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

ANGLE = 0.012  # rad that nominal arms turn their tips too far by at most; usual ones by 3 mrad
OF_REACH = 0.006  # of the reach: the same for positions
SPREAD = (2e-3, 1e-3)  # rad and share of the reach, per axis: a nominal arm's usual error, and nothing finer decides
ASTRAY = 0.05  # share of readings that may say anything
INDEPENDENT = 100  # stations that count
ANYWHERE = float(np.log(8.0 * np.pi**2))  # log of the volume of orientations
_DRAWS = 400  # with a third of the stations in agreement, one draw of five holds only these: 1 − (1 − 3⁻⁵)⁴⁰⁰ = 81 %
_ROUNDS = 8  # iterations
_NEAR = 1e-3  # m that a closed form is brought within; iterations follow
_TURNED = 1e-4  # rad; shorter steps change no score
OF_MOTION = 0.1  # of what moves; a fit that leaves more than this explains nothing
MANY = 0.2  # share of the stations that must agree, lest chance finds that many


def limits(chain: Mechanism) -> tuple[float, float]:
    """Angle [rad] and distance [m] that a nominal arm misses by at most."""
    return ANGLE, OF_REACH * chain.reach()


@dataclass(frozen=True)
class Placement:
    """Base (Y, t) and tool (X, x): orientations are Y A X, positions Y (A x) + t. Several at once have a first axis."""

    Y: Array
    X: Array
    x: Array
    t: Array

    def left(self, case: HandEye) -> tuple[Array, Array]:
        """Turns [rad] and gaps [m] of the readings from what is expected, (…, N, 3); turns are zero without poses."""
        gaps = case.p - self.points(case.B)
        if not case.poses:
            return np.zeros_like(gaps), gaps
        return turns_left(self.Y, case.A[..., :3, :3], self.X, case.R), gaps

    def points(self, A: Array) -> Array:
        """Positions (…, N, 3) at tip poses (…, N, 4, 4)."""
        point = (A[..., :3, :3] @ self.x[..., None, :, None])[..., 0] + A[..., :3, 3]
        return np.asarray(point @ np.swapaxes(self.Y, -1, -2) + self.t[..., None, :])

    def expected(self, A: Array) -> tuple[Array, Array]:
        """Orientations (N, 3, 3) and positions (N, 3) at tip poses (N, 4, 4)."""
        return self.Y @ A[:, :3, :3] @ self.X, self.points(A)


@dataclass(frozen=True)
class HandEye:
    """Stations of one frame in order of time, with their numbers (N,). chain: as described. A (N, 4, 4): poses of its
    tip by the joints q (N, n), which have names. p, R: readings. poses: whether orientations are asked. volume: log of
    what undoing shrank a station's reading by, (N,). mixed (N, 4, 4): of what mean of tip poses positions are; None: of
    the station's own.
    """

    chain: Chain
    names: tuple[str, ...]
    station: np.ndarray
    q: Array
    A: Array
    p: Array
    R: Array
    poses: bool
    volume: Array
    mixed: Array | None = None

    @classmethod
    def of(cls, samples: Samples, chain: Mechanism, most: int = 300, first: bool = False) -> HandEye | None:
        """The poses and points at rest in the frame with most readings. most: stations, evenly, or the first ones.

        None of other robots than serial arms, of a ball in a socket, and where nothing is left.
        """
        if not is_serial_arm(chain) or not len(samples):
            return None
        f = int(np.argmax(np.bincount(samples.frame)))
        rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")) & ~samples.moving)
        if not len(rows) or samples.frames[f] in samples.sockets:
            return None
        rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
        return cls.holding(samples.select(rows[:most] if first else rows[spread_rows(len(rows), most)]), chain)

    @classmethod
    def holding(cls, samples: Samples, chain: Chain) -> HandEye:
        """All of these samples."""
        case = cls.of_arrays(chain, samples.q, samples.reading, samples.R if samples.is_pose.all() else None)
        return replace(case, names=samples.names or chain.names, station=samples.station)

    @classmethod
    def of_arrays(cls, robot: Mechanism, q: Array, p: Array, R: Array | None = None) -> HandEye:
        """Rows of joint positions (N, n), positions (N, 3) [m] and, of poses, orientations (N, 3, 3)."""
        chain = cast(Chain, robot)  # what asks more of it than poses and reach asks serial arms alone
        N = len(q)
        turns = np.tile(np.eye(3), (N, 1, 1)) if R is None else R
        A = forward(chain, q)
        return cls(chain, chain.names, np.arange(N), q, A, p, turns, R is not None, np.zeros(N))

    def __len__(self) -> int:
        return len(self.p)

    @property
    def B(self) -> Array:
        """Poses of the tip that positions are of, (N, 4, 4)."""
        return self.A if self.mixed is None else self.mixed

    @property
    def limits(self) -> tuple[float, float]:
        """Angle [rad] and distance [m] that a nominal arm misses by at most."""
        return limits(self.chain)

    def read(self, p: Array | None = None, R: Array | None = None, volume: Array | float = 0.0) -> HandEye:
        """The case with other readings."""
        changed = replace(self, p=self.p if p is None else p, R=self.R if R is None else R)
        return replace(changed, volume=self.volume + volume)

    def moved(self, q: Array) -> HandEye:
        """The case with other joint positions."""
        return replace(self, q=q, A=forward(self.chain, q))

    def select(self, rows: np.ndarray) -> HandEye:
        """Some of the stations."""
        parts = {name: getattr(self, name)[rows] for name in ("station", "q", "A", "p", "R", "volume")}
        return replace(self, mixed=None if self.mixed is None else self.mixed[rows], **parts)

    def of_rows(self, other: HandEye, rows: np.ndarray) -> HandEye:
        """The case with some rows as in another."""
        out = {name: getattr(self, name).copy() for name in ("q", "A", "p", "R", "volume")}
        for name, values in out.items():
            values[rows] = getattr(other, name)[rows]
        return replace(self, **out)

    @cached_property
    def scale(self) -> ErrorScale:
        """What residuals are measured with."""
        reach = self.chain.reach()
        far = np.linalg.norm(self.p - np.median(self.p, axis=0), axis=1) / (4.0 * reach)
        volume = 3.0 * np.log(4.0 * reach) + 4.0 * np.log(np.maximum(far, 1.0))
        return ErrorScale(SPREAD[1] * reach, volume, reach, self.poses)

    @cached_property
    def motion(self) -> tuple[float, float]:
        """By how much readings differ from their middle, medians [rad, m]."""
        place = float(np.median(np.linalg.norm(self.p - np.median(self.p, axis=0), axis=1)))
        turned = np.linalg.norm(so3.log(so3.mean(self.R).T @ self.R), axis=1) if self.poses else np.full(1, np.inf)
        return float(np.median(turned)), place


@dataclass(frozen=True)
class ErrorScale:
    """position: least deviation per axis [m]. volume (N,): log of that in which each reading may be anything [m³]; what
    lies farther than an arm reaches is the rarer for it. reach [m]: no deviation is larger. poses: whether orientations
    count.
    """

    position: float
    volume: Array
    reach: float
    poses: bool

    def rows(self, turns: Array, gaps: Array) -> Array:
        """Log likelihood of each station, (N,), at the spreads that are likeliest over all."""
        out = likeliest(np.sum(gaps**2, axis=1), self.position, self.volume, self.reach)
        return out + likeliest(np.sum(turns**2, axis=1), SPREAD[0], ANYWHERE, np.pi) if self.poses else out


def likelihood_at(square: Array, sigma: Array | float, volume: Array | float, dimensions: int = 3) -> Array:
    """Log likelihood of squared residuals (N,) of these deviations: (N,), or (S, N) of deviations (S, 1)."""
    inside = np.log1p(-ASTRAY) - 0.5 * square / sigma**2 - 0.5 * dimensions * np.log(2.0 * np.pi * sigma**2)
    return np.asarray(np.logaddexp(inside, np.log(ASTRAY) - volume))


def likeliest(square: Array, least: float, volume: Array | float, most: float, dimensions: int = 3) -> Array:
    """Log likelihood (N,) of squared residuals (N,): Gaussian of the likeliest deviation in these limits, or any."""
    sigma = least * 2.0 ** np.arange(24.0)
    largest = min(2.0 * max(least, float(np.sqrt(square.max(initial=0.0)))), most)
    sigma = sigma[sigma <= max(largest, least)][:, None]
    each = likelihood_at(square, sigma, volume, dimensions)
    return np.asarray(each[int(np.argmax(each.sum(axis=1)))])


@dataclass(frozen=True)
class HandEyeFit:
    """A case with base and tool. rows (N,): log likelihood of each station. turn, gap (N,): what is left [rad, m]."""

    case: HandEye
    placement: Placement
    rows: Array
    turn: Array
    gap: Array

    @cached_property
    def evidence(self) -> float:
        """Log evidence [nats]: twelve values fitted, nine without orientations."""
        N = len(self.rows)
        share = min(1.0, INDEPENDENT / max(N, 1))
        return share * float((self.rows + self.case.volume).sum()) - (6.0 if self.case.poses else 4.5) * np.log(N)

    def agree(self, times: float = 1.0) -> np.ndarray:
        """Stations within a multiple of what a nominal arm misses by, (N,)."""
        angle, distance = self.case.limits
        return (self.turn < times * angle) & (self.gap < times * distance)

    def better_than(self, other: HandEyeFit) -> bool:
        """Whether this placement of the same case is the better one: by how many stations agree, where many do.

        A wide spread swallows two heaps of readings; one of them, with the other astray, says what is wrong.
        """
        mine, others = int(self.agree(2.0).sum()), int(other.agree(2.0).sum())
        if max(mine, others) >= MANY * len(self.gap) and mine != others:
            return mine > others
        return self.evidence > other.evidence

    @property
    def usual(self) -> tuple[float, float]:
        """What the usual station is missed by: medians [rad, m]."""
        return float(np.median(self.turn)), float(np.median(self.gap))

    @property
    def explains(self) -> bool:
        """Whether a nominal arm misses the usual station by no more than its own errors, and by little of what moves.

        Readings by which hardly anything moves fit whatever they are.
        """
        limits = zip(self.usual, self.case.limits, self.case.motion, strict=True)
        return all(left <= min(limit, OF_MOTION * motion) for left, limit, motion in limits)

    @property
    def clean(self) -> bool:
        """Whether the readings fit as well as a nominal arm can, so that nothing can fit better."""
        near = (self.turn < 3.0 * SPREAD[0]) & (self.gap < 3.0 * self.case.scale.position)
        return bool(near.mean() > 1.0 - ASTRAY)


def points(case: HandEye) -> HandEye:
    """The case by its positions alone: orientations may say anything."""
    return replace(case, poses=False, volume=case.volume - ANYWHERE) if case.poses else case


def placed(case: HandEye, thorough: bool = True) -> HandEyeFit:
    """The case with the base and the tool that most of its stations agree on, of very many found on some.

    thorough: also from draws of a few stations.
    """
    best: HandEyeFit | None = None
    few = _independent(case)
    for start in _starts(few):
        for fit in (at(few, start), at(few, _refined(few, start))):
            best = fit if best is None or fit.better_than(best) else best
        if best is not None and best.explains:
            break
    assert best is not None
    best = best if few is case else at(case, _refined(case, best.placement))
    return redrawn(best) if thorough else best


def redrawn(best: HandEyeFit) -> HandEyeFit:
    """A fit, or one that starts from draws of a few stations, where closed forms over all of them leave many astray."""
    case = best.case
    if best.agree().mean() < 1.0 - ASTRAY and len(case) >= 8:
        few = _independent(case)
        drawn = _by_draws(few)
        for placement in () if drawn is None else (drawn, _refined(few, drawn)):
            fit = at(case, placement)
            best = fit if fit.better_than(best) else best
    return best


def _independent(case: HandEye) -> HandEye:
    """As many stations as count, evenly along the recording."""
    return case if len(case) <= INDEPENDENT else case.select(spread_rows(len(case), INDEPENDENT))


def at(case: HandEye, placement: Placement) -> HandEyeFit:
    """The case with base and tool as they are given."""
    turns, gaps = placement.left(case)
    rows = case.scale.rows(turns, gaps)
    return HandEyeFit(case, placement, rows, np.linalg.norm(turns, axis=1), np.linalg.norm(gaps, axis=1))


def closed(case: HandEye, within: float = _NEAR) -> Placement:
    """Base and tool in closed form, by orientations where there are any; of stacked tips (K, N, 4, 4) those of each.

    within: [m] that positions alone bring tool points to.
    """
    if case.poses:
        return _with_places(case, *base_and_tool_turns(case.A[..., :3, :3], case.R))
    A = case.B.reshape(-1, *case.B.shape[-3:])
    p = np.broadcast_to(case.p, (*case.B.shape[:-2], 3)).reshape(len(A), -1, 3)
    Y = base_by_positions(A, p, within=within).reshape(*case.B.shape[:-3], 3, 3)
    return _with_places(case, Y, np.broadcast_to(np.eye(3), Y.shape))


def _starts(case: HandEye) -> list[Placement]:
    by_all = closed(case)
    if not case.poses:
        return [by_all]
    Y = base_by_positions(case.B[None], case.p[None], within=_NEAR)[0]
    return [_with_places(case, Y, so3.mean(np.swapaxes(Y @ case.A[:, :3, :3], 1, 2) @ case.R)), by_all]


def _with_places(case: HandEye, Y: Array, X: Array) -> Placement:
    _, x, t = tool_and_place(Y, case.B, case.p)
    return Placement(Y, X, x, t)


def _refined(case: HandEye, start: Placement) -> Placement:
    """Robust Newton steps of base and tool from a start."""
    Y, X, x, t = start.Y, start.X, start.x, start.t
    least = np.array([case.scale.position, SPREAD[0]][: 1 + case.poses]) ** 2
    a, N = case.A[:, :3, :3], len(case)
    for _ in range(_ROUNDS):
        turns, gaps = Placement(Y, X, x, t).left(case)
        # columns: turn of the base, turn of the tool, tool point, base's place
        G = np.zeros((1 + case.poses, N, 3, 12))
        G[0, :, :, :3] = -Y @ so3.hat(se3.apply(case.B, x))
        G[0, :, :, 6:9] = Y @ case.B[:, :3, :3]
        G[0, :, :, 9:] = np.eye(3)
        if case.poses:
            G[1, :, :, :3] = np.swapaxes(a @ X, 1, 2)
            G[1, :, :, 3:6] = np.eye(3)
        r = np.stack([gaps, turns][: len(G)])
        square = np.sum(r**2, axis=2)
        weight = 1.0 / (np.maximum(np.median(square, axis=1) / 2.366, least)[:, None] + square)  # Cauchy
        flat, weighted = G.reshape(-1, 12), (weight[..., None, None] * G).reshape(-1, 12)
        H, g = flat.T @ weighted, weighted.T @ r.ravel()
        unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        unit = np.where(np.diag(H) > 0.0, unit, 0.0)
        step = unit * np.linalg.solve(H * np.outer(unit, unit) + 1e-9 * np.eye(12), unit * g)
        size = float(np.linalg.norm(step[:6]))
        step = step / max(size, 1.0)
        Y, X, x, t = Y @ so3.exp(step[:3]), X @ so3.exp(step[3:6]), x + step[6:9], t + step[9:]
        if size < _TURNED:
            break
    return Placement(Y, X, x, t)


def _by_draws(case: HandEye) -> Placement | None:
    """Base and tool of the few stations, neighbours or random, that most others agree with (Fischler & Bolles 1981)."""
    rng, N = np.random.default_rng(0), len(case)
    few = min(5 if case.poses else 8, N - 2)
    draws = _DRAWS if case.poses else _DRAWS // 2
    near = rng.integers(0, max(N - 2 * few, 1), draws)[:, None] + np.arange(min(2 * few, N))
    rows = np.where(np.arange(draws)[:, None] % 2 == 0, rng.permuted(near, axis=1)[:, :few], 0)
    far = rng.permuted(np.tile(np.arange(N), (draws, 1)), axis=1)[:, :few]
    rows = np.where(np.arange(draws)[:, None] % 2 == 0, rows, far)
    A, B, p, R = case.A[rows], case.B[rows], case.p[rows], case.R[rows]
    if case.poses:
        Y, X = base_and_tool_turns(A[..., :3, :3], R)
    else:
        Y = base_by_positions(B, p, _ROUNDS, _NEAR)
        X = np.tile(np.eye(3), (draws, 1, 1))
    _, x, t = tool_and_place(Y, B, p)
    angle, distance = case.limits
    points = np.einsum("nij,cj->cni", case.B[:, :3, :3], x) + case.B[:, :3, 3]
    inside = np.linalg.norm(case.p - (points @ np.swapaxes(Y, 1, 2) + t[:, None]), axis=2) < 2.0 * distance
    if case.poses:  # of draws that enough positions agree with
        likely = inside.sum(axis=1) > few
        back = np.swapaxes(Y[likely], 1, 2)[:, None] @ case.R @ np.swapaxes(X[likely], 1, 2)[:, None]
        cosine = 0.5 * (np.einsum("cnk,nk->cn", back.reshape(-1, N, 9), case.A[:, :3, :3].reshape(N, 9)) - 1.0)
        inside[likely] &= cosine > np.cos(2.0 * angle)
    best = int(np.argmax(inside.sum(axis=1)))
    if inside[best].sum() <= few:
        return None
    agreeing = case.select(np.flatnonzero(inside[best]))
    return max((at(agreeing, s) for s in _starts(agreeing)), key=lambda fit: fit.evidence).placement
