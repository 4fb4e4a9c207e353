"""Residuals and their derivatives, for every parameter at once.

Everything is seen from the *root*: the frame of the first joint before it moves, its axis along z. A reading in frame f
is carried there by the frame's current pose; the tool is carried there by the chain. With ``p`` the tool's position and
(R_k, p_k) the frame of place k,

    residual  r = y − p            (positions, m)      r = log(R_y Rᵀ)   (orientations, rad)
    ∂p/∂θ_j   = R_k v_j + (R_k ω_j) × (p − p_k)        ∂rot/∂θ_j = R_k ω_j

where (v_j, ω_j) is the twist, in the frame of its place, that parameter j makes per unit. Distances between places
do not change with the root, so isotropic noise stays isotropic. Two factors are left out: the derivative of the
logarithm, and the turn of the root that a frame's own error makes. The transpose of either maps r to itself, so the
gradient Jᵀr is exact and only the curvature is rounded.

Arrays are component-major, (3, N): ``J[j]`` holds all x, y, z of the positions and then of the orientations, so each
parameter is written in contiguous sweeps and the normal equations are one matrix product.

Of two curves with a weight for each sample, ``Φ diag(w) Ψᵀ`` is a sum over samples of small blocks, kept as one sparse
matrix that w is multiplied by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from modcal_core.calibration.model import Model, Sights, look
from modcal_core.calibration.parameters import INSTRUMENT, ModelParameter
from modcal_core.effects import READING, RODS, Drivers, Effect, Knots, Term, all_columns, knots_of, motion, zeros
from modcal_core.geometry import Array, error_transform, local_twists, se3, so3
from modcal_core.measurements import Samples
from modcal_core.robots import Frames, tool_frames

# --- Curves of many knots: columns of which every sample has but a few that are not zero

_MAX_KEPT = 8e6  # numbers of what is kept of two curves; of more it is made each time


@dataclass(frozen=True)
class Curve:
    """All functions of a shape along one direction of a place. at: their numbers among the columns of effects. numbers:
    (b, N). knots: of a curve of many; None where whole matrices are quicker.
    """

    place: int
    direction: int
    at: slice
    numbers: Array
    knots: Knots | None

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def key(self) -> tuple[int, int]:
        """Its place and direction."""
        return self.place, self.direction

    @property
    def functions(self) -> Array | scipy.sparse.csr_array:
        """Its functions as a matrix (b, N), sparse where most are zero."""
        return self.numbers if self.knots is None else self.knots.whole


def curves_of(terms: Sequence[list[Term]], at: Drivers) -> tuple[list[Curve], list[int]]:
    """The curves among columns of effects, and the numbers of all other columns."""
    found, others = whole_shapes(terms)
    return [
        Curve(term.place, term.direction, slice(j, j + len(of)), of, knots_of(of, at)) for j, term, of in found
    ], others


def whole_shapes(terms: Sequence[list[Term]]) -> tuple[list[tuple[int, Term, Array]], list[int]]:
    """Where all functions of a shape stand along one direction: the first's number, it, and all (b, N); and the numbers
    of all other columns.
    """
    found: list[tuple[int, Term, Array]] = []
    others: list[int] = []
    j = 0
    while j < len(terms):
        of = terms[j][0].of if len(terms[j]) == 1 else None
        last = [] if of is None else terms[j : j + len(of)][-1]
        # all functions of one direction stand one after another: the last says whether they do
        same = len(last) == 1 and last[0].of is of and last[0].direction == terms[j][0].direction
        if of is not None and same and j + len(of) <= len(terms):
            found.append((j, terms[j][0], of))
            j += len(of)
        else:
            others.append(j)
            j += 1
    return found, others


def product(one: Curve, other: Curve, weight: Array, at: Drivers) -> Array:
    """``Φ diag(weight) Ψᵀ``, (b, c), of the functions of curves at the samples of these drivers."""
    if one.knots is None:
        return np.asarray((other.functions @ (one.numbers * weight).T).T)
    if other.knots is None:
        return np.asarray(one.functions @ (other.numbers * weight).T)
    if one.knots.value.size * other.knots.value.shape[1] > _MAX_KEPT:
        blocks = _blocks(one.knots, other.knots)
    else:
        blocks = at.kept.made_of((one.knots, other.knots), _blocks)
    return np.asarray(blocks @ weight).reshape(len(one), len(other))


def _blocks(one: Knots, other: Knots) -> scipy.sparse.csc_array:
    """Matrix (b c, N) that maps sample weights to products of functions."""
    value = one.value[:, :, None] * other.value[:, None, :]
    at = one.at[:, :, None] * np.int32(len(other)) + other.at[:, None, :]
    each = value[0].size
    begins = np.arange(0, value.size + 1, each, dtype=np.int32)
    shape = len(one) * len(other), len(value)
    return scipy.sparse.csc_array((value.ravel(), at.ravel(), begins), shape=shape)


_AT_ONCE = 256  # samples, whose products then stay near the processor


@dataclass(frozen=True)
class Linearised:
    """Residuals of N samples and their derivatives at one set of values.

    position: [m], (3, N). rotation: [rad], (3, M) for the M pose samples. J: (P, 3 N + 3 M),
    d(prediction)/d(parameter).
    """

    position: Array
    rotation: Array
    J: Array

    @property
    def residual(self) -> Array:
        """All residuals in the order of J's columns, (3 N + 3 M,)."""
        return np.concatenate([self.position.ravel(), self.rotation.ravel()])

    @cached_property
    def square_position(self) -> Array:
        """Squared residual of each position [m²], (N,)."""
        return np.asarray(np.einsum("ij,ij->j", self.position, self.position))

    @cached_property
    def square_rotation(self) -> Array:
        """Squared residual of each orientation [rad²], (M,)."""
        return np.asarray(np.einsum("ij,ij->j", self.rotation, self.rotation))


