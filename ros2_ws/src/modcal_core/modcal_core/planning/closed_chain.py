"""The closed chain from the measuring frame over the arm to the point that is measured, and its parameters.

    P_M = T_M_B · T_B_tool0 · P_tool0

For an arm of n joints in Denavit–Hartenberg form these are 4 n + 9 parameters (33 for six joints): theta, d, a and
alpha of every row, three shifts (along the measuring frame) and three turns (about the base) of the base, and the three
coordinates of the point in the last frame. DH cannot hold nearly parallel axes; the directions that a calibration uses,
one at each place, are the other choice and hold for any arm.

The pose of a point is ``E_1 E_2 … E_m``, read from the measuring frame to the point. A motion is a constant transform,
a joint's, or a parameter's: zero for the nominal arm. In this form any number of arms, each with errors of its own, is
one sweep over vectors, and a derivative is the axis itself: with R the frame in front of a motion, o its origin and p
the point,

    ∂p/∂g = R e  (shift along e)        ∂p/∂g = (R e) × (p − o),  ∂rot/∂g = R e  (turn about e)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration import (
    Model,
    ModelParameter,
    RowView,
    View,
    choose_parameters,
    exact_samples,
    geometry_rows,
)
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import Chain, Mechanism, is_serial_arm, read_rows, to_dh

# --- A chain as a row of elementary motions, each a shift along or a turn about one axis of the frame it stands in

_BLOCK = 16_000  # arms times postures that are moved at once; more does not fit a processor's cache


@dataclass(frozen=True)
class ElementaryMotion:
    """direction: 0 … 5, shift along x y z or turn about x y z. joint, parameter: which of them makes it, else −1."""

    direction: int
    joint: int = -1
    parameter: int = -1


@dataclass(frozen=True)
class ElementaryChain:
    """A point at the end of a row of motions.

    steps: constants (4, 4) [m] and motions, from the measuring frame to the point; parameters are numbered 0, 1, …
    """

    steps: tuple[Array | ElementaryMotion, ...]

    @property
    def parameters(self) -> int:
        """How many there are."""
        return sum(isinstance(step, ElementaryMotion) and step.parameter >= 0 for step in self.steps)

    def positions(self, q: ArrayLike, errors: ArrayLike) -> Array:
        """The point [m] in the measuring frame, (S, N, 3), of S arms with errors (S, P) in postures q (N, n)."""
        q, x = np.atleast_2d(np.asarray(q, dtype=float)), np.atleast_2d(np.asarray(errors, dtype=float))
        assert x.shape[1] == self.parameters, x.shape
        rows = max(1, _BLOCK // max(len(q), 1))
        return np.concatenate([self._positions(q, x[i : i + rows]) for i in range(0, max(len(x), 1), rows)])

    def _positions(self, q: Array, x: Array) -> Array:
        p = np.zeros((3, len(x), len(q)))
        for step in reversed(self.steps):
            if not isinstance(step, ElementaryMotion):
                p = (step[:3, :3] @ p.reshape(3, -1)).reshape(p.shape) + step[:3, 3, None, None]
                continue
            size = q[None, :, step.joint] if step.joint >= 0 else x[:, step.parameter, None]
            if step.direction < 3:
                p[step.direction] += size
                continue
            b, c = (step.direction + 1) % 3, (step.direction + 2) % 3
            cos, sin = np.cos(size), np.sin(size)
            p[b], p[c] = cos * p[b] - sin * p[c], sin * p[b] + cos * p[c]
        return np.moveaxis(p, 0, -1)

    def jacobian(self, q: ArrayLike) -> Array:
        """Derivatives of the nominal arm's point and orientation, (N, 6, P) [m and rad per m or rad], at q (N, n)."""
        q = np.atleast_2d(np.asarray(q, dtype=float))
        N = len(q)
        T = np.tile(np.eye(4), (N, 1, 1))
        axes, origins, kinds = np.zeros((self.parameters, N, 3)), np.zeros((self.parameters, N, 3)), {}
        for step in self.steps:
            if not isinstance(step, ElementaryMotion):
                T = T @ step
            elif step.joint >= 0:
                xi = np.zeros((N, 6))
                xi[:, step.direction] = q[:, step.joint]
                T = T @ se3.exp(xi)
            else:
                axes[step.parameter] = T[:, :3, step.direction % 3]
                origins[step.parameter] = T[:, :3, 3]
                kinds[step.parameter] = step.direction >= 3
        turns = np.array([kinds[k] for k in range(self.parameters)], dtype=bool)
        J = np.zeros((N, 6, self.parameters))
        arm = np.cross(axes[turns], T[:, :3, 3] - origins[turns])
        J[:, :3, turns] = arm.transpose(1, 2, 0)
        J[:, 3:, turns] = axes[turns].transpose(1, 2, 0)
        J[:, :3, ~turns] = axes[~turns].transpose(1, 2, 0)
        return J


