"""The closed chain from the measuring frame over the arm to the measured point, and the postures there are to choose
from.

    P_M = T_M_B · T_B_tool0 · P_tool0

For n joints in Denavit–Hartenberg form it has 4 n + 9 parameters: theta, d, a and alpha of every row, three shifts
(along the measuring frame) and three turns (about the base) of the base, and three coordinates of the point in the last
frame. DH cannot hold nearly parallel axes; the directions that a calibration uses are the other choice and hold for any
robot.

Errors count to first order. With R the frame in front of a parameter's motion, o its origin and p the point,

    ∂p/∂g = R e  (shift along e)        ∂p/∂g = (R e) × (p − o),  ∂rot/∂g = R e  (turn about e)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration import Calibration, Model, View, choose_parameters, exact_samples, linearise
from modcal_core.errors import BadTable, NotPlannable
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.site import Site, Spheres, clearance, spheres_of, view_postures, visible
from modcal_core.robots import Chain, Mechanism, is_serial_arm, joint_ranges, random_postures, read_rows, to_dh
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


CANDIDATES = 1500  # random postures that stations are chosen from, for time
_WHERE = 400  # postures that stand for where accuracy counts
_ROADMAP = 1500  # postures that ways may lead over
_OFF_LIMITS = 0.02  # rad or m that is kept from the joints' limits
_PROBED = 2048  # postures by which it is seen where a joint's turn had better end
_CUT = 0.15  # rad, about that end
_DRAWN = 40  # times as many postures are drawn as are wanted, before it is said that hardly any is allowed
_AIMED = 2  # times as many lines of sight are tried as postures are wanted, where hardly any random posture is seen
_MOVED = (0.3, 0.1)  # rad or m by which a chosen posture is moved in search of a better one
_TRIED = 24  # postures around it, each time


@dataclass(frozen=True)
class Ground:
    """An arm at a site. model: the nominal one, its frame at the tracker. spheres: of its links."""

    model: Model
    site: Site
    spheres: Spheres

    def free(self, q: Array) -> np.ndarray:
        """True for postures (N, n) that touch nothing."""
        return np.asarray(clearance(self.spheres, self.site, q) >= 0.0)

    def allowed(self, q: Array) -> np.ndarray:
        """True for postures (N, n) that touch nothing and are seen."""
        return self.free(q) & visible(self.spheres, self.site, q)

    def around(self, q: Array, sizes: tuple[float, ...], each: int, rng: np.random.Generator) -> Array:
        """Allowed postures near q (k, n), moved by these sizes [rad, m], so many tried for each."""
        chain = self.model.chain
        moved = [np.repeat(q, each, axis=0) + s * rng.standard_normal((each * len(q), q.shape[1])) for s in sizes]
        near = np.clip(np.concatenate(moved), chain.lower, chain.upper)
        return near[self.allowed(near)]


@dataclass(frozen=True)
class Pool:
    """What there is to choose from.

    - q: postures to choose from, (N, n). order: numbers of them in the order in which they are drawn at random.
    - where: postures (M, n) that stand for where accuracy counts. roadmap: allowed ones, seen or not.
    - ground: the arm at its site; None where q are the stations of a recording, each of which can be measured once.
    - shares: of the postures drawn that touch nothing, and of these seen.
    """

    q: Array
    order: np.ndarray
    where: Array
    roadmap: Array
    ground: Ground | None
    shares: tuple[float, float] = (1.0, 1.0)

    @property
    def recorded(self) -> bool:
        """Whether it is a recording's."""
        return self.ground is None

    def around(self, q: Array, rng: np.random.Generator) -> Array:
        """Allowed postures near q (n,), itself first, (k, n)."""
        return q[None] if self.ground is None else np.vstack([q, self.ground.around(q[None], _MOVED, _TRIED, rng)])


