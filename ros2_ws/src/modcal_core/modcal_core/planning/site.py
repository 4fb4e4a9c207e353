"""Where an arm is measured: what the tracker sees, what the arm must not touch, and how well things are read.

Positions and axes of the tracker, and what to keep out of, are given in the arm's base link; those of the target in its
tip. A camera on the tool is given in the tip, its target in the base link. Links are named by the joint that moves
them, the first one ``base``. Spheres stand along the straight lines from joint to joint, or where a site puts them. Two
of them are compared where they are more than twice the sum of their radii apart along the arm: nearer ones are
neighbours round a bend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import (
    Chain,
    Frames,
    Mechanism,
    frames,
    inverse_batch,
    is_serial_arm,
    random_postures,
    takes,
    tool_frames,
)
from modcal_core.schema import NUMBER, POSITIVE, SIZE, TEXT, list_of, mapping_of, record, require, stated

FORMAT = 1  # of the file
BASE = "base"


@dataclass(frozen=True)
class Cone:
    """Where something looks. axis: unit vector (3,). half_angle: [rad]."""

    axis: Array
    half_angle: float


@dataclass(frozen=True)
class SiteTracker:
    """position: (3,) [m]. view: its field of view; None where it turns every way. nearest, farthest: range [m].
    carried: it is a camera on the tool, and looks at a target that stands still.
    """

    position: Array
    view: Cone | None = None
    nearest: float = 0.0
    farthest: float = np.inf
    carried: bool = False


@dataclass(frozen=True)
class SiteTarget:
    """What the tracker sees. position: (3,) in the tip [m]. facing: from where it is seen; None: from everywhere.
    radius: [m] about it, all of which must be in view.
    """

    position: Array = field(default_factory=lambda: np.array([0.05, 0.0, 0.1]))
    facing: Cone | None = None
    radius: float = 0.0


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis. position [m], and what is added to it per metre of distance; rotation [rad], of
    pose readings; joint_turn [rad], joint_slide [m]: by which joints do not repeat.
    """

    position: float = 5e-5
    per_metre: float = 0.0
    rotation: float = 5e-5
    joint_turn: float = 2e-5
    joint_slide: float = 2e-5


@dataclass(frozen=True)
class Ball:
    """A sphere. link: BASE or the joint that moves it, None for one of the surroundings. centre: (3,) [m], in the frame
    of the joint, as a URDF has it; radius [m].
    """

    centre: Array
    radius: float
    link: str | None = None


@dataclass(frozen=True)
class Site:
    """Surroundings of a plan.

    - tracker: the instrument; None where everything can be seen.
    - spheres: of the arm; empty: along its links with link_radius [m], or 4 % of its reach. margin: clearance [m].
    - floor: height [m] below which no moving sphere may be; None for no floor.
    - obstacles, boxes: of the surroundings, boxes as corners (2, 3) [m].
    - limits: limits by joint [rad, m] that are narrower than the robot's.
    - box: corners (2, 3) [m] of the workspace in which accuracy counts; None: everywhere.
    """

    tracker: SiteTracker | None = None
    target: SiteTarget = field(default_factory=SiteTarget)
    noise: Noise = field(default_factory=Noise)
    spheres: tuple[Ball, ...] = ()
    link_radius: float | None = None
    margin: float = 0.0
    floor: float | None = None
    obstacles: tuple[Ball, ...] = ()
    boxes: tuple[Array, ...] = ()
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    box: Array | None = None

    @property
    def carried(self) -> bool:
        """Whether the instrument is on the tool."""
        return self.tracker is not None and self.tracker.carried

    @property
    def still(self) -> Array:
        """The one of instrument and target that stands still, in the base link (3,) [m]; zeros where nobody knows."""
        if self.tracker is None:
            return np.zeros(3)
        return self.target.position if self.tracker.carried else self.tracker.position

    @property
    def moving(self) -> Array:
        """The one of instrument and target that the arm moves, in the tip (3,) [m]."""
        return self.tracker.position if self.tracker is not None and self.tracker.carried else self.target.position


