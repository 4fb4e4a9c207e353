"""Every arm near the calibrated one, as a linear model: what the readings say of it, and how likely arms are.

The values are all six errors at every place of the arm (those that a fit leaves out as well), base frames, tool and
constants of instruments, the effects of the calibrated model, and, joint by joint, functions that stand for effects
that nobody has named: 1 … 5 waves a turn, the direction of approach, and torque and moment of weight. Readings,
linearised at the calibrated model, give normal equations; the arm's errors are counted from the *nominal* arm, where
arms are likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from modcal_core.calibration import (
    Cell,
    Groups,
    Model,
    ModelParameter,
    NoiseModel,
    RowView,
    blocks_at,
    distance_rows,
    drop_fixed,
    has_shared_noise,
    linearise,
    ordered_candidates,
    row_weights,
    shared_noise,
    stated_std,
    views_of,
    weigh,
)
from modcal_core.claim.repeatability import missed_by_joints
from modcal_core.effects import Drivers, prior_stds
from modcal_core.effects.families import unknown
from modcal_core.geometry import Array, error_values, se3
from modcal_core.measurements import POSE, Samples, spread_rows
from modcal_core.measurements.kinds import dimensions, kinds
from modcal_core.robots import Mechanism, is_delta, is_serial_arm

LENGTH_M, ANGLE_RAD = 5e-4, 1e-3  # how far links of usual arms are off, times a width that the readings tell
UNNAMED_RAD = 2e-4  # the same of functions for effects that nobody named, of one wave; of k waves 1/√k of it
UNNAMED_M = 5e-5  # of each function by which the whole arm is off
FREE_M, FREE_RAD = 0.5, 1.0  # of bases, tool and constants of instruments, of which nothing is expected
_SHOWN = 1e6  # deviations; a free value that is known better than that needs no wider prior
_SEED = 47  # the same readings give the same word
_ROTATION = "~rotation"  # of poses, whose noise is its own; last among the kinds
_FINEST, _USUAL = 5e-6, 5e-5  # m or rad; what instruments read no better than, and usually
_NEAR = 1e-4  # rad or m, over which derivatives change
_FREE_SHARE = 0.1  # of a row, at least
_FEW = 200  # samples that say how joints move readings
LENGTH, ANGLE, WAVE, LOAD, SIGN, WARP, FREE = range(7)  # sorts of values


@dataclass(frozen=True)
class ArmEvidence:
    """What is said of K values of an arm, as far as draws of them ask for it.

    shipped: values that the calibrated model has (K,), from the nominal arm. H (S, K, K), g (S, K), square, rows (S,):
    by each kind of reading normal equations about the calibrated model, squared residuals, in units of the fit's noise,
    and equations. stated: H (K, K) and g (K,) of what is known besides. usual: noise that instruments usually have, in
    the same units (S,). std: usual size of each value (K,). sort: of each, LENGTH … FREE (K,). group: a number of what
    it belongs to, a link or one joint's functions of a sort (K,). main: the kind with the most equations. pull: what g
    is short of (K,).
    """

    shipped: Array
    H: Array
    g: Array
    square: Array
    rows: Array
    stated: tuple[Array, Array]
    usual: Array
    std: Array
    sort: np.ndarray
    group: np.ndarray
    main: int
    pull: Array

    def equations(self, noise: Array) -> tuple[Array, Array]:
        """H (K, K) and g (K,) of all that is known, given the noise of each kind (S,)."""
        each = noise**-2.0
        return np.tensordot(each, self.H, 1) + self.stated[0], each @ self.g + self.stated[1]


@dataclass(frozen=True)
class Neighbourhood(ArmEvidence):
    """model: the calibrated one, with the functions as effects of no size. parameters: of the geometry. place: of
    values of the arm, else -1 (K,). moves: which move the tool in the root (K,). stations: by which joints are told
    from the instrument. turned: whether the main kind has orientations. missed: draws of what joints missed at stations
    (R, n, J) [rad, m], where all scatter is that of the fit.
    """

    model: Model
    parameters: tuple[ModelParameter, ...]
    place: np.ndarray
    moves: np.ndarray
    stations: StationEquations
    turned: bool
    missed: Array

    def unread(self) -> Neighbourhood:
        """The same before the readings are there: they miss the model by their noise, about the calibrated arm, and
        joints have what the instrument leaves of it.
        """
        nothing, at = np.zeros_like(self.shipped), self.stations
        share = np.clip(1.0 - at.usual**2, 0.0, 1.0)
        missed = np.sqrt(share / at.square) * np.random.default_rng(_SEED).standard_normal(self.missed.shape)
        return replace(self, g=0.0 * self.g, square=self.rows, shipped=nothing, pull=nothing, missed=missed)

    @property
    def values(self) -> Array:
        """What the calibrated model is linearised at: no error of the geometry, effects as they are, (K,)."""
        return np.concatenate([np.zeros(len(self.parameters)), *(e.values for e in self.model.effects)])


def arms_near(
    calibrated: Model,
    nominal: Mechanism,
    samples: Samples,
    cell: Cell,
    functions: bool = True,
    noise: NoiseModel | None = None,
) -> Neighbourhood:
    """What these samples say of all arms near the calibrated one.

    functions: with those for effects nobody named. noise: of the readings; None: what they miss the model by.
    """
    named = calibrated.effects
    more = unknown.functions(calibrated.drivers(samples), calibrated.T_tip_tool[:3, 3]) if functions else ()
    model = replace(calibrated.with_effects((*named, *more)), fallback=None)
    around = model.drivers(samples)
    every = ordered_candidates(model.chain, model.frames, views_of(samples), model.instruments, model.leaders)
    parameters = tuple(drop_fixed(every, cell.kept, all_there=False))
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
    left = linearise(model, (), np.zeros(0), samples, jacobian=False, drivers=around)
    groups = Groups.of(samples, bool(model.instruments))
    weights, missed = weigh(left, groups, 0.0, np.inf)
    noise = noise or replace(
        missed,
        position=max(missed.position, _FINEST),
        rotation=max(missed.rotation, _FINEST),
        others={name: max(size, _FINEST) for name, size in missed.others.items()},
    )
    row_weight = row_weights(weights, noise, samples)
    names = [*sorted(samples.kinds), *([_ROTATION] if samples.is_pose.any() else [])]
    alike = shared_noise(samples, left, row_weight) if has_shared_noise(samples) else 1.0
    H, g, square, rows = (x / alike for x in _by_kind(model, parameters, values, samples, row_weight, names))
    stated = np.zeros(H.shape[1:]), np.zeros(len(values))
    if cell.distances:
        known = distance_rows(model, parameters, values, cell.distances)
        stated = (known.J / known.std**2) @ known.J.T, (known.J / known.std**2) @ known.residual
    std, sort, group = _expected(parameters, model, len(named), cell, around, np.diag(H.sum(axis=0)))
    main = int(rows[: len(samples.kinds)].argmax())
    own = np.flatnonzero(samples.kind == names[main])
    others = [False] * (len(values) - len(parameters))
    of_arm = np.array([p.of_arm for p in parameters] + others)
    usual = _USUAL / np.array(
        [_read(noise, name, groups.known_position[samples.kind == name], groups.known_rotation) for name in names]
    )
    instrument = cell.stated.instrument_mm
    by = float(usual[main]) * (1.0 if instrument is None else 1e-3 * instrument / np.sqrt(3.0) / _USUAL)
    about = Neighbourhood(
        model=model,
        parameters=parameters,
        shipped=np.r_[_from_nominal(parameters, model.chain, nominal), np.zeros(len(others))],
        H=H,
        g=g,
        square=square,
        rows=rows,
        stated=stated,
        usual=usual,
        std=std,
        sort=sort,
        group=group,
        place=np.where(of_arm, group, -1),
        moves=of_arm | np.array([p.name.startswith("tool/") for p in parameters] + others),
        stations=_stations(model, parameters, samples.select(own), row_weight[_rows_of(samples, own)], by),
        missed=np.zeros((1, 1, model.chain.n)),
        main=main,
        turned=names[main] == POSE,
        pull=np.zeros(len(values)),
    )
    return with_joints(about)


def _read(noise: NoiseModel, name: str, known_p: Array, known_r: Array) -> float:
    """What readings of a kind scatter by, usually, with what they know of it themselves [its unit]."""
    size = noise.rotation if name == _ROTATION else noise.others.get(name, noise.position)
    own = known_r if name == _ROTATION else known_p
    return float(np.hypot(size, np.median(own) if len(own) else 0.0))


def _by_kind(
    model: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    samples: Samples,
    row_weight: Array,
    names: Sequence[str],
) -> tuple[Array, Array, Array, Array]:
    """Normal equations (S, K, K), (S, K), squared residuals and equations (S,), of these kinds of readings."""
    S, K, root = len(names), len(values), np.sqrt(row_weight)
    out = np.zeros((S, K, K)), np.zeros((S, K)), np.zeros(S), np.zeros(S)
    for block in blocks_at(samples, model.drivers(samples)):
        part = block.part
        here = linearise(model, parameters, values, part, drivers=block.at)
        kind = np.searchsorted(names, part.kind)
        each = np.concatenate([np.tile(kind, 3), np.full(3 * int(part.is_pose.sum()), S - 1)])
        seen = np.concatenate([dimensions(part) - 3.0 * part.is_pose, np.full(int(part.is_pose.sum()), 3.0)])
        for k in range(S):
            rows = np.flatnonzero(each == k)
            J, r = here.J[:, rows] * root[block.rows][rows], here.residual[rows] * root[block.rows][rows]
            of = np.concatenate([kind, np.full(int(part.is_pose.sum()), S - 1)]) == k
            for total, more in zip(out, (J @ J.T, J @ r, r @ r, seen[of].sum()), strict=True):
                total[k] += more
    return out


def _rows_of(samples: Samples, own: np.ndarray) -> np.ndarray:
    """The rows of a linearisation, (3 n + 3 m,), that belong to n of the samples."""
    N, M = len(samples), int(samples.is_pose.sum())
    turned = (np.cumsum(samples.is_pose) - 1)[own[samples.is_pose[own]]]
    return np.concatenate([own, N + own, 2 * N + own, *(3 * N + M * d + turned for d in range(3))])


def _expected(
    parameters: Sequence[ModelParameter], model: Model, named: int, cell: Cell, around: Drivers, seen: Array
) -> tuple[Array, np.ndarray, np.ndarray]:
    groups: dict[tuple[str, str, str], int] = {}
    std, sort, group = [], [], []
    for p in parameters:
        stated = stated_std(p, cell.tool, cell.known)
        if p.of_arm:
            std.append(LENGTH_M if p.unit == "m" else ANGLE_RAD)
        else:
            std.append(stated if stated is not None else FREE_RAD if p.unit == "rad" else FREE_M)
        sort.append(FREE if not p.of_arm else LENGTH if p.unit == "m" else ANGLE)
        group.append(p.place)
    for i, effect in enumerate(model.effects):
        if i < named:
            std += prior_stds(effect, around).tolist()
        elif effect.shape.kind == "warp":
            std += [UNNAMED_M] * len(effect.values)
        elif effect.shape.kind == "turn":
            std += [UNNAMED_RAD / np.sqrt(effect.shape.settings["cycles"])] * 2
        else:
            size = float(np.sqrt(np.mean(around.values(effect.driver, effect.lag) ** 2)))
            std += [UNNAMED_RAD / max(size, 1e-9)] * len(effect.values)
        own = {"turn": WAVE, "linear": LOAD, "sign": SIGN, "warp": WARP}
        sort += [FREE if i < named else own[effect.shape.kind]] * len(effect.values)
        key = effect.place, effect.driver, effect.direction
        group += [1000 + groups.setdefault(key, len(groups))] * len(effect.values)
    of, sizes = np.array(sort), np.array(std)
    enough = _SHOWN / np.sqrt(np.maximum(seen, 1e-300))
    return np.where(of == FREE, np.minimum(sizes, np.maximum(enough, 1e-12)), sizes), of, np.array(group)


def _from_nominal(parameters: Sequence[ModelParameter], chain: Mechanism, nominal: Mechanism) -> Array:
    """Values of the parameters (P,) that make the nominal arm this one; bases, tool and instruments count from here."""
    out = np.zeros(len(parameters))
    if is_serial_arm(chain) and is_serial_arm(nominal):
        A = se3.transform(nominal.joint_basis)
        off = error_values(se3.inverse(nominal.origins[:-1] @ A) @ chain.origins[:-1] @ A)
        for j, p in enumerate(parameters):
            if p.of_arm:
                out[j] = off[p.place, p.direction]
    elif is_delta(chain) and is_delta(nominal):
        constants = chain.constants - nominal.constants
        for j, p in enumerate(parameters):
            if p.of_arm:
                out[j] = constants[p.direction - 6, p.place - chain.first_place]
    return out


@dataclass(frozen=True)
class StationEquations:
    """Some of the stations of the main kind, with its equations, 0 where there is no orientation.

    J (n, K, 6), left (n, 6): derivatives and residuals in units of the fit's noise. motions (n, J, 6): the same per rad
    or m that a joint misses. count: equations. pull (J, K): what the gradient of all stations is off by per rad² that
    joints miss, for derivatives are taken where they were reported. usual: noise of the instrument, in that of the fit.
    """

    J: Array
    left: Array
    motions: Array
    count: float
    pull: Array
    usual: float

    @property
    def square(self) -> float:
        """The mean over equations of their squared motion per rad² of all joints, each alone."""
        return max(float((self.motions**2).sum()) / self.count, 1e-300)


def _stations(
    model: Model, parameters: Sequence[ModelParameter], samples: Samples, row_weight: Array, usual: float
) -> StationEquations:
    rows = spread_rows(len(samples), _FEW)
    weight, some = row_weight[_rows_of(samples, rows)], samples.select(rows)
    around = model.drivers(some)
    view = RowView.of(model, some, around)
    geometry, bare = np.zeros(len(parameters)), model.with_effects(())
    values = np.concatenate([geometry, *(e.values for e in model.effects)])
    at = linearise(model, parameters, values, some, drivers=around)
    root, pull = np.sqrt(weight), np.zeros((model.chain.n, len(values)))
    motions = np.stack([joint_motion(view, model.chain, j) for j in range(model.chain.n)])
    for motion, moved, own in zip(motions, np.eye(model.chain.n), pull, strict=True):
        there, back = (
            linearise(bare, parameters, geometry, replace(some, q=some.q + side * moved)).J for side in (_NEAR, -_NEAR)
        )
        own[: len(there)] = (there - back) @ (weight * motion) * (len(samples) / len(rows)) / (2.0 * _NEAR)

    def of_each(x: Array) -> Array:  # (k, 3 n + 3 m) as (n, k, 6)
        out = np.zeros((len(rows), len(x), 6))
        out[:, :, :3] = x[:, : 3 * len(rows)].reshape(len(x), 3, -1).transpose(2, 0, 1)
        out[some.is_pose, :, 3:] = x[:, 3 * len(rows) :].reshape(len(x), 3, -1).transpose(2, 0, 1)
        return out

    J, left, moved = (of_each(np.atleast_2d(x * root)) for x in (at.J, at.residual, motions))
    return StationEquations(J, left[:, 0], moved, float(dimensions(some).sum()), pull, usual)


def with_joints(about: Neighbourhood) -> Neighbourhood:
    """The same with what joints missed, and what the gradient is off by.

    What readings miss of the most likely arm is divided by the share of it that its values do not take up. Readings
    that are all alike, of contacts and sockets, get closer to each other as the arm gets smaller, whatever its size:
    with n what the joints miss, E[Aᵀ J n] = Σ ρ² ∂A/∂qᵀ J is no sign of its size, and is taken out.
    """
    at = about.stations
    both = zip((about.H, about.g), about.stated, strict=True)
    H, g = (x[about.main] + (x[-1] if about.turned else 0.0) + told for x, told in both)
    lower = np.linalg.cholesky(H * np.outer(about.std, about.std) + np.eye(len(H)))
    solved = np.column_stack(
        [about.std * g - about.shipped / about.std, about.std[:, None] * np.concatenate(at.J, axis=1)]
    )
    half = scipy.linalg.solve_triangular(lower, solved, lower=True)
    left = at.left - (half[:, 0] @ half[:, 1:]).reshape(at.left.shape)
    half = half[:, 1:]
    free = np.maximum(1.0 - (half**2).sum(axis=0), _FREE_SHARE).reshape(at.left.shape)
    rng = np.random.default_rng(_SEED)
    missed = missed_by_joints(at.motions, left / np.sqrt(free), at.count, at.usual, rng)
    return replace(about, missed=missed, pull=np.where(about.moves, (missed**2).mean(axis=(0, 1)) @ at.pull, 0.0))


def shows_base(samples: Samples, frame: int) -> bool:
    """Whether the readings in a frame are positions there, which show where the base is, and every length."""
    names = set(samples.kind[samples.frame == frame].tolist())
    return any(kinds()[name].direct for name in names) and not samples.is_same_point(frame)


def joint_motion(view: RowView, chain: Mechanism, j: int) -> Array:
    """How readings move per rad or m of a joint, (3 N + 3 M,)."""
    return view.unit_column(chain.first_place + j, 5 if chain.revolute[j] else 2)
