"""The error model: every effect is a sum of small motions *place × direction × driver*.

An effect's amplitude a moves each sample by the sum of its terms, ``a · φ(driver)`` along one direction at one place,
where places and directions are those of :mod:`modcal_core.calibration.parameters`. Effects therefore compose, and their
columns of the linearised model are the geometry's columns times numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from modcal_core.effects.drivers import Drivers, public_driver
from modcal_core.effects.placements import OF_FRAME, of_readings
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import DIRECTIONS, Array, local_twists
from modcal_core.robots import Mechanism, delta_kinematics

# --- Functions of a curve with many knots: at every sample but a few are zero

_MIN = 100_000  # numbers of a curve; of fewer, products of whole matrices are quicker
_MAX_EACH = 8  # functions that are not zero at one sample; of more, blocks are no less work than whole matrices


@dataclass(frozen=True)
class Knots:
    """Functions (b, N) of which few are not zero at a sample. at: numbers of these few, (N, k). value: theirs, (N, k).

    whole: all of them as a sparse array, (b, N). functions: b.
    """

    at: np.ndarray
    value: Array
    whole: scipy.sparse.csr_array
    functions: int

    @classmethod
    def of(cls, numbers: Array) -> Knots | None:
        """Sparse form of a shape's functions (b, N); None where too many are nonzero at some sample."""
        b, N = numbers.shape
        flat = np.flatnonzero(numbers != 0.0)
        begins = np.searchsorted(flat, N * np.arange(b + 1))
        whole = scipy.sparse.csr_array((numbers.ravel()[flat], flat % N, begins), shape=(b, N))
        by_sample = whole.T.tocsr()
        count = np.diff(by_sample.indptr)
        most = int(count.max(initial=0))
        if not 0 < most <= _MAX_EACH:
            return None
        sample = np.repeat(np.arange(N), count)
        place = np.arange(len(sample)) - by_sample.indptr[sample]
        at, value = np.zeros((N, most), np.int32), np.zeros((N, most))
        at[sample, place], value[sample, place] = by_sample.indices, by_sample.data
        return cls(at, value, whole, b)

    def __len__(self) -> int:
        return self.functions


def knots_of(functions: Array, at: Drivers) -> Knots | None:
    """Sparse form of a shape's functions (b, N), cached by these drivers; None where dense matrices are faster."""
    return at.kept.made_of((functions,), Knots.of) if functions.size >= _MIN else None


READING = -1  # the place of what is done to readings: direction 0 scales them, 1 + f shifts the zero of frame f
STEPS = ("step", "until", "between")  # shapes of what happens at one time, or at two
AXIS, ACROSS, LENGTH, ALL, SHIFT, JOINTS, RADIAL = "axis", "across", "length", "all", "shift", "joints", "radial"
ZERO = "zero"  # direction of the number that an instrument adds to what it reads
PAIRS = "rods"  # of parallelograms, by what their two rods differ
RODS, ROWS = delta_kinematics.RODS, delta_kinematics.ROWS  # directions of a Delta's arms behind the six of a twist
LENGTHS_OF_PAIRS = ("radius", "x", "y", "z")  # settings that come with them
EXPECTED_RODS = 0.02  # of their spacing: 1 mm at 50 mm
EXPECTED_ANGLE, EXPECTED_LENGTH = 2e-3, 2e-3  # rad, m: how large an effect may be before its prior minds
EXPECTED_BEND = 5e-4  # rad or m: the same for each coefficient of a free shape
EXPECTED_DELAY = 0.05  # s
HELD = "held"  # setting of a shape: how large its amplitudes are likely to be, which is then their prior [rad or m]
_NONE = np.empty(0)  # values of thousands of candidates
_NONE.flags.writeable = False
_TURNED = 3e-3  # rad or m; what a shorter turn changes in the derivatives hardly changes the steps of a fit


