"""What is normal: every signal's model over a reference period, and by how much it scatters, on three scales.

y = X β + Z u + s + e. Cells scatter by e, as far as they are independent of their neighbours; blocks of some seconds
have s in common, for what a model of friction and dynamics lacks depends on where the arm just is; and coefficients
differ by u from recording to recording, for an arm is cold one morning and warm the next. A change must stand out of
all three, so that 250 samples a second are not 250 witnesses. Of each recording only F = [X, changes, y] as Fᵀ V⁻¹ F is
needed. u has variances by expectation and maximisation, from above. What that leaves out, and how roughly a few
recordings tell it, is in ``predictive``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3
from modcal_core.hypotheses import HandEye, placed
from modcal_core.moves import EFFORT, FRICTION, GEAR, MASS
from modcal_core.sentinel.cells import Cells, MonitoredArm
from modcal_core.sentinel.channels import CARRIED, LIFTED, RUBS, Placed, SignalRows, ball_and_sockets, signals_of

FEWEST_BAGS = 4  # recordings that show how much one differs from the next
BLOCK = 5.0  # s whose cells have an error in common
_ROWS = 20  # cells of a signal in a recording, below which it says nothing
_WIDE = 10.0  # times what would explain all of a signal: coefficients of which nothing is known
_STRAY = 5.0  # robust standard deviations, beyond which a cell is a contact or a jump
_ROUNDS = 25  # of estimating variances and coefficients in turn
SEEN = 0.5  # share of a signal's cells inside what the reference period covers; less is other work, not known yet
_MARGIN = 0.05  # of a joint's range, and of its top speed, that a recording may go beyond
_MOST_ALIKE = 0.9  # correlation of neighbouring cells
_HELD = 100.0  # kg, kg m, kg m²: of a payload that is declared to differ
_LEAST = 1e-9  # of a signal's size: a scatter that no sensor goes below
_NOTHING = 1e-9  # of a column: weight on a vertical axis, but for rounding
_FACTOR = 0.5  # of what the stated weight asks, from which to its inverse efforts are torques
_TAG_POSES = 120  # that camera and tag are placed by


@dataclass(frozen=True)
class SignalNormal:
    """One signal over the reference period. beta (p,), with precision (p, p). spread: variances of the loose ones.
    cell, block: standard deviations of a cell, as far as it is independent, and of a block. own: what a recording's own
    fit leaves of a cell. leverage (p, p), limit: of cells, beyond which the model was never asked. width: as
    of the rows, finite. names: of the changes.
    """

    beta: Array
    precision: Array
    spread: Array
    cell: float
    block: float
    own: float
    leverage: Array
    limit: float
    width: Array
    names: tuple[str, ...]

    @property
    def torques(self) -> bool:
        """Whether efforts grow with the arm's weight as torques do, where that loads the joint."""
        return bool(self.width[3] < _NOTHING or _FACTOR < self.beta[3] < 1.0 / _FACTOR)


@dataclass(frozen=True)
class Moments:
    """Fᵀ V⁻¹ F of one recording's signal, F = [X, changes, y], and how many of its cells count."""

    square: Array
    share: float