@dataclass(frozen=True)
class Deviations:
    """Six error values at every place: frames (F, 6) in front of the arm, places (n, 6) for places 1 … n.

    constants: (n, 6), changes of what a Delta's arm at the place has of its own. instruments: changes of the constants
    of each, where there are any.
    """

    frames: Array
    places: Array
    constants: Array = field(default_factory=lambda: np.zeros((0, 6)))
    instruments: tuple[Array, ...] = ()


def deviations(model: Model, parameters: Sequence[ModelParameter], values: Array) -> Deviations:
    """The errors at every place of a model that these parameter values stand for."""
    own = tuple(np.zeros(len(i.constants)) for i in model.instruments)
    n = model.chain.tool_place
    out = Deviations(np.zeros((len(model.frames), 6)), np.zeros((n, 6)), np.zeros((n, 6)), own)
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.place == INSTRUMENT:
            out.instruments[parameter.instrument][parameter.direction] += value
        elif parameter.place == 0:
            out.frames[parameter.frame, parameter.direction] += value
        elif parameter.direction >= 6:
            out.constants[parameter.place - 1, parameter.direction - 6] += value
        else:
            out.places[parameter.place - 1, parameter.direction] += value
    return replace(out, frames=out.frames[list(model.leaders)]) if model.leaders else out


def apply_deviations(model: Model, errors: Deviations) -> Model:
    """The model with these errors put in: frames moved, constants of the chain changed, tool moved."""
    chain = model.chain
    both, ahead = error_transform(np.concatenate([errors.frames, errors.places])), len(errors.frames)
    E = both[ahead:]
    changed = chain.with_errors(E, errors.constants)
    T_base_root = chain.T_base_root
    T_frame_base = model.T_frame_base @ T_base_root @ both[:ahead] @ se3.inverse(T_base_root)
    T_tip_tool = model.T_tip_tool @ E[-1]
    instruments = tuple(i.moved(d) for i, d in zip(model.instruments, errors.instruments, strict=True))
    return replace(model, chain=changed, T_frame_base=T_frame_base, T_tip_tool=T_tip_tool, instruments=instruments)


def linearise(
    model: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    samples: Samples,
    jacobian: bool = True,
    drivers: Drivers | None = None,
) -> Linearised:
    """Residuals of the samples, and derivatives, with the parameters at these values about the given model.

    values: those of the parameters, and behind them, where given, those of the model's effects; the derivatives come in
    the same order. drivers: of the samples, where they are known already.
    """
    at = drivers or model.drivers(samples)
    now = model_at(model, parameters, values)
    view = RowView.of(now, samples, at)
    if not jacobian:
        return Linearised(view.position, view.rotation, np.zeros((0, view.position.size + view.rotation.size)))
    P = len(parameters)
    J = np.empty((len(values), view.position.size + view.rotation.size))
    geometry_rows(view, model, parameters, values, out=J[:P])
    if len(values) > P:
        effect_rows(view, all_columns(now.effects, at), out=J[P:])
    return Linearised(view.position, view.rotation, J)


