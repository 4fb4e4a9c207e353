"""Tracks of things that are no one joint, written before the rules of trust over a horizon and run once, after them."""

from __future__ import annotations

import numpy as np
from paths import DEGREE, Array, Maker, Path, about_z, flat
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

UNSEEN: dict[str, Maker] = {}


def unseen(maker: Maker) -> Maker:
    UNSEEN[maker.__name__] = maker
    return maker


def _walk(heading: Array, s: Array) -> Array:
    """A way in the plane with a heading [rad] at each length s [m]."""
    step = np.gradient(s)
    return flat(np.cumsum(np.cos(heading) * step), np.cumsum(np.sin(heading) * step))


@unseen
def link_of_watt(rng: np.random.Generator, n: int) -> Path:
    """A point beside the middle of the floating link between two arms: nearly straight, and then not."""
    arm, link, turn = 0.4, rng.uniform(0.18, 0.26), np.linspace(-0.2, rng.uniform(0.5, 0.7), n)
    first = arm * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    pivot = np.array([2.0 * arm, link])
    d = pivot - first
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(np.clip((link**2 + far**2 - arm**2) / (2.0 * link * far), -1.0, 1.0))
    at = np.arctan2(d[:, 1], d[:, 0]) + beta
    share = rng.uniform(0.5, 0.8)
    return flat(first[:, 0] + share * link * np.cos(at), first[:, 1] + share * link * np.sin(at)), about_z(at)


@unseen
def spiral_of_archimedes(rng: np.random.Generator, n: int) -> Path:
    """A pin in the groove of a scroll: outwards by 5 to 9 cm a radian."""
    a = np.linspace(0.0, rng.uniform(100.0, 170.0) * DEGREE, n)
    r = rng.uniform(0.15, 0.25) + rng.uniform(0.05, 0.09) * a
    return flat(r * np.cos(a), r * np.sin(a)), about_z(a)


@unseen
def parabolic_chute(rng: np.random.Generator, n: int) -> Path:
    x = np.linspace(0.0, rng.uniform(0.45, 0.65), n)
    steep = rng.uniform(1.2, 2.4)
    return flat(x, steep * x**2), about_z(np.arctan(2.0 * steep * x))


@unseen
def flipper_door(rng: np.random.Generator, n: int) -> Path:
    """A front that is turned up about its upper edge and then pushed in above the shelf."""
    k = n // 2
    a = np.linspace(0.0, 90.0 * DEGREE, k)
    height = rng.uniform(0.25, 0.4)
    p = height * flat(np.sin(a), 1.0 - np.cos(a))
    into = np.linspace(0.0, rng.uniform(0.2, 0.35), n - k)
    q = p[-1] + np.outer(into, [-1.0, 0.0, 0.0])
    return np.concatenate([p, q]), about_z(np.concatenate([a, np.full(n - k, a[-1])]))


@unseen
def bayonet_with_a_long_lever(rng: np.random.Generator, n: int) -> Path:
    """Pushed in by some centimetres, turned by a lever, and drawn out again."""
    k = n // 4
    push, out = rng.uniform(0.03, 0.06), rng.uniform(0.15, 0.3)
    a = np.concatenate([np.zeros(k), np.linspace(0.0, rng.uniform(40.0, 70.0) * DEGREE, k)])
    a = np.concatenate([a, np.full(n - 2 * k, a[-1])])
    z = np.concatenate([np.linspace(0.0, -push, k), np.full(k, -push), -push + np.linspace(0.0, out, n - 2 * k)])
    lever = rng.uniform(0.2, 0.3)
    p = flat(lever * np.cos(a), lever * np.sin(a))
    p[:, 2] = z
    return p, about_z(a)


@unseen
def trammel(rng: np.random.Generator, n: int) -> Path:
    """A rod with two pins in crossed slots, held at its end: an ellipse, and the rod turns the other way."""
    a = np.linspace(10.0 * DEGREE, rng.uniform(95.0, 125.0) * DEGREE, n)
    whole, part = rng.uniform(0.45, 0.55), rng.uniform(0.2, 0.3)
    return flat(whole * np.cos(a), part * np.sin(a)), about_z(-a)


@unseen
def cradle_that_rocks(rng: np.random.Generator, n: int) -> Path:
    """A handle above two curved runners that roll on the floor."""
    a = np.linspace(-25.0 * DEGREE, rng.uniform(30.0, 45.0) * DEGREE, n)
    runner, above = rng.uniform(0.35, 0.5), rng.uniform(0.3, 0.45)
    x = runner * a + above * np.sin(a)
    y = runner + above * np.cos(a) + rng.uniform(0.05, 0.12) * np.sin(2.0 * a)
    return flat(x, y), about_z(-a)


@unseen
def table_on_a_turntable(rng: np.random.Generator, n: int) -> Path:
    """Two turntables, one on the other and geared to it."""
    a = np.linspace(0.0, rng.uniform(60.0, 100.0) * DEGREE, n)
    b = rng.uniform(1.6, 2.6) * a
    p = rng.uniform(0.25, 0.35) * flat(np.cos(a), np.sin(a)) + rng.uniform(0.1, 0.16) * flat(np.cos(b), np.sin(b))
    return p, about_z(b)


