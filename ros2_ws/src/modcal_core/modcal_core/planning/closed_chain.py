"""The closed chain from the measuring frame over the arm to the point that is measured, and its parameters.

    P_M = T_M_B · T_B_tool0 · P_tool0

For an arm of n joints in Denavit–Hartenberg form these are 4 n + 9 parameters (33 for six joints): theta, d, a and
alpha of every row, three shifts (along the measuring frame) and three turns (about the base) of the base, and the three
coordinates of the point in the last frame. DH cannot hold nearly parallel axes; the directions that a calibration uses,
one at each place, are the other choice and hold for any robot.

Errors count to first order, for which a millimetre and a milliradian are small: they change derivatives by some
thousandths. With R the frame in front of a parameter's motion, o its origin and p the point,

    ∂p/∂g = R e  (shift along e)        ∂p/∂g = (R e) × (p − o),  ∂rot/∂g = R e  (turn about e)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration import Model, View, choose_parameters, exact_samples, linearise
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import Chain, Mechanism, read_rows, to_dh
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
        return replace(
            self, factors=tuple(self.factors[k] for k in kept), jacobian=lambda q: self.jacobian(q)[..., kept]
        )

    def matching(self, pattern: str) -> list[int]:
        """Numbers of the parameters that a name or pattern names. Raises BadTable where there are none."""
        hit = [k for k, name in enumerate(self.names) if fnmatchcase(name, pattern)]
        if not hit:
            raise BadTable(f"pattern '{pattern}'", "matches no parameter", f"choose from {', '.join(self.names)}")
        return hit


_DH = (("theta", 5), ("d", 2), ("a", 0), ("alpha", 3))  # in the order in which a row moves the frame
_AXES = ("x", "y", "z", "rx", "ry", "rz")


def dh_closed_chain(
    chain: Chain, T_measuring_base: Array | None = None, point: ArrayLike = (0.0, 0.0, 0.0)
) -> ClosedChain:
    """The closed chain in 4 n + 9 parameters. point: what is measured, in the tip [m].

    Raises NotRepresentable where DH cannot hold the arm: take :func:`calibration_chain` then.
    """
    rows = read_rows(to_dh(chain), "dh", {key: NUMBER for key, _ in _DH})
    columns = {key: rows.column(key) for key, _ in _DH}
    base = np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float)
    named = [(f"base/{_AXES[d]}", d) for d in range(6)]
    named += [(f"{joint}/{key}", d) for joint in chain.names for key, d in _DH]
    named += [(f"point/{_AXES[d]}", d) for d in range(3)]

    def jacobian(q: Array) -> Array:
        q = np.atleast_2d(np.asarray(q, dtype=float))
        T = np.tile(np.eye(4), (len(q), 1, 1))
        before = [T] * 3 + [T @ base] * 3  # the frame in front of each parameter's motion
        T = T @ base @ rows.T_base
        for k in range(chain.n):
            for pair in (_DH[:2], _DH[2:]):  # a turn about and a shift along one axis commute
                before += [T, T]
                xi = np.zeros((len(q), 6))
                for key, d in pair:
                    xi[:, d] = columns[key][k]
                if pair == _DH[:2]:
                    xi[:, 5 if chain.revolute[k] else 2] += q[:, k]
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


def one_frame_model(chain: Mechanism, T_measuring_base: Array | None = None, T_tip_tool: Array | None = None) -> Model:
    """The nominal arm watched from one frame called ``tracker``; poses default to the identity."""
    base = np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float)
    tool = np.eye(4) if T_tip_tool is None else np.asarray(T_tip_tool, dtype=float)
    return Model(chain, ("tracker",), base[None], tool)


def readings_at(model: Model, q: Array, kind: str) -> Samples:
    """Readings of a kind, in the first frame, at postures q (N, n), as the model's geometry makes them."""
    N = len(q)
    return exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES))


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