_DH = (("theta", 5), ("d", 2), ("a", 0), ("alpha", 3))  # in the order in which a row moves the frame


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
class ModelMotions:
    """The same of a robot whose loops no product of motions describes, to first order: a millimetre and a milliradian
    change its derivatives by some thousandths.
    """

    model: Model
    parameters: tuple[ModelParameter, ...]

    def positions(self, q: ArrayLike, errors: ArrayLike) -> Array:
        """The point [m], (S, N, 3), of arms with errors (S, P) [m, rad] in postures q (N, n) [rad, m]."""
        q, x = np.atleast_2d(np.asarray(q, dtype=float)), np.atleast_2d(np.asarray(errors, dtype=float))
        here = self.model.predict(q, np.zeros(len(q), dtype=int))[:, :3, 3]
        return np.asarray(here + np.einsum("nkp,sp->snk", self.jacobian(q)[:, :3], x))

    def jacobian(self, q: ArrayLike) -> Array:
        """d(position, orientation)/d(parameter), (N, 6, P), at postures q (N, n)."""
        q = np.asarray(q, dtype=float)
        N = len(q)
        samples = exact_samples(self.model, q, np.zeros(N, dtype=int), np.full(N, "pose", dtype=KIND_NAMES))
        view = RowView.of(self.model, samples, self.model.drivers(samples))
        rows = geometry_rows(view, self.model, self.parameters, np.zeros(len(self.parameters)))
        R = self.model.T_frame_base[0, :3, :3] @ self.model.chain.T_base_root[:3, :3]
        by_place = rows.reshape(len(rows), 2, 3, N)  # position, orientation, as seen from the root
        return np.einsum("ab,pkbn->nkap", R, by_place).reshape(N, 6, len(rows))


@dataclass(frozen=True)
class ClosedChain:
    """chain: the nominal arm. factors: the P parameters. motions: the same chain, one motion a parameter."""

    chain: Mechanism
    factors: tuple[Factor, ...]
    motions: ElementaryChain | ModelMotions

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(f.name for f in self.factors)

    def positions(self, q: ArrayLike, errors: ArrayLike) -> Array:
        """The point [m], (S, N, 3), of arms with errors (S, P) [m, rad] in postures q (N, n) [rad, m]."""
        return self.motions.positions(q, errors)

    def jacobian(self, q: ArrayLike) -> Array:
        """d(position, orientation)/d(parameter), (N, 6, P), at postures q (N, n)."""
        return self.motions.jacobian(q)

    def index(self, name: str) -> int:
        """Number of the named parameter. Raises BadTable."""
        if name not in self.names:
            raise BadTable(f"parameter '{name}'", "is not one of the chain's", f"choose from {', '.join(self.names)}")
        return self.names.index(name)


