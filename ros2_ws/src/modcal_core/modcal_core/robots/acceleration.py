"""How hard each joint may be accelerated, here and now: what gravity, friction and speed leave of the drives' torque.

Joint i's drive, of torque τ_i within ±τ_max,i, moves

    Σ_j M_ij q̈_j = τ_i − f_i − (C q̇ + g)_i,      f_i = sign(q̇_i) f_c,i + f_v,i q̇_i

(rotor inertias are on the diagonal of M), so the accelerations that all drives can give are a polytope,

    lower ≤ M q̈ ≤ upper,      upper = τ_max − f − C q̇ − g,      lower = −τ_max − f − C q̇ − g.

Of a joint that stands dry friction is taken from both sides. Three readings of it: *equivalent*, ``lower_i / M_ii ≤
q̈_i ≤ upper_i / M_ii``, each joint with the others at rest and their drives out of account; *given*, joint i's interval
while the others accelerate as they do; and *box*, bounds that hold together, whatever the others do within theirs.

What goes with no acceleration follows by Newton and Euler's recursion in the base frame, where it becomes sums along
the chain, gravity being an acceleration of the base upwards (Luh, Walker and Paul 1980; Featherstone 2008, chapter 5).

The box: bounds −l ≤ x ≤ u of the greatest product Π (u_i l_i)^w_i, w_i > 0, all of whose corners obey ``lower ≤ A x ≤
upper``; it does not depend on the units of the components. With A⁺ and A⁻ the positive and negative parts of A,

    | A⁺  A⁻ | | u |     |  upper |
    | A⁻  A⁺ | | l |  ≤  | −lower |

so Σ w log z is maximised over B z ≤ h with B ≥ 0, z > 0. The optimum has Bᵀ y = w/z and y (h − B z) = 0: Newton's
method on both, the second relaxed to μ → 0 (primal-dual interior point; Boyd and Vandenberghe 2004, chapter 11).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot, Overloaded
from modcal_core.geometry import Array, sealed, so3
from modcal_core.robots.bodies import STANDARD_GRAVITY, Bodies, Payload, beyond, with_payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias
from modcal_core.robots.urdf_tree import parse

# --- The torques that a motion takes: M(q) q̈ + C(q, q̇) q̇ + g(q), without friction

DOWN = (0.0, 0.0, -STANDARD_GRAVITY)


def bias_torque(
    chain: Chain, inertias: Inertias, q: ArrayLike, velocity: ArrayLike, gravity: ArrayLike = DOWN
) -> Array:
    """Drive torques C(q, q̇) q̇ + g(q) (N, n) [N m; N] that go with no joint acceleration, at q (N, n) [rad, m] and
    velocity (N, n) [rad/s, m/s]. gravity: acceleration of free fall (3,) [m/s²] in the base.
    """
    return bias_of(Bodies.at(chain, inertias, q), velocity, gravity)


def bias_of(bodies: Bodies, velocity: ArrayLike, gravity: ArrayLike = DOWN) -> Array:
    """:func:`bias_torque` of bodies at their postures."""
    rate = np.swapaxes(bodies.twists, 1, 2) * np.asarray(velocity, dtype=float)[..., None]  # S_i q̇_i, (N, n, 6)
    V = np.cumsum(rate, axis=1)
    ad = _bracket(V)
    A = np.cumsum((ad @ rate[..., None])[..., 0], axis=1)
    A[..., :3] -= np.asarray(gravity, dtype=float)
    inertia = bodies.spatial
    force = inertia @ A[..., None] - np.swapaxes(ad, -1, -2) @ (inertia @ V[..., None])
    return np.einsum("nai,nia->ni", bodies.twists, beyond(force[..., 0]))


def torque(
    chain: Chain,
    inertias: Inertias,
    q: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    gravity: ArrayLike = DOWN,
) -> Array:
    """Drive torques (N, n) [N m; N] of a motion without friction: M q̈ + C q̇ + g. All arguments (N, n)."""
    bodies = Bodies.at(chain, inertias, q)
    inertial = np.einsum("nij,nj->ni", bodies.matrix, np.asarray(acceleration, dtype=float))
    return inertial + bias_of(bodies, velocity, gravity)


def _bracket(V: Array) -> Array:
    """ad(V) of twists (..., 6) as matrices (..., 6, 6): ad(V) X is the change of X as its frame moves with V."""
    turn, shift = so3.hat(V[..., 3:]), so3.hat(V[..., :3])
    out = np.zeros((*V.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = turn
    out[..., :3, 3:] = shift
    return out


# --- What the drives of a chain can do, as a URDF states it: effort, velocity, friction

# field: its attribute, and what is written where nothing is stated
_STATED = {
    "torque": ("effort", np.nan),
    "speed": ("velocity", np.inf),
    "coulomb": ("friction", 0.0),
    "viscous": ("damping", 0.0),
}


@dataclass(frozen=True)
class Drives:
    """The drives of n joints, all seen from the joint: behind the gear.

    names: the joints. torque: largest torque either way [N m; N where it slides], NaN where nobody says. speed: largest
    speed [rad/s; m/s]. coulomb: dry friction [N m; N]. viscous: friction per speed [N m s/rad; N s/m]. rotor: inertia
    of motor and gear [kg m²; kg]. All (n,).
    """

    names: tuple[str, ...]
    torque: Array
    speed: Array
    coulomb: Array
    viscous: Array
    rotor: Array

    def with_values(self, what: str, values: Mapping[str, float]) -> Drives:
        """The drives with other numbers of one kind, by joint. Raises BadRobot for a wrong joint or number."""
        new = np.array(getattr(self, what))
        for name, value in values.items():
            if name not in self.names:
                known = ", ".join(self.names)
                raise BadRobot(f"{what} of joint '{name}'", "is not of this arm", f"name one of {known}")
            least = "above 0" if what in ("torque", "speed") else "0 or more"
            if not np.isfinite(value) or value < 0.0 or (value == 0.0 and least == "above 0"):
                raise BadRobot(f"{what} of joint {name}", f"is {value:g}, not a number {least}", "correct it")
            new[self.names.index(name)] = value
        changed: dict[str, Any] = {what: new}
        return sealed(replace(self, **changed))

    def require_torque(self) -> None:
        """Raises BadRobot for a joint whose largest torque nobody says."""
        unknown = [name for name, known in zip(self.names, np.isfinite(self.torque), strict=True) if not known]
        if unknown:
            said = "the robot description states no effort for it"
            raise BadRobot(f"drive of joint {', '.join(unknown)}", said, "write <limit effort>, or give the torque")


def read_drives(urdf_xml: str, chain: Chain) -> Drives:
    """The drives of a chain that was read from this URDF; an effort of 0 counts as none stated, so does a speed of 0.

    Raises BadRobot for a number that is none, or is negative, and for a joint that the URDF does not have.
    """
    tree = parse(urdf_xml)
    stated = {name: tree.joint(name).drive for name in chain.names}
    columns = {
        what: np.array([_number(drive.get(key), none, name, key) for name, drive in stated.items()])
        for what, (key, none) in _STATED.items()
    }
    return sealed(Drives(chain.names, **columns, rotor=np.zeros(chain.n)))


def _number(text: str | None, none: float, joint: str, attribute: str) -> float:
    if text is None or not text.strip():
        return none
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if np.isnan(value) or value < 0.0:
        raise BadRobot(f"joint {joint}: {attribute}", f"'{text}' is not a number of 0 or more", "correct the URDF")
    return none if value == 0.0 or np.isinf(value) else value


# --- The largest box around nothing at all that keeps to linear limits

_MAX_STEPS = 60
_GAP = 1e-7  # of Σ w log z, to the best there is: bounds within some 1e-5 of the best ones, and never outside
_TO_THE_WALL = 0.99  # of the way to where something would turn negative
_CENTRING = 0.1


def largest_box(
    A: ArrayLike, lower: ArrayLike, upper: ArrayLike, weights: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Lower and upper bounds (N, n), lower < 0 < upper, of the largest boxes in N polytopes lower ≤ A x ≤ upper.

    A: (N, m, n), no column without a number. lower < 0 < upper: (N, m). weights: (n,) > 0; all 1 if none are given.
    """
    A = np.asarray(A, dtype=float)
    n = A.shape[-1]
    up, down = np.maximum(A, 0.0), np.maximum(-A, 0.0)
    B = np.concatenate([np.concatenate([up, down], axis=-1), np.concatenate([down, up], axis=-1)], axis=-2)
    h = np.concatenate([np.asarray(upper, dtype=float), -np.asarray(lower, dtype=float)], axis=-1)
    assert (h > 0.0).all()
    assert (B.max(axis=-2) > 0.0).all()
    # in units in which each bound alone would be 1 and every limit is 1
    B = B / h[..., None]
    alone = 1.0 / B.max(axis=-2)
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    assert (w > 0.0).all()
    z = _largest(B * alone[..., None, :], np.tile(w / w.mean(), 2)) * alone
    z /= (B @ z[..., None]).max(axis=(-2, -1))[..., None]  # rounding must not leave it outside
    return -z[..., n:], z[..., :n]