def effect_rows(view: RowView, terms: Sequence[list[Term]], out: Array) -> None:
    """Write d(prediction)/d(value), (K, 3 N + 3 M), of effects' values, those of one direction of a shape at once."""
    shapes, others = whole_shapes(terms)
    for j, term, numbers in shapes:
        view.times(view.unit_column(term.place, term.direction), numbers, out[j : j + len(numbers)])
    for j in others:
        view.moved_by(terms[j], out=out[j])


def model_at(model: Model, parameters: Sequence[ModelParameter], values: Array, std: Array | None = None) -> Model:
    """The model with these values put in: those of the parameters, then, where given, those of its effects.

    std: standard deviations of the effects' values; zero by default.
    """
    P = len(parameters)
    now = apply_deviations(model, deviations(model, parameters, values[:P]))
    if len(values) == P:
        return now
    ends = np.cumsum([len(e.values) for e in model.effects])[:-1]
    parts = np.split(values[P:], ends)
    stds = [None] * len(parts) if std is None else np.split(std, ends)
    return now.with_effects(tuple(e.with_values(x, s) for e, x, s in zip(model.effects, parts, stds, strict=True)))


def geometry_rows(
    view: RowView, model: Model, parameters: Sequence[ModelParameter], values: Array, out: Array | None = None
) -> Array:
    """d(prediction)/d(parameter), (P, 3 N + 3 M), of the geometry's parameters at these values; in out, where given."""
    J = np.empty((len(parameters), view.position.size + view.rotation.size)) if out is None else out
    errors = deviations(model, parameters, values[: len(parameters)])
    of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
    own = [i.moved_by(d) for i, d in zip(model.instruments, errors.instruments, strict=True)]
    for j, parameter in enumerate(parameters):
        if parameter.place == INSTRUMENT:
            view.own_column(parameter.instrument, own[parameter.instrument][:, parameter.direction], out=J[j])
            continue
        if parameter.direction >= 6:
            view.constant_column(parameter.place, parameter.direction - 6, out=J[j])
            continue
        twist = (of_places[parameter.place - 1] if parameter.place else of_frames[parameter.frame])[parameter.direction]
        view.column(parameter.place, twist, out=J[j])
        if parameter.place == 0 and len(model.frames) > 1:
            view.only_frame(model.frames_led_by(parameter.frame), J[j])
    return J


