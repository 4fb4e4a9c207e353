"""Which channels of a recording follow the robot, each judged by itself, and what the others look like.

Where a model misses by far, one thing may be wrong and all the rest right: a column of the readings, the orientations,
the row in which a reading stands. Lists of mistakes find what is on them.
Here each channel is asked alone, in closed form. With a (N, 3, 3) and b (N, 3) the turns and places of the arm's tip, a
coordinate of a point of the tool is linear in vec(a), b and 1, whatever base and tool are, and so is each element of an
orientation in vec(a). A coordinate that is not so at its own station, and is at a neighbour's, stands in another row.
Coordinates that are, say by their coefficients how long and how turned their frame is; orientations say it once more.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.calibration import base_and_tool_turns, tool_and_place, turns_left
from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import ANGLE, OF_REACH, Disagreement
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MIN = 40  # stations; a coordinate has 13 coefficients
_MAX = 400  # the same at most; more say the same
_SHIFTS = (1, -1, 2, -2, 3, -3)  # stations, by which readings may have slipped against the joints
_APART = np.radians(3.0)  # by which two frames are turned, from which that is no error of an arm
_LONGER = 0.05  # share by which a coordinate is too long or too short
_SEEN = 0.03  # of the reach; deviation of the tip's place beyond what its turns tell, from which scales are known
_MOSTLY = 0.8  # share of the orientations that must agree on a frame, before it is said to be that of all of them


def disagreeing_channel(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """What looks wrong with one channel of a recording, None where none is singled out.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    found = _Channels.of(samples, chain)
    if found is None:
        return None
    try:
        return found.late() or found.frames() or found.unrelated()
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True)
class _Channels:
    """Stations of one frame, in order of time."""

    samples: Samples
    chain: Chain
    A: Array

    @classmethod
    def of(cls, samples: Samples, chain: Mechanism) -> _Channels | None:
        part = most_seen(samples, chain, _MIN, _MAX)
        if part is None or not is_serial_arm(chain):
            return None
        return cls(part, chain, forward(chain, part.q))

    @property
    def poses(self) -> bool:
        return bool(self.samples.is_pose.all())

    @property
    def limit(self) -> float:
        """Distance [m] that a nominal arm misses by at most."""
        return OF_REACH * self.chain.reach()

    @cached_property
    def design(self) -> Array:
        """What a coordinate of a point of the tool is linear in, (N, 13)."""
        N = len(self.samples)
        return np.concatenate([self.A[:, :3, :3].reshape(N, 9), self.A[:, :3, 3], np.ones((N, 1))], axis=1)

    @cached_property
    def turned(self) -> tuple[Array, Array, float]:
        """How base and tool are turned as orientations say, and the median angle [rad] that these miss by."""
        a, R = self.A[:, :3, :3], self.samples.R
        Y, X = base_and_tool_turns(a, R)
        return Y, X, float(np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=1)))

    @property
    def turns_agree(self) -> bool:
        return self.turned[2] < ANGLE

    @property
    def _agreeing(self) -> float:
        """Share of the orientations that agree on how base and tool are turned."""
        Y, X, _ = self.turned
        left = turns_left(Y, self.A[:, :3, :3], X, self.samples.R)
        return float((np.linalg.norm(left, axis=1) < 2.0 * ANGLE).mean())

    # --- rows --------------------------------------------------------------------------------------------------------

    def late(self) -> Disagreement | None:
        """Columns of the readings that belong to another row than they stand in."""
        names = ["x", "y", "z", *(["orientations"] if self.poses else [])]
        fits = self._agree(0)
        if fits.all():
            return None
        for shift in _SHIFTS:
            moved = ~fits & self._agree(shift)
            if not moved.any() or not (fits | moved).all():
                continue
            who = "readings" if moved.all() else self._columns([n for n, m in zip(names, moved, strict=True) if m])
            side = "late" if shift > 0 else "early"
            rows = f"{abs(shift)} row{'s' if abs(shift) > 1 else ''}"
            look = "looks" if who.startswith("column ") and who.endswith("positions") else "look"
            what = f"{who} {look} {side} by {abs(shift)} station{'s' if abs(shift) > 1 else ''}"
            what += f": each stands {rows} too {'low' if shift > 0 else 'high'} in the order of the stations"
            remedy = "pair each reading with its own posture (a table that slipped, or a clock that is off)"
            return self._said(what, remedy)
        return None

    def unrelated(self) -> Disagreement | None:
        """Coordinates that do not follow the posture, where the others do."""
        fits = self._agree(0)[:3]
        if fits.all() or fits.sum() < 2 - (self.poses and self.turns_agree):
            return None
        who = self._columns([axis for axis, fit in zip("xyz", fits, strict=True) if not fit])
        rest = " and ".join(axis for axis, fit in zip("xyz", fits, strict=True) if fit)
        verb = "do" if who.startswith("columns") else "does"
        return self._said(
            f"{who} {verb} not follow the posture, and {rest} {'do' if len(rest) > 1 else 'does'}",
            "check how that column is read, sorted and written, and whether it holds a coordinate at all",
        )

    @staticmethod
    def _columns(names: list[str]) -> str:
        own = [n for n in names if n != "orientations"]
        said = [f"{'columns' if len(own) > 1 else 'column'} {' and '.join(own)} of the positions"] if own else []
        return " and ".join([*said, *(["orientations"] if "orientations" in names else [])])

    def _agree(self, shift: int) -> np.ndarray:
        """Whether x, y, z, and orientations if there are any, follow the posture ``shift`` stations earlier."""
        N = len(self.samples)
        here = np.arange(max(0, -shift), N - max(0, shift))
        there = here + shift
        design = self.design[here]
        out = [self._linear(design, self.samples.reading[there, k])[1] < self.limit for k in range(3)]
        if self.poses:
            a, R = self.A[here, :3, :3], self.samples.R[there]
            Y, X = base_and_tool_turns(a, R)
            out.append(float(np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=1))) < ANGLE)
        return np.array(out)

    @staticmethod
    def _linear(design: Array, column: Array) -> tuple[Array, float]:
        """Coefficients, and the median miss in the units of the tip's place; robust."""
        weight = np.ones(len(column))
        for _ in range(4):
            H, g = (design.T * weight) @ design, (design.T * weight) @ column
            solution = np.linalg.solve(H + 1e-10 * np.trace(H) * np.eye(len(H)), g)
            square = (column - design @ solution) ** 2
            weight = 1.0 / (square + max(float(np.median(square)), 1e-18))
            weight /= weight.max()
        usual = float(np.sqrt(np.median(square)))
        return solution, usual / max(float(np.linalg.norm(solution[9:12])), 1e-9)

    # --- frames ------------------------------------------------------------------------------------------------------

    def frames(self) -> Disagreement | None:
        """Positions and orientations that each agree with the arm, and not with each other; coordinates too long."""
        each = [self._linear(self.design, self.samples.reading[:, k]) for k in range(3)]
        beyond = (
            self.design[:, 9:12]
            - self.design[:, :9] @ np.linalg.lstsq(self.design[:, :9], self.design[:, 9:12], rcond=1e-9)[0]
        )
        if max(miss for _, miss in each) > self.limit or beyond.std(axis=0).min() < _SEEN * self.chain.reach():
            return self._orientations_alone()
        M = np.stack([solution[9:12] for solution, _ in each])
        size = np.linalg.norm(M, axis=1)
        common = float(np.median(size))
        off = [k for k in range(3) if abs(size[k] / common - 1.0) > _LONGER]
        if off:
            which = " and ".join("xyz"[k] for k in off)
            return self._said(
                f"coordinate {which} of the readings looks {size[off[0]] / common:.4g} times as long as the others",
                "write all three coordinates in one unit, and check the instrument's scale",
            )
        Y = so3.nearest_rotation(M / common)
        if np.linalg.det(M) < 0.0 or abs(common - 1.0) > _LONGER:
            return None  # the mistakes have these
        if self._gap(Y) > self.limit:
            return self._not_one_point(Y)
        if not self.poses:
            return None
        if not self.turns_agree:
            return self._orientations_alone()
        apart = float(np.linalg.norm(so3.log(self.turned[0] @ Y.T)))
        if apart < _APART or self._agreeing < _MOSTLY:
            return None
        if self._gap(self.turned[0]) < self.limit or self._turned_by(Y) < ANGLE:
            return None  # a small part of space, or tools that hardly turn, do not tell how the base is turned
        return self._said(
            f"orientations are given in a frame that is turned by {np.degrees(apart):.3g}° to that of the positions "
            "(a static transform was left out of one of them, or the axes stand in another order)",
            "give positions and orientations in one frame",
        )

    def _gap(self, Y: Array) -> float:
        """Median distance [m] that positions miss by, with the base turned so."""
        gap = tool_and_place(Y[None], self.A[None], self.samples.reading[None])[0][0]
        return float(np.median(np.linalg.norm(gap, axis=1)))

    def _turned_by(self, Y: Array) -> float:
        """Median angle [rad] that orientations miss by, with the base turned so."""
        a, R = self.A[:, :3, :3], self.samples.R
        X = so3.mean(np.swapaxes(Y @ a, 1, 2) @ R)
        return float(np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=1)))

    def _not_one_point(self, Y: Array) -> Disagreement | None:
        """Positions that are linear in the posture and not those of one point of the tool."""
        more = ""
        if self.poses:
            R, N = self.samples.R, len(self.samples)
            columns = np.concatenate(
                [Y @ self.A[:, :3, :3], np.broadcast_to(np.eye(3), (N, 3, 3)), np.swapaxes(R, 1, 2)], axis=2
            )
            h = self.samples.reading - self.A[:, :3, 3] @ Y.T
            solution = np.linalg.lstsq(columns.reshape(-1, 9), h.ravel(), rcond=1e-9)[0]
            gap = h - columns @ solution
            if float(np.median(np.linalg.norm(gap, axis=1))) < self.limit:
                size = 1e3 * float(np.linalg.norm(solution[6:]))
                more = f", but as if an offset of {size:.3g} mm had been turned by the inverse orientation"
        return self._said(
            f"positions correlate with the posture, though not as those of one point of the tool{more}",
            "check how the tool's offset is taken into account before positions are written",
        )

    def _orientations_alone(self) -> Disagreement | None:
        """Positions that agree with the arm where orientations do not."""
        if not self.poses or self.turns_agree:
            return None
        each = [self._linear(self.design, self.samples.reading[:, k])[1] for k in range(3)]
        if max(each) > self.limit:
            return None
        return self._said(
            f"positions correlate with the posture and orientations do not (they miss by "
            f"{np.degrees(self.turned[2]):.3g}°)",
            "check how orientations are computed, and whether they are of the same target",
        )

    def _said(self, what: str, remedy: str) -> Disagreement:
        return Disagreement(what, remedy, len(self.samples), len(self.samples))