def _largest(B: Array, w: Array) -> Array:
    """z (N, k) of the greatest Σ w log z with B z ≤ 1, for B (N, m, k) whose columns reach 1."""
    N, m, k = B.shape
    z = np.full((N, k), 0.5) / B.sum(axis=-1).max(axis=-1)[:, None]
    s = 1.0 - (B @ z[..., None])[..., 0]
    y = np.full((N, m), 1.0 / m) / s
    weights, sides = np.diag(w), np.empty((N, m, 2))
    for _ in range(_MAX_STEPS):
        gap = (y * s).sum(axis=-1, keepdims=True)
        aim = (_CENTRING / m) * gap / s  # where y would be, were all y s alike and smaller
        scaled = B * z[:, None, :]  # by which z changes relatively: well conditioned whatever the bounds' sizes
        scaled_t = scaled.swapaxes(-1, -2)
        sides[..., 0], sides[..., 1] = y, aim
        missing = w[:, None] - scaled_t @ sides  # (N, k, 2): with y as it is, and there
        open_ = (gap > _GAP) | (np.abs(missing[..., 0]).max(axis=-1, keepdims=True) > _GAP)
        if not open_.any():
            break
        slope = y / s
        d = np.linalg.solve(weights + scaled_t @ (scaled * slope[..., None]), missing[..., 1:])
        ds = -(scaled @ d)[..., 0]
        dy = aim - y - slope * ds
        d = d[..., 0]
        step = np.where(open_, np.minimum(_reach(d), _reach(ds / s)), 0.0)
        z, s = z * (1.0 + step * d), s + step * ds
        y = y + np.where(open_, _reach(dy / y), 0.0) * dy
    return z