def dh_closed_chain(
    chain: Chain, T_measuring_base: Array | None = None, point: ArrayLike = (0.0, 0.0, 0.0)
) -> ClosedChain:
    """The closed chain in 4 n + 9 parameters. point: what is measured, in the tip [m].

    Raises NotRepresentable where DH cannot hold the arm: take :func:`calibration_chain` then.
    """
    table = to_dh(chain)
    rows = read_rows(table, "dh", {key for key, _ in _DH})
    columns = {key: rows.column(key) for key, _ in _DH}
    factors: list[Factor] = []
    steps: list[Array | ElementaryMotion] = []

    def add(name: str, direction: int) -> None:
        steps.append(ElementaryMotion(direction, parameter=len(factors)))
        factors.append(Factor(name, "m" if direction < 3 else "rad"))

    for d in range(3):
        add(f"base/{'xyz'[d]}", d)
    steps.append(np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float))
    for d in range(3):
        add(f"base/r{'xyz'[d]}", 3 + d)
    steps.append(rows.T_base)
    for k, joint in enumerate(chain.names):
        steps.append(ElementaryMotion(5 if chain.revolute[k] else 2, joint=k))
        for pair in (_DH[:2], _DH[2:]):  # a turn about and a shift along one axis commute
            xi = np.zeros(6)
            for key, direction in pair:
                add(f"{joint}/{key}", direction)
                xi[direction] = columns[key][k]
            steps.append(se3.exp(xi))
    steps.append(rows.T_tool @ se3.transform(p=point))
    for d in range(3):
        add(f"point/{'xyz'[d]}", d)
    return ClosedChain(chain, tuple(factors), ElementaryChain(tuple(steps)))


def calibration_chain(
    chain: Mechanism, T_measuring_base: Array | None = None, T_tip_tool: Array | None = None, kind: str = "point"
) -> ClosedChain:
    """The closed chain in the parameters that ``modcal calibrate`` would fit to readings of this kind, by its names."""
    model = one_frame_model(chain, T_measuring_base, T_tip_tool)
    parameters = choose_parameters(model, (View(kind, 0),)).parameters
    return chain_of_parameters(model, parameters)


def one_frame_model(chain: Mechanism, T_measuring_base: Array | None = None, T_tip_tool: Array | None = None) -> Model:
    """The nominal arm watched from one frame called ``tracker``; poses default to the identity."""
    base = np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float)
    tool = np.eye(4) if T_tip_tool is None else np.asarray(T_tip_tool, dtype=float)
    return Model(chain, ("tracker",), base[None], tool)


def chain_of_parameters(model: Model, parameters: Sequence[ModelParameter]) -> ClosedChain:
    """The closed chain of a model with one frame, in these parameters of a calibration, in their order."""
    factors = tuple(Factor(p.name, p.unit) for p in parameters)
    if not is_serial_arm(model.chain):
        return ClosedChain(model.chain, factors, ModelMotions(model, tuple(parameters)))
    chain = model.serial
    at: dict[int, list[tuple[int, int]]] = {}
    for j, p in enumerate(parameters):
        at.setdefault(p.place, []).append((p.direction, j))
    M = chain.along_z
    steps: list[Array | ElementaryMotion] = [model.T_frame_base[0] @ M[0]]
    for k in range(chain.n + 1):
        if k == chain.n:
            steps.append(model.T_tip_tool)
        steps += [ElementaryMotion(d, parameter=j) for d, j in sorted(at.get(k, []))]
        if k < chain.n:
            steps += [ElementaryMotion(5 if chain.revolute[k] else 2, joint=k), M[k + 1]]
    return ClosedChain(chain, factors, ElementaryChain(tuple(steps)))


def sizes_of(closed: ClosedChain, length: float, angle: float, tolerances: Mapping[str, float] | None = None) -> Array:
    """Sizes Δg of the parameters' errors, (P,): one for lengths [m], one for angles [rad], others by name or pattern.

    Raises BadTable for a pattern that names nothing and for a size that is negative or not finite.
    """
    out = np.array([length if f.is_length else angle for f in closed.factors])
    for pattern, size in (tolerances or {}).items():
        hit = [k for k, name in enumerate(closed.names) if fnmatchcase(name, pattern)]
        if not hit:
            raise BadTable(
                f"tolerance of '{pattern}'", "matches no parameter", f"choose from {', '.join(closed.names)}"
            )
        out[hit] = size
    bad = np.flatnonzero(~np.isfinite(out) | (out < 0.0))
    if len(bad):
        name = closed.names[bad[0]]
        raise BadTable(f"tolerance of '{name}'", f"is {out[bad[0]]}, at least 0 is needed", "give metres or radians")
    return out
