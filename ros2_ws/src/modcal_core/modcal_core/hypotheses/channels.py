"""Single columns of the readings that do not follow the joints as the others do.

With a (N, 3, 3) and b (N, 3) the turns and places of the arm's tip, a coordinate of a point of the tool is linear in
vec(a), b and 1, whatever base and tool are. A coordinate that is not so at its own station, and is at a neighbour's,
stands in another row. Coordinates that are, say by their coefficients how long and how turned their frame is;
orientations say it once more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import base_and_tool_turns, turns_left
from modcal_core.geometry import Array, so3
from modcal_core.hypotheses.hand_eye import HandEye, points
from modcal_core.hypotheses.hypothesis import RARE, ROWS_REMEDY, VERY_RARE, Hypothesis

_SHIFTS = (1, -1, 2, -2, 3, -3)  # stations, by which readings may have slipped against the joints
_COEFFICIENTS = 13  # of a coordinate: nine of a turn, three of a place, and 1


def channels(case: HandEye) -> list[Hypothesis]:
    """What may be wrong with one column or with the orientations; nothing of fewer rows than twice the coefficients."""
    if len(case) < 2 * _COEFFICIENTS:
        return []
    found = _Channels(case)
    try:
        return [*found.late(), *found.longer(), *found.unrelated(), *found.offset()]
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return []


def turned_frames(case: HandEye) -> list[Hypothesis]:
    """Orientations that are given in another frame than positions."""
    if not case.poses or len(case) < 2 * _COEFFICIENTS:
        return []
    try:
        return list(_Channels(case).frames())
    except np.linalg.LinAlgError:
        return []


@dataclass(frozen=True)
class _Channels:
    case: HandEye

    @cached_property
    def design(self) -> Array:
        """What a coordinate of a point of the tool is linear in, (N, 13)."""
        N = len(self.case)
        return np.concatenate([self.case.A[:, :3, :3].reshape(N, 9), self.case.A[:, :3, 3], np.ones((N, 1))], axis=1)

    @cached_property
    def each(self) -> list[tuple[Array, float]]:
        """Coefficients of x, y and z, and what each misses by [m at the tip]."""
        return [_linear(self.design, self.case.p[:, k]) for k in range(3)]

    @cached_property
    def turned(self) -> Array:
        """How the base is turned as orientations say."""
        return base_and_tool_turns(self.case.A[:, :3, :3], self.case.R)[0]

    def fits(self, shift: int) -> np.ndarray:
        """Whether x, y, z, and orientations if there are any, follow the posture ``shift`` stations earlier."""
        N, (angle, distance) = len(self.case), self.case.limits
        here = np.arange(max(0, -shift), N - max(0, shift))
        out = [_linear(self.design[here], self.case.p[here + shift, k])[1] < distance for k in range(3)]
        if self.case.poses:
            a, R = self.case.A[here, :3, :3], self.case.R[here + shift]
            Y, X = base_and_tool_turns(a, R)
            out.append(float(np.median(np.linalg.norm(turns_left(Y, a, X, R), axis=1))) < angle)
        return np.array(out)

    def late(self) -> Iterator[Hypothesis]:
        """Columns of the readings that belong to another row than they stand in."""
        fits, names = self.fits(0), ["x", "y", "z", "orientations"]
        if fits.all():
            return
        for shift in _SHIFTS:
            slipped = ~fits & self.fits(shift)
            if not slipped.any() or slipped.all():  # readings as wholes are orders of rows
                continue
            who = _columns([n for n, s in zip(names, slipped, strict=False) if s])
            side, rows = ("late" if shift > 0 else "early"), f"{abs(shift)} row{'s' if abs(shift) > 1 else ''}"
            what = f"{who} {_verb(who, 'look')} {side} by {abs(shift)} station{'s' if abs(shift) > 1 else ''}"
            what += f": each stands {rows} too {'low' if shift > 0 else 'high'} in the order of the stations"

            def undone(c: HandEye, slipped: np.ndarray = slipped, shift: int = shift) -> HandEye:
                p = np.where(slipped[:3], np.roll(c.p, -shift, axis=0), c.p)
                return c.read(p, np.roll(c.R, -shift, axis=0) if slipped[3:].any() else c.R)

            yield Hypothesis(what, ROWS_REMEDY, undone, RARE - float(np.log(14 * len(_SHIFTS))))

    def longer(self) -> Iterator[Hypothesis]:
        """One coordinate that is longer or shorter than the others, or two."""
        size = np.array([np.linalg.norm(solution[9:12]) for solution, _ in self.each])
        for k in range(3):
            ratio = float(size[k] / max(np.median(np.delete(size, k)), 1e-12))
            if ratio < 1e-9:
                continue
            scale = np.where(np.arange(3) == k, 1.0 / ratio, 1.0)
            yield Hypothesis(
                f"coordinate {'xyz'[k]} of the readings looks {ratio:.4g} times as long as the others",
                "write all three coordinates in one unit, and check the instrument's scale",
                lambda c, scale=scale: c.read(c.p * scale, volume=float(np.log(scale).sum())),  # type: ignore[misc]
                VERY_RARE,
                1,
            )

    def unrelated(self) -> Iterator[Hypothesis]:
        """Coordinates that do not follow the posture where the others do, and orientations."""
        distance = self.case.limits[1]
        wrong = [k for k in range(3) if self.each[k][1] > distance]
        if len(wrong) == 1 or (len(wrong) == 2 and self.case.poses):
            rest = [k for k in range(3) if k not in wrong]
            who, others = _columns(["xyz"[k] for k in wrong]), " and ".join("xyz"[k] for k in rest)
            yield Hypothesis(
                f"{who} {_verb(who, 'do')} not follow the posture, and {others} {'do' if len(rest) > 1 else 'does'}",
                "check how that column is read, sorted and written, and whether it holds a coordinate at all",
                lambda c: _without(c, rest),
                RARE,
                4,
            )
        if self.case.poses:
            yield Hypothesis(
                "positions correlate with the posture and orientations do not",
                "check how orientations are computed, and whether they are of the same target",
                points,
                VERY_RARE,
                touches="orientations",
            )

    def frames(self) -> Iterator[Hypothesis]:
        """Positions and orientations that each agree with the arm, and not with each other."""
        if not self.case.poses:
            return
        M = np.stack([solution[9:12] for solution, _ in self.each])
        S = so3.nearest_rotation(M) @ self.turned.T
        apart = float(np.degrees(np.linalg.norm(so3.log(S))))
        cube = np.round(S)
        other_axes = bool(np.abs(S - cube).max() < self.case.limits[0])  # axes in another order, one of 23 ways
        S = so3.nearest_rotation(cube) if other_axes else S
        yield Hypothesis(
            f"orientations are given in a frame that is turned by {apart:.3g}° to that of the positions "
            "(a static transform was left out of one of them, or the axes stand in another order)",
            "give positions and orientations in one frame",
            lambda c: c.read(R=S @ c.R),
            RARE - (float(np.log(23.0)) if other_axes else 0.0),
            0 if other_axes else 3,
            "orientations",
        )

    def offset(self) -> Iterator[Hypothesis]:
        """Positions with an offset of the tool that was turned by the inverse orientation."""
        if not self.case.poses:
            return
        N, Y = len(self.case), self.turned
        R = np.swapaxes(self.case.R, 1, 2)
        columns = np.concatenate([Y @ self.case.A[:, :3, :3], np.broadcast_to(np.eye(3), (N, 3, 3)), R], axis=2)
        h = self.case.p - self.case.A[:, :3, 3] @ Y.T
        v = np.linalg.lstsq(columns.reshape(-1, 9), h.ravel(), rcond=1e-9)[0][6:]
        yield Hypothesis(
            "positions correlate with the posture, though not as those of one point of the tool, but as if an offset "
            f"of {1e3 * float(np.linalg.norm(v)):.3g} mm had been turned by the inverse orientation",
            "check how the tool's offset is taken into account before positions are written",
            lambda c: c.read(c.p - (np.swapaxes(c.R, 1, 2) @ v)),
            RARE,
            3,
        )


def _without(c: HandEye, rest: list[int]) -> HandEye:
    """The case with the coordinates that are not in ``rest`` as a base and a tool that the rest asks for have them."""
    design = np.concatenate([c.A[:, :3, :3].reshape(-1, 9), c.A[:, :3, 3], np.ones((len(c), 1))], axis=1)
    M = np.zeros((3, _COEFFICIENTS))
    for k in rest:
        M[k] = _linear(design, c.p[:, k])[0]
    wrong = [k for k in range(3) if k not in rest]
    if c.poses:
        Y = base_and_tool_turns(c.A[:, :3, :3], c.R)[0]
        x = np.linalg.lstsq(
            np.concatenate([(Y[k] @ c.A[:, :3, :3]) - (Y[k] @ c.A[:, :3, :3]).mean(axis=0) for k in rest]),
            np.concatenate([v - v.mean() for v in (c.p[:, k] - c.A[:, :3, 3] @ Y[k] for k in rest)]),
            rcond=1e-9,
        )[0]
    else:
        a, b = (M[k, 9:12] / max(float(np.linalg.norm(M[k, 9:12])), 1e-12) for k in rest)
        Y = np.zeros((3, 3))
        Y[rest[0]], Y[rest[1]] = a, b
        Y[wrong[0]] = np.cross(Y[(wrong[0] + 1) % 3], Y[(wrong[0] + 2) % 3])
        Y = so3.nearest_rotation(Y)
        x = np.linalg.lstsq(
            np.concatenate([np.kron(Y[k][:, None], np.eye(3)) for k in rest]),
            np.concatenate([M[k, :9] for k in rest]),
            rcond=1e-9,
        )[0]
    p = c.p.copy()
    expected = (c.A[:, :3, :3] @ x + c.A[:, :3, 3]) @ Y.T
    p[:, wrong] = expected[:, wrong]
    scale = c.scale  # nothing is said of them: anything in the volume, for what a fit would have explained
    lost = len(wrong) * (scale.volume / 3.0 - np.log(scale.position * np.sqrt(2.0 * np.pi)))
    return replace(c, p=p, volume=c.volume - lost)


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


def _columns(names: list[str]) -> str:
    own = [n for n in names if n != "orientations"]
    said = [f"column{'s' if len(own) > 1 else ''} {' and '.join(own)} of the positions"] if own else []
    return " and ".join([*said, *(["orientations"] if "orientations" in names else [])])


def _verb(who: str, verb: str) -> str:
    single = who.startswith("column ") and who.endswith("positions")
    return {"look": "looks", "do": "does"}[verb] if single else verb
