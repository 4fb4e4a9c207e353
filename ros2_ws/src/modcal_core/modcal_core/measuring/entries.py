"""Whether readings that people typed can be readings at all, by what the nominal arm makes of those around them.

Base and tool are those on which most of the stations agree (:mod:`modcal_core.plausibility.consensus`), so that a few
wrong rows do not matter. A nominal arm is a centimetre off at most; metres for millimetres, columns that were swapped,
another row's reading or a wrong digit are off by more. A fit would leave such a reading out, or be bent by it: whoever
stands beside the arm can still correct it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.measuring.session import Session
from modcal_core.measuring.table import CHECKED
from modcal_core.plausibility.agreement import Placed
from modcal_core.plausibility.consensus import CLEARLY, Consensus
from modcal_core.plausibility.conventions import points_match
from modcal_core.plausibility.mistakes import left_handed
from modcal_core.plausibility.require import LIMIT_OF_REACH
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism, is_serial_arm

_MIN = 10  # stations; of fewer, base and tool leave nothing to tell a wrong one by
_MAX = 2.0 / 3.0  # of the stations that agree; where fewer do it is the arm that is off, or all readings are wrong
_UNITS = ((1e3, "metres"), (10.0, "centimetres"), (25.4, "inches"), (1e-3, "micrometres"))  # with their size in mm
_BETTER = 4.0  # times smaller must be what is missed, before all readings are said to be mistaken


def require_likely(session: Session, mechanism: Mechanism, read: Sequence[int], source: str) -> None:
    """Raises BadTable for the first of these stations whose reading cannot be one of this arm, with what it may be.

    read: numbers of the stations that were read just now. Nothing is asked of a Delta, nor of few stations.
    """
    rows = session.rows()
    if not is_serial_arm(mechanism) or len(rows) < _MIN or not read:
        return
    samples = session.samples(rows)
    consensus = Consensus(samples, mechanism)
    placed, agree = consensus.largest(np.arange(len(samples)))
    if placed is None or agree.mean() < _MAX:
        _require_convention(samples, mechanism, source)
        return
    near = consensus.within(placed, consensus.A, samples, CLEARLY)
    expected = se3.apply(consensus.A, placed.x) @ placed.Y.T + placed.t
    for k in np.flatnonzero(~near).tolist():
        if rows[k] in read:
            what, remedy = _meant(k, samples, expected, consensus, placed, rows, int(agree.sum()))
            raise BadTable(f"{source}, station {rows[k] + 1}", what, f"{remedy}; if it is right, note: {CHECKED}")


def _require_convention(samples: Samples, chain: Chain, source: str) -> None:
    """Raises BadTable where all readings are in another unit or in a mirrored frame."""

    def missed(other: Array) -> float:
        return points_match(chain, samples.q, other).typical

    as_is = missed(samples.reading)
    meant = [(f"readings look like {unit}", scale * samples.reading, "write millimetres") for scale, unit in _UNITS]
    mirrored = left_handed()  # by which axis nothing says: the tracker may stand in any way
    meant.append((mirrored.offender, mirrored.undone(samples).reading, mirrored.remedy))
    left, i = min((missed(other), i) for i, (_, other, _) in enumerate(meant))
    if left < min(LIMIT_OF_REACH * chain.reach(), as_is / _BETTER):
        said = f"{meant[i][0]}: the arm misses them by {1e3 * as_is:.0f} mm, corrected by {1e3 * left:.0f} mm"
        raise BadTable(source, said, meant[i][2])


def _meant(
    k: int, samples: Samples, expected: Array, consensus: Consensus, placed: Placed, rows: Sequence[int], others: int
) -> tuple[str, str]:
    """What a reading may have been meant to be, and what to do."""
    p, limit = samples.reading[k], CLEARLY * consensus.limit[1]
    gap = p - expected[k]
    far = float(np.linalg.norm(gap))
    if far < limit:
        turn = float(placed.residual(consensus.A, samples)[0][k])
        said = f"is turned by {np.degrees(turn):.1f}° from where the other {others} readings have it"
        return said, "correct rx, ry and rz (degrees, about fixed axes)"
    for words, other, remedy in _corrected(p):
        if float(np.linalg.norm(other - expected[k])) < limit:
            return words, remedy
    for j in np.argsort(np.linalg.norm(expected - p, axis=1))[:1]:
        if j != k and float(np.linalg.norm(expected[j] - p)) < limit:
            return f"has what the arm should read at station {rows[j] + 1}", "write each reading into its own row"
    axis = int(np.argmax(np.abs(gap)))
    if float(np.linalg.norm(np.delete(gap, axis))) < limit:
        said = (
            f"{'xyz'[axis]} is {1e3 * gap[axis]:+.1f} mm from where the other {others} readings have it; the rest fits"
        )
        return said, "look for a wrong digit or decimal point"
    said = f"lies {1e3 * far:.0f} mm from where the other {others} readings have it"
    return said, "correct it, or note: unseen"


def _corrected(p: Array) -> Iterator[tuple[str, Array, str]]:
    """What a position (3,) [m] would be without a mistake of typing: words for it, the position, and what to do."""
    for scale, unit in _UNITS:
        yield f"looks like {unit}", scale * p, "write millimetres"
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            columns = ", ".join("xyz"[i] for i in order)
            yield (
                f"looks as if its columns stood in the order {columns}",
                p[list(np.argsort(order))],
                "put them in order",
            )
    for signs in product((1.0, -1.0), repeat=3):
        if min(signs) < 0.0:
            wrong = " and ".join("xyz"[i] for i in range(3) if signs[i] < 0.0)
            yield f"looks as if the sign of {wrong} were wrong", p * np.array(signs), "correct the sign"
