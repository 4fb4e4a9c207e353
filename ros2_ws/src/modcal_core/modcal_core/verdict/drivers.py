"""What the rest may go with: every place with every driver that was recorded, as motions of the place by the driver.

A *place* is what errs: a joint about its axis, a link in all directions, tool, base, the instrument. A *driver* is what
the error goes with: positions, how joints arrived, the order of the stations, a load, gravity, a signal, the place of
the target as the model expects it. No driver holds a reading or a residual. The functions know nothing of gears,
springs or heat: low waves, hats, random functions of the posture (Rahimi & Recht 2007), and what of a signal the
posture does not tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, combinations_with_replacement, pairwise
from typing import cast

import numpy as np

from modcal_core.calibration import station_numbers
from modcal_core.diagnosis import last_moves, moments_on_base, paths, since_last, slipped
from modcal_core.effects import periodic
from modcal_core.geometry import Array
from modcal_core.measurements import RANGE, moving_beside, others_at, spoken_name
from modcal_core.verdict.rest import Rest

CONSTANT = ""  # the driver of an error that depends on nothing
OWN_WAVES = 6  # waves a turn of a joint's own position
_SMOOTH, _NEAR = 16, 40  # random functions of the whole posture, and of neighbours in it
_FREQUENCIES = 0.6, 2.0  # rad per deviation of the postures: less than half a wave over most of them, and more than one
_NEAR_STATIONS = 300  # stations from which neighbours in posture are close enough to say anything
_SLOW, _FAST = 4, 44  # waves over the order of the stations
_MAX_WAVES, _LOADED_WAVES = 130, 60  # waves a turn that are looked for alone, and times the joint's load
ON_BASE = "the moment of the arm's weight on it"
OTHER_JOINTS = "the positions of the other joints"
_MAX_SIGNALS, _MAX_BESIDE, _MAX_NAMED = 40, 14, 6  # signals, other joints, names in a sentence
_CUTS = (0.25, 0.5, 0.75)  # of the order of the stations, at which everything may have become another
_HATS = 9  # over a range
_WIDTHS = slice(3, None, 2)  # of followers with play, that are asked for: every other, from 3° on
MIN_OF_FRAME, _MAX_FRAMES = 12, 6  # readings of an instrument that tell its nine numbers of scale; instruments


@dataclass(frozen=True)
class Part:
    """A place with a driver. columns: (D, 6, N). group: of parts that are asked together, each of which may matter a
    little, as text after "can be predicted from"; empty where the part is asked alone. place: empty where a part names
    nothing by itself.
    """

    group: str
    place: str
    driver: str
    columns: Array

    @property
    def name(self) -> str:
        """Place and driver, as text."""
        return f"{self.place} by {self.driver or 'a constant'}"


class PlaceDrivers:
    """All parts of a rest."""

    def __init__(self, rest: Rest) -> None:
        self.rest, self.samples, self.chain = rest, rest.samples, rest.chain
        self.at = rest.model.drivers(rest.samples)
        self.N = len(rest.samples)
        self.one = np.ones((1, self.N))
        self.rng = np.random.default_rng(0)
        # order in time of each sample's station, 0 … 1
        self.rank = station_numbers(rest.samples) / max(rest.samples.stations - 1, 1)
        # whether it is later than a tenth, two, ... of them, (9, N)
        self.later: Array = (self.rank > np.arange(1, 10)[:, None] / 10.0).astype(float)
        self.axes = [rest.axis(j) for j in range(self.chain.n)]
        self.base, self.tool = rest.body(0), rest.body(self.chain.tool_place)
        self.turn = np.moveaxis(rest.view.f.rotation(-1), 0, -1)  # orientations of the tip, (3, 3, N)
        self.flat = self.turn.reshape(9, self.N)
        self.down = np.einsum("jin,j->in", self.turn, self.chain.T_base_root[:3, :3].T @ [0.0, 0.0, -1.0])
        self.sight = np.einsum("jin,jn->in", self.turn, _unit(rest.view.expected))  # the beam along the tip's axes
        self.ends = ("the tool", self.tool), ("the base", self.base)
        step, approach = last_moves(self.samples), self.samples.approach
        self.came = np.where(approach.any(axis=1, keepdims=True), approach, np.sign(step)).T
        self.step = _standard(step.T)

    def grouped(self) -> Iterator[Part]:
        """Parts of groups, which tell how much of the rest is predictable."""
        yield from self._positions()
        yield from self._order()
        yield from self._history()
        yield from self._loads()
        yield from self._signals()
        yield from self._instrument()

    def alone(self, constant: bool) -> Iterator[Part]:
        """Parts that say where to look, beside those of groups. constant: whether constant errors are asked for, as of
        a model that was not fitted to these samples.
        """
        for j, name in enumerate(self.chain.names):
            who, own = f"joint {name}", f"the position of {name} itself"
            if constant:
                yield _part("", who, CONSTANT, [self.axes[j]], self.one)
            yield _part("", who, own, [self.axes[j]], _hats(self.samples.q[:, j]))
            every = self._directions(j)
            yield _part("", f"{who} across its axis too", own, every, np.concatenate([self.one, self._waves(j, 2)]))
            sizes = {"": self.one[0]}
            if self.at.arm.weighed:
                sizes[", as large as its load"] = self.at.values(f"load:{name}")
            for how, number in sizes.items():
                k, wave = self._loudest(j, number)
                yield _part("", who, f"{own}, {k} times a turn (a gear){how}", [self.axes[j]], wave)
        for who, body in self.ends if constant else ():
            yield _part("", who, CONSTANT, body, self.one)
        moved = np.stack([u * x for j, u in enumerate(self.axes) for x in (self.came[j], self.step[j])])
        yield Part("", "all joints, or the readings' time (a filter, an average, a late clock)", "the last move", moved)
        yield _part("", "the tool", "how it is turned against gravity", self.tool, np.r_[self.down, np.sign(self.down)])
        yield _part("", "the tool", "the side from which the tracker looks at it", self.tool, _curves(self.sight))
        yield _part("", "the base", ON_BASE, self.base, moments_on_base(self.at))
        where = np.concatenate([_standard(np.asarray(self.rest.view.f.p[-1])), self.flat, self.flat**3])
        who = "the tool (or the target on it)"
        yield _part("", who, "where it is and how it is turned in the cell", self.tool, where)

    def beside(self) -> Iterator[Part]:
        """Joints with the position of a neighbour, whose cables and links run through both."""
        for i, j in (*pairwise(range(self.chain.n)), *pairwise(reversed(range(self.chain.n)))):
            driver = f"the position of {self.chain.names[j]}"
            yield _part("", f"joint {self.chain.names[i]}", driver, [self.axes[i]], self._waves(j, 2))

    def changed(self, by_parameters: Array) -> Iterator[Part]:
        """Parameters of the model, scales and shears of the readings, that are others from some station on (Chow 1960),
        or through one instrument than through the others.

        by_parameters: derivatives of the samples by the parameters, in units of the noise, (K, 6, N).
        """
        x = self.rest.view.expected
        x = (x - x.mean(axis=1, keepdims=True)) / max(float(x.std()), 1e-12)
        scales = self._scales(x)
        sides = np.stack([np.where(self.rank > cut, 1.0, -1.0) for cut in _CUTS])
        group = "the order of the stations: parameters of the model, or the readings, changed"
        yield _part(group, "", "", np.concatenate([by_parameters, scales]), sides)
        frame, names = self.samples.frame, self.samples.frames
        seen = np.flatnonzero(np.bincount(frame, minlength=len(names)) >= MIN_OF_FRAME).tolist()
        if not 2 <= len(seen) <= _MAX_FRAMES or self.samples.sockets:
            return
        x = self.rest.view.expected.copy()
        for f in seen:
            x[:, frame == f] -= x[:, frame == f].mean(axis=1, keepdims=True)
        own = np.concatenate([by_parameters, self._scales(x / max(float(x.std()), 1e-12))])
        for f in seen if len(seen) > 2 else seen[:1]:
            these = f"frame '{names[f]}' do" if len(seen) > 2 else f"frames '{names[f]}' and '{names[seen[1]]}' do"
            group = f"which instrument reads it: those in {these} not agree in scale, shape or target"
            yield _part(group, "", "", own, np.where(frame == f, 1.0, -1.0)[None])

    def waves(self) -> Iterator[Part]:
        """Very many columns, a few of which may matter: every joint's axis with each wave of its own position, alone
        and times its load; all with waves of two joints. And base and tool with those of other joints that move beside
        the arm, whose weight may bend what both stand on. In single precision.
        """
        of = "single waves of the joint positions"
        found: list[tuple[Sequence[Array] | Array, Array]] = []
        for j, axis in enumerate(self.axes):
            found.append(([axis], self._waves(j, _MAX_WAVES)[2 * OWN_WAVES :]))
        for j, name in enumerate(self.chain.names if self.at.arm.weighed else ()):  # teeth and pins bend under load
            load = _standard(self.at.values(f"load:{name}")[None])
            if load.any():
                found.append(([self.axes[j] * load], self._waves(j, _LOADED_WAVES)))
        both = _pairs([self._waves(j, 1) for j in range(self.chain.n)])
        if len(both):
            found.append((np.concatenate([np.stack(self.axes), self.base, self.tool]), both))
        yield Part(of, "", "", np.concatenate([_part(of, "", "", *_single(*some)).columns for some in found]))
        beside = moving_beside(self.samples)[:_MAX_BESIDE]
        if beside:
            turns = [periodic("sine", np.ones(1), q).reshape(2, -1) for q in others_at(self.samples)[:, :_MAX_BESIDE].T]
            numbers = np.concatenate([*turns, *([both] if len(both := _pairs(turns)) else [])])
            of = f"single waves of the positions of {_listed(beside)}"
            yield _part(of, "", "", *_single(self.rest.ends(), numbers))

    def _positions(self) -> Iterator[Part]:
        own, others = "each joint's own position", OTHER_JOINTS
        low = [self._waves(j, 2) for j in range(self.chain.n)]
        for j, name in enumerate(self.chain.names):
            number = np.concatenate([self.one, self._waves(j, OWN_WAVES)])
            yield _part(own, f"joint {name}", f"the position of {name} itself", [self.axes[j]], number)
            yield _part(own, "", "", self._directions(j, axis=False), number[:3])
            if self.chain.n > 1:
                number = np.concatenate([w for i, w in enumerate(low) if i != j])
                yield _part(others, f"joint {name}", others, [self.axes[j]], number)
        number = np.concatenate([self.one, self._random(_SMOOTH, _FREQUENCIES[0])])
        yield _part("the posture", "", "", self.rest.ends(), number)
        if self.samples.stations >= _NEAR_STATIONS:
            yield _part("neighbours in posture", "", "", self.tool, self._random(_NEAR, _FREQUENCIES[1]))

    def _order(self) -> Iterator[Part]:
        """Slow waves over the order of the stations, and time, with base, tool, joints and orientations; fast ones with
        the base alone.
        """
        order = "the order of the stations"
        waves = np.stack([np.cos(np.pi * k * self.rank) for k in range(1, min(_FAST, self.samples.stations // 2) + 1)])
        slow = list(waves[:_SLOW])
        stamps = self.samples.stamps - self.samples.stamps.min()
        if np.ptp(stamps) > 0.0:
            slow += [stamps / np.ptp(stamps), np.exp(-10.0 * stamps / np.ptp(stamps))]
        number = np.stack(slow)
        for who, body in self.ends:
            yield _part(order, who, order, body, number)
        for name, axis in zip(self.chain.names, self.axes, strict=True):
            yield _part(order, f"joint {name}", f"{order}: {name} changed on the way", [axis], number)
        if len(self.rest.view.pose):
            alone = self.rest.turned(np.eye(3)[..., None] * self.one)
            yield _part(order, "the tracker's orientations alone", order, alone, number)
        if len(waves) > _SLOW:
            yield _part(f"fast waves over {order}", "the base", order, self.base, waves[_SLOW:])
        hats = np.concatenate([_hats(self.rank), self.later])
        for who, body in self.ends:
            yield _part(f"stretches and steps of {order}", who, order, body, hats)

    def _history(self) -> Iterator[Part]:
        """Joints, base and tool with the way joints arrived, how far they came, and how fast they move."""
        s, group = self.samples, "how the joints arrived and moved"
        speed = np.nan_to_num(s.velocity).T
        own = [self.came, self.step, *([np.sign(speed)] if s.moving.any() else [])]
        followed = paths(s).mean(axis=2)[:, :, _WIDTHS]
        near = [np.sign(self.step) * np.exp(-np.abs(last_moves(s).T) / width) for width in (0.2, 0.8)]
        own += [x for x in (_standard(s.following.T), *near) if x.any()]
        for j, name in enumerate(self.chain.names):
            number = np.stack([x[j] for x in own])
            number = np.concatenate([number, _standard(followed[:, j].T)])
            driver = f"how {name} arrived (backlash, friction, hysteresis)"
            yield _part(group, f"joint {name}", driver, [self.axes[j]], number)
            yield _part(group, "", "", [self.axes[j]], self.came)
        for who, body in self.ends:
            yield _part(group, who, "how the joints arrived", body, self.came)
        if s.moving.any():
            fast = _standard(speed), _standard(s.mean_acceleration.T)
            for j, name in enumerate(self.chain.names):
                number = np.stack([x[j] for x in fast])
                yield _part(group, f"joint {name}", f"how fast {name} moves (a lag, a spring)", [self.axes[j]], number)
            yield _part(group, "the tool", "how it is accelerated", self.tool, _standard(self.at.tip_motion[0]))
        else:
            driver = "the previous moment of the arm's weight on it (slip)"
            number = _standard(slipped(s, moments_on_base(self.at)))
            yield _part("the previous load on the base", "the base", driver, self.base, number)
            before, creeps = "the load at the station before", "its load at the station before (creep)"
            yield _part(before, "the tool", creeps, self.tool, since_last(s, self.down.T).T)
            for name, axis in zip(self.chain.names, self.axes, strict=True):
                load = self.at.values(f"{'load' if self.at.arm.weighed else 'payload'}:{name}")
                yield _part(before, f"joint {name}", creeps, [axis], _standard(since_last(s, load[:, None]).T))

    def _loads(self) -> Iterator[Part]:
        """Every joint's directions with its torques: of a weight at the tip, of the arm, and as the actuators say."""
        group = "the load of the joints"
        kinds = ["payload", *(["load"] if self.at.arm.weighed else [])]
        kinds += ["effort"] if np.isfinite(self.samples.effort).any() else []
        for j, name in enumerate(self.chain.names):
            number = _curves(np.stack([self.at.values(f"{kind}:{name}") for kind in kinds]))
            yield _part(group, f"joint {name}", f"the load of {name}", [self.axes[j]], number)
            across = self._directions(j, axis=False)
            yield _part(group, "", "", across[3:] if len(across) > 3 else across, number[: len(kinds)])
        names = self.chain.names
        weighs = [u * self.at.values(f"payload:{name}") for u, name in zip(self.axes, names, strict=True)]
        driver = "another load from some station on (a payload)"
        yield _part(f"{group}, another from some station on", "all joints", driver, weighs, self.later)

    def _signals(self) -> Iterator[Part]:
        """Base, tool and joints with each recorded signal, its waves, and what of it the posture does not tell."""
        names = self.at.signal_names()[:_MAX_SIGNALS]
        if not names:
            return
        x = np.stack([self.at.values(name) for name in names])
        design = np.concatenate([self.one, self.samples.q.T])
        beyond = x - (x @ np.linalg.pinv(design)) @ design
        beyond[beyond.std(axis=1) < 1e-9 * np.maximum(np.abs(x).max(axis=1), 1e-300)] = 0.0
        group = f"what was recorded of {_listed([spoken_name(name) for name in names])}"
        joints = [(f"joint {name}", axis[None]) for name, axis in zip(self.chain.names, self.axes, strict=True)]
        for name, value, rest in zip(names, x, beyond, strict=True):
            number = _standard(np.stack([value, rest, np.sin(value), np.cos(value), _standard(value[None])[0] ** 2]))
            for who, body in (*self.ends, *joints):
                yield _part(group, who, f"what was recorded of {spoken_name(name)}", body, number)

    def _instrument(self) -> Iterator[Part]:
        """Readings with where the target is expected, from the instrument's origin, and with its last move there."""
        x, who = self.rest.view.expected, "the tracker's readings"
        r = np.linalg.norm(x, axis=0)
        if not r.any() or self.samples.sockets:  # the ball is always at a socket's origin
            return
        frame, own = self.samples.frame, self.samples.kind == RANGE
        ranged = [f for f in np.unique(frame).tolist() if own[frame == f].all()]
        for f in ranged if len(ranged) > 1 else ():
            here, name = frame == f, self.samples.frames[f]
            way, group = self.rest.read(_unit(x) * here)[None], f"what '{name}' reads and where it points"
            z = _standard(np.where(here, x, x[:, here].mean(axis=1, keepdims=True)))
            two = np.concatenate([self.one, _monomials(z, 2)])
            length = np.concatenate([self.one, _hats(np.where(here, r, r[here].mean()))])
            yield _part(group, f"'{name}'", "its own length", way, length)
            yield _part(group, f"'{name}'", "where it points", way, two)
        if ranged:
            return
        group, place = "the place of the target before the tracker", "the place of the target before the tracker"
        z, along, unit = _standard(x), self.rest.read(np.eye(3)[..., None] * self.one), r.mean()
        powers = np.stack([np.ones_like(r), r / unit, (r / unit) ** 2, (r / unit) ** 3])
        yield _part(group, who, "the distance from the tracker", self.rest.read(_unit(x))[None], powers)
        yield _part(group, who, place, along, _monomials(z, 3))
        yield _part("", who, place, along, z)
        yield _part("", who, "how the target is turned", along, np.concatenate([self.flat, self.flat**3]))
        group = "the side from which the tracker sees the target (the angle of the beam, or the target's roll)"
        yield _part(group, who, group, self.rest.read(_unit(x))[None], _monomials(self.sight, 3))
        yield _part(group, "", "", along, _monomials(self.sight, 2))
        T = (self.rest.model.T_frame_base @ self.chain.T_base_root)[self.samples.frame, :3, :3]
        seen = np.einsum("nij,jn->in", T, x)
        angles = [np.arctan2(seen[1], seen[0]), np.arcsin(np.clip(seen[2] / np.maximum(r, 1e-9), -1.0, 1.0))]
        waves = [f(k * a) * r / unit for a in angles for k in range(1, 5) for f in (np.sin, np.cos)]
        yield _part(group, who, "the direction in which the tracker looks", along, np.stack(waves))
        order = np.lexsort((self.samples.stamps, self.samples.frame))
        move = np.zeros_like(x)
        move[:, order[1:]] = np.diff(x[:, order], axis=1)
        driver = "the last move of the target (a filter, or a late clock)"
        yield _part("", who, driver, self.rest.read(move)[None], self.one)
        cuts = self.rank > np.array([0.2, 0.4, 0.5, 0.6, 0.8])[:, None]
        steps = (cuts[:, None] * np.concatenate([self.one, z])).reshape(-1, self.N)
        yield _part("", who, "the order of the stations: their scale or their frame changed", along, steps)

    def _scales(self, x: Array) -> Array:
        """Scales and shears (9, 6, N) of readings x (3, N)."""
        out = np.zeros((3, 3, 3, self.N))
        for i in range(3):
            out[:, i, i] = x
        return self.rest.read(out.reshape(9, 3, -1))

    def _directions(self, j: int, axis: bool = True) -> list[Array]:
        """Motions of a joint's place in all directions, or in those across its axis."""
        place = self.rest.place(j)
        if place in self.rest.view.f.loops:
            return [self.axes[j]] if axis else []
        return [self.rest.motion(place, d) for d in range(6) if axis or d != self.rest.direction(j)]

    def _waves(self, j: int, count: int) -> Array:
        """Waves (2 count, N) of a joint's position; of a sliding one over its range."""
        q = self.samples.q[:, j]
        if not self.chain.revolute[j]:
            q = (q - q.min()) * np.pi / max(float(np.ptp(q)), 1e-9)
        return periodic("sine", np.arange(1.0, count + 1.0), q).reshape(2 * count, -1)

    def _loudest(self, j: int, number: Array) -> tuple[int, Array]:
        """The wave of a joint's position beyond the lowest, times a number (N,), that stands out most, (2, N)."""
        number = number / max(float(np.abs(number).max()), 1e-12)
        waves = self._waves(j, _MAX_WAVES).reshape(_MAX_WAVES, 2, -1) * number
        sums = np.linalg.norm(waves @ np.sum(self.axes[j] * self.rest.residual, axis=0), axis=1)
        k = OWN_WAVES + int(np.argmax(sums[OWN_WAVES:]))
        return k + 1, waves[k]

    def _random(self, count: int, frequency: float) -> Array:
        """Random waves (count, N) of the posture in units of its spread, with about this frequency [rad]."""
        z = _standard(self.samples.q.T)
        direction = self.rng.normal(size=(count, len(z))) * frequency / np.sqrt(max(len(z), 1) / 3.0)
        return np.asarray(np.cos(direction @ z + self.rng.uniform(0.0, 2.0 * np.pi, (count, 1))))