@dataclass(frozen=True)
class Term:
    """One motion: place 0 … n or READING, direction 0 … 5, and its size at every sample, (N,). of: the functions (b, N)
    that the size is one of, where it is just that.
    """

    place: int
    direction: int
    size: Array
    of: Array | None = None


@dataclass(frozen=True)
class Effect:
    """One effect of the error model.

    family: as in reports. place: a joint, "base", "tool", "tracker" or "frame NAME". direction: x y z rx ry rz of the
    place, "axis" (along the joint's), "across" it, "length" (along the link before the joint), "shift" (x y z), "all"
    six, "joints" (the axes of all joints at once), "rods" (of a Delta's parallelograms), "radial" (from the tracker) or
    "zero" (of what an instrument reads). driver: see
    :mod:`modcal_core.effects.drivers`. shape: how it follows the driver. values, std: amplitudes and their standard
    deviations (m,), in rad or m per unit of the driver, then the settings that are fitted with them.
    """

    family: str
    place: str
    direction: str
    driver: str
    shape: Shape
    values: Array = field(default_factory=lambda: _NONE)
    std: Array = field(default_factory=lambda: _NONE)

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What makes two effects one entry of a report."""
        return self.family, self.place, self.direction, self.driver

    @property
    def lag(self) -> float:
        """Seconds behind a recorded signal."""
        return self.shape.settings.get("lag", 0.0)

    @property
    def public_driver(self) -> str:
        """The driver's name in reports."""
        return public_driver(self.driver)

    @property
    def label(self) -> str:
        """For people and for ``same_as``."""
        cycles = f" ({self.shape.settings['cycles']:.4g} cycles a turn)" if "cycles" in self.shape.settings else ""
        return f"{self.place} {self.direction} by {self.public_driver}{cycles}"

    @property
    def refined(self) -> tuple[str, ...]:
        """Names of the settings that are fitted with the amplitudes."""
        return self.shape.refined

    @cached_property
    def stepped(self) -> tuple[tuple[float, Effect, Effect], ...]:
        """For each refined setting a small step, and the effect with the setting that much above and below."""
        out = []
        for name in self.refined:
            value = self.shape.settings[name]
            step = 1e-4 * max(abs(value), 1e-3)
            above, below = (self.shape.with_settings({name: value + side}) for side in (step, -step))
            out.append((step, replace(self, shape=above), replace(self, shape=below)))
        return tuple(out)

    @property
    def held(self) -> float | None:
        """How large its amplitudes are likely to be [rad or m], by the samples themselves; None where nobody asked."""
        return self.shape.settings.get(HELD)

    @property
    def freedom(self) -> float:
        """How many numbers the samples had to tell of it: of amplitudes that are held, those that the prior did not."""
        if self.held is None:
            return float(len(self.values))
        return float(np.sum(1.0 - np.minimum(self.std[: len(self.amplitudes)] / self.held, 1.0) ** 2))

    @property
    def amplitudes(self) -> Array:
        """The linear part of the values."""
        return self.values[: len(self.values) - len(self.refined)]

    def with_values(self, values: Array, std: Array | None = None) -> Effect:
        """The effect with these values: amplitudes, then refined settings."""
        values = np.asarray(values, dtype=float)
        std = np.zeros_like(values) if std is None else np.asarray(std, dtype=float)
        refined, shape = self.refined, self.shape
        if refined:
            settings = values[len(values) - len(refined) :].tolist()
            shape = shape.with_settings(dict(zip(refined, settings, strict=True)))
            values = np.r_[values[: -len(refined)], [shape.settings[name] for name in refined]]
        # by its constructor, which takes a third of the time of replace: a fit asks hundreds of times
        return Effect(self.family, self.place, self.direction, self.driver, shape, values, std)

    def held_to(self, size: float) -> Effect:
        """The same, its amplitudes expected to be of this size [rad or m]."""
        return replace(self, shape=self.shape.with_settings({HELD: size}))

    def started(self, amplitudes: Array) -> Effect:
        """The effect with these amplitudes and its settings as they are."""
        return self.with_values(np.r_[amplitudes, [self.shape.settings[name] for name in self.refined]])