def _reach(change: Array) -> Array:
    """How much of a relative change (N, k) leaves positive values positive, (N, 1), at most 1."""
    worst = -change.min(axis=-1, keepdims=True)
    return np.minimum(1.0, _TO_THE_WALL / np.maximum(worst, 1e-300))


STILL = 1e-3  # rad/s or m/s below which a joint may begin to move either way


@dataclass(frozen=True)
class Window:
    """The accelerations that the drives of the named joints can give at N postures: lower ≤ M q̈ ≤ upper. matrix: M (N,
    n, n) [kg m², kg m, kg]. lower, upper: torque that is left for accelerating, (N, n) [N m; N].
    """

    names: tuple[str, ...]
    matrix: Array
    lower: Array
    upper: Array

    def equivalent(self) -> tuple[Array, Array]:
        """Bounds (N, n) [rad/s², m/s²] by equivalent inertias; both of one sign where a drive cannot hold its joint."""
        inertia = np.diagonal(self.matrix, axis1=1, axis2=2)
        return self.lower / inertia, self.upper / inertia

    def given(self, acceleration: ArrayLike) -> tuple[Array, Array]:
        """Bounds (N, n) of each joint while the others accelerate as given, (N, n) or (n,), all drives within their
        limits; NaN where there are none.
        """
        a = np.broadcast_to(np.asarray(acceleration, dtype=float), self.lower.shape)
        taken = (self.matrix @ a[..., None]) - self.matrix * a[:, None, :]  # row k, by all but joint i: (N, k, i)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(side[..., None] - taken) / self.matrix for side in (self.lower, self.upper)])
        untouched = self.matrix == 0.0
        within = (taken >= self.lower[..., None]) & (taken <= self.upper[..., None])
        low = np.where(untouched, np.where(within, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
        high = np.where(untouched, np.where(within, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
        return np.where(low <= high, low, np.nan), np.where(low <= high, high, np.nan)

    def box(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        """Bounds (N, n), lower < 0 < upper, that hold together: the largest box in the polytope, by Π upper · lower.

        weights: exponents of the joints in that product, (n,), if some matter more. Raises Overloaded where the drives
        cannot even hold what there is.
        """
        self.require_held()
        return largest_box(self.matrix, self.lower, self.upper, weights)

    def held(self) -> np.ndarray:
        """Whether all drives can go on without accelerating, with torque left either way, (N,)."""
        return np.all((self.lower < 0.0) & (self.upper > 0.0), axis=1)

    def require_held(self) -> None:
        """Raises Overloaded, with the worst joint, where the drives cannot hold gravity, friction and speed."""
        if self.held().all():
            return
        short = np.maximum(self.lower, -self.upper) / (self.upper - self.lower)
        at, joint = np.unravel_index(int(np.argmax(short)), short.shape)
        half = 0.5 * (self.upper - self.lower)[at, joint]
        needed = abs(0.5 * (self.upper + self.lower)[at, joint])
        where = f" at posture {at + 1} of {len(self.lower)}" if len(self.lower) > 1 else ""
        said = f"gravity, friction and speed need {needed:.4g} of the {half:.4g} N m (N) that its drive has"
        remedy = "reduce the payload or the speed, or use another posture"
        raise Overloaded(f"joint {self.names[joint]}{where}", said, remedy)


# --- An arm with what it carries and what its drives may give: from a URDF and a few numbers

COUPLED, EQUIVALENT = "coupled", "equivalent"
METHODS = (COUPLED, EQUIVALENT)


@dataclass(frozen=True)
class LoadedArm:
    """chain, bare inertias and drives as the URDF has them; payload at the tip; share of the torque that may be used;
    gravity (3,) [m/s²] in the base.
    """

    chain: Chain
    inertias: Inertias
    drives: Drives
    payload: Payload = field(default_factory=Payload)
    share: float = 1.0
    gravity: Array = field(default_factory=lambda: np.array(DOWN))

    @classmethod
    def read(
        cls, urdf_xml: str, base: str | None = None, tip: str | None = None, recorded: Collection[str] | None = None
    ) -> LoadedArm:
        """The arm of a URDF, carrying nothing; base, tip, recorded as of :func:`read_chain`. Raises BadRobot."""
        chain = read_chain(urdf_xml, base, tip, recorded)
        inertias = read_inertias(urdf_xml, chain)
        if not inertias.known:
            raise BadRobot("robot description", "states no mass of any link", "write the links' <inertial>")
        return cls(chain, inertias, read_drives(urdf_xml, chain))

    def carrying(self, payload: Payload) -> LoadedArm:
        """The arm with another payload."""
        return replace(self, payload=payload)

    def using(self, share: float, gravity: ArrayLike = DOWN) -> LoadedArm:
        """The arm with this share of its torque, in this gravity. Raises BadRobot for numbers that are none."""
        g = np.asarray(gravity, dtype=float).ravel()
        if not (np.isfinite(share) and 0.0 < share <= 1.0):
            raise BadRobot("share of the torque", f"{share:g} is not above 0 and at most 1", "give a share such as 0.8")
        if g.shape != (3,) or not np.isfinite(g).all() or np.linalg.norm(g) > 100.0:
            raise BadRobot("gravity", "is not x y z of 100 m/s² at most", "give it in the base link, such as 0 0 -9.81")
        return replace(self, share=float(share), gravity=g)

    def with_drives(self, **values: Mapping[str, float]) -> LoadedArm:
        """The arm with other torque, speed, coulomb, viscous or rotor of its drives, by joint. Raises BadRobot."""
        drives = self.drives
        for what, by_joint in values.items():
            drives = drives.with_values(what, by_joint)
        return replace(self, drives=drives)

    @cached_property
    def loaded(self) -> Inertias:
        """The inertias with what is carried, which a node asks for at every posture."""
        return with_payload(self.inertias, self.chain, self.payload)

    def window(self, q: ArrayLike, velocity: ArrayLike | None = None) -> Window:
        """What the drives leave for accelerating at joint positions q (N, n) and velocities (N, n), default at rest.
        Raises BadRobot where a torque limit, or the mass that a joint moves, is not known.
        """
        q, drives = np.atleast_2d(np.asarray(q, dtype=float)), self.drives
        v = np.zeros_like(q) if velocity is None else np.atleast_2d(np.asarray(velocity, dtype=float))
        drives.require_torque()
        bodies = Bodies.at(self.chain, self.loaded, q)
        M = bodies.matrix + np.diag(drives.rotor)
        light = np.diagonal(M, axis1=1, axis2=2).min(axis=0) <= 0.0
        if light.any():
            remedy = "write the links' <inertial>, or a rotor inertia"
            raise BadRobot(f"joint {self.chain.names[int(np.argmax(light))]}", "moves nothing that has a mass", remedy)
        still = np.abs(v) < STILL
        friction = drives.viscous * v + np.where(still, 0.0, np.sign(v) * drives.coulomb)
        taken = bias_of(bodies, v, self.gravity) + friction
        most = self.share * drives.torque - np.where(still, drives.coulomb, 0.0)
        return Window(self.chain.names, M, -most - taken, most - taken)

    def bounds(self, q: ArrayLike, velocity: ArrayLike | None = None, method: str = COUPLED) -> tuple[Array, Array]:
        """Lower and upper bounds of acceleration (N, n) [rad/s², m/s²], lower < 0 < upper.

        method: "coupled", bounds that hold together whatever the other joints do within theirs, or "equivalent", each
        joint by its equivalent inertia. Raises Overloaded where the drives cannot hold the arm, BadRobot for what is
        not known.
        """
        require_method(method)
        left = self.window(q, velocity)
        left.require_held()
        return left.box() if method == COUPLED else left.equivalent()


def require_method(method: str) -> None:
    """Raises BadRobot for a method that there is none of."""
    if method not in METHODS:
        raise BadRobot(f"method '{method}'", f"is neither {' nor '.join(METHODS)}", "choose one of them")