_POINT, _PAIR = list_of(NUMBER, 3, 3), list_of(NUMBER, 2, 2)  # x y z; two ends
_CONE = {"axis": _POINT, "half_angle_deg": {**POSITIVE, "maximum": 180}}
_BALL = {"center_m": _POINT, "radius_m": SIZE}
_NOISE = ("position_m", "position_m_per_m", "rotation_rad", "joint_rad", "joint_m")  # in the order of Noise
_SCHEMA = record(
    (),
    modcal_site={"enum": [FORMAT]},
    tracker=record(("position_m",), position_m=_POINT, range_m=_PAIR, on_tool={"type": "boolean"}, **_CONE),
    target=record((), position_m=_POINT, radius_m=SIZE, **_CONE),
    noise=record((), **dict.fromkeys(_NOISE, SIZE)),
    arm=record(
        (), spheres=list_of(record(("center_m", "link"), link=TEXT, **_BALL)), link_radius_m=SIZE, margin_m=SIZE
    ),
    surroundings=record(
        (), floor_m=NUMBER, spheres=list_of(record(("center_m",), **_BALL)), boxes=list_of(list_of(_PAIR, 3, 3))
    ),
    limits=mapping_of(_PAIR),
    workspace=record((), box_m=list_of(_PAIR, 3, 3)),
)
_REMEDY = "correct the file, as docs/planning.md shows one"


@refusing
def site_from_data(data: Any, source: str) -> Site:
    """The site in nested mappings, such as a YAML file holds. Raises BadTable; docs/planning.md shows one."""
    top = stated(data)
    require(top, _SCHEMA, source, _REMEDY)
    tracker, target, noise, arm, around, limits = (
        top.get(key, {}) for key in ("tracker", "target", "noise", "arm", "surroundings", "limits")
    )
    box = top.get("workspace", {}).get("box_m")
    return Site(
        tracker=_tracker(tracker, f"{source}: tracker") if tracker else None,
        target=SiteTarget(
            np.array(target.get("position_m", SiteTarget().position), dtype=float),
            _cone(target, f"{source}: target"),
            float(target.get("radius_m", 0.0)),
        ),
        noise=Noise(*(float(noise.get(key, size)) for key, size in zip(_NOISE, astuple(Noise()), strict=True))),
        spheres=_balls(arm),
        link_radius=arm.get("link_radius_m"),
        margin=float(arm.get("margin_m", 0.0)),
        floor=around.get("floor_m"),
        obstacles=_balls(around),
        boxes=tuple(_box(b, f"{source}: surroundings: box {i + 1}") for i, b in enumerate(around.get("boxes", ()))),
        limits={name: _pair(ends, f"{source}: limits: {name}") for name, ends in limits.items()},
        box=None if box is None else _box(box, f"{source}: workspace: box_m"),
    )


def _cone(data: Mapping[str, Any], what: str) -> Cone | None:
    if "axis" not in data and "half_angle_deg" not in data:
        return None
    axis = np.array(data.get("axis", np.zeros(3)), dtype=float)
    length = float(np.linalg.norm(axis))
    if length < 1e-9 or "half_angle_deg" not in data:
        raise BadTable(what, "its cone has no axis or no angle", "give axis: [x, y, z] and half_angle_deg: 1 to 180")
    return Cone(axis / length, float(np.radians(data["half_angle_deg"])))


def _tracker(data: Mapping[str, Any], what: str) -> SiteTracker:
    near, far = _pair(data["range_m"], f"{what}: range_m") if "range_m" in data else (0.0, np.inf)
    position = np.array(data["position_m"], dtype=float)
    return SiteTracker(position, _cone(data, what), near, far, data.get("on_tool", False))


def _pair(ends: Sequence[float], what: str) -> tuple[float, float]:
    if ends[0] >= ends[1]:
        raise BadTable(what, f"{ends[0]:g} is not below {ends[1]:g}", "give [least, largest]")
    return float(ends[0]), float(ends[1])


def _box(ranges: Sequence[Sequence[float]], what: str) -> Array:
    return np.array([_pair(ends, what) for ends in ranges]).T


def _balls(data: Mapping[str, Any]) -> tuple[Ball, ...]:
    rows = data.get("spheres", ())
    return tuple(Ball(np.array(r["center_m"], dtype=float), float(r.get("radius_m", 0.0)), r.get("link")) for r in rows)


# --- Postures that show the target, evenly over what can be seen: a line of sight in both cones, a turn about it, and
# inverse kinematics, where random ones hardly ever do, as with a camera that looks at a board

_AROUND = Cone(np.array([0.0, 0.0, 1.0]), np.pi)  # every direction


