"""Positions that were written as something else: along other axes, from the other end, as angles, as steps.

Each way is undone and judged in closed form: with the readings as they should be, a nominal arm misses by no more than
its own errors. How the base is turned is taken from the orientations, from these inverted, and from the positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, tool_and_place
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.mistakes import Mistake, of_axes_of_the_pose
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Mechanism, forward, is_serial_arm

_MIN = 24  # stations; nine numbers of base and tool, and ways enough to hit by chance with fewer
_MAX = 200  # the same at most, the first ones: steps must follow each other
_UNITS = (("radians", 1.0), ("degrees", np.pi / 180.0), ("gon", np.pi / 200.0), ("milliradians", 1e-3))
_LENGTHS = (("metres", 1.0), ("millimetres", 1e-3))
_MAX_TURN = 1.05  # times a half or a whole turn; angles are no larger


def written_otherwise(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """The convention in which the positions seem to be written, if undoing it brings the residual down to that of a
    nominal arm; otherwise None.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    A = forward(chain, part.q)
    limit = limits(chain)[1]
    try:
        if _missed(A, part) < limit:
            return None
        for mistake in _ways(part):
            if _missed(A, mistake.undone(part)) < limit:
                return Disagreement(mistake.offender, mistake.remedy, len(part), len(part))
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    return None


def _missed(A: Array, samples: Samples) -> float:
    """Median distance [m] from the best base and tool in closed form, whatever the orientations say."""
    p = samples.reading
    bases = [base_by_positions(A[None], p[None])[0]]
    if samples.is_pose.all():
        bases += [base_and_tool_turns(A[:, :3, :3], R)[0] for R in (samples.R, np.swapaxes(samples.R, 1, 2))]
    left = [tool_and_place(Y, A, p)[0] for Y in bases]
    return min(float(np.median(np.linalg.norm(gap, axis=1))) for gap in left)


def _ways(samples: Samples) -> Iterator[Mistake]:
    if samples.is_pose.all():
        yield from of_axes_of_the_pose()
    yield _steps()
    yield from _polar(samples.reading)


def _steps() -> Mistake:
    """How far the target went since the station before."""
    return Mistake(
        "positions look like differences to the last station (increments), and not like places",
        "record places in the tracker's frame, or add the differences up",
        lambda s: replace(s, reading=np.cumsum(s.reading, axis=0)),
        "reading",
    )


def _polar(position: Array) -> Iterator[Mistake]:
    """Angles and a range in the columns of x, y and z, in any order, as instruments measure them."""
    size = np.abs(position).max(axis=0)
    for far, swapped in product((2, 0, 1), (False, True)):
        around, up = [k for k in range(3) if k != far][:: -1 if swapped else 1]
        for (unit, angle), (length, metre) in product(_UNITS, _LENGTHS):
            most = _MAX_TURN * np.pi / angle
            if size[around] > 2.0 * most or size[up] > most:
                continue
            for zenith, clockwise in product((False, True), repeat=2):

                def undone(
                    samples: Samples,
                    columns: tuple[int, int, int] = (around, up, far),
                    scales: tuple[float, float] = (angle, metre),
                    how: tuple[bool, bool] = (zenith, clockwise),
                ) -> Samples:
                    a, e, r = (samples.reading[:, k] for k in columns)
                    a, e, r = scales[0] * a, scales[0] * e, scales[1] * r
                    e = 0.5 * np.pi - e if how[0] else e
                    a = -a if how[1] else a
                    xyz = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
                    return replace(samples, reading=r[:, None] * xyz)

                order = sorted(((around, "azimuth"), (up, "zenith angle" if zenith else "elevation"), (far, "range")))
                yield Mistake(
                    f"positions look like polar coordinates ({', '.join(name for _, name in order)}; "
                    f"angles in {unit}, range in {length}{', azimuth clockwise' if clockwise else ''})",
                    "write x, y and z in metres",
                    undone,
                    "reading",
                )
