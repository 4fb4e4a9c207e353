"""Pairs of a place and a driver that :mod:`dependence_scan` ranks: motions of the place by the driver, as columns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.diagnosis.hysteresis import last_moves, moments_on_base, play, slipped
from modcal_core.diagnosis.spectra import Spectrum
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spoken_name

CONSTANT = ""  # the driver of an error that depends on nothing
_CYCLES = 130  # a turn; gears of more teeth are rare
_HATS = 12  # over a joint's range
_MAX_SIGNALS = 20  # for time
_SMALL = 1e-9  # of a spread or a range; less is rounding


@dataclass(frozen=True)
class Pair:
    """place: what errs. driver: what it goes with. columns: motions of the readings, of k samples, (D, 6, k)."""

    place: str
    driver: str
    columns: Array


def pairs(model: Model, samples: Samples, view: RowView, rows: np.ndarray, constant: bool) -> Iterator[Pair]:
    """Every place with every driver, at these of the samples."""
    builder = _PairColumns(model, samples, view, rows)
    yield from builder.of_joints(constant)
    yield from builder.of_all_joints()
    yield from builder.of_ends(constant)
    yield from builder.of_places()
    yield from builder.of_instrument()


class _PairColumns:
    """Columns of places times numbers of drivers."""

    def __init__(self, model: Model, samples: Samples, view: RowView, rows: np.ndarray) -> None:
        self.model, self.samples, self.view, self.rows = model, samples, view, rows
        self.at = model.drivers(samples)
        self.chain = model.serial
        self.N = len(samples)
        self.one = np.ones((1, self.N))
        self.order = self._over_order()
        step = last_moves(samples).T
        came = np.where((samples.approach != 0.0).any(axis=1)[:, None], samples.approach, np.sign(step.T)).T
        near = [np.sign(step) * np.exp(-np.abs(step) / width) for width in (0.2, 0.8)]
        self.arrived = np.concatenate([came[:, None], step[:, None], np.stack(near, axis=1), play(samples)], axis=1)
        self.came = came

    def of_joints(self, constant: bool) -> Iterator[Pair]:
        chain = self.chain
        for j, name in enumerate(chain.names):
            place = place_index(name, chain)
            axis = [(place, 5 if chain.revolute[j] else 2)]
            q = self.samples.q[:, j]
            who = f"joint {name}"
            if constant:
                yield self._pair(who, CONSTANT, axis, self.one)
            yield self._pair(who, f"the position of {name} itself", axis, self._hats(q))
            if chain.revolute[j]:
                yield self._pair(who, f"the position of {name} itself", axis, self._waves(j, 5))
                yield from self._single_waves(who, j, axis)
            yield self._pair(who, f"how {name} arrived (backlash, friction, hysteresis)", axis, self.arrived[j])
            yield self._pair(who, f"the order of the stations: {name} changed on the way", axis, self.order)
            others = [self._waves(i, 1) for i in range(chain.n) if i != j]
            yield self._pair(who, "the positions of the other joints", axis, np.concatenate(others))
            loads = [self.at.values(f"{kind}:{name}") for kind in self._loads()]
            yield self._pair(who, f"the load of {name}", axis, _curves(np.stack(loads)))
            for signal in self.at.signal_names()[:_MAX_SIGNALS]:
                number = _curves(self.at.values(signal)[None])
                yield self._pair(who, f"what was recorded of {spoken_name(signal)}", axis, number)
            every = [(place, d) for d in range(6)]
            yield self._pair(f"{who} across its axis too", f"the position of {name} itself", every, self._waves(j, 2))

    def of_all_joints(self) -> Iterator[Pair]:
        """Every joint by its own last move, at once: readings that are not of the end of the motion look like that."""
        chain = self.chain
        places = [(place_index(name, chain), 5 if chain.revolute[j] else 2) for j, name in enumerate(chain.names)]
        columns = [
            self._unit(*where) * number for where, some in zip(places, self.arrived, strict=True) for number in some[:2]
        ]
        who = "all joints, or the readings' time (a filter, an average, a late clock)"
        yield self._at_rows(who, "the last move", np.stack(columns))

    def _loads(self) -> list[str]:
        kinds = ["payload", *(["load"] if self.at.arm.weighed else [])]
        return [*kinds, *(["effort"] if np.isfinite(self.samples.effort).all() else [])]

    def _single_waves(self, who: str, j: int, axis: list[tuple[int, int]]) -> Iterator[Pair]:
        """The wave of the joint's own position that stands out most, alone and as large as the joint's load."""
        unit = self._unit(*axis[0])
        name, q = self.chain.names[j], self.samples.q[:, j]
        numbers = [("", np.ones(self.N))]
        if self.at.arm.weighed:
            load = self.at.values(f"load:{name}")
            numbers.append((", as large as its load", load / max(float(np.abs(load).max()), 1e-12)))
        waves = Spectrum(q, 1.0, _CYCLES)
        own = np.sum(unit * self._residual(), axis=0)
        for how, number in numbers:
            sums = waves.sums((own * number)[:, None])[6:, :, 0]
            k = 6 + int(np.argmax(np.hypot(sums[:, 0], sums[:, 1])))
            wave = np.stack([np.sin(k * q), np.cos(k * q)]) * number
            yield self._pair(who, f"the position of {name} itself, {k} times a turn (a gear){how}", axis, wave)

    def _residual(self) -> Array:
        out = np.zeros((6, self.N))
        out[:3], out[3:, self.view.pose] = self.view.position, self.view.rotation
        return out

    def of_ends(self, constant: bool) -> Iterator[Pair]:
        """Tool and base."""
        tool, base = ([(place, d) for d in range(6)] for place in (self.chain.tool_place, 0))
        gravity, sight = self._down_in_tool(), self._sight_in_tool()
        for who, where in (("the tool", tool), ("the base", base)):
            if constant:
                yield self._pair(who, CONSTANT, where, self.one)
            yield self._pair(who, "the order of the stations", where, self.order)
            yield self._pair(who, "how the joints arrived", where, self.came)
            for signal in self.at.signal_names()[:_MAX_SIGNALS]:
                number = _curves(self.at.values(signal)[None])
                yield self._pair(who, f"what was recorded of {spoken_name(signal)}", where, number)
        yield self._pair("the tool", "how it is turned against gravity", tool, gravity)
        yield self._pair("the tool", "how it is turned against gravity", tool, np.sign(gravity))
        yield self._pair("the tool", "the side from which the tracker looks at it", tool, _curves(sight))
        moments = moments_on_base(self.at)
        yield self._pair("the base", "the moment of the arm's weight on it", base, moments)
        slip = slipped(self.samples, moments)
        yield self._pair("the base", "the previous moment of the arm's weight on it (slip)", base, slip)

    def of_places(self) -> Iterator[Pair]:
        """The tool with where it is and how it is turned in the cell, whatever brought it there."""
        tool = [(self.chain.tool_place, d) for d in range(6)]
        where = np.concatenate([_unit_spread(self._places()), self._turns()])
        yield self._pair("the tool (or the target on it)", "where it is and how it is turned in the cell", tool, where)

    def _places(self) -> Array:
        return np.asarray(self.view.f.p[-1])

    def _turns(self) -> Array:
        """Elements of the tool's orientation, and their cubes, (18, N)."""
        R = np.moveaxis(self.view.f.rotation(-1), 0, -1).reshape(9, self.N)
        return np.concatenate([R, R**3])

    def of_instrument(self) -> Iterator[Pair]:
        """Readings that depend on where the target is, from the instrument's origin."""
        x = self.view.expected  # (3, N), along the root's axes
        r = np.linalg.norm(x, axis=0)
        unit = r.mean()
        if unit == 0.0:  # sockets: the ball is always at their origin
            return
        radial = np.zeros((6, self.N))
        radial[:3] = x / np.maximum(r, 1e-9)
        powers = np.stack([np.ones_like(r), r / unit, (r / unit) ** 2, (r / unit) ** 3])
        who = "the tracker's readings"
        yield self._at_rows(who, "the distance from the tracker", powers[:, None] * radial)
        before = np.zeros_like(x)
        order = np.lexsort((self.samples.stamps, self.samples.frame))
        before[:, order[1:]] = np.diff(x[:, order], axis=1)
        moved = np.zeros((1, 6, self.N))
        moved[0, :3] = before
        yield self._at_rows(who, "the last move of the target (a filter, or a late clock)", moved)
        if len(self.view.pose):
            turns = np.zeros((3, len(self.order), 6, self.N))
            for axis in range(3):
                turns[axis, :, 3 + axis, self.view.pose] = self.order[:, self.view.pose].T
            alone = "the tracker's orientations alone"
            yield self._at_rows(alone, "the order of the stations", turns.reshape(-1, 6, self.N))
        z = (x - x.mean(axis=1, keepdims=True)) / np.maximum(x.std(axis=1, keepdims=True), 1e-9)
        one = [z[i] for i in range(3)]
        two = [z[i] * z[j] for i in range(3) for j in range(i + 1)]
        three = [z[i] * z[j] * z[k] for i in range(3) for j in range(i + 1) for k in range(j + 1)]
        along = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)[:, :, None]
        place = "the place of the target before the tracker"
        for some in (one, [*one, *two, *three]):
            yield self._read(who, place, np.stack(some), along)
        yield self._read(who, "how the target is turned", self._turns(), along)
        steps = self.order[-9::2]
        scales = np.stack([np.ones_like(r), *one])
        changed = (steps[:, None] * scales[None]).reshape(-1, self.N)
        yield self._read(who, "the order of the stations: their scale or their frame changed", changed, along)
        R_frame_root = (self.model.T_frame_base @ self.chain.T_base_root)[self.samples.frame, :3, :3]
        seen = np.einsum("nij,jn->in", R_frame_root, x)
        angles = [np.arctan2(seen[1], seen[0]), np.arcsin(np.clip(seen[2] / np.maximum(r, 1e-9), -1.0, 1.0))]
        waves = [f(k * a) * r / unit for a in angles for k in range(1, 5) for f in (np.sin, np.cos)]
        yield self._read(who, "the direction in which the tracker looks", np.stack(waves), along)

    def _down_in_tool(self) -> Array:
        R = self.view.f.rotation(-1)
        down = self.chain.T_base_root[:3, :3].T @ [0.0, 0.0, -1.0]
        return np.asarray(np.einsum("nji,j->in", R, down))

    def _sight_in_tool(self) -> Array:
        R = self.view.f.rotation(-1)
        x = self.view.expected
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-9)
        return np.asarray(np.einsum("nji,jn->in", R, x))

    def _over_order(self) -> Array:
        """Hats over the order of the stations, and a rest that dies away."""
        rank = np.argsort(np.argsort(self.samples.stamps, kind="stable"), kind="stable") / max(self.N - 1, 1)
        hats = np.maximum(1.0 - np.abs(rank * 8.0 - np.arange(9)[:, None]), 0.0)
        steps = np.stack([(rank > k / 10.0) * 1.0 for k in range(1, 10)])
        return np.concatenate([hats, steps])

    def _hats(self, q: Array) -> Array:
        low, high = float(q.min()), float(q.max())
        u = (q - low) / max(high - low, _SMALL) * (_HATS - 1)
        return np.maximum(1.0 - np.abs(u - np.arange(_HATS)[:, None]), 0.0)

    def _waves(self, j: int, count: int) -> Array:
        q = self.samples.q[:, j]
        if not self.chain.revolute[j]:
            q = (q - q.min()) * np.pi / max(float(np.ptp(q)), _SMALL)
        return np.concatenate([self.one, *[[np.sin(k * q), np.cos(k * q)] for k in range(1, count + 1)]])

    def _unit(self, place: int, direction: int) -> Array:
        row = self.view.unit_column(place, direction)
        out = np.zeros((6, self.N))
        out[:3] = row[: 3 * self.N].reshape(3, self.N)
        out[3:, self.view.pose] = row[3 * self.N :].reshape(3, -1)
        return out

    def _pair(self, who: str, driver: str, where: list[tuple[int, int]], numbers: Array) -> Pair:
        unit = np.stack([self._unit(place, direction)[:, self.rows] for place, direction in where])
        columns = unit[:, None] * numbers[None, :, None, self.rows]
        return Pair(who, driver, columns.reshape(-1, 6, len(self.rows)))

    def _at_rows(self, who: str, driver: str, columns: Array) -> Pair:
        """The pair of columns (D, 6, N) of all samples."""
        return Pair(who, driver, columns[..., self.rows])

    def _read(self, who: str, driver: str, numbers: Array, along: Array) -> Pair:
        """The pair of numbers (c, N) along directions (d, 6, 1)."""
        return Pair(who, driver, _along(numbers[:, self.rows], along))


def _along(numbers: Array, along: Array) -> Array:
    """Columns (c × d, 6, N) of numbers (c, N) along directions (d, 6, 1)."""
    return np.asarray((numbers[:, None, None] * along[None]).reshape(-1, 6, numbers.shape[-1]))


def _unit_spread(x: Array) -> Array:
    return np.asarray((x - x.mean(axis=1, keepdims=True)) / np.maximum(x.std(axis=1, keepdims=True), _SMALL))


def _curves(numbers: Array) -> Array:
    """Numbers (c, N) in units of their spread, their squares, and their signs."""
    numbers = np.nan_to_num(numbers)
    x = (numbers - numbers.mean(axis=1, keepdims=True)) / np.maximum(numbers.std(axis=1, keepdims=True), 1e-12)
    return np.concatenate([x, x**2, np.sign(numbers)])