@dataclass(frozen=True)
class Normal:
    """What is normal for an arm. placed: of a tag and sockets. lowest, highest, fastest (n,): joints and speeds of the
    reference. moments: of each reference recording, by signal. bags: their names, with their beginnings [s]. dropped:
    signals that are not what they should be: efforts that are no torques.
    """

    arm: MonitoredArm
    signals: Mapping[str, SignalNormal]
    placed: Placed
    lowest: Array
    highest: Array
    fastest: Array
    moments: tuple[Mapping[str, Moments], ...] = ()
    bags: tuple[tuple[str, float], ...] = ()
    dropped: tuple[str, ...] = ()

    @classmethod
    def fit(cls, reference: Sequence[Cells], arm: MonitoredArm) -> Normal:
        """What is normal by these recordings. Raises NotEnoughData for fewer than FEWEST_BAGS of them, or no signal."""
        if len(reference) < FEWEST_BAGS:
            said = f"holds {len(reference)} recordings, {FEWEST_BAGS} are needed"
            raise NotEnoughData("reference", said, "record the arm at its work on several days, a minute each")
        at = _placed(reference, arm)
        every = [signals_of(cells, arm, at) for cells in reference]
        names = sorted({name for signals in every for name in signals})
        signals = {}
        for name in names:
            rows = [s[name] for s in every if name in s and len(s[name].y) >= _ROWS]
            if len(rows) >= FEWEST_BAGS:
                signals[name] = _noise(rows)
        if not signals:
            said = "shows neither efforts of an arm with masses, commands, a tag, nor sockets"
            raise NotEnoughData("reference", said, "record efforts and commands, and give --urdf with masses")
        q, v = (np.concatenate([cells[key] for cells in reference]) for key in ("q", "v"))
        moments = tuple({n: _moments(s[n], signals[n]) for n in signals if n in s} for s in every)
        bags = tuple((cells.name, cells.began) for cells in reference)
        ranges = (q.min(axis=0), q.max(axis=0), np.abs(v).max(axis=0))
        for name, of in signals.items():
            heard = [one[name].square for one in moments if name in one and one[name].share > 0.0]
            signals[name] = _solved(of, heard)
        out = cls(arm, signals, at, *ranges, moments, bags)
        odd = tuple(name for name, of in out.signals.items() if name.startswith("torque ") and not of.torques)
        return replace(out, signals={n: of for n, of in out.signals.items() if n not in odd}, dropped=odd)

    def without(self, bag: int) -> Normal:
        """The same by the other reference recordings, with the same scatter."""
        signals = dict(self.signals)
        for name, own in self.moments[bag].items():
            if name in signals and own.share > 0.0:
                signals[name] = _left_out(signals[name], own)
        return replace(self, signals=signals)

    def of(self, cells: Cells, carries_other: bool = False) -> dict[str, Moments]:
        """The signals of a later recording. carries_other: whether another payload than in the reference is declared.

        Cells in which joints are outside the ranges or speeds of the reference period say nothing.
        """
        out = {}
        room = _MARGIN * (self.highest - self.lowest)
        within = np.all((cells["q"] > self.lowest - room) & (cells["q"] < self.highest + room), axis=1)
        within &= np.all(np.abs(cells["v"]) < (1.0 + _MARGIN) * self.fastest, axis=1)
        inside = dict(zip(cells["t"].tolist(), within.tolist(), strict=True))
        for name, rows in signals_of(cells, self.arm, self.placed).items():
            if name not in self.signals:
                continue
            of = self.signals[name]
            keep = np.array([inside[t] for t in rows.t.tolist()], bool)
            keep &= np.einsum("np,pq,nq->n", rows.X, of.leverage, rows.X) <= of.limit
            found = _moments(rows.rows(keep), of, carries_other)
            out[name] = found if found.share >= SEEN else replace(found, share=0.0)
        return out

    @property
    def shares(self) -> list[tuple[str, str, tuple[dict[str, float], ...]]]:
        """Changes in proportion to what was: kind, joint, and sums of columns. Friction of each joint; efforts, with
        friction in them; a gear's ratio, by which a servo on the motor's side yields less; a mass at the tip, as joints
        without efforts yield by weight.
        """
        friction: dict[str, dict[str, float]] = {}
        out, lifted = list[tuple[str, str, tuple[dict[str, float], ...]]](), dict[str, float]()
        for name, of in self.signals.items():
            channel, joint = name.split(" ", 1)[0], name.rpartition(" ")[2]
            if channel == "torque":
                rubs = {f"rubs {i}:{joint}": of.beta[k] for i, k in enumerate(RUBS)}
                friction.setdefault(joint, {}).update(rubs)
                out.append((EFFORT, joint, ({f"gain:{joint}": 1.0, **rubs}, {f"bias:{joint}": 1.0})))
            elif f"drag:{joint}" in of.names:
                friction.setdefault(joint, {})[f"drag:{joint}"] = of.beta[2]
                lifted |= {f"{LIFTED}0:{joint}": of.beta[3]} if f"{LIFTED}0:{joint}" in of.names else {}
            elif channel == "following":
                out.append((GEAR, joint, ({f"ratio:{joint}": 1.0, f"servo:{joint}": -of.beta[2]},)))
        rubbed = [(FRICTION, joint, (of,)) for joint, of in friction.items() if any(w > 0.0 for w in of.values())]
        return [*rubbed, *out, *([(MASS, "tool", (lifted,))] if lifted else [])]


