"""What is left of stations that fall into two groups: a joint, a tool, a base or an instrument with two positions.

A bit that an encoder lost, a tracker that looks with either face, a target that sits in one of two places: each puts a
station in one of two groups, and neither posture nor time need tell in which. It looks like scatter, and returns take
it for such. But scatter is not two values. For each candidate motion the residual r is written as U (c ± θ), with the
sign of each station and θ found in turn (clusterwise regression; Späth 1979). Two groups must take away half of the
squares, and along the motion they must be separate: within normal scatter the best two explain 2/π of it, of a
uniform distribution 3/4, of a wave 8/π², and beyond these only what is two-valued.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Chain, is_serial_arm
from modcal_core.verdict.case import Case, weights

_MAX = 300  # samples; more are thinned evenly
_MIN = 30  # samples
_MIN_OF_THEM = 0.1  # share of the samples in the smaller group
_EXPLAINED = 0.5  # share of the squares
_SEPARATE = 0.85  # share of the squares along the motion; a wave, of all that is not two-valued the most, has 0.81
_ROUNDS = 12  # iterations
_BITS = (6, 24)  # that encoders have
_PLAINER = 0.9  # of the best share; a joint's axis is plainer than six directions
_BIT = 0.03  # of its size, to which a step is taken for a bit of an encoder


@dataclass(frozen=True)
class TwoGroups:
    """who: what seems to have two positions. apart: the size between them, as text. few: samples of the smaller
    group, of how many. share: of the squared error that the two groups explain.
    """

    who: str
    apart: str
    few: int
    of: int
    share: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return (
            f"The residual falls into two groups of {self.few} and {self.of - self.few} stations, {self.apart} apart, "
            f"as if {self.who} had two positions ({self.share:.0%} of the squared error): that is not scatter."
        )


@dataclass(frozen=True)
class _Motion:
    """A candidate: columns (d, C, N) in units of the noise; components: which of the six they are about; unit: a
    thousandth of that of a joint's position, nothing of others.
    """

    who: str
    columns: Array
    components: slice
    unit: str = ""  # of a joint


def two_groups(case: Case) -> TwoGroups | None:
    """Two groups that most of what a case leaves falls into, None where there are none."""
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    rows = rows[spread_rows(len(rows), _MAX)]
    chain = case.model.chain
    if len(rows) < _MIN or not is_serial_arm(chain) or not is_direct(case.samples.kinds):
        return None
    samples = case.samples.select(rows)
    view = RowView.of(case.model, samples, case.model.drivers(samples))
    weight = weights(case.noise, samples)
    residual = np.zeros((6, len(samples)))
    residual[:3], residual[3:, view.pose] = view.position, view.rotation
    residual = residual * weight
    if not case.fitted:
        residual = _settled(residual, chain, view, weight)
    found: list[tuple[float, TwoGroups, bool]] = []
    for motion in _motions(chain, view, weight):
        split = _split(motion.columns, residual[motion.components])
        if split is not None:
            share, sign, theta = split
            apart = _apart(motion, theta, weight)
            few = int(min((sign > 0.0).sum(), (sign < 0.0).sum()))
            found.append((share, TwoGroups(motion.who, apart, few, len(sign), share), bool(motion.unit)))
    best = max((share for share, *_ in found), default=0.0)
    found.sort(key=lambda f: (not f[2], -f[0]))
    return next((said for share, said, _ in found if share >= _PLAINER * best), None)


def _settled(residual: Array, chain: Chain, view: RowView, weight: Array) -> Array:
    """The residual (6, N) beside the base, tool and joint zeros that it asks for.

    What moved since a calibration, or was mastered again, is not in two places where stations are near two postures.
    """
    columns = [_of_place(place, view, weight) for place in (0, chain.tool_place)]
    columns += [_of_axis(j, chain, view, weight)[None] for j in range(chain.n)]
    flat = np.concatenate(columns).reshape(-1, residual.size)
    return np.asarray(residual - (np.linalg.lstsq(flat.T, residual.ravel(), rcond=1e-9)[0] @ flat).reshape(6, -1))


def _column(place: int, direction: int, view: RowView, weight: Array) -> Array:
    """Motion of the tool (6, N) per unit of a direction at a place, in units of the noise."""
    N = weight.shape[1]
    row = view.unit_column(place, direction)
    out = np.zeros((6, N))
    out[:3] = row[: 3 * N].reshape(3, N)
    out[3:, view.pose] = row[3 * N :].reshape(3, -1)
    return out * weight


def _of_place(place: int, view: RowView, weight: Array) -> Array:
    """The same of all directions that the readings show, (d, 6, N): a point of the tool does not turn."""
    columns = np.stack([_column(place, d, view, weight) for d in range(6)])
    return columns[np.abs(columns).max(axis=(1, 2)) > 0.0]


def _of_axis(j: int, chain: Chain, view: RowView, weight: Array) -> Array:
    """The same of a joint along its axis, (6, N)."""
    return _column(place_index(chain.names[j], chain), 5 if chain.revolute[j] else 2, view, weight)


def _motions(chain: Chain, view: RowView, weight: Array) -> Iterator[_Motion]:
    every = slice(0, 6)
    for j, name in enumerate(chain.names):
        axis = _of_axis(j, chain, view, weight)
        yield _Motion(f"joint {name}", axis[None], every, "mrad" if chain.revolute[j] else "mm")
    for who, place in (("the tool (or the target on it)", chain.tool_place), ("the base (or the tracker)", 0)):
        columns = _of_place(place, view, weight)
        yield _Motion(who, columns, every)
        if len(view.pose) and place == 0:  # readings of positions alone, as a tracker that looks with either face
            yield _Motion("the tracker, in its positions,", columns[:, :3], slice(0, 3))


def _split(columns: Array, residual: Array) -> tuple[float, Array, Array] | None:
    """(share of the squares explained, signs (N,), θ (d,)) of the best two groups, None where they are no two."""
    d = len(columns)
    size = np.sqrt(np.sum(columns**2, axis=(1, 2)))
    if not (size > 0.0).all():
        return None
    U = columns / size[:, None, None]
    flat, r = U.reshape(d, -1), residual.ravel()
    gram = flat @ flat.T + 1e-9 * np.eye(d)
    level = residual - np.tensordot(np.linalg.solve(gram, flat @ r), U, axes=1)
    total = float(np.sum(level**2))
    if total <= 0.0:
        return None
    best: tuple[float, Array, Array, float] | None = None
    for start in range(d):
        sign = np.where(np.sum(U[start] * level, axis=0) > 0.0, 1.0, -1.0)
        for _ in range(_ROUNDS):
            signed = (U * sign).reshape(d, -1)
            cross = flat @ signed.T
            H = np.block([[gram, cross], [cross.T, gram]])
            both = np.linalg.solve(H + 1e-9 * np.eye(2 * d), np.r_[flat @ r, signed @ r])
            off = residual - np.tensordot(both[:d], U, axes=1)
            along = np.tensordot(both[d:], U, axes=1)
            new = np.where(np.sum(along * off, axis=0) > 0.0, 1.0, -1.0)
            if (new == sign).all():
                break
            sign = new
        share = 1.0 - float(np.sum((off - sign * along) ** 2)) / total
        if best is None or share > best[0]:
            best = share, sign, both[d:] / size, _separate(off, along, sign)
    assert best is not None
    share, sign, theta, separate = best
    few = min(float(np.mean(sign > 0.0)), float(np.mean(sign < 0.0)))
    return (share, sign, theta) if share >= _EXPLAINED and separate >= _SEPARATE and few >= _MIN_OF_THEM else None


def _separate(off: Array, along: Array, sign: Array) -> float:
    """Share of the squares along the motion (C, N) that the two groups explain."""
    weight = np.maximum(np.sum(along**2, axis=0), 1e-300)
    place = np.sum(along * off, axis=0) / weight
    mean = float(np.average(place, weights=weight))
    return 1.0 - float(np.average((place - sign) ** 2, weights=weight)) / max(
        float(np.average((place - mean) ** 2, weights=weight)), 1e-300
    )


def _apart(motion: _Motion, theta: Array, weight: Array) -> str:
    if motion.unit:
        step = 2.0 * abs(float(theta[0]))
        bits = np.log2(2.0 * np.pi / step)
        whole = (
            motion.unit == "mrad"
            and _BITS[0] <= round(bits) <= _BITS[1]
            and abs(2.0 ** (round(bits) - bits) - 1.0) < _BIT
        )
        bit = f", 1/{2 ** round(bits)} of a turn, as an encoder's bit is," if whole else ""
        return f"{1e3 * step:.3g} {motion.unit}{bit}"
    moved = np.tensordot(theta, motion.columns, axes=1)[:3] / weight[:3]
    return f"{2e3 * float(np.sqrt(np.mean(np.sum(moved**2, axis=0)))):.3g} mm"