def survey(
    chain: Mechanism, site: Site, rng: np.random.Generator, reading: str = "point", candidates: int = CANDIDATES
) -> Pool:
    """The postures of a robot that are allowed and seen. Raises NotPlannable where there are none.

    reading: ``point`` or ``pose``. candidates: how many postures.
    """
    spheres = spheres_of(with_limits(chain, site), site)
    chain = one_turn(spheres, site, rng)
    if site.carried and reading != "pose":
        raise BadTable(f"reading '{reading}'", "does not come from a camera on the tool", "choose pose")
    T = se3.transform(p=-site.still)  # how what stands there is turned does not matter
    ground = Ground(one_frame_model(chain, T, se3.transform(p=site.moving)), site, spheres)
    drawn = random_postures(chain, min(_DRAWN * candidates, 1 << 16), rng)
    free, seen, tried = [], [], 0
    for block in np.array_split(drawn, max(1, len(drawn) // 2048)):
        untouched = block[ground.free(block)]
        free.append(untouched)
        seen.append(untouched[visible(spheres, site, untouched)])
        tried += len(block)
        if sum(map(len, seen)) >= candidates and sum(map(len, free)) >= _WHERE:
            break
    shares = (sum(map(len, free)) / tried, sum(map(len, seen)) / max(sum(map(len, free)), 1))
    if sum(map(len, seen)) < candidates and site.tracker is not None and is_serial_arm(chain):
        aimed = view_postures(chain, site, _AIMED * candidates, rng)
        seen.append(aimed[ground.allowed(aimed)])
    all_free, q = np.concatenate(free), np.concatenate(seen)[:candidates]
    if len(q) < 2:
        what = "touches nothing" if not len(all_free) else "is seen by the tracker"
        said = f"{'none' if not len(q) else 'one'} {what}"
        remedy = "check the site: radii, floor, obstacles, the tracker's place, cone and range"
        raise NotPlannable(f"{tried} postures within the joints' limits", said, remedy)
    where = _in_box(ground, all_free)[:_WHERE]
    return Pool(q, np.arange(0), where, all_free[:_ROADMAP], ground, shares)


def _in_box(ground: Ground, q: Array) -> Array:
    """The postures of q (N, n) at which the target is in the site's workspace. Raises NotPlannable for none."""
    box = ground.site.box
    if box is None:
        return q
    at = ground.model.predict(q)[:, :3, 3] + ground.site.still
    q = q[((at >= box[0]) & (at <= box[1])).all(axis=1)]
    if not len(q):
        raise NotPlannable("workspace box", "no allowed posture holds the target in it", "correct box_m")
    return q


def of_robot(chain: Mechanism, site: Site, kind: str, rng: np.random.Generator, candidates: int = CANDIDATES) -> Pool:
    """Postures of a robot at a site to measure on: one half is chosen from, the other drawn from, for what proves must
    not be near what was fitted by design. Raises NotPlannable where there are few.
    """
    pool = survey(chain, site, rng, kind, 2 * candidates)
    if len(pool.q) < 2 * _TRIED or pool.ground is None:
        said = f"only {len(pool.q)} of the postures tried are allowed and seen"
        raise NotPlannable("measuring", said, "widen limits, or correct radii, floor and the tracker's place")
    half = len(pool.q) // 2
    mixed = pool.q[rng.permutation(len(pool.q))]
    drawn = _in_box(pool.ground, mixed[half:])
    order = half + np.arange(len(drawn))
    return replace(pool, q=np.concatenate([mixed[:half], drawn]), order=order, where=drawn[:_WHERE])


def of_recording(q: Array, rng: np.random.Generator) -> Pool:
    """The stations (N, n) of a recording."""
    order = rng.permutation(len(q))
    return Pool(q, order, q[order[:_WHERE]], q[:0], None)


def with_limits(chain: Mechanism, site: Site) -> Mechanism:
    """The chain within the site's narrower limits, a little kept free at either end, where controllers stop.

    Raises BadTable for a joint that is not there, and for limits that leave nothing.
    """
    lower, upper = joint_ranges(chain)
    off = np.minimum(_OFF_LIMITS, 0.05 * (upper - lower))
    lower, upper = lower + off, upper - off
    for name, (low, high) in site.limits.items():
        if name not in chain.names:
            raise BadTable(f"limits of '{name}'", "there is no such joint", f"choose from {', '.join(chain.names)}")
        k = chain.names.index(name)
        lower[k], upper[k] = max(low, lower[k]), min(high, upper[k])
        if lower[k] >= upper[k]:
            said = "leave no part of the robot's own limits"
            raise BadTable(f"limits of '{name}'", said, "give [least, largest] in SI")
    return chain.with_limits(lower, upper)


def one_turn(spheres: Spheres, site: Site, rng: np.random.Generator) -> Mechanism:
    """The chain whose joints turn once at most: geometry looks the same after a turn, and ways get shorter.

    Of the turns that a joint may make, the one is taken that begins and ends where the fewest postures are free, so
    that hardly any way is cut that the arm could go. Joints for which the site states limits are left as they are.
    """
    chain = spheres.chain
    wide = chain.revolute & (chain.upper - chain.lower > 2.0 * np.pi) & ~np.isin(chain.names, list(site.limits))
    if not wide.any():
        return chain
    q = random_postures(chain, _PROBED, rng)
    q = q[clearance(spheres, site, q) >= 0.0]
    lower, upper = chain.lower.copy(), chain.upper.copy()
    for k in np.flatnonzero(wide):
        # first angles of turns that stay within the limits, the middle one first among equals; those farther than a
        # turn from the middle are the same again, and in limits that somebody wrote in degrees far from any arm's
        middle = 0.5 * (lower[k] + upper[k])
        first = np.linspace(max(lower[k], middle - 2.0 * np.pi), min(upper[k] - 2.0 * np.pi, middle), 25)
        first = first[np.argsort(np.abs(first - first.mean()), kind="stable")]
        apart = np.abs(np.angle(np.exp(1j * (q[:, k, None] - first))))
        begin = first[np.argmin(np.sum(apart < _CUT, axis=0))]
        lower[k], upper[k] = begin, begin + 2.0 * np.pi
    return chain.with_limits(lower, upper)


def allowed(calibration: Calibration, site: Site) -> Callable[[Array], np.ndarray]:
    """Says of postures (N, n) whether this arm, by its nominal model, may take them at a site and is seen there."""
    chain = with_limits(calibration.nominal.chain, site)
    ground = Ground(calibration.nominal, site, spheres_of(chain, site))

    def may(q: Array) -> np.ndarray:
        return ((q >= chain.lower) & (q <= chain.upper)).all(axis=1) & ground.allowed(q)

    return may