def _placed(reference: Sequence[Cells], arm: MonitoredArm) -> Placed:
    """Where tag and camera, sockets and the ball in them are, by the reference period."""
    touches = {frame: np.concatenate([c[f"touch:{frame}"] for c in reference if frame in c.of("touch")])
               for frame in sorted({frame for cells in reference for frame in cells.of("touch")})}  # fmt: skip
    known = {frame: q[np.isfinite(q).all(axis=1)] for frame, q in touches.items()}
    out = ball_and_sockets(arm, {frame: q for frame, q in known.items() if len(q) >= _ROWS})
    with_tag = [cells for cells in reference if "tag" in cells.columns]
    if arm.chain is None or not with_tag:
        return out
    q, pose = (np.concatenate([cells[key] for cells in with_tag]) for key in ("tag_q", "tag"))
    rows = np.flatnonzero(np.isfinite(pose).all(axis=1))
    if len(rows) < _ROWS:
        return out
    rows = rows[np.linspace(0, len(rows) - 1, min(_TAG_POSES, len(rows))).astype(int)]
    T = se3.inverse(se3.from_pose(pose[rows]))  # the camera by the tag
    found = placed(HandEye.of_arrays(arm.chain, q[rows], T[:, :3, 3], T[:, :3, :3]))
    if not found.explains:
        return out
    at = found.placement
    return replace(out, tag=(se3.transform(at.Y, at.t), se3.transform(at.X, at.x)))


def _finite_width(rows: Sequence[SignalRows]) -> Array:
    """Standard deviations of the coefficients beforehand; of those of which nothing is known by the signal's size."""
    X, y = np.concatenate([r.X for r in rows]), np.concatenate([r.y for r in rows])
    size = np.sqrt(np.mean(X**2, axis=0))
    wide = np.where(size > _NOTHING, _WIDE * np.sqrt(np.mean(y**2)) / np.maximum(size, _NOTHING), 0.0)
    return np.asarray(np.maximum(np.where(np.isfinite(rows[0].width), rows[0].width, wide), 1e-12))


def _ridge(X: Array, y: Array, width: Array, sigma: float) -> Array:
    """Coefficients of a fit of y, held by their widths."""
    A = np.concatenate([X * width, sigma * np.eye(len(width))])
    return np.asarray(width * np.linalg.lstsq(A, np.r_[y, np.zeros(len(width))], rcond=None)[0])


def _own(rows: SignalRows, width: Array) -> tuple[Array, np.ndarray]:
    """What a recording's own fit leaves, and which cells are no strays."""
    keep, left = np.ones(len(rows.y), bool), rows.y
    if len(rows.y) < _ROWS:
        return left, keep
    sigma = 0.1 * float(np.std(rows.y)) + 1e-12
    for _ in range(3):
        left = rows.y - rows.X @ _ridge(rows.X[keep], rows.y[keep], width, sigma)
        sigma = max(1.4826 * float(np.median(np.abs(left[keep]))), 1e-12)
        keep = np.abs(left) < _STRAY * sigma
    return left, keep


def _blocks(F: Array, t: Array) -> tuple[Array, np.ndarray, Array]:
    """The means of F (N, m) over blocks, the number of each cell's block, and the cells of each block."""
    _, at = np.unique(np.floor(t / BLOCK), return_inverse=True)
    count = np.bincount(at).astype(float)
    out = np.zeros((len(count), F.shape[1]))
    np.add.at(out, at, F)
    return out / count[:, None], at, count


def _noise(rows: Sequence[SignalRows]) -> SignalNormal:
    """The scatter of cells and blocks, by what one model leaves whose loose coefficients are each recording's own."""
    width = _finite_width(rows)
    own = [_own(one, width) for one in rows]
    kept = [one.rows(keep) for one, (_, keep) in zip(rows, own, strict=True)]
    Xs, ys = [], []
    for one in kept:
        Q = np.linalg.svd(one.X[:, : one.loose] * width[: one.loose], full_matrices=False)[0]
        Xs.append(one.X - Q @ (Q.T @ one.X))
        ys.append(one.y - Q @ (Q.T @ one.y))
    X, y = np.concatenate(Xs), np.concatenate(ys)
    left = y - X @ _ridge(X, y, width, 0.1 * float(np.std(y)) + 1e-12)
    parts = np.split(left, np.cumsum([len(one.y) for one in kept])[:-1])
    within, shifted, means, counts = 0.0, 0.0, [], []
    for one, part in zip(kept, parts, strict=True):
        mean, at, count = _blocks(part[:, None], one.t)
        rest, same = part - mean[at, 0], at[1:] == at[:-1]
        shifted += float(rest[1:][same] @ rest[:-1][same])
        within += float(rest @ rest)
        means.append(mean[:, 0])
        counts.append(count)
    count, mean = np.concatenate(counts), np.concatenate(means)
    alike = float(np.clip(shifted / max(within, 1e-300), 0.0, _MOST_ALIKE))
    least = _LEAST * float(np.sqrt(np.mean(np.concatenate([one.y for one in kept]) ** 2))) + 1e-15
    cell = max(within / max(float((count - 1.0).sum()), 1.0) * (1.0 + alike) / (1.0 - alike), least**2)
    free = max(len(count) - len(width) - sum(one.loose for one in kept), 0.25 * len(count))
    block = max(float((mean**2).sum()) / free - cell * float(np.mean(1.0 / count)), 0.0)
    every = np.concatenate([one.X for one in kept])
    leverage = np.linalg.inv(every.T @ every + cell * np.diag(width**-2.0))
    of_own = float(np.median([np.std(left[keep]) for left, keep in own]))
    limit = np.inf if rows[0].geometric else float(np.einsum("np,pq,nq->n", every, leverage, every).max())
    names, p = tuple(sorted(rows[0].columns)), len(width)
    empty = (np.zeros(p), np.zeros((p, p)), np.zeros(rows[0].loose))
    return SignalNormal(*empty, float(np.sqrt(cell)), float(np.sqrt(block)), of_own, leverage, limit, width, names)


