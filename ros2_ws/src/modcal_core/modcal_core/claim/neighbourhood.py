"""Every arm near the calibrated one, as a linear model: what the readings say of it, and how likely arms are.

The values are all six errors at every place of the arm (those that a fit leaves out as well), base frames, tool and
constants of instruments, the effects of the calibrated model, and, joint by joint, functions that stand for effects
that nobody has named: 1 … 5 waves a turn, the direction of approach, and torque and moment of weight. Readings,
linearised at the calibrated model, give normal equations; the arm's errors are counted from the *nominal* arm, where
arms are likely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    known_sigma,
    linearise,
    normal_equations,
    of_rows,
    ordered_candidates,
    shared_noise,
    stated_std,
    views_of,
    weigh,
)
from modcal_core.effects import Drivers, prior_stds
from modcal_core.effects.families import unknown
from modcal_core.geometry import Array, error_values, se3
from modcal_core.measurements import POSE, Samples, spread_rows
from modcal_core.measurements.kinds import dimensions, kinds
from modcal_core.robots import Mechanism, is_delta, is_serial_arm

LENGTH_M, ANGLE_RAD = 5e-4, 1e-3  # how far links of usual arms are off, times a width that the readings tell
UNNAMED_RAD = 2e-4  # the same of functions for effects that nobody named, of one wave; of k waves 1/√k of it
FREE_M, FREE_RAD = 0.5, 1.0  # of bases, tool and constants of instruments, of which nothing is expected
_SHOWN = 1e6  # deviations; a free value that is known better than that needs no wider prior
SHARES = np.linspace(0.05, 0.99, 16) ** 2  # of the scatter's square that joints may have
_FINEST, _USUAL = 5e-6, 1e-4  # m or rad; what instruments other than trackers read no better than, and usually
_ROUNDS = 6
_NEAR = 1e-4  # rad or m, over which derivatives change
_FREE_SHARE = 0.1  # of a row, at least
_FEW = 200  # samples that say how joints move readings
ARM, UNNAMED, FREE = 0, 1, 2  # what a value belongs to


@dataclass(frozen=True)
class Neighbourhood:
    """model: the calibrated one, with the functions as effects of no size. parameters: of the geometry. shipped: values
    that the calibrated model has (K,), from the nominal arm. H (K, K), g (K,), square: normal equations of the values
    and squared readings, in units of the fit's noise. rows: equations. std: usual size of each value (K,), and of
    what it is one (K,): ARM, UNNAMED, FREE. joints: mean squared weighed reading per rad² of all joints, each alone.
    shares: how likely each of SHARES is (S,). pull: what g is short of, per s² (K,). noise: of the readings.
    """

    model: Model
    parameters: tuple[ModelParameter, ...]
    shipped: Array
    H: Array
    g: Array
    square: float
    rows: float
    std: Array
    kind: np.ndarray
    place: np.ndarray
    joints: float
    shares: Array
    pull: Array
    noise: NoiseModel

    @property
    def values(self) -> Array:
        """What the calibrated model is linearised at: no error of the geometry, effects as they are, (K,)."""
        return np.concatenate([np.zeros(len(self.parameters)), *(e.values for e in self.model.effects)])


def neighbourhood(
    calibrated: Model, nominal: Mechanism, samples: Samples, cell: Cell, functions: bool = True
) -> Neighbourhood:
    """What these samples say of all arms near the calibrated one. functions: with those for effects nobody named."""
    named = calibrated.effects
    more = unknown.functions(calibrated.drivers(samples)) if functions else ()
    model = replace(calibrated.with_effects((*named, *more)), fallback=None)
    around = model.drivers(samples)
    every = ordered_candidates(model.chain, model.frames, views_of(samples), model.instruments, model.leaders)
    parameters = tuple(drop_fixed(every, [p for p in cell.kept if _names(p, every)]))
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
    left = linearise(model, (), np.zeros(0), samples, jacobian=False, drivers=around)
    pose = samples.is_pose
    known_p, known_r = known_sigma(samples.sigma_position), known_sigma(samples.sigma_rotation[pose])
    groups = Groups.of(samples, bool(model.instruments))
    weights, noise = weigh(left, pose, known_p, known_r, groups, 0.0, np.inf)
    row_weight = of_rows(weights, noise.of(samples), noise.rotation, known_p, known_r, pose)
    shipped = np.concatenate([_from_nominal(parameters, model.chain, nominal), np.zeros(len(values) - len(parameters))])
    parts, by_kind = blocks_at(samples, around), {}
    for name in samples.kinds:
        mine = samples.kind == name
        weight = np.concatenate(
            [np.tile(row_weight[: len(samples)] * mine, 3), row_weight[3 * len(samples) :] * (name == POSE)]
        )
        H, g = normal_equations(model, parameters, values, samples, weight, parts)
        by_kind[name] = H, g, float(weight @ left.residual**2), float((weights * dimensions(samples))[mine].sum())
    std, kind = _expected(parameters, model, len(named), cell, around, np.diag(sum(one[0] for one in by_kind.values())))
    scatter = _scatter(by_kind, noise, std, shipped) if len(by_kind) > 1 else dict.fromkeys(by_kind, 1.0)
    for name, factor in scatter.items():
        row_weight[: 3 * len(samples)].reshape(3, -1)[:, samples.kind == name] /= factor
        row_weight[3 * len(samples) :] /= factor if name == POSE else 1.0
    H = np.sum([one[0] / scatter[name] for name, one in by_kind.items()], axis=0)
    g = np.sum([one[1] / scatter[name] for name, one in by_kind.items()], axis=0)
    joints = _of_joints(model, parameters, values, samples, left.residual, row_weight, H, std)
    square, rows = float(row_weight @ left.residual**2), float(weights @ dimensions(samples))
    alike = shared_noise(samples, left, row_weight) if has_shared_noise(samples) else 1.0
    H, g, square, rows = H / alike, g / alike, square / alike, rows / alike
    if cell.distances:
        known = distance_rows(model, parameters, values, cell.distances)
        H = H + (known.J / known.std**2) @ known.J.T
        g = g + (known.J / known.std**2) @ known.residual
        square, rows = square + known.cost, rows + len(known.residual)
    # counted from the nominal arm, the readings are those that its neighbours are seen by
    square += float(2.0 * shipped @ g + shipped @ H @ shipped)
    moves = [p.of_arm or p.name.startswith("tool/") for p in parameters] + [False] * (len(values) - len(parameters))
    pull = np.where(moves, joints.pull, 0.0) / alike * float(joints.shares @ SHARES) / max(joints.square, 1e-300)
    place = np.array([p.place if p.of_arm else -1 for p in parameters] + [-1] * (len(values) - len(parameters)))
    g = g + H @ shipped
    return Neighbourhood(
        model, parameters, shipped, H, g, square, rows, std, kind, place, joints.square, joints.shares, pull, noise
    )


def _expected(
    parameters: Sequence[ModelParameter], model: Model, named: int, cell: Cell, around: Drivers, seen: Array
) -> tuple[Array, np.ndarray]:
    std, kind = [], []
    for p in parameters:
        stated = stated_std(p, cell.tool, cell.known)
        if p.of_arm:
            std.append(LENGTH_M if p.unit == "m" else ANGLE_RAD)
        else:
            std.append(stated if stated is not None else FREE_RAD if p.unit == "rad" else FREE_M)
        kind.append(ARM if p.of_arm else FREE)
    for i, effect in enumerate(model.effects):
        if i < named:
            std += prior_stds(effect, around).tolist()
        elif effect.shape.kind == "turn":
            std += [UNNAMED_RAD / np.sqrt(effect.shape.settings["cycles"])] * 2
        else:
            size = float(np.sqrt(np.mean(around.values(effect.driver, effect.lag) ** 2)))
            std.append(UNNAMED_RAD / max(size, 1e-9))
        kind += [FREE if i < named else UNNAMED] * len(effect.values)
    of, sizes = np.array(kind), np.array(std)
    enough = _SHOWN / np.sqrt(np.maximum(seen, 1e-300))
    return np.where(of == FREE, np.minimum(sizes, np.maximum(enough, 1e-12)), sizes), of


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


def _scatter(
    by_kind: Mapping[str, tuple[Array, Array, float, float]], noise: NoiseModel, std: Array, shipped: Array
) -> dict[str, float]:
    """By kind, how much larger its scatter's square is than the fit took it to be, the values being held to what is
    usual. A fit may meet the few readings of one instrument as if they were exact; so this begins from usual scatter.

    by_kind: H, g, squared readings and equations of each.
    """
    least = {name: (_FINEST / noise.others[name]) ** 2 if name in noise.others else 0.0 for name in by_kind}
    out = {name: max(1.0, (_USUAL / noise.others[name]) ** 2) if name in noise.others else 1.0 for name in by_kind}
    for _ in range(_ROUNDS):
        H = np.sum([one[0] / out[name] for name, one in by_kind.items()], axis=0)
        g = np.sum([one[1] / out[name] for name, one in by_kind.items()], axis=0)
        A = H * np.outer(std, std)
        A.flat[:: len(A) + 1] += 1.0
        C = np.linalg.inv(A) * np.outer(std, std)
        x = C @ (g - shipped / std**2)
        for name, (own, toward, square, count) in by_kind.items():
            missed = square - 2.0 * float(x @ toward) + float(x @ own @ x)
            free = max(count - float((C * own).sum()) / out[name], 1.0)
            out[name] = max(missed / free, least[name], 1e-6)
    return out


@dataclass(frozen=True)
class _OfJoints:
    """What joints that do not repeat do to the weighed readings.

    square: mean over rows of their squared motion per rad², or m², of every joint. shares: how likely each of SHARES of
    the scatter is theirs (S,). pull: what the gradient is off by, for derivatives are taken where joints were reported,
    per rad² (K,).
    """

    square: float
    shares: Array
    pull: Array


def _of_joints(
    model: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    samples: Samples,
    left: Array,
    row_weight: Array,
    H: Array,
    std: Array,
) -> _OfJoints:
    """left: residuals, (3 N + 3 M,). H, std: of all readings, and as expected, (K, K), (K,).

    Joints that do not repeat scatter more where an arm is stretched out, and across it; an instrument does not. What is
    missed there is divided by the share of it that the values do not take up. Readings that are all alike, of contacts
    and sockets, get closer to each other as the arm gets smaller, whatever its size: with n what the joints miss,
    E[Aᵀ J n] = ρ² Σ ∂A/∂qᵀ J is no sign of its size, and is taken out.
    """
    N = len(samples)
    rows = spread_rows(N, _FEW)
    some, turned = samples.select(rows), (np.cumsum(samples.is_pose) - 1)[rows[samples.is_pose[rows]]]
    M = (len(row_weight) - 3 * N) // 3
    at = np.concatenate([rows, N + rows, 2 * N + rows, *(3 * N + M * d + turned for d in range(3))])
    around, weight = model.drivers(some), row_weight[at]
    view = RowView.of(model, some, around)
    here, geometry = linearise(model, parameters, values, some, drivers=around).J, np.zeros(len(parameters))
    root, pull = np.sqrt(weight), np.zeros(len(values))
    motions = np.stack([joint_motion(view, model.chain, j) for j in range(model.chain.n)])
    for motion, moved in zip(motions, np.eye(model.chain.n), strict=True):
        there = linearise(model, parameters, geometry, replace(some, q=some.q + _NEAR * moved)).J
        pull[: len(there)] += (there - here[: len(there)]) @ (weight * motion) / _NEAR

    def of_each(x: Array) -> Array:  # (k, 3 n + 3 m) as (n, k, 6), zero where there is no orientation
        out = np.zeros((len(rows), len(x), 6))
        out[:, :, :3] = x[:, : 3 * len(rows)].reshape(len(x), 3, -1).transpose(2, 0, 1)
        out[some.is_pose, :, 3:] = x[:, 3 * len(rows) :].reshape(len(x), 3, -1).transpose(2, 0, 1)
        return out

    each, seen = of_each(motions * root), float(dimensions(some).sum())
    square = float((each**2).sum()) / seen
    size, axes = np.linalg.eigh(np.swapaxes(each, 1, 2) @ each / max(square, 1e-300))
    lower = np.linalg.cholesky(H * np.outer(std, std) + np.eye(len(H)))
    half = scipy.linalg.solve_triangular(lower, std[:, None] * here * root, lower=True)
    free = np.maximum(1.0 - (half**2).sum(axis=0), _FREE_SHARE)
    missed = (of_each((left[at] * root / np.sqrt(free))[None]) @ axes)[:, 0] ** 2
    spread = 1.0 - SHARES[:, None, None] + SHARES[:, None, None] * np.maximum(size, 0.0)
    scale = (missed / spread).sum(axis=(1, 2)) / seen
    blind = 6.0 * len(rows) - seen  # directions that no reading has, in which nothing is missed
    told = -0.5 * (np.log(spread).sum(axis=(1, 2)) - blind * np.log(1.0 - SHARES) + seen * np.log(scale))
    likely = np.exp(told - told.max())
    return _OfJoints(square, likely / likely.sum(), pull * N / len(rows))


def shows_base(samples: Samples, frame: int) -> bool:
    """Whether the readings in a frame are positions there, which show where the base is, and every length."""
    names = set(samples.kind[samples.frame == frame].tolist())
    return any(kinds()[name].direct for name in names) and not samples.is_same_point(frame)


def joint_motion(view: RowView, chain: Mechanism, j: int) -> Array:
    """How readings move per rad or m of a joint, (3 N + 3 M,)."""
    return view.unit_column(chain.first_place + j, 5 if chain.revolute[j] else 2)


def _names(pattern: str, parameters: Sequence[ModelParameter]) -> bool:
    from fnmatch import fnmatchcase

    return any(fnmatchcase(p.name, pattern) or p.name.rpartition("/")[0] == pattern for p in parameters)
