"""What columns of a table mean, told by which reading of them makes the nominal arm fit.

Every meaning of a set of columns (unit of the positions, form and order of the orientation, direction of the pose, unit
of the joints) gives poses, and the hand-eye problem of the nominal arm has a likelihood for them, the same as
:mod:`search` compares. What is best by :data:`~modcal_core.hypotheses.meant.BEYOND_DOUBT` is proved. Two
meanings are one where their poses differ only by a fixed transform on either side: base and tool take it up, and the
calibrated arm is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import base_and_tool_turns, tool_and_place, turns_left
from modcal_core.geometry import Array, se3
from modcal_core.hypotheses.hand_eye import OF_MOTION, HandEye, placed
from modcal_core.hypotheses.search import rough
from modcal_core.measurements import spread_rows
from modcal_core.robots import Mechanism, forward, takes

LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}  # m; units that tables have positions in
MIN_ROWS = 10  # twelve unknown numbers at most, of thirty or sixty
ARM_SHARE = 0.01  # of the reach; a nominal arm that misses by more (median) is not explained
ARM_ANGLE = 0.035  # rad; the same of orientations
_FEW, _MAX = 60, 300  # rows, evenly along the table, to look for meanings and to judge them
_ROTATIONS = 48  # ways to read orientations, the best by themselves, that are tried with positions
_NEAR = (3.0, 0.02)  # times, and rad more than, what the best leaves of orientations, that still count as good
_JUDGED = 6  # meanings, the likeliest on few rows, that are judged on many
_SAME_TURN, _SAME_PLACE = 1e-3, 1e-5  # rad, m; what digits of an export leave of two forms of one pose


Turns = Callable[[Array], Array]  # rotations (N, 3, 3) that columns (N, k) are in one way to read them


@dataclass(frozen=True)
class Meaning:
    """One reading of all columns. postures: index of the choice of joints. unit: of the positions. way: index of the
    way to read orientations, None where there are none. inverse: the table holds the tracker's pose in the tool.
    """

    postures: int
    unit: str
    way: int | None
    inverse: bool = False


@dataclass(frozen=True)
class Judged:
    """A meaning with how well the nominal arm fits it. score: log evidence [nats]. typical, typical_angle: medians left
    [m, rad].
    """

    meaning: Meaning
    score: float
    typical: float
    typical_angle: float
    case: HandEye

    @classmethod
    def of(cls, meaning: Meaning, case: HandEye) -> Judged:
        """A meaning by its case, to which base and tool are fitted."""
        fit = placed(case, thorough=False)
        return cls(meaning, fit.evidence, fit.usual[1], fit.usual[0], case)

    @property
    def R(self) -> Array:
        """Orientations (N, 3, 3) that were read."""
        return self.case.R

    @property
    def position(self) -> Array:
        """Positions (N, 3) [m]."""
        return self.case.p

    @property
    def share(self) -> float:
        """What is left of places, or of turns where that is more, as a share of what moves.

        A meaning by which hardly anything moves fits whatever the columns are.
        """
        turn, place = self.case.motion
        left = self.typical / max(place, 1e-12)
        return left if self.meaning.way is None else max(left, self.typical_angle / max(turn, 1e-12))

    @property
    def near(self) -> bool:
        """Whether little is left of what moves: the arm is the one that was read, however wrong it may be."""
        return self.share <= OF_MOTION

    def explained(self, chain: Mechanism) -> bool:
        """Whether what is left is also no more than most nominal arms are wrong by: no other meaning is looked for."""
        return self.near and self.typical <= ARM_SHARE * chain.reach() and self.typical_angle <= ARM_ANGLE


def judge(
    chain: Mechanism, choices: Sequence[Array], position: Array, turned: Array | None = None, ways: Sequence[Turns] = ()
) -> list[Judged]:
    """The likeliest meanings of columns, best first, of those that are physically one only the first.

    choices: postures (N, n) [rad, m] that the joints' columns may be. position: (N, 3), in the table's unit. turned:
    columns of the orientation (N, k), None without, and the ways to read them. All rows are whole.
    """
    if len(position) < MIN_ROWS or (turned is not None and not ways):
        return []
    found: list[Judged] = []
    for c, q in enumerate(choices):
        if not takes(chain, q).all():  # in another unit, a Delta's platform fits its arms no more
            continue
        if turned is None:
            found += [_judged_point(chain, q, c, position, unit) for unit in LENGTHS]
        else:
            found += _judged_poses(chain, q, c, position, turned, ways)
    found.sort(key=lambda j: (not j.near, -j.score))
    distinct: list[Judged] = []
    for one in found:
        if not any(_same(one, other, choices) for other in distinct):
            distinct.append(one)
    return distinct


def _judged_point(chain: Mechanism, q: Array, c: int, position: Array, unit: str) -> Judged:
    rows = spread_rows(len(position), _MAX)
    table = HandEye.of_arrays(chain, q[rows], position[rows])
    case = table.read(LENGTHS[unit] * table.p, volume=3.0 * float(np.log(LENGTHS[unit])))
    return Judged.of(Meaning(c, unit, None), case)


def _judged_poses(
    chain: Mechanism, q: Array, c: int, position: Array, turned: Array, ways: Sequence[Turns]
) -> list[Judged]:
    few, more = (spread_rows(len(position), most) for most in (_FEW, _MAX))
    unread = np.tile(np.eye(3), (len(position), 1, 1))
    R = np.stack([way(turned[few]) for way in ways])
    likely = _likely_turns(chain, q[few], R)
    meanings = [Meaning(c, unit, way, inverse) for way in likely for inverse in (False, True) for unit in LENGTHS]
    table = HandEye.of_arrays(chain, q[few], position[few], unread[few])
    scores = np.array(rough([_read(m, R[m.way], table) for m in meanings]))
    table = HandEye.of_arrays(chain, q[more], position[more], unread[more])
    out = []
    for i in np.argsort(-scores, kind="stable")[:_JUDGED]:
        case = _read(meanings[i], ways[meanings[i].way or 0](turned[more]), table)
        out.append(Judged.of(meanings[i], case))
    return out


def _likely_turns(chain: Mechanism, q: Array, R: Array) -> list[int]:
    """Which of the ways, of orientations R (m, N, 3, 3), or their inverses, fit the arm best by themselves."""
    a = forward(chain, q)[:, :3, :3]
    R = np.concatenate([R, np.swapaxes(R, 2, 3)])
    A = np.broadcast_to(a, R.shape)
    Y, X = base_and_tool_turns(A, R)
    left = np.median(np.linalg.norm(turns_left(Y, A, X, R), axis=2), axis=1).reshape(2, -1).min(axis=0)
    order = np.argsort(left, kind="stable")
    near = max(_NEAR[0] * left[order[0]], left[order[0]] + _NEAR[1])
    return [int(i) for i in order[:_ROTATIONS] if left[i] <= near]


def _read(meaning: Meaning, R: Array, table: HandEye) -> HandEye:
    """The rows of a table as a meaning of its columns has them. R: (N, 3, 3), as the columns say."""
    p = LENGTHS[meaning.unit] * table.p
    if meaning.inverse:
        R = np.swapaxes(R, 1, 2)
        p = -(R @ p[..., None])[..., 0]
    return table.read(p, R, 3.0 * float(np.log(LENGTHS[meaning.unit])))


def _same(one: Judged, other: Judged, choices: Sequence[Array]) -> bool:
    """Whether two meanings give the same poses but for fixed transforms, and the same joints."""
    if one.meaning.way is None or other.meaning.way is None:
        return one.meaning == other.meaning
    a, b = choices[one.meaning.postures], choices[other.meaning.postures]
    if a is not b and float(np.abs(a - b).max()) > 1e-6:
        return False
    return same_poses(se3.transform(one.R, one.position), other.R, other.position)


def same_poses(A: Array, R: Array, position: Array) -> bool:
    """Whether poses R (N, 3, 3), position (N, 3) [m] are ``Y A X`` of poses A (N, 4, 4) to the digits of an export."""
    Y, X = base_and_tool_turns(A[:, :3, :3], R)
    turns = turns_left(Y, A[:, :3, :3], X, R)
    if float(np.median(np.linalg.norm(turns, axis=1))) > _SAME_TURN:
        return False
    gap = tool_and_place(Y, A, position)[0]
    return float(np.median(np.linalg.norm(gap, axis=1))) < max(
        _SAME_PLACE, 1e-5 * float(np.ptp(position, axis=0).max())
    )