def columns(effect: Effect, drivers: Drivers) -> list[list[Term]]:
    """For each amplitude of the effect its terms, at unit size."""
    chain = drivers.arm.chain
    if effect.direction == JOINTS:
        return [
            [
                Term(chain.first_place + j, axis_direction(chain, j), size)
                for j, size in enumerate(_delay(effect, drivers))
            ]
        ]
    if effect.driver == "velocity":
        j = chain.names.index(effect.place)
        return [[Term(chain.first_place + j, axis_direction(chain, j), _delay(effect, drivers)[j])]]
    x = drivers.values(effect.driver, effect.lag)
    k = place_index(effect.place, chain)
    if effect.direction == PAIRS:
        settings = effect.shape.settings
        lengths = [settings[name] for name in LENGTHS_OF_PAIRS]
        lengths[0] -= settings["known_radius"]
        arms = [chain.first_place + i for i in range(effect.shape.size)]
        return [[Term(i, RODS, x), *(Term(i, RODS + 1 + d, size * x) for d, size in enumerate(lengths))] for i in arms]
    if effect.driver.startswith("moment:"):  # a bearing deflects in the direction it is bent
        return [[Term(k, 3, x[0]), Term(k, 4, x[1])]]

    def made() -> list[list[Term]]:
        basis = drivers.basis(effect.driver, effect.lag, effect.shape)
        return [
            [Term(k, d, phi, basis) if share == 1.0 else Term(k, d, share * phi) for d, share in towards]
            for towards in _directions(effect, drivers, k)
            for phi in basis
        ]

    if not effect.shape.is_free:
        return made()
    name = "columns", k, effect.direction, effect.driver, effect.shape.kind, *sorted(effect.shape.settings.items())
    found: list[list[Term]] = drivers.kept.made_as(name, made)  # hundreds, which a fit asks for at every step
    return found


def plain_columns(effect: Effect, drivers: Drivers) -> tuple[list[tuple[int, int]], Array] | None:
    """For each amplitude of the effect its place and direction, and its sizes (m, N), where each has one term and that
    is a function of the shape: what :func:`columns` says, without a term for each. None of other effects.
    """
    composed = effect.direction in (JOINTS, PAIRS, LENGTH) or effect.driver.startswith("moment:")
    if composed or effect.driver == "velocity":
        return None
    k = place_index(effect.place, drivers.arm.chain)
    basis = drivers.basis(effect.driver, effect.lag, effect.shape)
    towards = [direction for ((direction, _),) in _directions(effect, drivers, k)]
    return [(k, direction) for direction in towards for _ in basis], np.concatenate([basis] * len(towards))


def shape_columns(effect: Effect, drivers: Drivers) -> Iterator[list[Term]]:
    """For each refined setting its terms: the change of the whole effect per unit of the setting."""
    amplitudes = effect.amplitudes
    for i, name in enumerate(effect.refined):
        slope = effect.shape.of_kind.slopes.get(name)
        if slope is not None and _has_one_basis(effect):
            x = drivers.values(effect.driver, effect.lag)
            functions = slope(x, effect.shape.settings, drivers.basis(effect.driver, effect.lag, effect.shape))
            yield list(_sums(effect, drivers, functions))
            continue
        step, above, below = effect.stepped[i]
        sides = columns(above, drivers), columns(below, drivers)
        yield [
            Term(up.place, up.direction, a * (up.size - down.size) / (2.0 * step))
            for a, ups, downs in zip(amplitudes, *sides, strict=True)
            for up, down in zip(ups, downs, strict=True)
        ]


