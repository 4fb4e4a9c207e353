"""The postures there are to choose from: those of a robot at a site that are allowed and seen, or a recording's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Model, exact_samples
from modcal_core.errors import BadTable, NotPlannable
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.site import Site, Spheres, clearance, spheres_of, view_postures, visible
from modcal_core.robots import Mechanism, is_serial_arm, joint_ranges, random_postures

CANDIDATES = 1500  # random postures that stations are chosen from, for time
_WHERE = 400  # postures that stand for where accuracy counts
_ROADMAP = 1500  # postures that ways may lead over
_OFF_LIMITS = 0.02  # rad or m that is kept from the joints' limits
_PROBED = 2048  # postures by which it is seen where a joint's turn had better end
_CUT = 0.15  # rad, about that end
_DRAWN = 40  # times as many postures are drawn as are wanted, before it is said that hardly any is allowed
_AIMED = 2  # times as many lines of sight are tried as postures are wanted, where hardly any random posture is seen
_FEW = 48  # postures, of which half are drawn at random, from which measuring is worth while


def one_frame_model(chain: Mechanism, T_measuring_base: Array | None = None, T_tip_tool: Array | None = None) -> Model:
    """The nominal arm watched from one frame called ``tracker``; poses default to the identity."""
    base = np.eye(4) if T_measuring_base is None else np.asarray(T_measuring_base, dtype=float)
    tool = np.eye(4) if T_tip_tool is None else np.asarray(T_tip_tool, dtype=float)
    return Model(chain, ("tracker",), base[None], tool)


def readings_at(model: Model, q: Array, kind: str) -> Samples:
    """Readings of a kind, in the first frame, at postures q (N, n), as the model's geometry makes them."""
    N = len(q)
    return exact_samples(model, q, np.zeros(N, dtype=int), np.full(N, kind, dtype=KIND_NAMES))


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

    def around(self, q: Array, size: float, each: int, rng: np.random.Generator) -> tuple[Array, np.ndarray]:
        """Allowed postures near q (k, n), off by this size [rad, m], and near which: so many are tried for each."""
        chain, of = self.model.chain, np.repeat(np.arange(len(q)), each)
        near = np.clip(q[of] + size * rng.standard_normal((len(of), q.shape[1])), chain.lower, chain.upper)
        may = self.allowed(near)
        return near[may], of[may]


@dataclass(frozen=True)
class Pool:
    """What there is to choose from.

    - q: postures (N, n). order: numbers of those that are drawn at random, in the order in which they are.
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
    def at(self) -> Ground:
        """The arm at its site, of a robot."""
        assert self.ground is not None
        return self.ground

    @property
    def recorded(self) -> bool:
        """Whether it is a recording's."""
        return self.ground is None

    @property
    def offered(self) -> np.ndarray:
        """Numbers of the postures that are chosen from: what proves must not be near what was fitted by design."""
        return np.arange(len(self.q)) if self.recorded else np.setdiff1d(np.arange(len(self.q)), self.order)


def survey(
    chain: Mechanism,
    site: Site,
    rng: np.random.Generator,
    reading: str = "point",
    candidates: int = CANDIDATES,
    drawn: bool = False,
) -> Pool:
    """The postures of a robot that are allowed and seen. reading: ``point`` or ``pose``. candidates: how many postures.
    drawn: as many more, which are drawn at random and stand for where accuracy counts; else all that touch nothing do.
    Raises NotPlannable where there are hardly any.
    """
    spheres = spheres_of(with_limits(chain, site), site)
    chain = one_turn(spheres, site, rng)
    if site.carried and reading != POSE:
        raise BadTable(f"reading '{reading}'", "does not come from a camera on the tool", "choose pose")
    T = se3.transform(p=-site.still)  # how what stands there is turned does not matter
    ground = Ground(one_frame_model(chain, T, se3.transform(p=site.moving)), site, spheres)
    wanted = 2 * candidates if drawn else candidates
    free, seen, tried = [], [], 0
    tries = random_postures(chain, min(_DRAWN * wanted, 1 << 16), rng)
    for block in np.array_split(tries, max(1, len(tries) // 2048)):
        untouched = block[ground.free(block)]
        free.append(untouched)
        seen.append(untouched[visible(spheres, site, untouched)])
        tried += len(block)
        if sum(map(len, seen)) >= wanted and sum(map(len, free)) >= _WHERE:
            break
    shares = (sum(map(len, free)) / tried, sum(map(len, seen)) / max(sum(map(len, free)), 1))
    if sum(map(len, seen)) < wanted and site.tracker is not None and is_serial_arm(chain):
        aimed = view_postures(chain, site, _AIMED * wanted, rng)
        seen.append(aimed[ground.allowed(aimed)])
    all_free, q = np.concatenate(free), np.concatenate(seen)[:wanted]
    if len(q) < (_FEW if drawn else 2):
        what = "is seen by the tracker" if len(all_free) else "touches nothing"
        said = f"{'none' if not len(q) else f'only {len(q)}'} {what}"
        remedy = "check the site: radii, limits, floor, obstacles, the tracker's place, cone and range"
        raise NotPlannable(f"{tried} postures within the joints' limits", said, remedy)
    if not drawn:
        return Pool(q, np.arange(0), _in_box(ground, all_free)[:_WHERE], all_free[:_ROADMAP], ground, shares)
    q, half = q[rng.permutation(len(q))], len(q) // 2
    random = _in_box(ground, q[half:])
    order, roadmap = half + np.arange(len(random)), all_free[:_ROADMAP]
    return Pool(np.concatenate([q[:half], random]), order, random[:_WHERE], roadmap, ground, shares)


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


def of_recording(q: Array, rng: np.random.Generator) -> Pool:
    """The stations (N, n) of a recording."""
    order = rng.permutation(len(q))
    return Pool(q, order, q[order[:_WHERE]], q[:0], None)


def with_limits(chain: Mechanism, site: Site) -> Mechanism:
    """The chain within the site's narrower limits, a little kept free at either end, where controllers stop. Raises
    BadTable for a joint that is not there, and for limits that leave nothing.
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
