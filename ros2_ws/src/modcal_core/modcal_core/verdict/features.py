"""Features for a regressor that knows no physics: motions of the tool times functions of everything that was recorded.

A motion of the tool is a small twist at the base, at the tool, or at a joint, along any direction; that is geometry,
and any residual whatever can be written so. The functions know nothing of gears, springs or heat: low waves of joint
positions, smooth random functions of posture (Rahimi & Recht 2007), waves in the order of the stations and in time, the
way joints arrived, torques, and each recorded signal with what of it the posture does not tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.diagnosis import moments_on_base, play, slipped
from modcal_core.effects import periodic, place_index
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, moving_beside, others_at, spoken_name

_OWN_WAVES = 6  # waves a turn of a joint's own position
_SMOOTH = 16  # random functions of the whole posture
_NEAR = 40  # the same of neighbours in posture
_FREQUENCIES = 0.6, 2.0  # rad per deviation of the postures: less than half a wave over most of them, and more than one
_NEAR_STATIONS = 300  # stations from which neighbours in posture are close enough to say anything
_SLOW, _FAST = 4, 44  # waves over the order of the stations
_MAX_WAVES = 130  # waves a turn of a joint's own position, where single ones are looked for
_LOADED_WAVES = 60  # the same of errors that grow with the joint's load
_MAX_COLUMNS = 300  # of a group; more are mixed at random, which keeps their products
_MAX_NAMED = 6  # signals that a sentence names
_MAX_SIGNALS = 40  # for time
_MAX_BESIDE = 14  # other joints, for time: another two arms of seven
_CUTS = (0.25, 0.5, 0.75)  # of the order of the stations, at which everything may have become another


@dataclass(frozen=True)
class Group:
    """Columns that belong together, each of which may matter a little. name: for a person, after "can be predicted
    from". columns: (D, 6, N).
    """

    name: str
    columns: Array


@dataclass(frozen=True)
class Waves:
    """Very many columns, a few of which may matter: in each part all motions (k, 6, N) times all numbers (c, N).

    Columns are numbered part after part, motion after motion.
    """

    motions: tuple[Array, ...]
    numbers: tuple[Array, ...]

    def squares(self) -> Array:
        """Squared lengths of the columns, (D,)."""
        parts = zip(self.motions, self.numbers, strict=True)
        return np.concatenate([(np.sum(u**2, axis=1) @ (x**2).T).ravel() for u, x in parts])

    def written(self, which: np.ndarray) -> Array:
        """The columns of these numbers (k,), in full, (k, 6, N)."""
        ends = np.cumsum([0, *(len(u) * len(x) for u, x in zip(self.motions, self.numbers, strict=True))])
        out = np.empty((len(which), 6, self.numbers[0].shape[-1]))
        for first, last, u, x in zip(ends[:-1], ends[1:], self.motions, self.numbers, strict=True):
            here = (which >= first) & (which < last)
            motion, number = np.divmod(which[here] - first, len(x))
            out[here] = u[motion] * x[number][:, None]
        return out


def groups(model: Model, samples: Samples, weight: Array) -> Iterator[Group]:
    """The groups of these samples. weight: of their six components, (6, N)."""
    builder = _GroupBuilder(model, samples, weight)
    yield builder.own_positions()
    yield builder.other_positions()
    yield builder.posture()
    if samples.stations >= _NEAR_STATIONS:
        yield builder.neighbours()
    yield builder.order(0, _SLOW)
    yield builder.order(_SLOW, _FAST)
    for group in (builder.history(), builder.slip(), builder.load(), builder.signals()):
        if group is not None:
            yield group


def on_the_way(model: Model, samples: Samples, weight: Array, by_parameters: Array) -> Group:
    """Parameters of the model, and scales and shears of the readings, that are others from some station on (Chow 1960).

    by_parameters: derivatives of the samples by the parameters, in units of the noise, (K, 6, N).
    """
    return _GroupBuilder(model, samples, weight).on_the_way(by_parameters)


def single_waves(model: Model, samples: Samples, weight: Array) -> Iterator[tuple[str, Waves]]:
    """Every joint's axis with each wave of its own position, alone and times its load; all with waves of two joints.
    And base and tool with those of other joints that move beside the arm, whose weight may bend what both stand on.

    With what they are called, as text. weight: of the samples' six components, (6, N).
    """
    builder = _GroupBuilder(model, samples, weight)
    yield "single waves of the joint positions", builder.single_waves()
    beside = moving_beside(samples)[:_MAX_BESIDE]
    if beside:
        yield f"single waves of the positions of {_listed(beside)}", builder.waves_beside()


class _GroupBuilder:
    """What all groups of some samples share."""

    def __init__(self, model: Model, samples: Samples, weight: Array) -> None:
        self.samples, self.weight = samples, weight
        self.at = model.drivers(samples)
        self.view = RowView.of(model, samples, self.at)
        chain = model.chain
        self.chain = chain
        self.places = [place_index(name, chain) for name in chain.names]
        self.axis = [5 if turns else 2 for turns in chain.revolute]
        self.tool = chain.tool_place
        self.rng = np.random.default_rng(0)
        self.z = _standard(samples.q.T)

    def own_positions(self) -> Group:
        """Every joint's axis with waves of its own position, its other directions with the lowest; and constants."""
        parts = []
        for j, (place, axis) in enumerate(zip(self.places, self.axis, strict=True)):
            waves = np.concatenate([np.ones((1, len(self.samples))), self._waves(j, _OWN_WAVES)])
            parts.append(self._times([(place, axis)], waves))
            others = [(place, d) for d in range(6) if d != axis and self._moves(place)]
            parts.append(self._times(others, waves[:3]))
        return self._group("each joint's own position", parts)

    def other_positions(self) -> Group:
        """Every joint's axis with low waves of the other joints."""
        waves = [self._waves(i, 2) for i in range(self.chain.n)]
        parts = []
        for j, (place, axis) in enumerate(zip(self.places, self.axis, strict=True)):
            parts.append(self._times([(place, axis)], np.concatenate([w for i, w in enumerate(waves) if i != j])))
        return self._group("the positions of the other joints", parts)

    def posture(self) -> Group:
        """Base and tool with smooth functions of the whole posture, a constant among them."""
        smooth = np.concatenate([np.ones((1, len(self.samples))), self._random(_SMOOTH, _FREQUENCIES[0])])
        return self._group("the posture", [self._times(self._ends(), smooth)])

    def neighbours(self) -> Group:
        """The tool with functions of the posture that change from one station to its neighbours."""
        return self._group(
            "neighbours in posture", [self._times(self._ends()[6:], self._random(_NEAR, _FREQUENCIES[1]))]
        )

    def order(self, first: int, last: int) -> Group:
        """Waves over the order of the stations, first < waves <= last: slow ones, and time, with base, tool and joints,
        fast ones with the base alone.
        """
        rank = _rank(self.samples)
        last = min(last, self.samples.stations // 2)
        waves = [np.cos(np.pi * k * rank) for k in range(first + 1, last + 1)]
        where = self._ends()[:6]
        if not first:
            where = [*self._ends(), *zip(self.places, self.axis, strict=True)]
            stamps = self.samples.stamps - self.samples.stamps.min()
            if np.ptp(stamps) > 0.0:
                share = stamps / np.ptp(stamps)
                waves += [share, np.exp(-10.0 * share)]
        parts = [self._times(where, np.stack(waves))]
        if not first and len(self.view.pose):
            parts.append(self._turned(np.stack(waves)))
        return self._group("the order of the stations", parts)

    def on_the_way(self, by_parameters: Array) -> Group:
        """See the function of this name."""
        x = self.view.expected
        x = (x - x.mean(axis=1, keepdims=True)) / max(float(x.std()), 1e-12)
        scales = np.zeros((3, 3, 6, len(self.samples)))
        for i in range(3):
            scales[:, i, i] = x
        scales = scales.reshape(9, 6, -1) * self.weight
        rank = _rank(self.samples)
        parts = [np.where(rank > cut, 1.0, -1.0) * columns for cut in _CUTS for columns in (by_parameters, scales)]
        return self._group("the order of the stations: parameters of the model, or the readings, changed", parts)

    def history(self) -> Group | None:
        """Joints, base and tool with the way joints arrived, how far they came, and how fast they move."""
        s = self.samples
        order = np.lexsort((s.stamps, s.frame))
        step = np.zeros_like(s.q)
        step[order[1:]] = np.diff(s.q[order], axis=0)
        come = np.where((s.approach != 0.0).any(axis=1)[:, None], s.approach, np.sign(step)).T
        numbers = [come, _standard(step.T)]
        if s.moving.any():
            speed = np.nan_to_num(s.velocity).T
            numbers += [_standard(speed), np.sign(speed), _standard(s.acceleration.T)]
        axes = list(zip(self.places, self.axis, strict=True))
        parts = [self._times(axes, come), self._times(self._ends(), come)]
        apart = _standard(s.following.T)
        if apart.any():
            numbers.append(apart)
        for some in numbers[1:]:
            parts += [self._times([axes[j]], some[j : j + 1]) for j in range(len(axes))]
        if not s.moving.any():
            parts += [self._times([axis], _standard(ahead)) for axis, ahead in zip(axes, play(s), strict=True)]
        return self._group("how the joints arrived and moved", parts)

    def slip(self) -> Group | None:
        """The base with what its load leaves behind where it slips."""
        if self.samples.moving.any():
            return None
        moments = _standard(slipped(self.samples, moments_on_base(self.at)))
        base = [(0, d) for d in range(6)]
        return self._group("the previous load on the base", [self._times(base, moments)])

    def load(self) -> Group | None:
        """Every joint's directions with its torques: of a weight at the tip, of the arm, and as the actuators say."""
        parts = []
        kinds = ["payload", *(["load"] if self.at.arm.weighed else [])]
        if np.isfinite(self.samples.effort).any():
            kinds.append("effort")
        for name, place, axis in zip(self.samples.names, self.places, self.axis, strict=True):
            numbers: list[Array] = []
            for kind in kinds:
                torque = self.at.values(f"{kind}:{name}")
                numbers += [torque, np.sign(torque)] if kind == "effort" else [torque]
            parts.append(self._times([(place, axis)], _standard(np.stack(numbers))))
            if self._moves(place):
                others = [(place, d) for d in range(3, 6) if d != axis]
                parts.append(self._times(others, _standard(np.stack(numbers))))
        return self._group("the load of the joints", parts)

    def signals(self) -> Group | None:
        """Base, tool and joints with each recorded signal, its waves, and what of it the posture does not tell."""
        names = self.at.signal_names()[:_MAX_SIGNALS]
        if not names:
            return None
        x = np.stack([self.at.values(name) for name in names])
        design = np.concatenate([np.ones((1, x.shape[1])), self.samples.q.T])
        beyond = x - (x @ np.linalg.pinv(design)) @ design
        small = beyond.std(axis=1) < 1e-9 * np.maximum(np.abs(x).max(axis=1), 1e-300)
        beyond[small] = 0.0
        numbers = np.concatenate([_standard(x), _standard(beyond), np.sin(x), np.cos(x)])
        numbers = _standard(numbers[numbers.std(axis=1) > 1e-12])
        if not len(numbers):
            return None
        where = [*self._ends(), *zip(self.places, self.axis, strict=True)]
        said = f"what was recorded of {_listed([spoken_name(name) for name in names])}"
        return self._group(said, [self._times(where, numbers)])

    def single_waves(self) -> Waves:
        """See the function of this name."""
        axes = list(zip(self.places, self.axis, strict=True))
        motions = [self._motions([axis]) for axis in axes]
        numbers = [self._waves(j, _MAX_WAVES)[2 * _OWN_WAVES :] for j in range(len(axes))]
        if self.at.arm.weighed:  # teeth and pins bend under load
            for j, (name, axis) in enumerate(zip(self.chain.names, axes, strict=True)):
                load = _standard(self.at.values(f"load:{name}")[None])
                if load.any():
                    motions.append(self._motions([axis]) * load)
                    numbers.append(self._waves(j, _LOADED_WAVES))
        turns = [self._waves(j, 1) for j in range(self.chain.n)]
        both = [a * b for i, x in enumerate(turns) for y in turns[:i] for a in x for b in y]
        if both:
            motions.append(self._motions([*axes, *self._ends()]))
            numbers.append(np.stack(both))
        return Waves(tuple(motions), tuple(numbers))

    def waves_beside(self) -> Waves:
        """Base and tool with waves of the other joints that were recorded, alone and two at a time."""
        q = others_at(self.samples)[:, :_MAX_BESIDE]
        turns = [periodic("sine", np.ones(1), column).reshape(2, -1) for column in q.T]
        both = [a * b for i, x in enumerate(turns) for y in turns[:i] for a in x for b in y]
        return Waves((self._motions(self._ends()),), (np.stack([*(wave for x in turns for wave in x), *both]),))

    def _ends(self) -> list[tuple[int, int]]:
        """All directions of base and tool."""
        return [(place, d) for place in (0, self.tool) for d in range(6)]

    def _moves(self, place: int) -> bool:
        """Whether twists of every direction make sense there: not at a Delta's shoulder."""
        return place not in self.view.f.loops

    def _waves(self, j: int, count: int) -> Array:
        """Waves (2 count, N) of a joint's position; of a sliding one over its range."""
        q = self.samples.q[:, j]
        if not self.chain.revolute[j]:
            q = (q - q.min()) * np.pi / max(float(np.ptp(q)), 1e-9)
        return periodic("sine", np.arange(1.0, count + 1.0), q).reshape(2 * count, -1)

    def _random(self, count: int, frequency: float) -> Array:
        """Random waves (count, N) of the posture in units of its spread, with about this frequency [rad]."""
        n = len(self.z)
        direction = self.rng.normal(size=(count, n)) * frequency / np.sqrt(max(n, 1) / 3.0)
        return np.asarray(np.cos(direction @ self.z + self.rng.uniform(0.0, 2.0 * np.pi, (count, 1))))

    def _times(self, where: list[tuple[int, int]], numbers: Array) -> Array:
        """Columns (places × numbers, 6, N)."""
        N = len(self.samples)
        if not where:
            return np.empty((0, 6, N))
        return (self._motions(where)[:, None] * numbers[None, :, None, :]).reshape(-1, 6, N)

    def _motions(self, where: list[tuple[int, int]]) -> Array:
        """Motions of the tool (k, 6, N) per unit of these directions at these places."""
        return np.stack([self._unit(place, direction) for place, direction in where])

    def _turned(self, numbers: Array) -> Array:
        """Columns (3 × numbers, 6, N) of orientations alone, about the root's axes: positions are as they were."""
        out = np.zeros((3, len(numbers), 6, len(self.samples)))
        for axis in range(3):
            out[axis, :, 3 + axis, self.view.pose] = numbers[:, self.view.pose].T
        return np.asarray((out * self.weight).reshape(-1, 6, len(self.samples)))

    def _unit(self, place: int, direction: int) -> Array:
        N = len(self.samples)
        if place in self.view.f.loops:
            direction = 5 if self.chain.revolute[self.places.index(place)] else direction
        row = self.view.unit_column(place, direction)
        out = np.zeros((6, N))
        out[:3] = row[: 3 * N].reshape(3, N)
        out[3:, self.view.pose] = row[3 * N :].reshape(3, -1)
        return out * self.weight

    def _group(self, name: str, parts: list[Array]) -> Group:
        columns = np.concatenate(parts)
        size = np.sqrt(np.einsum("dcn,dcn->d", columns, columns))
        columns = columns[size > 1e-9 * size.max(initial=1e-300)]
        if len(columns) > _MAX_COLUMNS:
            read = self.weight.any(axis=1)  # of points three of the six components are nothing
            flat = columns[:, read].reshape(len(columns), -1)
            length = np.sqrt(np.einsum("dr,dr->d", flat, flat))
            mix = self.rng.normal(size=(_MAX_COLUMNS, len(flat))) / np.sqrt(_MAX_COLUMNS)
            columns = np.zeros((_MAX_COLUMNS, *columns.shape[1:]))
            columns[:, read] = ((mix / length) @ flat).reshape(_MAX_COLUMNS, -1, columns.shape[2])
        return Group(name, columns)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"{', '.join(names[:_MAX_NAMED])}{more}"


def _standard(x: Array) -> Array:
    """Rows (c, N) of mean zero and deviation one; zero where they do not change."""
    x = np.nan_to_num(x)
    x = x - x.mean(axis=1, keepdims=True)
    size = x.std(axis=1, keepdims=True)
    return np.asarray(np.where(size > 1e-12, x / np.maximum(size, 1e-300), 0.0))


def _rank(samples: Samples) -> Array:
    """Order in time of each sample's station, 0 … 1, (N,)."""
    stations, of = np.unique(samples.station, return_inverse=True)
    first = np.full(len(stations), np.inf)
    np.minimum.at(first, of, samples.stamps)
    rank = np.empty(len(stations))
    rank[np.argsort(first, kind="stable")] = np.arange(len(stations))
    return np.asarray(rank[of] / max(len(stations) - 1, 1))