def all_columns(effects: Iterable[Effect], drivers: Drivers) -> list[list[Term]]:
    """Terms of every value of all effects: amplitudes, then refined settings, effect by effect.

    A place that the effects turn by much is seen from the turned frame: there each direction has a term along all six.
    """
    effects = tuple(effects)
    out = [terms for effect in effects for terms in (*columns(effect, drivers), *shape_columns(effect, drivers))]
    if not any(map(is_turned, effects)):
        return out
    turned = {
        place: local_twists(twist.T)
        for place, twist in motion(effects, drivers)[0].items()
        if np.abs(twist[3:]).max() > _TURNED and place in (0, drivers.arm.chain.tool_place)
    }
    for k, terms in enumerate(out):
        if len(terms) == 1 and terms[0].place in turned:
            place, direction, size = terms[0].place, terms[0].direction, terms[0].size
            out[k] = [Term(place, d, turned[place][:, direction, d] * size) for d in range(6)]
    return out


def is_turned(effect: Effect) -> bool:
    """Whether an effect turns its place by so much that columns there are those of the turned frame."""
    return effect.direction == ALL and bool(np.abs(effect.amplitudes).max(initial=0.0) > _TURNED)


def motion(effects: Iterable[Effect], drivers: Drivers) -> tuple[dict[int, Array], Array]:
    """What the effects do together: twists (6, N) by place, and the factor (N,) that readings are scaled by."""
    twists: dict[int, Array] = {}
    scale = np.ones(len(drivers))
    for effect in effects:
        for term in _moved(effect, drivers):
            if term.place == READING:
                scale = scale + term.size * (term.direction == 0)
            else:
                rows = 6 if term.direction < RODS else ROWS
                twist = twists.setdefault(term.place, np.zeros((rows, len(drivers))))
                if len(twist) < rows:
                    twist = twists[term.place] = np.concatenate([twist, np.zeros((rows - len(twist), len(drivers)))])
                twist[term.direction] += term.size
    return twists, scale


def _moved(effect: Effect, drivers: Drivers) -> Iterator[Term]:
    """The terms of an effect with its amplitudes, those of one direction together where the shape says how much."""
    if not _has_one_basis(effect):
        for amplitude, terms in zip(effect.amplitudes, columns(effect, drivers), strict=True):
            yield from (Term(term.place, term.direction, amplitude * term.size) for term in terms)
        return
    basis = drivers.basis(effect.driver, effect.lag, effect.shape)
    yield from _sums(effect, drivers, basis)


def _has_one_basis(effect: Effect) -> bool:
    """Whether its columns are the functions of its shape along each of its directions."""
    of_joints = effect.direction in (JOINTS, PAIRS) or effect.driver == "velocity"
    return not (of_joints or effect.driver.startswith("moment:"))


def _sums(effect: Effect, drivers: Drivers, functions: Array) -> Iterator[Term]:
    """Terms of an effect with its amplitudes, those of a direction together. functions: (b, N)."""
    k = place_index(effect.place, drivers.arm.chain)
    towards = _directions(effect, drivers, k)
    for several, size in zip(towards, effect.amplitudes.reshape(len(towards), -1) @ functions, strict=True):
        yield from (Term(k, direction, size if share == 1.0 else share * size) for direction, share in several)


def prior_stds(effect: Effect, drivers: Drivers) -> Array:
    """How large each value may be expected to be, (m,): wide, it only keeps what the data does not show at rest; of
    amplitudes that are held, as large as they are likely.
    """
    out = []
    for terms in columns(effect, drivers):
        if effect.held is not None:
            out.append(effect.held)
        elif effect.direction == JOINTS or effect.driver == "velocity":
            out.append(EXPECTED_DELAY / float(np.sqrt(np.mean(delay_course(effect, drivers) ** 2))))
        elif effect.direction == PAIRS:
            out.append(EXPECTED_RODS)
        elif effect.shape.kind in ("spline", "waves"):
            out.append(EXPECTED_BEND)
        else:
            rms = max(float(np.sqrt(np.mean(sum(t.size**2 for t in terms)))), 1e-12)
            out.append(
                (EXPECTED_LENGTH if terms[0].direction < 3 or terms[0].place == READING else EXPECTED_ANGLE) / rms
            )
    if effect.shape.kind in STEPS[1:] and len(effect.amplitudes):  # a move may be of any size
        out = np.maximum(out, np.abs(effect.amplitudes).max()).tolist()
    return np.array([*out, *(effect.shape.expected(name) for name in effect.refined)])


