"""The arm as spheres: whether it touches itself, the floor, or what stands around, and whether it hides the target.

Spheres stand along the straight lines from joint to joint, or where a site puts them. Two of them are compared where
they are more than twice the sum of their radii apart along the arm: nearer ones are neighbours round a bend, which
touch as the joint's own housing does. That finds folds sharper than about 120 degrees, and all that
comes from farther away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_core.planning.site import BASE, Ball, Site
from modcal_core.robots import Chain, Frames, Mechanism, frames, is_serial_arm, takes, tool_frames

_SHARE_OF_REACH = 0.04  # radius of a link where none is stated: 5 cm of an arm of 1.3 m
_NEIGHBOURS = 2.0  # sums of radii along the arm within which spheres are not compared
_BLOCK = 2000  # postures at a time


@dataclass(frozen=True)
class Spheres:
    """S spheres of an arm.

    link: number of the link, 0 for the base … n behind the last joint, (S,). centre: in the frame that the link carries
    (see :class:`Frames`), (S, 3) [m]. radius: (S,) [m]. along: how far out along the arm they are, (S,) [m].
    pairs: those that are compared, (K, 2).
    """

    chain: Mechanism
    link: np.ndarray
    centre: Array
    radius: Array
    along: Array
    pairs: np.ndarray

    def at(self, f: Frames) -> Array:
        """Centres in the base, (S, 3, N), for the frames of N postures."""
        return np.einsum("sdcn,sd->scn", f.axes[self.link], self.centre) + f.p[self.link]


def spheres_of(chain: Mechanism, site: Site) -> Spheres:
    """The spheres of an arm at a site. Raises BadTable for a sphere on a link that is not there."""
    if not is_serial_arm(chain):
        return _of_closed(chain, site)
    lines = _lines(chain, site.moving)
    start = np.r_[0.0, np.cumsum([np.linalg.norm(b - a) for a, b in lines])]
    if site.spheres:
        link, centre = _given(chain, site.spheres)
        radius = np.array([b.radius for b in site.spheres])
    else:
        size = _SHARE_OF_REACH * chain.reach() if site.link_radius is None else site.link_radius
        parts = [(k, p) for k, (a, b) in enumerate(lines) for p in _along(a, b, size)]
        link, centre = np.array([k for k, _ in parts]), np.array([p for _, p in parts])
        radius = np.full(len(parts), size)
    along = np.array([start[k] + _share(lines[k], c) for k, c in zip(link, centre, strict=True)])
    i, j = np.triu_indices(len(link), 1)
    far = (link[i] != link[j]) & (np.abs(along[i] - along[j]) > _NEIGHBOURS * (radius[i] + radius[j]))
    return Spheres(chain, link, centre, radius, along, np.stack([i[far], j[far]], axis=1))


def _of_closed(chain: Mechanism, site: Site) -> Spheres:
    """One sphere at the tip of a robot of closed chains: what carries it is above, and does not touch itself."""
    if site.spheres:
        said = "belongs to a serial arm: of this robot only the tip is looked at"
        raise BadTable(f"sphere on link '{site.spheres[0].link}'", said, "leave spheres out, state link_radius_m")
    size = _SHARE_OF_REACH * chain.reach() if site.link_radius is None else site.link_radius
    at = np.array([chain.tool_place])
    return Spheres(chain, at, np.zeros((1, 3)), np.array([size]), np.zeros(1), np.zeros((0, 2), dtype=int))


def _lines(chain: Chain, target: Array) -> list[tuple[Array, Array]]:
    """The two ends of every link, joint to joint, in the frame it carries; the last one ends at target or camera."""
    starts, ends = se3.inverse(chain.along_z)[:, :3, 3], np.zeros((chain.n + 1, 3))
    ends[-1] = target
    return list(zip(starts, ends, strict=True))


def _along(a: Array, b: Array, spacing: float) -> list[Array]:
    count = int(np.ceil(np.linalg.norm(b - a) / max(spacing, 1e-3)))
    return [a + (b - a) * t for t in np.linspace(0.0, 1.0, count + 1)] if count else []


def _share(line: tuple[Array, Array], point: Array) -> float:
    a, way = line[0], line[1] - line[0]
    length = float(np.linalg.norm(way))
    return float(np.clip((point - a) @ way / length, 0.0, length)) if length > 1e-9 else 0.0


def _given(chain: Chain, balls: Sequence[Ball]) -> tuple[np.ndarray, Array]:
    M, links, centres = chain.along_z, [], []
    names = (BASE, *chain.names)
    for ball in balls:
        if ball.link not in names:
            raise BadTable(f"sphere on link '{ball.link}'", "there is no such link", f"choose from {', '.join(names)}")
        k = names.index(ball.link)
        inside = ball.centre if k == 0 else chain.joint_basis[k - 1].T @ ball.centre
        links.append(k)
        centres.append(se3.apply(se3.inverse(M[k]), inside))
    return np.array(links), np.array(centres)


def clearance(spheres: Spheres, site: Site, q: Array) -> Array:
    """The least free distance [m] at postures q (N, n), (N,): to itself, the floor, and the obstacles; inf if to none.

    It is negative where something touches, and the site's margin is taken off already.
    """
    out = np.full(len(q), np.inf)
    for first in range(0, len(q), _BLOCK):
        rows = slice(first, first + _BLOCK)
        out[rows] = _clearance(spheres, site, q[rows])
    return out - site.margin


def _clearance(spheres: Spheres, site: Site, q: Array) -> Array:
    at = spheres.at(_frames(spheres.chain, q))
    out = np.where(takes(spheres.chain, q), np.inf, -np.inf)
    for i in np.unique(spheres.pairs[:, 0]):
        others = spheres.pairs[spheres.pairs[:, 0] == i, 1]
        gap = np.linalg.norm(at[others] - at[i], axis=1) - (spheres.radius[others] + spheres.radius[i])[:, None]
        out = np.minimum(out, gap.min(axis=0))
    moving = spheres.link > 0
    for ball in site.obstacles:
        gap = np.linalg.norm(at[moving] - ball.centre[:, None], axis=1) - spheres.radius[moving, None] - ball.radius
        out = np.minimum(out, gap.min(axis=0, initial=np.inf))
    for box in site.boxes:
        low, high = box[0][:, None], box[1][:, None]
        outside = np.linalg.norm(np.maximum(np.maximum(low - at[moving], at[moving] - high), 0.0), axis=1)
        inside = np.minimum(np.max(np.maximum(low - at[moving], at[moving] - high), axis=1), 0.0)
        out = np.minimum(out, (outside + inside - spheres.radius[moving, None]).min(axis=0, initial=np.inf))
    if site.floor is not None:
        # what the first joint carries stands on the floor
        high = spheres.link > 1
        gap = at[high, 2] - spheres.radius[high, None] - site.floor
        out = np.minimum(out, gap.min(axis=0, initial=np.inf))
    return out


def visible(spheres: Spheres, site: Site, q: Array) -> np.ndarray:
    """True for postures q (N, n) in which the tracker sees the target, (N,): range, both cones, nothing in between."""
    tracker, target = site.tracker, site.target
    if tracker is None:
        return np.ones(len(q), dtype=bool)
    f = _frames(spheres.chain, q)
    turned = f.axes[-1]

    def moved(v: Array) -> Array:
        return np.asarray(np.einsum("dcn,d->nc", turned, v))

    def still(v: Array) -> Array:
        return np.tile(v, (len(q), 1))

    of_eye, of_target = (moved, still) if tracker.carried else (still, moved)
    tip, zero = f.p[-1].T, np.zeros(3)
    eye = of_eye(tracker.position) + (tip if tracker.carried else zero)
    p = of_target(target.position) + (zero if tracker.carried else tip)
    way = p - eye
    distance = np.linalg.norm(way, axis=1)
    ray = way / np.maximum(distance, 1e-9)[:, None]
    seen = (distance >= tracker.nearest) & (distance <= tracker.farthest) & (distance > target.radius)
    if tracker.view is not None:
        aside = np.arccos(np.clip(np.sum(of_eye(tracker.view.axis) * ray, axis=1), -1.0, 1.0))
        wide = np.arcsin(np.minimum(target.radius / np.maximum(distance, 1e-9), 1.0))
        seen &= aside + wide <= tracker.view.half_angle
    if target.facing is not None:
        seen &= np.sum(of_target(target.facing.axis) * -ray, axis=1) >= np.cos(target.facing.half_angle)
    rows = np.flatnonzero(seen)
    seen[rows] &= ~_hidden(spheres, site, eye[rows], f, p, rows)
    return seen


def _frames(chain: Mechanism, q: Array) -> Frames:
    """Frames of the places in the base."""
    return frames(chain, q) if is_serial_arm(chain) else tool_frames(chain, np.eye(4), q)


def _hidden(spheres: Spheres, site: Site, eye: Array, f: Frames, p: Array, rows: np.ndarray) -> np.ndarray:
    """True where a sphere stands between eye (m, 3) and target, (m,); those next to the tool do not count."""
    at = spheres.at(Frames(f.axes[..., rows], f.p[..., rows]))
    end = float(spheres.along.max(initial=0.0))
    blocking = end - spheres.along > _NEIGHBOURS * spheres.radius
    centres = [*at[blocking], *(np.repeat(b.centre[:, None], len(rows), axis=1) for b in site.obstacles)]
    radii = [*spheres.radius[blocking], *(b.radius for b in site.obstacles)]
    way = p[rows].T - eye.T
    square = np.maximum(np.sum(way**2, axis=0), 1e-12)
    out = np.zeros(len(rows), dtype=bool)
    for centre, radius in zip(centres, radii, strict=True):
        to = centre - eye.T
        share = np.clip(np.sum(to * way, axis=0) / square, 0.0, 1.0)
        out |= np.linalg.norm(to - share * way, axis=0) < radius
    return out