def view_postures(chain: Chain, site: Site, count: int, rng: np.random.Generator) -> Array:
    """Postures (m, n) within the joints' limits at which the site's instrument looks at the target, whatever stands in
    between. count: lines of sight that are tried; those that the arm does not reach are left out.
    """
    tracker, target = site.tracker, site.target
    assert tracker is not None
    start = random_postures(chain, count, rng)
    reach = float(np.linalg.norm(chain.along_z[:, :3, 3], axis=1).sum())  # of the arm stretched out [m]
    farthest = min(tracker.farthest, tracker.nearest + 2.0 * reach)
    distance = rng.uniform(max(tracker.nearest, target.radius), farthest, count)
    view = tracker.view or _AROUND
    # so much of the view is taken up by the target itself
    room = view.half_angle - np.arcsin(np.minimum(target.radius / np.maximum(distance, 1e-9), 1.0))
    seen = room > 0.0
    start, distance, room = start[seen], distance[seen], room[seen]
    to_target = _within(view.axis, room, rng)
    facing = target.facing or _AROUND
    to_eye = _within(facing.axis, np.full(len(distance), facing.half_angle), rng)
    out, back = (to_target, to_eye) if tracker.carried else (to_eye, to_target)  # of what moves, and of what stands
    R = _turned(out, -back, rng)
    T = se3.transform(R, site.still + distance[:, None] * back - R @ site.moving)
    near = np.linalg.norm(T[:, :3, 3], axis=1) <= reach
    reached = inverse_batch(chain, T[near], start[near])
    return np.asarray(reached.q[reached.met])


def _within(axis: Array, angle: Array, rng: np.random.Generator) -> Array:
    """Unit directions (N, 3), evenly over caps of these angles (N,) [rad] about an axis (3,)."""
    up = rng.uniform(np.cos(angle), 1.0)
    turn = rng.uniform(0.0, 2.0 * np.pi, len(angle))
    beside = np.sqrt(np.maximum(1.0 - up**2, 0.0))
    local = np.stack([beside * np.cos(turn), beside * np.sin(turn), up], axis=1)
    return np.asarray(local @ _basis(axis[None])[0].T)


def _turned(a: Array, b: Array, rng: np.random.Generator) -> Array:
    """Rotations (N, 3, 3) that take directions a (N, 3) to b (N, 3), turned about b at random."""
    roll = so3.exp(rng.uniform(0.0, 2.0 * np.pi, (len(a), 1)) * b)
    return np.asarray(roll @ _basis(b) @ _basis(a).transpose(0, 2, 1))


