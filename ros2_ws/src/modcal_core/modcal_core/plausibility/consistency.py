"""Readings of which only a part agrees with the robot: which part, and what the rest looks like.

Where the model misses by far, or rejects many stations, the largest set of stations that agree on one base and one tool
is found (:mod:`consensus`). The rest is then read with each of the :mod:`mistakes` undone, with another base or tool,
and with the position of one joint or two taken as unknown (:mod:`joint_search`). Where no stations agree, one joint may
be wrong everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.agreement import Disagreement, Placed
from modcal_core.plausibility.consensus import CLEARLY, Consensus
from modcal_core.plausibility.joint_search import EXPLAINED, JointSearch
from modcal_core.plausibility.mistakes import (
    Mistake,
    inverse_pose,
    of_axes,
    of_axes_of_the_pose,
    of_joints,
    of_rotations,
    of_several_joints,
    of_units,
)
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MIN = 12  # stations that must agree, and be explained
_MIN_SHARE = 0.2  # of the stations that must agree, lest chance finds that many
_MAX_AGREE = 0.95  # where more do, single readings are wrong
_MAX = 160  # stations; more are thinned evenly
_OTHER_UNIT = 0.02  # by which a scale must differ to be another unit, and may miss one that has a name
# of a metre
_UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048, "kilometres": 1e-3}


def disagreement(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """What looks wrong with the stations that do not agree with the others, None where nothing is found.

    samples: in a frame of several, that with most readings is looked at.
    """
    if not is_serial_arm(chain) or not len(samples):
        return None
    f = int(np.argmax(np.bincount(samples.frame)))
    rows = np.flatnonzero((samples.frame == f) & (samples.is_pose | (samples.kind == "point")) & ~samples.moving)
    if len(rows) < 2 * _MIN or samples.frames[f] in samples.sockets:
        return None
    rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
    rows = rows[spread_rows(len(rows), _MAX)]
    try:
        return _ExplanationSearch(samples.select(rows), chain).found()
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None


class _ExplanationSearch:
    """Explanations of what does not agree, the plainest first."""

    def __init__(self, samples: Samples, chain: Chain) -> None:
        self._among = Consensus(samples, chain)
        self._joint = JointSearch(self._among)
        self.samples, self.chain = samples, chain

    def found(self) -> Disagreement | None:
        everything = np.arange(len(self.samples))
        placed, agree = self._among.largest(everything)
        if agree.mean() > _MAX_AGREE:
            return None
        if placed is not None and agree.sum() >= max(_MIN, _MIN_SHARE * len(agree)):
            rest = np.flatnonzero(~self._among.within(placed, self._among.A, self.samples, CLEARLY))
            if len(rest) >= _MIN // 2:
                said = (
                    self._by_mistake(placed, rest, self._mistakes())
                    or self._turned(placed, rest)
                    or self._in_another_unit(placed, rest)
                    or self._elsewhere(placed, rest)
                    or self._joint.one(placed, rest)
                    or self._by_mistake(placed, rest, of_several_joints(self.samples.names))
                    or self._joint.two(placed, rest)
                )
                if said is not None:
                    return said
        return self._joint.throughout(float(agree.mean()))

    def _by_mistake(self, placed: Placed, rest: np.ndarray, mistakes: Iterator[Mistake]) -> Disagreement | None:
        part = self.samples.select(rest)
        best, named = EXPLAINED, None
        for mistake in mistakes:
            undone = mistake.undone(part)
            A = forward(self.chain, undone.q) if mistake.touches == "joints" else self._among.A[rest]
            share = float(self._among.within(placed, A, undone).mean())
            if share > best:
                best, named = share, mistake
        if named is None:
            return None
        return self._among.said(
            rest, f"{named.offender} at {self._among.stations(rest)}, and not at the others", named.remedy
        )

    def _mistakes(self) -> Iterator[Mistake]:
        yield from of_units()
        yield from of_axes()
        yield from of_joints(self.samples.names)
        if self._among.poses:
            yield inverse_pose()
            yield from of_axes_of_the_pose()
            yield from of_rotations()

    def _turned(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """Positions of the rest that agree, and orientations that are turned by one angle about one axis."""
        if not self._among.poses:
            return None
        A, R = self._among.A[rest, :3, :3], self.samples.R[rest]
        gap = placed.residual(self._among.A[rest], self.samples.select(rest))[1]
        if (gap < CLEARLY * self._among.limit[1]).mean() < EXPLAINED:
            return None
        expected = placed.Y @ A @ placed.X
        best, named, about = EXPLAINED, np.eye(3), ""
        for off, frame in (
            (R @ np.swapaxes(expected, 1, 2), "the tracker"),
            (np.swapaxes(expected, 1, 2) @ R, "the tool"),
        ):
            cosine = 0.5 * (np.einsum("nij,kij->nk", off, off) - 1.0)
            alike = (cosine > np.cos(CLEARLY * self._among.limit[0])).mean(axis=1)
            k = int(np.argmax(alike))
            if alike[k] > best:
                best, named, about = float(alike[k]), off[k], frame
        if not about:
            return None
        turn = so3.log(named)
        angle = float(np.linalg.norm(turn))
        axis = ", ".join(f"{v:.2f}" for v in turn / max(angle, 1e-12) + 0.0)
        return self._among.said(
            rest,
            f"orientations look turned by {np.degrees(angle):.4g}° about ({axis}) of {about} "
            f"at {self._among.stations(rest)}, and positions agree",
            "check how orientations are computed (an angle that is folded or of which the sign is lost), and whether "
            "the target looks alike from several sides",
        )

    def _in_another_unit(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with positions that are one number times as long as they should be."""
        expected = se3.apply(self._among.A[rest], placed.x) @ placed.Y.T + placed.t
        seen = self.samples.reading[rest]
        factor = float(np.median(np.sum(seen * expected, axis=1) / np.sum(expected**2, axis=1)))
        if abs(factor - 1.0) < _OTHER_UNIT or abs(factor) < 1e-9:
            return None
        part = replace(self.samples.select(rest), reading=seen / factor)
        if self._among.within(placed, self._among.A[rest], part, CLEARLY).mean() < EXPLAINED:
            return None
        unit = next((f" ({name})" for name, size in _UNITS.items() if abs(factor / size - 1.0) < _OTHER_UNIT), "")
        return self._among.said(
            rest,
            f"positions look {factor:.4g} times as long as the others, in another unit{unit}, "
            f"at {self._among.stations(rest)}",
            "write all positions in metres",
        )

    def _elsewhere(self, placed: Placed, rest: np.ndarray) -> Disagreement | None:
        """The rest with a base, a tool, or both of its own."""
        other, agree = self._among.largest(rest)
        if other is None or agree.sum() < _MIN // 2 or agree.mean() < EXPLAINED:
            return None
        tool = replace(placed, Y=other.Y, t=other.t), "the base (or the tracker) is displaced"
        base = replace(placed, X=other.X, x=other.x), "the tool (or the target on it) is displaced"
        part, A = self.samples.select(rest), self._among.A[rest]
        said = next(
            (text for one, text in (tool, base) if self._among.within(one, A, part).mean() >= EXPLAINED),
            "base and tool are both displaced",
        )
        remedy = (
            "check whether two trackers or targets publish under one name; give each part its own frame or recording"
        )
        joint = self._joint.one(placed, rest)  # a turn about its axis is as well that of the base, or of the tool
        as_well = "" if joint is None else f", or {joint.what}"
        return self._among.said(rest, f"{said} at {self._among.stations(rest)}{as_well}", remedy)