def zeros(effects: Iterable[Effect], drivers: Drivers) -> Array:
    """What the effects add to the readings of instruments that read one number [m], (N,)."""
    out = np.zeros(len(drivers))
    for effect in effects:
        for term in _moved(effect, drivers) if effect.direction == ZERO else ():
            out += term.size * (drivers.samples.frame == term.direction - 1)
    return out


def is_of_clock(effect: Effect) -> bool:
    """Whether it is what an instrument's clock does: all joints have moved on meanwhile."""
    return effect.direction == JOINTS and of_readings(effect.place)


def is_move(effect: Effect) -> bool:
    """Whether an effect is a move of base or tool at one time."""
    return effect.place in ("base", "tool") and effect.driver == "time" and effect.shape.kind in STEPS


def is_large_move(effect: Effect) -> bool:
    """Whether it is a move by more than is expected of an effect: a linearised step tells nothing of it."""
    return is_move(effect) and bool(np.abs(effect.amplitudes).max(initial=0.0) > EXPECTED_LENGTH)


def place_index(place: str, chain: Mechanism) -> int:
    """0 … for base, joints and tool; READING for the tracker and instruments by their frames."""
    if place in chain.names:
        return chain.first_place + chain.names.index(place)
    return READING if of_readings(place) else {"base": 0, "tool": chain.tool_place}[place]


def axis_direction(chain: Mechanism, j: int) -> int:
    """The direction that joint j moves in."""
    return 5 if chain.revolute[j] else 2


def _directions(effect: Effect, drivers: Drivers, k: int) -> list[list[tuple[int, float]]]:
    """The directions of a place that move together, each with its share; one list for every amplitude."""
    direction, chain, frames = effect.direction, drivers.arm.chain, drivers.samples.frames
    if direction == ZERO:
        name = effect.place.removeprefix(OF_FRAME)
        return [[(1 + (frames.index(name) if name in frames else len(frames)), 1.0)]]
    if direction == AXIS:
        return [[(axis_direction(chain, k - chain.first_place), 1.0)]]
    if direction == ACROSS:
        return [[(3, 1.0)], [(4, 1.0)]]
    if direction == LENGTH:
        along = chain.length_direction(k)
        return [[(d, float(along[d])) for d in range(3)]]
    if direction == ALL:
        return [[(d, 1.0)] for d in range(6)]
    if direction == SHIFT:
        return [[(d, 1.0)] for d in range(3)]
    if direction == RADIAL:
        return [[(0, 1.0)]]
    return [[(DIRECTIONS.index(direction), 1.0)]]


def delay_course(effect: Effect, drivers: Drivers) -> Array:
    """What the amplitude of a delay is multiplied by, (N,): one, or its course over time."""
    if effect.shape.kind == "linear":
        return np.ones(len(drivers))
    return drivers.basis(effect.driver, 0.0, effect.shape)[0]


def _delay(effect: Effect, drivers: Drivers) -> Array:
    """Motion of the joints (n, N) per amplitude of a delay: back along their course, to second order."""
    course = delay_course(effect, drivers)
    delay = course * (float(effect.values[0]) if len(effect.values) else 0.0)
    return np.asarray(
        course * (-np.nan_to_num(drivers.samples.velocity.T) + 0.5 * delay * drivers.samples.acceleration.T)
    )
