"""A Delta from distances between points alone: no frame has to be known, or even to exist (CN114571465B).

With p(q; X) the tool's position for the 24 parameters X of :class:`modcal_core.robots.delta.Delta`, and D_ij the
measured distance between the points of postures i and j,

    r_ij = D_ij − |p(q_i; X) − p(q_j; X)|,        f(X) = RMS of r_ij,

    ∂r_ij/∂X = −u_ij · (∂p_i/∂X − ∂p_j/∂X),        u_ij = (p_i − p_j) / |p_i − p_j|.

Distances stay the same when all points are moved together, so what moves all of them cannot be told, see
:func:`visibility`. The fit leaves nominal what distances show only together with parameters before it.

All parameters are shaken at once, ``X' = X + step (rand − 0.5)``; a better X' is taken, a worse one with probability
``exp(−(f(X') − f(X)) / T)`` (Metropolis). After so many trials the temperature falls by a factor, and the next ones
begin at the best X so far. Nothing is said of what the data cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.initial import procrustes
from modcal_core.calibration.parameters import PRIOR_ANGLE_RAD, PRIOR_LENGTH_M, independent_columns
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import (
    ARMS,
    AZIMUTH,
    CONSTANTS,
    OFFSET,
    PARAMETERS,
    ZERO,
    Delta,
    position_jacobians,
    tool_positions,
)

# --- Simulated annealing as CN114571465B describes it, to stand beside least squares


@dataclass(frozen=True)
class Schedule:
    """step: width of the shaking, in the parameters' units. trials: at each temperature. first, last: temperatures, in
    the unit of f. cooling: factor from one to the next. most: temperatures at the most.
    """

    step: float = 1e-3
    trials: int = 60
    first: float = 1e-4
    last: float = 1e-7
    cooling: float = 0.93
    most: int = 1000


@dataclass(frozen=True)
class Annealed:
    """The least f that was met, how often f was asked for, and the least f after each temperature."""

    f: float
    evaluations: int
    history: tuple[float, ...]


_RANK = 1e-7  # share of the largest singular value below which a combination changes nothing
_NAMED = 0.3  # share of a direction (of unit length) above which a parameter is named as part of it
_INSIDE = 0.999  # of the largest deviation; a fit begins inside its bounds
_MAX_TOOL_DEVIATION = 0.1  # m, rad; where a tool is held is less sure than how a robot is built


@dataclass(frozen=True)
class Pairs:
    """Measured distances. first, second: numbers of the postures, (D,). distance: [m], (D,)."""

    first: np.ndarray
    second: np.ndarray
    distance: Array

    @classmethod
    def of_points(cls, points: Array) -> Pairs:
        """All distances between points (N, 3) [m], whatever frame they are in."""
        first, second = np.triu_indices(len(points), 1)
        return cls(first, second, np.linalg.norm(points[first] - points[second], axis=1))


@dataclass(frozen=True)
class DistanceFit:
    """What distances say of a Delta.

    delta: fitted. f: RMS of the distances' errors before and after [m]. evaluations: of f or of its derivatives.
    at_bound: names of parameters that ended at a bound.
    """

    delta: Delta
    before: float
    f: float
    evaluations: int
    at_bound: tuple[str, ...]


def max_deviations(delta: Delta) -> Array:
    """How far each parameter may be from the drawing, (24,): 10 mm, 20 mrad, 2 % of a ratio; at the tool 0.1 m, rad."""
    units = delta.units.values()
    arms = np.repeat([PRIOR_LENGTH_M if unit == "m" else PRIOR_ANGLE_RAD for unit in units], ARMS)
    return np.r_[arms, np.full(PARAMETERS - len(arms), _MAX_TOOL_DEVIATION)]


def distance_errors(delta: Delta, q: Array, pairs: Pairs) -> Array:
    """Measured minus modelled distances [m], (D,), for postures q (N, n); NaN where no platform fits."""
    p = tool_positions(delta, q)
    return np.asarray(pairs.distance - np.linalg.norm(p[:, pairs.first] - p[:, pairs.second], axis=0))


def distance_jacobian(delta: Delta, q: Array, pairs: Pairs) -> Array:
    """Derivatives of the modelled distances by the parameters, (D, 24) [m per rad, 1 or m]."""
    p, J, _ = position_jacobians(delta, q)
    gap = p[pairs.first] - p[pairs.second]
    u = gap / np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-12)
    return np.einsum("dc,dcx->dx", u, J[pairs.first] - J[pairs.second])


def objective(delta: Delta, q: Array, pairs: Pairs) -> float:
    """f(X) [m]; infinite where some posture has no platform."""
    r = distance_errors(delta, q, pairs)
    return float(np.sqrt(np.mean(r * r))) if np.isfinite(r).all() else np.inf


def fit_distances(
    nominal: Delta, q: Array, pairs: Pairs, max_deviation: Array | None = None, begin: Delta | None = None
) -> DistanceFit:
    """The Delta whose distances are nearest to the measured ones, by bounded least squares with analytic derivatives.

    max_deviation: how far each parameter may be from nominal, (24,); 0 holds it. begin: where to begin, such as where
    annealing ended; nominal by default. Raises NotEnoughData where distances are no more than the combinations they
    show, BadRecording for postures that the nominal robot cannot take.
    """
    max_deviation = max_deviations(nominal) if max_deviation is None else np.asarray(max_deviation, dtype=float)
    before = _start(nominal, q, pairs)
    free = np.flatnonzero(max_deviation > 0.0)
    seen = visibility(nominal, q, pairs, max_deviation)
    told = min(len(pairs.distance), 3 * len(q) - 6)  # points in space have no more than that of their own
    if seen.rank >= told:
        limit = f"{told} independent ones are not more than the combinations of parameters they depend on"
        raise NotEnoughData(f"{len(pairs.distance)} distances", limit, "measure more of them, or fix parameters")

    shown = distance_jacobian(nominal, q, pairs)[:, free] * max_deviation[free]
    size = np.linalg.norm(shown, axis=0)
    free, shown = free[size > _RANK * size.max()], shown[:, size > _RANK * size.max()]
    free = free[independent_columns(shown, _RANK)]

    def at(x: Array) -> Delta:
        X = nominal.vector.copy()
        X[free] += x * max_deviation[free]
        return nominal.with_vector(X)

    def errors(x: Array) -> Array:
        r = distance_errors(at(x), q, pairs)
        return r if np.isfinite(r).all() else np.full(len(r), nominal.reach())

    def derivatives(x: Array) -> Array:
        return -distance_jacobian(at(x), q, pairs)[:, free] * max_deviation[free]

    first = np.zeros(len(free))
    if begin is not None:
        first = np.clip((begin.vector - nominal.vector)[free] / max_deviation[free], -_INSIDE, _INSIDE)
    found = least_squares(
        errors, first, derivatives, bounds=(-1.0, 1.0), method="trf", tr_solver="exact",
        ftol=1e-13, xtol=1e-13, gtol=1e-15,
    )  # fmt: skip
    fitted = at(found.x)
    after = objective(fitted, q, pairs)
    names = nominal.parameter_names
    ended = tuple(names[j] for j, x in zip(free, found.x, strict=True) if abs(x) > 1.0 - 1e-6)
    return DistanceFit(fitted, before, after, int(found.nfev + (found.njev or 0)), ended)


def anneal_distances(
    nominal: Delta,
    q: Array,
    pairs: Pairs,
    rng: np.random.Generator,
    schedule: Schedule | None = None,
    max_deviation: Array | None = None,
) -> tuple[Delta, Annealed]:
    """The Delta of the least f that a walk from the nominal one meets, and how it went.

    max_deviation: as of the fit; X is drawn in to it.
    """
    max_deviation = max_deviations(nominal) if max_deviation is None else np.asarray(max_deviation, dtype=float)
    plan = schedule or Schedule()
    low, high = nominal.vector - max_deviation, nominal.vector + max_deviation
    best = here = nominal.vector
    best_f = here_f = _start(nominal, q, pairs)
    evaluations, temperature = 1, plan.first
    history: list[float] = []
    while temperature >= plan.last and len(history) < plan.most:
        for _ in range(plan.trials):
            tried = np.clip(here + plan.step * (rng.random(PARAMETERS) - 0.5), low, high)
            tried_f = objective(nominal.with_vector(tried), q, pairs)
            evaluations += 1
            if tried_f <= here_f or rng.random() < np.exp(-(tried_f - here_f) / temperature):
                here, here_f = tried, tried_f
                if here_f <= best_f:
                    best, best_f = here, here_f
        history.append(best_f)
        here, here_f = best, best_f
        temperature *= plan.cooling
    return nominal.with_vector(best), Annealed(best_f, evaluations, tuple(history))


@dataclass(frozen=True)
class Visibility:
    """Which combinations of the 24 parameters distances show at certain postures.

    rank: how many. condition: ratio of the largest to the smallest singular value among them, each parameter in units
    of its largest deviation. unseen: the others, in words. weakest: what is seen least of all, by name.
    """

    rank: int
    condition: float
    unseen: tuple[str, ...]
    weakest: str


def visibility(delta: Delta, q: Array, pairs: Pairs, max_deviation: Array | None = None) -> Visibility:
    """What these distances can tell of the parameters, and what they cannot.

    max_deviation: 0 for parameters that are held.
    """
    max_deviation = max_deviations(delta) if max_deviation is None else np.asarray(max_deviation, dtype=float)
    J = distance_jacobian(delta, q, pairs) * max_deviation
    _, size, Vt = np.linalg.svd(np.concatenate([J, np.zeros((PARAMETERS, PARAMETERS))]), full_matrices=False)
    rank = int((size > _RANK * size[0]).sum())
    held = np.flatnonzero(max_deviation == 0.0)
    left = Vt[rank:].T
    left = left[:, np.linalg.norm(left, axis=0) > 0.5]
    words = []
    named = np.eye(PARAMETERS)[:, held]
    for direction, sentence in _freedoms(delta):
        v = np.where(max_deviation > 0.0, direction / np.maximum(max_deviation, 1e-300), 0.0)
        if (direction[held] != 0.0).any() or not v.any():
            continue
        v /= np.linalg.norm(v)
        if np.linalg.norm(J @ v) <= 10.0 * _RANK * size[0]:
            words.append(sentence)
            named = np.c_[named, v]
    basis, _ = np.linalg.qr(named) if named.shape[1] else (named, None)
    rest = left - basis @ (basis.T @ left)
    U, extent, _ = np.linalg.svd(rest, full_matrices=False)
    words += [_parts(delta, u) for u, e in zip(U.T, extent, strict=True) if e > 0.5]
    condition = float(size[0] / size[rank - 1]) if rank else np.inf
    return Visibility(rank, condition, tuple(words), _parts(delta, Vt[rank - 1]) if rank else "")


def _freedoms(delta: Delta) -> list[tuple[Array, str]]:
    """Combinations that move all points together, or none: their directions (24,), and what they are."""
    names = delta.parameter_names
    arms = CONSTANTS * ARMS

    def one(name: str) -> Array:
        return np.asarray(np.eye(PARAMETERS)[names.index(name)])

    at, turn = delta.constants[AZIMUTH], np.zeros(PARAMETERS)
    turn[AZIMUTH * ARMS : (AZIMUTH + 1) * ARMS] = 1.0
    turn[arms], turn[arms + 1] = -delta.tool[1], delta.tool[0]
    out = [
        (turn, "azimuths of all arms together, the tool turned along: that turns the base"),
        (one("tool/z"), "tool/z: that lifts the base"),
        *((one(f"tool/{d}"), f"tool/{d}: a point has no orientation") for d in ("rx", "ry", "rz")),
    ]
    shift = ((one(f"tool/{d}"), f"tool/{d}: without a turn of the shaft that shifts the base") for d in ("x", "y"))
    if delta.linear:  # with upright towers the base moves with what their carriages have in common
        lift = (np.arange(PARAMETERS) // ARMS == ZERO).astype(float)
        out.append((lift, "zeros of all towers together: that lifts the base"))
        for way, (along, across) in {"x": (np.cos, -np.sin(at)), "y": (np.sin, np.cos(at))}.items():
            moved = np.zeros((CONSTANTS, ARMS))
            moved[OFFSET], moved[AZIMUTH] = along(at), across / delta.constants[OFFSET]
            both = np.r_[moved.ravel(), np.zeros(PARAMETERS - arms)]
            out.append((both, f"offsets and azimuths of all towers along {way}: that shifts the base"))
    return [*out, *shift]


def _parts(delta: Delta, v: Array) -> str:
    parts = sorted(((abs(x), name) for x, name in zip(v, delta.parameter_names, strict=True)), reverse=True)
    return " with ".join([name for size, name in parts if size >= _NAMED] or [parts[0][1]])


def _start(nominal: Delta, q: Array, pairs: Pairs) -> float:
    before = objective(nominal, q, pairs)
    if not np.isfinite(before):
        lost = int((~np.isfinite(tool_positions(nominal, q)).all(axis=0)).sum())
        said = f"{lost} of {len(q)} cannot be reached by the nominal Delta"
        raise BadRecording("postures", said, "correct its constants, joint names and signs, or leave them out")
    return before


# --- The published method beside least squares, scored on points that none of them has seen

_MOST = 100  # points; all distances between more take annealing minutes and say nothing new


@dataclass(frozen=True)
class DistanceMethod:
    """What one way to the parameters comes to. f: RMS of the errors of distances it was fitted to [m]. held_out: RMS
    miss of held-out points [m], their frame found from the fitted ones. evaluations: of f or of its derivatives.
    """

    name: str
    f: float
    held_out: float
    evaluations: int


@dataclass(frozen=True)
class ByDistances:
    """A Delta from distances alone, by several methods. points: that were fitted. seen: what their distances tell.
    at_bound: parameters that least squares left at a bound.
    """

    points: int
    seen: Visibility
    at_bound: tuple[str, ...]
    methods: tuple[DistanceMethod, ...]


def by_distances(nominal: Delta, train: Samples, held_out: Samples, rng: np.random.Generator) -> ByDistances:
    """Simulated annealing and least squares on the same distances, each from the nominal arms with the tool fitted.

    Raises BadRecording where readings are no points or poses in one frame, NotEnoughData where there are too few.
    """
    if len(train.frames) > 1 or not (train.is_pose | (train.kind == "point")).all() or train.is_same_point(0):
        remedy = "give points or poses in the frame of one tracker"
        raise BadRecording("readings", "have no distances between points of one frame", remedy)
    T = fit_cell(nominal, train, Cell()).model.T_tip_tool
    start = nominal.with_vector(np.r_[nominal.constants.ravel(), T[:3, 3], so3.log(T[:3, :3])])
    train = train.select(spread_rows(len(train), _MOST))
    pairs = Pairs.of_points(train.reading)
    direct = fit_distances(start, train.q, pairs)
    annealed, went = anneal_distances(start, train.q, pairs, rng)
    polished = fit_distances(start, train.q, pairs, begin=annealed)

    def method(name: str, delta: Delta, evaluations: int) -> DistanceMethod:
        T = procrustes(tool_positions(delta, train.q).T, train.reading)
        gap = held_out.reading - se3.apply(T, tool_positions(delta, held_out.q).T)
        missed = float(np.sqrt(np.mean(np.sum(gap * gap, axis=1))))
        return DistanceMethod(name, objective(delta, train.q, pairs), missed, evaluations)

    methods = (
        method("nominal", start, 0),
        method("simulated annealing", annealed, went.evaluations),
        method("annealing, then least squares", polished.delta, went.evaluations + polished.evaluations),
        method("least squares", direct.delta, direct.evaluations),
    )
    return ByDistances(len(train), visibility(start, train.q, pairs), direct.at_bound, methods)