def _part(group: str, place: str, driver: str, motions: Sequence[Array] | Array, numbers: Array) -> Part:
    """The part of motions (k, 6, N) times numbers (c, N)."""
    if not len(motions):
        return Part(group, place, driver, np.empty((0, 6, numbers.shape[-1])))
    u = np.stack(list(motions))
    return Part(group, place, driver, (u[:, None] * numbers[None, :, None]).reshape(-1, *u.shape[1:]))


def _single(motions: Sequence[Array] | Array, numbers: Array) -> tuple[Array, Array]:
    """The same in single precision."""
    return cast(Array, np.stack(list(motions)).astype(np.float32)), cast(Array, numbers.astype(np.float32))


def _pairs(turns: Sequence[Array]) -> Array:
    """Products (k, N) of the waves (2, N) of every two."""
    both = [a * b for i, x in enumerate(turns) for y in turns[:i] for a in x for b in y]
    return np.stack(both) if both else np.empty((0, 0))


def _monomials(z: Array, degree: int) -> Array:
    """Products (k, N) of one to so many of the rows of z (c, N)."""
    some = chain.from_iterable(combinations_with_replacement(z, d) for d in range(1, degree + 1))
    return np.stack([np.prod(factors, axis=0) for factors in some])


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"{', '.join(names[:_MAX_NAMED])}{more}"


def _unit(x: Array) -> Array:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=0), 1e-12))


def _standard(x: Array) -> Array:
    """Rows (c, N) of mean zero and deviation one; zero where they do not change."""
    x = np.nan_to_num(x)
    x = x - x.mean(axis=1, keepdims=True)
    size = x.std(axis=1, keepdims=True)
    return np.asarray(np.where(size > 1e-12, x / np.maximum(size, 1e-300), 0.0))


def _curves(numbers: Array) -> Array:
    """Numbers (c, N) in units of their spread, their squares, and their signs."""
    x = _standard(numbers)
    return np.concatenate([x, x**2, np.sign(np.nan_to_num(numbers))])


def _hats(x: Array) -> Array:
    """Hats over a range, (_HATS, N)."""
    u = (x - x.min()) / max(float(np.ptp(x)), 1e-12) * (_HATS - 1)
    return np.asarray(np.maximum(1.0 - np.abs(u - np.arange(_HATS)[:, None]), 0.0))