def _basis(z: Array) -> Array:
    """Rotations (N, 3, 3) whose last columns are these unit directions (N, 3)."""
    helper = np.where(np.abs(z[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


# --- The arm as spheres

_SHARE_OF_REACH = 0.04  # radius of a link where none is stated: 5 cm of an arm of 1.3 m
_NEIGHBOURS = 2.0  # sums of radii along the arm within which spheres are not compared


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
    size = _SHARE_OF_REACH * chain.reach() if site.link_radius is None else site.link_radius
    if not is_serial_arm(chain):
        return _of_closed(chain, site.spheres, size)
    lines = _lines(chain, site.moving)
    start = np.r_[0.0, np.cumsum([np.linalg.norm(b - a) for a, b in lines])]
    if site.spheres:
        link, centre = _given(chain, site.spheres)
        radius = np.array([b.radius for b in site.spheres])
    else:
        parts = [(k, p) for k, (a, b) in enumerate(lines) for p in _along(a, b, size)]
        link, centre = np.array([k for k, _ in parts]), np.array([p for _, p in parts])
        radius = np.full(len(parts), size)
    along = np.array([start[k] + _share(lines[k], c) for k, c in zip(link, centre, strict=True)])
    i, j = np.triu_indices(len(link), 1)
    far = (link[i] != link[j]) & (np.abs(along[i] - along[j]) > _NEIGHBOURS * (radius[i] + radius[j]))
    return Spheres(chain, link, centre, radius, along, np.stack([i[far], j[far]], axis=1))


def _of_closed(chain: Mechanism, stated: Sequence[Ball], size: float) -> Spheres:
    """One sphere at the tip of a robot of closed chains: what carries it is above, and does not touch itself."""
    if stated:
        said = "belongs to a serial arm: of this robot only the tip is looked at"
        raise BadTable(f"sphere on link '{stated[0].link}'", said, "leave spheres out, state link_radius_m")
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
    """The least free distance [m], less the margin, at postures q (N, n), (N,): to itself, the floor, and the
    obstacles; inf if to none, negative where something touches.
    """
    at = spheres.at(_frames(spheres.chain, q))
    out = np.where(takes(spheres.chain, q), np.inf, -np.inf)
    for i in np.unique(spheres.pairs[:, 0]):
        others = spheres.pairs[spheres.pairs[:, 0] == i, 1]
        gap = np.linalg.norm(at[others] - at[i], axis=1) - (spheres.radius[others] + spheres.radius[i])[:, None]
        out = np.minimum(out, gap.min(axis=0))
    own, radius = at[spheres.link > 0], spheres.radius[spheres.link > 0, None]
    for ball in site.obstacles:
        gap = np.linalg.norm(own - ball.centre[:, None], axis=1) - radius - ball.radius
        out = np.minimum(out, gap.min(axis=0, initial=np.inf))
    for box in site.boxes:
        beyond = np.maximum(box[0][:, None] - own, own - box[1][:, None])
        gap = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0) - radius
        out = np.minimum(out, gap.min(axis=0, initial=np.inf))
    if site.floor is not None:
        # what the first joint carries stands on the floor
        high = spheres.link > 1
        gap = at[high, 2] - spheres.radius[high, None] - site.floor
        out = np.minimum(out, gap.min(axis=0, initial=np.inf))
    return out - site.margin


def visible(spheres: Spheres, site: Site, q: Array) -> np.ndarray:
    """True for postures q (N, n) in which the tracker sees the target, (N,): range, both cones, nothing in between."""
    tracker, target = site.tracker, site.target
    if tracker is None:
        return np.ones(len(q), dtype=bool)
    f = _frames(spheres.chain, q)
    moving = f.p[-1].T + np.einsum("dcn,d->nc", f.axes[-1], site.moving)
    away = site.still - moving
    distance = np.linalg.norm(away, axis=1)
    ray = away / np.maximum(distance, 1e-9)[:, None]
    # each as the one that looks has it: in the tip where the arm moves it, else in the base
    outwards, back = np.einsum("dcn,nc->nd", f.axes[-1], ray), -ray
    to_target, to_eye = (outwards, back) if tracker.carried else (back, outwards)
    seen = (distance >= tracker.nearest) & (distance <= tracker.farthest) & (distance > target.radius)
    if tracker.view is not None:
        aside = np.arccos(np.clip(to_target @ tracker.view.axis, -1.0, 1.0))
        wide = np.arcsin(np.minimum(target.radius / np.maximum(distance, 1e-9), 1.0))
        seen &= aside + wide <= tracker.view.half_angle
    if target.facing is not None:
        seen &= to_eye @ target.facing.axis >= np.cos(target.facing.half_angle)
    rows = np.flatnonzero(seen)
    seen[rows] &= ~_hidden(spheres, site, f, moving, rows)
    return seen


def _frames(chain: Mechanism, q: Array) -> Frames:
    """Frames of the places in the base."""
    return frames(chain, q) if is_serial_arm(chain) else tool_frames(chain, np.eye(4), q)


def _hidden(spheres: Spheres, site: Site, f: Frames, moving: Array, rows: np.ndarray) -> np.ndarray:
    """True where a sphere stands between what stands still and what moves (N, 3), of these rows (m,); spheres next to
    the tool do not count.
    """
    at = spheres.at(Frames(f.axes[..., rows], f.p[..., rows]))
    end = float(spheres.along.max(initial=0.0))
    blocking = end - spheres.along > _NEIGHBOURS * spheres.radius
    centres = [*at[blocking], *(b.centre[:, None] for b in site.obstacles)]
    radii = [*spheres.radius[blocking], *(b.radius for b in site.obstacles)]
    begin = site.still[:, None]
    way = moving[rows].T - begin
    square = np.maximum(np.sum(way**2, axis=0), 1e-12)
    out = np.zeros(len(rows), dtype=bool)
    for centre, radius in zip(centres, radii, strict=True):
        share = np.clip(np.sum((centre - begin) * way, axis=0) / square, 0.0, 1.0)
        out |= np.linalg.norm(centre - begin - share * way, axis=0) < radius
    return out
