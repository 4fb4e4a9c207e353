"""What there is to choose from: postures that the arm may take and the tracker sees, and where accuracy counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    ModelParameter,
    NoiseModel,
    View,
    choose_parameters,
    exact_samples,
    joint_ranges,
)
from modcal_core.claim import Claim, expected_claim
from modcal_core.errors import BadTable, NotPlannable
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POSE
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.planning.closed_chain import one_frame_model
from modcal_core.planning.sensitivity_study import sobol_postures
from modcal_core.planning.site import Site, Spheres, clearance, spheres_of, view_postures, visible
from modcal_core.planning.worth import Accuracy, StationRows, Workspace, position_rows, station_rows
from modcal_core.robots import Mechanism, is_serial_arm

CANDIDATES = 1500  # random postures that stations are chosen from, for time
_WORKSPACE = 400  # postures that stand for the workspace
_ROADMAP = 1500  # postures that ways may lead over
_OFF_LIMITS = 0.02  # rad or m that is kept from the joints' limits
_PROBED = 2048  # postures by which it is seen where a joint's turn had better end
_CUT = 0.15  # rad, about that end
_DRAWN = 40  # times as many postures are drawn as are wanted, before it is said that hardly any is allowed
_AIMED = 2  # times as many lines of sight are tried as postures are wanted, where hardly any random posture is seen
_CLAIMED = 200  # postures that a claim is made over, for time
_RANDOM = 20  # random sets that a plan is compared with


@dataclass(frozen=True)
class PosturePool:
    """What there is to choose from.

    model: with its one frame at the tracker. q: allowed and seen postures (N, n). rows: what they tell. workspace:
    where accuracy counts. free_q: postures that are allowed, seen or not. shares: of the postures drawn that touch
    nothing, and of these seen. known, besides: stations that are measured already, and
    their postures.
    """

    model: Model
    site: Site
    spheres: Spheres
    parameters: tuple[ModelParameter, ...]
    reading: str
    q: Array
    rows: StationRows
    workspace: Workspace
    free_q: Array
    shares: tuple[float, float]
    known: StationRows | None = None
    besides: Array | None = None

    @property
    def given(self) -> Array | None:
        """What is known already, (P, P), in units of the prior."""
        return None if self.known is None else self.known.information(np.arange(len(self.known)))

    def claim(self, q: Array) -> Claim:
        """The claim to be expected over the workspace from stations q (k, n) and those that are known already."""
        every = q if self.besides is None else np.concatenate([self.besides, q])
        N, noise, rows = len(every), self.site.noise, self.rows
        planned = exact_samples(self.model, every, np.zeros(N, dtype=int), np.full(N, self.reading, dtype=KIND_NAMES))
        distance = float(np.mean(np.linalg.norm(planned.reading, axis=1)))
        scatter = np.hypot(noise.position + noise.per_metre * distance, np.sqrt(rows.joint_variance[0]))
        turned = np.hypot(noise.rotation, np.sqrt(rows.joint_variance[-1]))
        ends = np.stack([every.min(axis=0), every.max(axis=0)])
        made = Calibration(self.model, self.model, self.model, ends)
        where = self.workspace.q[:_CLAIMED]
        return expected_claim(made, planned, Cell(), NoiseModel(float(scatter), float(turned)), where)

    def accuracy(self, rows: StationRows) -> Accuracy:
        """The accuracy from these stations and those that are known already."""
        every = rows if self.known is None else rows.joined(self.known)
        return self.workspace.accuracy(every.covariance(np.arange(len(every))))


def survey(
    chain: Mechanism,
    site: Site,
    rng: np.random.Generator,
    reading: str = "point",
    fixed: tuple[str, ...] = (),
    candidates: int = CANDIDATES,
    besides: Array | None = None,
) -> PosturePool:
    """The postures that are allowed and seen, and what each would tell. Raises NotPlannable where there are none.

    reading: ``point`` or ``pose``. fixed: parameters that are not fitted. candidates: how many postures.
    besides: stations (N, n) that are measured already, wherever they are.
    """
    spheres = spheres_of(with_limits(chain, site), site)
    chain = one_turn(spheres, site, rng)
    if site.carried and reading != POSE:
        raise BadTable(f"reading '{reading}'", "does not come from a camera on the tool", f"choose {POSE}")
    T = np.eye(4)
    T[:3, 3] = -site.still  # how what stands there is turned does not matter
    model = one_frame_model(chain, T, se3.transform(p=site.moving))
    parameters = choose_parameters(model, (View(reading, 0),), fixed).parameters
    drawn = sobol_postures(chain, min(_DRAWN * candidates, 1 << 16), rng)
    free, seen, tried = [], [], 0
    for block in np.array_split(drawn, max(1, len(drawn) // 2048)):
        allowed = block[clearance(spheres, site, block) >= 0.0]
        free.append(allowed)
        seen.append(allowed[visible(spheres, site, allowed)])
        tried += len(block)
        if sum(map(len, seen)) >= candidates and sum(map(len, free)) >= _WORKSPACE:
            break
    shares = (sum(map(len, free)) / tried, sum(map(len, seen)) / max(sum(map(len, free)), 1))
    if sum(map(len, seen)) < candidates and site.tracker is not None and is_serial_arm(chain):
        aimed = view_postures(chain, site, _AIMED * candidates, rng)
        seen.append(aimed[(clearance(spheres, site, aimed) >= 0.0) & visible(spheres, site, aimed)])
    all_free, q = np.concatenate(free), np.concatenate(seen)[:candidates]
    if len(q) < 2:
        what = "touches nothing" if not len(all_free) else "is seen by the tracker"
        said = f"{'none' if not len(q) else 'one'} {what}"
        remedy = "check the site: radii, floor, obstacles, the tracker's place, cone and range"
        raise NotPlannable(f"{tried} postures within the joints' limits", said, remedy)
    inside = all_free
    if site.box is not None:
        at = model.predict(inside)[:, :3, 3] - T[:3, 3]
        inside = inside[((at >= site.box[0]) & (at <= site.box[1])).all(axis=1)]
        if not len(inside):
            raise NotPlannable("workspace box", "no allowed posture holds the target in it", "correct box_m")
    inside = inside[:_WORKSPACE]
    rows = station_rows(model, parameters, q, reading, site.noise)
    workspace = Workspace(inside, *position_rows(model, parameters, inside, site.noise))
    known = None
    if besides is not None:
        known = station_rows(model, parameters, besides, reading, site.noise, rows.joint_variance)
    return PosturePool(
        model,
        site,
        spheres,
        tuple(parameters),
        reading,
        q,
        rows,
        workspace,
        all_free[:_ROADMAP],
        shares,
        known,
        besides,
    )


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
            raise BadTable(
                f"limits of '{name}'", "leave no part of the robot's own limits", "give [least, largest] in SI"
            )
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
    q = sobol_postures(chain, _PROBED, rng)
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


def random_accuracies(pool: PosturePool, count: int, rng: np.random.Generator, sets: int = _RANDOM) -> list[Accuracy]:
    """What as many stations would give that are drawn from the same postures."""
    return [pool.accuracy(pool.rows.of(rng.choice(len(pool.q), count, replace=False))) for _ in range(sets)]


def allowed(calibration: Calibration, site: Site) -> Callable[[Array], np.ndarray]:
    """Says of postures (N, n) whether this arm, by its nominal model, may take them at a site and is seen there."""
    chain = with_limits(calibration.nominal.chain, site)
    spheres = spheres_of(chain, site)

    def may(q: Array) -> np.ndarray:
        inside = ((q >= chain.lower) & (q <= chain.upper)).all(axis=1)
        return np.asarray(inside & (clearance(spheres, site, q) >= 0.0) & visible(spheres, site, q))

    return may