def _moments(rows: SignalRows, of: SignalNormal, carries_other: bool = False) -> Moments:
    """Fᵀ W⁻¹ F of a signal, W the scatter within a recording; no share where it has too few cells."""
    cells, (left, keep) = max(rows.cells, 1), _own(rows, of.width)
    rows = rows.rows(keep)
    if len(rows.y) < _ROWS:
        return Moments(np.zeros((0, 0)), 0.0)
    louder = max(float(np.std(left[keep])) / max(of.own, 1e-300), 1.0)
    F = np.column_stack([rows.X, *(rows.columns[name] for name in of.names), rows.y])
    mean, at, count = _blocks(F, rows.t)
    share = 1.0 - of.cell / np.sqrt(of.cell**2 + count * of.block**2)
    F = (F - (share[:, None] * mean)[at]) / (of.cell * louder)
    square = F.T @ F
    if carries_other:
        held = len(of.beta) + np.flatnonzero([name in CARRIED or name.startswith(LIFTED) for name in of.names])
        square = _freed(square, held, np.full(len(held), _HELD**2))
    return Moments(square, len(rows.y) / cells)


def _freed(square: Array, at: np.ndarray, variance: Array) -> Array:
    """The same where these coefficients differ with these variances (Woodbury)."""
    scale = np.sqrt(np.maximum(variance, 0.0))
    G = scale[:, None] * square[at]
    return np.asarray(square - G.T @ np.linalg.solve(np.eye(len(at)) + G[:, at] * scale, G))


def _solved(of: SignalNormal, squares: Sequence[Array]) -> SignalNormal:
    """Coefficients, and how much the loose ones differ from one recording to the next."""
    p, z = len(of.beta), len(of.spread)
    own = np.r_[np.arange(p), -1]
    S = np.stack([square[np.ix_(own, own)] for square in squares])  # (m, p + 1, p + 1)
    spread = 1e-2 * of.width[:z] ** 2
    for left in reversed(range(_ROUNDS)):
        scale = np.sqrt(spread)
        inner = np.eye(z) + scale[:, None] * S[:, :z, :z] * scale
        gain = scale[:, None] * np.linalg.inv(inner) * scale
        whole = (S - np.swapaxes(S[:, :z], 1, 2) @ gain @ S[:, :z]).sum(axis=0)
        precision = np.diag(of.width**-2.0) + whole[:p, :p]
        covariance = np.linalg.inv(precision)
        beta = covariance @ whole[:p, -1]
        if left:
            mean = (gain @ (S[:, :z, -1:] - S[:, :z, :p] @ beta[:, None]))[..., 0]
            slope = gain @ S[:, :z, :p]
            unsure = np.diagonal(gain, axis1=1, axis2=2) + np.einsum("mzp,pq,mzq->mz", slope, covariance, slope)
            spread = (mean**2 + unsure).mean(axis=0)
    return replace(of, beta=beta, precision=precision, spread=spread)


def _left_out(of: SignalNormal, own: Moments) -> SignalNormal:
    """The coefficients without one of the recordings that they are of."""
    p, S = len(of.beta), differing(own, of)
    precision = of.precision - S[:p, :p]
    beta = np.asarray(np.linalg.solve(precision, of.precision @ of.beta - S[:p, -1]))
    return replace(of, beta=beta, precision=precision)


def differing(one: Moments, of: SignalNormal) -> Array:
    """Fᵀ V⁻¹ F, V with what the loose coefficients differ by from one recording to the next."""
    return _freed(one.square, np.arange(len(of.spread)), of.spread)