@unseen
def trailer_that_is_swung(rng: np.random.Generator, n: int) -> Path:
    """The end of a trailer whose hitch is drawn along a line: a tractrix."""
    length = rng.uniform(0.35, 0.5)
    s = np.linspace(0.0, rng.uniform(0.5, 0.8), n)
    heading = np.empty(n)
    heading[0] = rng.uniform(75.0, 88.0) * DEGREE
    for i in range(1, n):
        heading[i] = heading[i - 1] - np.sin(heading[i - 1]) * (s[i] - s[i - 1]) / length
    over = rng.uniform(1.2, 1.6) * length  # the handle sits behind the axle
    return flat(s - over * np.cos(heading), -over * np.sin(heading)), about_z(heading)


@unseen
def arm_at_random(rng: np.random.Generator, n: int) -> Path:
    """The tool of an arm of six joints, each of which goes smoothly to and fro."""
    t = np.linspace(0.0, 1.0, n)
    knots = np.linspace(0.0, 1.0, 5)
    links = [(0.0, 0.0, 0.35), (0.4, 0.0, 0.0), (0.35, 0.0, 0.0), (0.0, 0.0, 0.1), (0.1, 0.0, 0.0), (0.0, 0.0, 0.12)]
    axes = [(0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1)]
    p, R = np.zeros((n, 3)), Rotation.from_rotvec(np.zeros((n, 3)))
    for link, axis in zip(links, axes, strict=True):
        q = CubicSpline(knots, rng.normal(0.3, 0.45, 5))(t)
        R = R * Rotation.from_rotvec(np.outer(q, axis))
        p = p + R.apply(link)
    return p, R


@unseen
def rail_of_the_third_degree(rng: np.random.Generator, n: int) -> Path:
    """Straight at first, and off to the side with the cube of the way."""
    s = np.linspace(0.0, rng.uniform(0.45, 0.65), n)
    side = rng.uniform(0.08, 0.2) * (s / s[-1]) ** 3
    return flat(s, side), about_z(np.arctan(np.gradient(side, s)))


@unseen
def toggle_clamp(rng: np.random.Generator, n: int) -> Path:
    """The lever of a clamp on a short crank and a rocker: its point runs round a tight corner."""
    crank, coupler, rocker, ground = 0.1, rng.uniform(0.16, 0.2), 0.18, rng.uniform(0.2, 0.24)
    a = np.linspace(30.0 * DEGREE, rng.uniform(140.0, 180.0) * DEGREE, n)
    A = crank * np.stack([np.cos(a), np.sin(a)], axis=1)
    d = np.array([ground, 0.0]) - A
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(np.clip((coupler**2 + far**2 - rocker**2) / (2.0 * coupler * far), -1.0, 1.0))
    turn = np.arctan2(d[:, 1], d[:, 0]) + beta
    lever = rng.uniform(0.3, 0.45)
    return flat(A[:, 0] + lever * np.cos(turn + 0.8), A[:, 1] + lever * np.sin(turn + 0.8)), about_z(turn)


@unseen
def spiral_slide_with_a_landing(rng: np.random.Generator, n: int) -> Path:
    """A helix that ends in a straight."""
    radius, pitch = rng.uniform(0.2, 0.3), rng.uniform(0.06, 0.12)
    k = (2 * n) // 3
    a = np.linspace(0.0, rng.uniform(80.0, 130.0) * DEGREE, k)
    p = np.column_stack([radius * np.cos(a), radius * np.sin(a), -pitch * a])
    on = np.array([-np.sin(a[-1]), np.cos(a[-1]), 0.0])
    q = p[-1] + np.outer(np.linspace(0.0, rng.uniform(0.15, 0.3), n - k), on)
    return np.concatenate([p, q]), about_z(np.concatenate([a, np.full(n - k, a[-1])]))


@unseen
def second_hinge_that_joins_in(rng: np.random.Generator, n: int) -> Path:
    """A leaf on a leaf: the second begins to turn, slowly, when the first has turned by 20 to 30 degrees."""
    a = np.linspace(0.0, rng.uniform(60.0, 85.0) * DEGREE, n)
    late = np.clip(a - rng.uniform(20.0, 30.0) * DEGREE, 0.0, None)
    b = a + rng.uniform(0.8, 1.4) * late**2 / (late + 0.2)
    p = rng.uniform(0.3, 0.4) * flat(np.cos(a), np.sin(a)) + rng.uniform(0.3, 0.4) * flat(np.cos(b), np.sin(b))
    return p, about_z(b)


@unseen
def lane_that_comes_back(rng: np.random.Generator, n: int) -> Path:
    """A slide that is led to one side and back again, once, by 4 to 7 cm."""
    t = np.linspace(0.0, 1.0, n)
    side = rng.uniform(0.04, 0.07) * 0.5 * (1.0 - np.cos(2.0 * np.pi * t))
    return np.column_stack([rng.uniform(0.5, 0.8) * t, side, 0.15 * side]), Rotation.from_rotvec(np.zeros((n, 3)))