@dataclass
class RowView:
    """Readings and frames of the chain as seen from the root, and how twists anywhere move the tool.

    effects: of the model that is looked at.
    """

    samples: Samples
    pose: np.ndarray
    f: Frames
    position: Array
    rotation: Array
    reading: Array
    sights: Sights | None = None
    effects: tuple[Effect, ...] = ()
    _units: dict[tuple[int, int], Array] = field(default_factory=dict)

    @classmethod
    def of(cls, now: Model, samples: Samples, at: Drivers) -> RowView:
        """What these samples show of this model, given their drivers."""
        N = len(samples)
        twists, scale = motion(now.effects, at) if now.effects else ({}, np.ones(N))
        # readings from the root, (3, N)
        T_root_frame = se3.inverse(now.T_frame_base @ now.chain.T_base_root)
        true = samples.reading
        if now.effects:
            true = np.c_[true[:, :1] - zeros(now.effects, at)[:, None], true[:, 1:]] / scale[:, None]
        if len(now.frames) == 1:
            reading = T_root_frame[0, :3, :3] @ true.T
            y = reading + T_root_frame[0, :3, 3:]
        else:
            reading = np.einsum("nij,nj->in", T_root_frame[samples.frame, :3, :3], true)
            y = reading + T_root_frame[samples.frame, :3, 3].T
        # from the root to the tool, so that the last frame is the tool itself
        f = tool_frames(now.chain, now.T_tip_tool, samples.q, twists)
        pose = np.flatnonzero(samples.is_pose)
        rotation = np.zeros((3, len(pose)))
        if len(pose):
            R = f.rotation(-1) if len(pose) == N else f.rotation(-1)[pose]
            R_y = T_root_frame[samples.frame[pose], :3, :3] @ samples.R[pose]
            rotation = so3.log(R_y @ np.swapaxes(R, -1, -2)).T
        view = cls(samples, pose, f, y - f.p[-1], rotation, reading, effects=now.effects)
        if now.instruments and (sights := look(now.instruments, samples, true, T_root_frame, f)) is not None:
            view.sights = sights
            view.position[:, sights.rows], view.reading[:, sights.rows] = sights.residual, sights.scale
        return view

    @property
    def residual(self) -> Array:
        """All residuals, (3 N + 3 M,)."""
        return np.concatenate([self.position.ravel(), self.rotation.ravel()])

    @property
    def expected(self) -> Array:
        """What the model expects to be read, from the instrument's origin along the root's axes, (3, N).

        What residuals are explained by holds no reading: its own error would stand on both sides.
        """
        out = self.reading - self.position
        as_read = np.isin(
            self.samples.frame, [f for f in range(len(self.samples.frames)) if self.samples.is_same_point(f)]
        )
        if self.sights is not None:
            as_read[self.sights.rows] = True  # the motion per unit of scale, which the model gives
        return np.where(as_read, self.reading, out)

    def column(self, place: int, twist: Array, out: Array) -> None:
        """Write the motion of the tool, (3 N + 3 M,), per unit of a twist (6,) at a place."""
        N, M = self.position.shape[1], self.rotation.shape[1]
        position, rotation = out[: 3 * N].reshape(3, N), out[3 * N :].reshape(3, M)
        if place == READING:
            position[:], rotation[:] = self.reading, 0.0
            return
        p = self.f.p[-1] if self.sights is None else self.sights.watched
        flat = self.f.axes[place].reshape(3, 3 * N)
        if place in self.f.loops:
            shift, turn = ((part @ flat).reshape(3, N) for part in (twist[:3], twist[3:]))
            self._put(self.f.loops[place].moved(shift, turn, p), position, rotation)
        elif not twist[3:].any():
            np.matmul(twist[:3], flat, out=out[: 3 * N])
            rotation[:] = 0.0
        else:
            turn = (twist[3:] @ flat).reshape(3, N)
            so3.cross(turn, p - self.f.p[place], out=position)
            rotation[:] = turn if M == N else turn[:, self.pose]
            if twist[:3].any():
                position += (twist[:3] @ flat).reshape(3, N)
        if self.sights is not None:
            self.sights.look_through(position)

    def constant_column(self, place: int, constant: int, out: Array) -> None:
        """Write the motion of the tool, (3 N + 3 M,), per unit of what a place's arm has of its own."""
        N, M = self.position.shape[1], self.rotation.shape[1]
        position, rotation = out[: 3 * N].reshape(3, N), out[3 * N :].reshape(3, M)
        p = self.f.p[-1] if self.sights is None else self.sights.watched
        self._put(self.f.loops[place].moved_by_constant(constant, p), position, rotation)
        if self.sights is not None:
            self.sights.look_through(position)

    def _put(self, moved: tuple[Array, Array], position: Array, rotation: Array) -> None:
        """Write a shift and a turn (3, N) of the tool into columns."""
        position[:], turn = moved
        rotation[:] = turn if rotation.shape[1] == position.shape[1] else turn[:, self.pose]

    def rods_column(self, place: int, direction: int, out: Array) -> None:
        """Write the motion of the tool, (3 N + 3 M,), per unit by which the rods of a place differ."""
        N, M = self.position.shape[1], self.rotation.shape[1]
        position, rotation = out[: 3 * N].reshape(3, N), out[3 * N :].reshape(3, M)
        p = self.f.p[-1] if self.sights is None else self.sights.watched
        self._put(self.f.loops[place].moved_by_rods(direction - RODS, p), position, rotation)
        if self.sights is not None:
            self.sights.look_through(position)

    def own_column(self, instrument: int, change: Array, out: Array) -> None:
        """Write what changes, (3 N + 3 M,), per unit of a change of an instrument's constants."""
        N = self.position.shape[1]
        out[:] = 0.0
        if self.sights is not None and instrument in self.sights.constants:
            rows, by_constants = self.sights.constants[instrument]
            out[: 3 * N].reshape(3, N)[:, rows] = np.tensordot(change, by_constants, 1)

    def _zero_column(self, frame: int, out: Array) -> None:
        """Write what changes, (3 N + 3 M,), per unit that the zero of a frame's one number is off."""
        out[:] = 0.0
        if self.sights is not None:
            rows, scale = self.sights.rows, self.sights.scale  # along which a length grows
            along = scale * np.sign(self.samples.reading[rows, 0]) / np.maximum(np.linalg.norm(scale, axis=0), 1e-300)
            out[: self.position.size].reshape(3, -1)[:, rows] = along * (self.samples.frame[rows] == frame)

    def only_frame(self, frames: Sequence[int], out: Array) -> None:
        """Make a column (3 N + 3 M,) zero for samples of other frames than these."""
        N = self.position.shape[1]
        here = self.samples.frame
        away = here != frames[0] if len(frames) == 1 else ~np.isin(here, frames)
        out[: 3 * N].reshape(3, N)[:, away] = 0.0
        out[3 * N :].reshape(3, -1)[:, away[self.pose]] = 0.0

    def moved_by(self, terms: Sequence[Term], out: Array | None = None) -> Array:
        """The motion of the tool, (3 N + 3 M,), that the terms of one amplitude make together; in out, where given."""
        N = self.position.shape[1]
        out = np.empty(self.position.size + self.rotation.size) if out is None else out
        position, rotation = out[: 3 * N].reshape(3, N), out[3 * N :].reshape(3, -1)
        turned = slice(None) if len(self.pose) == N else self.pose
        for i, term in enumerate(terms):
            unit = self.unit_column(term.place, term.direction)
            if i == 0:
                np.multiply(unit[: 3 * N].reshape(3, N), term.size, out=position)
                np.multiply(unit[3 * N :].reshape(3, -1), term.size[turned], out=rotation)
            else:
                position += unit[: 3 * N].reshape(3, N) * term.size
                rotation += unit[3 * N :].reshape(3, -1) * term.size[turned]
        return out

    def times(self, unit: Array, numbers: Array, out: Array) -> None:
        """Write a column (3 N + 3 M,) times the numbers that several amplitudes have at each sample, (b, N)."""
        N, b = self.position.shape[1], len(numbers)
        turned = numbers if len(self.pose) == N else numbers[:, self.pose]
        for rows, factor in ((slice(3 * N), numbers), (slice(3 * N, None), turned)):
            np.multiply(unit[rows].reshape(1, 3, -1), factor[:, None], out=out[:, rows].reshape(b, 3, -1))

    def products(self, rows: Array, unit: Array) -> Array:
        """Sums over the components of each sample, (d, N), of rows (d, 3 N + 3 M) times one row (3 N + 3 M,)."""
        N, d = self.position.shape[1], len(rows)
        out = np.einsum("dcn,cn->dn", rows[:, : 3 * N].reshape(d, 3, N), unit[: 3 * N].reshape(3, N))
        if len(self.pose):
            turned = np.einsum("dcn,cn->dn", rows[:, 3 * N :].reshape(d, 3, -1), unit[3 * N :].reshape(3, -1))
            if len(self.pose) == N:
                out += turned
            else:
                out[:, self.pose] += turned
        return np.asarray(out)

    def all_products(self, rows: Array, units: Array) -> Array:
        """Sums over the components of each sample, (k, N, d), of rows (d, 3 N + 3 M) times each of (k, 3 N + 3 M)."""
        N = self.position.shape[1]
        out = np.empty((len(units), N, len(rows)))
        for first in range(0, N, _AT_ONCE):
            some = slice(first, min(first + _AT_ONCE, N))
            one, other = self._by_sample(rows, some), self._by_sample(units, some)
            out[:, some] = (other @ np.swapaxes(one, 1, 2)).transpose(1, 0, 2)
        return out

    def _by_sample(self, rows: Array, some: slice) -> Array:
        """Rows (d, 3 N + 3 M) at n of the samples, (n, d, 6), zero where there is no orientation; or (n, d, 3)."""
        N, d = self.position.shape[1], len(rows)
        position = rows[:, : 3 * N].reshape(d, 3, N)[:, :, some].transpose(2, 0, 1)
        if not len(self.pose):
            return np.ascontiguousarray(position)
        here = slice(*np.searchsorted(self.pose, (some.start, some.stop)).tolist())
        out = np.zeros((len(position), d, 6))
        out[:, :, :3] = position
        turned = rows[:, 3 * N :].reshape(d, 3, -1)[:, :, here].transpose(2, 0, 1)
        if len(turned) == len(position):
            out[:, :, 3:] = turned
        else:
            out[self.pose[here] - some.start, :, 3:] = turned
        return out

    def unit_column(self, place: int, direction: int) -> Array:
        """The motion of the tool, (3 N + 3 M,), per unit along one direction of a place; computed once."""
        if (place, direction) not in self._units:
            out = np.empty(self.position.size + self.rotation.size)
            if place == READING and direction:
                self._zero_column(direction - 1, out)
            elif direction >= RODS:
                self.rods_column(place, direction, out)
            else:
                self.column(place, np.eye(6)[direction], out=out)
            self._units[place, direction] = out
        return self._units[place, direction]
