"""How far the point moves for each parameter's error: at one posture, and over many.

The closed chain goes from the measuring frame over the arm to the measured point, P_M = T_M_B · T_B_tool0 · P_tool0.
For n joints in Denavit–Hartenberg form it has 4 n + 9 parameters: theta, d, a and alpha of every row, three shifts
(along the measuring frame) and three turns (about the base) of the base, and three coordinates of the point in the last
frame. DH cannot hold nearly parallel axes; the directions that a calibration uses are the other choice and hold for any
robot. Errors count to first order. With R the frame in front of a parameter's motion, o its origin and p the point,

    ∂p/∂g = R e  (shift along e)        ∂p/∂g = (R e) × (p − o),  ∂rot/∂g = R e  (turn about e)

    Θ_k(q) = ‖∂p/∂g_k · Δg_k‖                          single-point index (SFDPE)
    Θ_k    = Σ_i P_k(Θ_k(q_i)) Θ_k(q_i) / Σ_i P_k(…)    multi-point index (SFCDPE)

P_k is the share of postures in the bin of the histogram of Θ_k that a value falls in: what is usual counts most.
Divided by that of a base factor they are the relative indices RSFDPE and RSFCDPE.

Gains: errors before calibration are independent with deviations Δg, C = diag(Δg²); measurements leave C' = (C⁻¹ + Jᵀ W
J)⁻¹. With derivatives G where accuracy counts, the mean square error is V = mean tr(G C Gᵀ), and

    V_k = mean ‖G C e_k‖² / C_kk

of it goes away when parameter k comes to be known exactly. Afterwards it counts only what the measurements left: a
parameter that is seen only together with another has no gain left when the two also act together. *Matters and is not
seen* is a parameter that had a share worth naming, more than half of which is still there.

An orthogonal array of strength 2 shows, in any two of its columns, every pair of levels equally often. For a prime
number of levels s, runs are the vectors u of s^k, columns the vectors c whose first number that is not zero is 1, and
entries u · c mod s (Bose & Bush 1952): (s^k − 1) / (s − 1) columns. s = 5 and k = 2 is Taguchi's L25(5^6).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration import View, choose_parameters, linearise
from modcal_core.errors import BadTable
from modcal_core.geometry import DIRECTIONS, Array, se3
from modcal_core.measurements import POSE
from modcal_core.planning.pool import one_frame_model, readings_at
from modcal_core.robots import Chain, Mechanism, joint_ranges, random_postures, read_rows, takes, to_dh
from modcal_core.schema import NUMBER


@dataclass(frozen=True)
class Factor:
    """A parameter whose error matters. name: "JOINT/theta", "base/rx", "point/z" or as a calibration has it."""

    name: str
    unit: str

    @property
    def is_length(self) -> bool:
        """Whether it is a shift rather than a turn."""
        return self.unit == "m"


@dataclass(frozen=True)
class ClosedChain:
    """chain: the nominal arm. factors: the P parameters. jacobian: d(position, orientation)/d(parameter), (N, 6, P), in
    the measuring frame, at postures q (N, n).
    """

    chain: Mechanism
    factors: tuple[Factor, ...]
    jacobian: Callable[[Array], Array]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(f.name for f in self.factors)

    def index(self, name: str) -> int:
        """Number of the named parameter. Raises BadTable."""
        if name not in self.names:
            raise BadTable(f"parameter '{name}'", "is not one of the chain's", f"choose from {', '.join(self.names)}")
        return self.names.index(name)

    def only(self, patterns: Sequence[str]) -> ClosedChain:
        """The same chain with the parameters that these names or patterns name, the others taken as known; with all of
        them where there are no patterns. Raises BadTable for one that names nothing.
        """
        kept = sorted({k for pattern in patterns for k in self.matching(pattern)})
        if not kept:
            return self
        factors = tuple(self.factors[k] for k in kept)
        return replace(self, factors=factors, jacobian=lambda q: self.jacobian(q)[..., kept])

    def matching(self, pattern: str) -> list[int]:
        """Numbers of the parameters that a name or pattern names. Raises BadTable where there are none."""
        hit = [k for k, name in enumerate(self.names) if fnmatchcase(name, pattern)]
        if not hit:
            raise BadTable(f"pattern '{pattern}'", "matches no parameter", f"choose from {', '.join(self.names)}")
        return hit


_DH = (("theta", 5), ("d", 2), ("a", 0), ("alpha", 3))  # in the order in which a row moves the frame


def dh_closed_chain(
    chain: Chain, T_measuring_base: Array | None = None, point: ArrayLike = (0.0, 0.0, 0.0)
) -> ClosedChain:
    """The closed chain in 4 n + 9 parameters. point: what is measured, in the tip [m]. Raises NotRepresentable where DH
    cannot hold the arm: take :func:`calibration_chain` then.
    """
    rows = read_rows(to_dh(chain), "dh", {key: NUMBER for key, _ in _DH})
    columns = {key: rows.column(key) for key, _ in _DH}
    base = np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float)
    named = [(f"base/{DIRECTIONS[d]}", d) for d in range(6)]
    named += [(f"{joint}/{key}", d) for joint in chain.names for key, d in _DH]
    named += [(f"point/{DIRECTIONS[d]}", d) for d in range(3)]

    def jacobian(q: Array) -> Array:
        q = np.atleast_2d(np.asarray(q, dtype=float))
        T = np.tile(np.eye(4), (len(q), 1, 1))
        before = [T] * 3 + [T @ base] * 3  # the frame in front of each parameter's motion
        T = T @ base @ rows.T_base
        for k in range(chain.n):
            for key, d in _DH:
                xi = np.zeros((len(q), 6))
                xi[:, d] = columns[key][k] + (q[:, k] if key == ("theta" if chain.revolute[k] else "d") else 0.0)
                before.append(T)
                T = T @ se3.exp(xi)
        T = T @ rows.T_tool @ se3.transform(p=point)
        J = np.zeros((len(q), 6, len(named)))
        for j, ((_, d), at) in enumerate(zip(named, [*before, T, T, T], strict=True)):
            axis = at[:, :3, d % 3]
            J[:, :3, j] = axis if d < 3 else np.cross(axis, T[:, :3, 3] - at[:, :3, 3])
            J[:, 3:, j] = axis if d >= 3 else 0.0
        return J

    return ClosedChain(chain, tuple(Factor(name, "m" if d < 3 else "rad") for name, d in named), jacobian)


def calibration_chain(
    chain: Mechanism, T_measuring_base: Array | None = None, T_tip_tool: Array | None = None, kind: str = "point"
) -> ClosedChain:
    """The closed chain in the parameters that ``modcal calibrate`` would fit to readings of this kind, by its names."""
    model = one_frame_model(chain, T_measuring_base, T_tip_tool)
    parameters = choose_parameters(model, (View(kind, 0),)).parameters
    P = len(parameters)

    def jacobian(q: Array) -> Array:
        samples = readings_at(model, np.atleast_2d(np.asarray(q, dtype=float)), POSE)
        N = len(samples)
        seen = linearise(model, parameters, np.zeros(P), samples).J.reshape(P, 2, 3, N)  # as seen from the root
        R = model.T_frame_base[0, :3, :3] @ model.chain.T_base_root[:3, :3]
        return np.asarray(np.einsum("ab,pkbn->nkap", R, seen).reshape(N, 6, P))

    return ClosedChain(chain, tuple(Factor(p.name, p.unit) for p in parameters), jacobian)


def sizes_of(closed: ClosedChain, length: float, angle: float, tolerances: Mapping[str, float] | None = None) -> Array:
    """Sizes Δg of the parameters' errors, (P,): one for lengths [m], one for angles [rad], others by name or pattern.
    Raises BadTable for a pattern that names nothing and for a size that is negative or not finite.
    """
    out = np.array([length if f.is_length else angle for f in closed.factors])
    for pattern, size in (tolerances or {}).items():
        out[closed.matching(pattern)] = size
    bad = np.flatnonzero(~np.isfinite(out) | (out < 0.0))
    if len(bad):
        name = closed.names[bad[0]]
        raise BadTable(f"tolerance of '{name}'", f"is {out[bad[0]]}, at least 0 is needed", "give metres or radians")
    return out


# --- Postures of an orthogonal array

LEVELS = 5  # with six joints Taguchi's L25(5^6)
_MAX_RUNS = 20_000  # for time
_SAME = 1e-6  # rad


def orthogonal_array(factors: int, levels: int) -> np.ndarray:
    """The smallest array of strength 2 with these columns, entries 0 … levels − 1, (levels^k, factors). Raises BadTable
    unless levels is a prime, and where the array would have more than 20 000 rows.
    """
    if levels < 2 or any(levels % d == 0 for d in range(2, int(levels**0.5) + 1)):
        what = f"orthogonal array of {levels} levels"
        raise BadTable(what, "the number is not a prime", "choose 2, 3, 5, 7, 11 or 13")
    k = 2
    while (levels**k - 1) // (levels - 1) < factors:
        k += 1
    if levels**k > _MAX_RUNS:
        said = f"{levels**k} runs, {_MAX_RUNS} are the limit"
        raise BadTable(f"orthogonal array of {factors} factors at {levels} levels", said, "choose fewer levels")
    # unit vectors last to first, then the sums: i, j, i + j, i + 2 j … for two
    forms = sorted(
        (c for c in product(range(levels), repeat=k) if any(c) and c[np.flatnonzero(c)[0]] == 1),
        key=lambda c: (sum(x > 0 for x in c), tuple(x > 0 for x in reversed(c)), c),
    )
    runs = np.array(list(product(range(levels), repeat=k)))
    return np.asarray(runs @ np.array(forms[:factors]).T % levels)


def array_postures(chain: Mechanism, levels: int = LEVELS) -> Array:
    """Postures (N, n) [rad, m] of the orthogonal array, every joint at so many levels from its least to its largest, or
    over one turn where some of them would be the same angle.
    """
    low, high = joint_ranges(chain)
    array = orthogonal_array(chain.n, levels)
    q = np.column_stack([_levels(low[k], high[k], levels, chain.revolute[k])[array[:, k]] for k in range(chain.n)])
    return q[takes(chain, q)]


def _levels(low: float, high: float, count: int, turns: bool) -> Array:
    at = np.linspace(low, high, count)
    if turns:
        apart = np.abs(np.angle(np.exp(1j * (at[:, None] - at[None]))))[np.triu_indices(count, 1)]
        if apart.min() < _SAME:
            return np.asarray(0.5 * (low + high) + 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5))
    return at


# --- How far the point moves

_ROUNDING = 1e-9  # share of a value within which values are the same


@dataclass(frozen=True)
class Sensitivity:
    """Indices of P parameters at N postures.

    names: of the parameters. base: number of the base factor. sizes: Δg (P,) [m, rad]. single: (N, P) [m]. multi: (P,)
    [m].
    """

    names: tuple[str, ...]
    base: int
    sizes: Array
    single: Array
    multi: Array

    @property
    def relative_single(self) -> Array:
        """Single-point indices over that of the base factor at the same posture, (N, P)."""
        return self.single / self.single[:, self.base, None]

    @property
    def relative_multi(self) -> Array:
        """Multi-point indices over that of the base factor, (P,)."""
        return self.multi / self.multi[self.base]

    @property
    def mean(self) -> Array:
        """Plain means over the postures [m], (P,)."""
        return self.single.mean(axis=0)


def sensitivity(closed: ClosedChain, q: Array, sizes: Array, base: str, bins: int | None = None) -> Sensitivity:
    """Single- and multi-point indices of every parameter over postures q (N, n).

    base: name of the base factor. bins: intervals of the histograms; Sturges' 1 + log2 N where it is not given. Raises
    BadTable for a base factor that is not there or moves nothing.
    """
    single = np.linalg.norm(closed.jacobian(q)[:, :3], axis=1) * sizes
    reference = closed.index(base)
    if not (single[:, reference] > _ROUNDING * single.max()).all():
        raise BadTable(f"base factor '{base}'", "moves nothing at some posture", "choose a shift, such as base/x")
    bins = int(np.ceil(np.log2(len(q)))) + 1 if bins is None else bins
    weights = [interval_probabilities(column, bins) for column in single.T]
    multi = np.array([w @ column / w.sum() for w, column in zip(weights, single.T, strict=True)])
    return Sensitivity(closed.names, reference, sizes, single, multi)


def interval_probabilities(values: Array, bins: int) -> Array:
    """For each value (N,) the share of all values in the interval of the histogram that it falls in, (N,)."""
    low, high = float(values.min()), float(values.max())
    if high - low <= _ROUNDING * max(abs(high), abs(low)):
        return np.ones(len(values))
    index = np.minimum(((values - low) / (high - low) * bins).astype(int), bins - 1)
    return np.asarray(np.bincount(index, minlength=bins)[index] / len(values))


# --- What knowing a parameter is worth, before and after the measurements that are planned

NAMED = 0.01  # share of the mean square error from which on a parameter matters
_LEFT = 0.5  # share of a gain that, if left over, calls a parameter not seen


@dataclass(frozen=True)
class Gain:
    """mean_square: V [m²]. of_each: V_k [m²], (P,), what goes away when only parameter k is known exactly."""

    mean_square: float
    of_each: Array

    @property
    def rms(self) -> float:
        """RMS position error [m]."""
        return float(np.sqrt(self.mean_square))

    @property
    def share(self) -> Array:
        """Shares of the mean square error, (P,)."""
        return self.of_each / max(self.mean_square, 1e-300)

    @property
    def rms_gain(self) -> Array:
        """By how much the RMS error [m] falls when the parameter comes to be known, (P,)."""
        return self.rms - np.sqrt(np.maximum(self.mean_square - self.of_each, 0.0))


def gains(G: Array, covariance: Array) -> Gain:
    """The gain from knowing each parameter, for derivatives G (N, 3, P) of positions and a covariance (P, P)."""
    GC = G @ covariance
    of_each = np.mean(np.sum(GC**2, axis=1), axis=0) / np.maximum(np.diag(covariance), 1e-300)
    return Gain(float(np.mean(np.sum(GC * G, axis=(1, 2)))), of_each)


def left_by(J: Array, std: Array, sizes: Array) -> Array:
    """Covariance (P, P) that readings leave. J: derivatives of all readings, (R, P). std: of each, (R,). sizes: Δg."""
    scaled = J * sizes / std[:, None]
    information = np.eye(len(sizes)) + scaled.T @ scaled
    return np.linalg.inv(information) * np.outer(sizes, sizes)


@dataclass(frozen=True)
class JointGain:
    """Gains before and after measurements. seen: 1 − (deviation after / before)², (P,): 0 nothing is learned, 1 all."""

    before: Gain
    after: Gain
    seen: Array

    @property
    def unseen(self) -> np.ndarray:
        """True for parameters that matter and that the measurements leave open, (P,)."""
        left = self.after.of_each / np.maximum(self.before.of_each, 1e-300)
        return (self.before.share >= NAMED) & (left > _LEFT)


def joint_use(G: Array, sizes: Array, J: Array, std: Array) -> JointGain:
    """Sensitivity and observability together: derivatives G (N, 3, P) where it counts, J (R, P) of what is measured
    with these deviations (R,) [m or rad]; sizes Δg (P,) [m, rad].
    """
    before = np.diag(sizes**2)
    after = left_by(J, std, sizes)
    seen = 1.0 - np.diag(after) / np.maximum(sizes**2, 1e-300)
    return JointGain(gains(G, before), gains(G, after), np.where(sizes > 0.0, seen, 0.0))


# --- The whole study of a closed chain: indices, gains, and what measuring these stations would leave

_GAIN_POSTURES = 2048  # where accuracy counts; derivatives are cheap


@dataclass(frozen=True)
class Measured:
    """Stations that are measured. q: (N, n). kind: point or pose. std_m, std_rad: of a reading per axis."""

    q: Array
    kind: str = "point"
    std_m: float = 5e-5
    std_rad: float = 5e-5


@dataclass(frozen=True)
class Study:
    """closed: the chain. q: postures (N, n) of the indices. joint: over random postures, by what is measured."""

    closed: ClosedChain
    q: Array
    indices: Sensitivity
    joint: JointGain
    measured: Measured


def study(closed: ClosedChain, q: Array, sizes: Array, base: str, measured: Measured) -> Study:
    """Everything there is to say of the sensitivity of a closed chain at postures q (N, n), with errors of these sizes
    (P,) [m, rad] beside that of the base factor. Raises BadTable for a base factor as :func:`sensitivity`.
    """
    indices = sensitivity(closed, q, sizes, base)
    workspace = random_postures(closed.chain, _GAIN_POSTURES, np.random.default_rng(0))  # the same each time
    G = closed.jacobian(workspace)[:, :3]
    rows = 6 if measured.kind == "pose" else 3
    J = closed.jacobian(measured.q)[:, :rows].reshape(-1, len(sizes))
    std = np.tile(np.repeat([measured.std_m, measured.std_rad], 3)[:rows], len(measured.q))
    return Study(closed, q, indices, joint_use(G, sizes, J, std), measured)
