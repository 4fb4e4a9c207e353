"""Which postures there are to choose from, and which ones count: a robot's own, or those that were recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from modcal_core.errors import NotPlannable
from modcal_core.geometry.so3 import Array
from modcal_core.planning.criteria import ACCURACY, criterion
from modcal_core.planning.exchange import exchange
from modcal_core.planning.posture_pool import CANDIDATES, survey
from modcal_core.planning.site import Site
from modcal_core.planning.spheres import Spheres, clearance, visible
from modcal_core.robots.mechanism import Mechanism

_AHEAD = 400  # postures that stand for where accuracy counts, for time
_PASSES = 2  # of the exchange that chooses the first stations; later ones take what it missed
_MOVED = (0.3, 0.1)  # rad or m by which a chosen posture is moved in search of a better one
_TRIED = 24  # postures around it, each time


@dataclass(frozen=True)
class Pool:
    """q: postures to choose from (N, n). where: postures (M, n) that stand for where accuracy counts. order: numbers of
    q in the order in which they are drawn at random. first: numbers of q that are best to begin with, the best first.
    allowed: says of postures (N, n) whether the arm may take them and they should be seen; None where only q exist.
    recorded: q are stations of a recording, each of which can be measured once.
    """

    q: Array
    where: Array
    order: np.ndarray
    first: Callable[[int], np.ndarray]
    allowed: Callable[[Array], np.ndarray] | None
    lower: Array
    upper: Array
    recorded: bool = False

    def around(self, q: Array, rng: np.random.Generator) -> Array:
        """Postures near q (n,) that are allowed, itself first, (k, n)."""
        if self.allowed is None:
            return q[None]
        moved = [q + size * rng.standard_normal((_TRIED, len(q))) for size in _MOVED]
        near = np.clip(np.concatenate(moved), self.lower, self.upper)
        return np.concatenate([q[None], near[self.allowed(near)]])


def of_robot(chain: Mechanism, site: Site, kind: str, rng: np.random.Generator, candidates: int = CANDIDATES) -> Pool:
    """Postures of a robot at a site: within limits, touching nothing, seen by the instrument. Raises NotPlannable."""
    there = survey(chain, site, rng, kind, (), 2 * candidates)
    if len(there.q) < 2 * _TRIED:
        said = f"only {len(there.q)} of the postures tried are allowed and seen"
        raise NotPlannable("measuring", said, "widen limits, or correct radii, floor and the tracker's place")
    # one half is chosen from, the other half is drawn from: what proves must not be near what was fitted by design
    half = len(there.q) // 2
    mixed = there.q[rng.permutation(len(there.q))]
    drawn = mixed[half:]
    if site.box is not None:
        at = there.model.predict(drawn)[:, :3, 3] + site.still
        drawn = drawn[((at >= site.box[0]) & (at <= site.box[1])).all(axis=1)]
        if not len(drawn):
            raise NotPlannable("workspace box", "no allowed posture holds the target in it", "correct box_m")
    good = criterion(ACCURACY, there.workspace.gamma)
    seed = int(rng.integers(1 << 31))

    def first(count: int) -> np.ndarray:
        found = exchange(there.rows, min(count, len(there.q)), good, np.random.default_rng(seed), 1, _PASSES)
        return found.chosen

    limits = there.model.chain
    return Pool(
        q=np.concatenate([there.q, drawn]),
        where=drawn[:_AHEAD],
        order=len(there.q) + np.arange(len(drawn)),
        first=first,
        allowed=partial(_allowed, there.spheres, site),
        lower=np.asarray(limits.lower),
        upper=np.asarray(limits.upper),
    )


def _allowed(spheres: Spheres, site: Site, q: Array) -> np.ndarray:
    return np.asarray((clearance(spheres, site, q) >= 0.0) & visible(spheres, site, q))


def of_recording(q: Array, rng: np.random.Generator) -> Pool:
    """The stations (N, n) of a recording."""
    order = rng.permutation(len(q))
    where = q[order[:_AHEAD]]

    def first(count: int) -> np.ndarray:
        """Postures far from each other: nothing is known of base and tool that would say more."""
        scale = np.maximum(np.ptp(q, axis=0), 1e-6)
        x = q / scale
        chosen = [int(np.argmax(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))]
        apart = np.sum((x - x[chosen[0]]) ** 2, axis=1)
        while len(chosen) < min(count, len(q)):
            chosen.append(int(np.argmax(apart)))
            apart = np.minimum(apart, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
        return np.array(chosen)

    return Pool(q, where, order, first, None, q.min(axis=0), q.max(axis=0), recorded=True)
