"""Tracks of things that are no one joint, written before what a path without a joint explains was weighed; run once."""

from __future__ import annotations

import numpy as np
from paths import DEGREE, Array, Maker, Path, about_z, flat
from scipy.spatial.transform import Rotation

ASIDE: dict[str, Maker] = {}


def aside(maker: Maker) -> Maker:
    ASIDE[maker.__name__] = maker
    return maker


def _ray(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@aside
def lamp_on_two_parallelograms(rng: np.random.Generator, n: int) -> Path:
    """A balanced lamp: both arms turn, the upper one less, and its head keeps its orientation."""
    a = np.linspace(20.0 * DEGREE, rng.uniform(75.0, 100.0) * DEGREE, n)
    b = rng.uniform(120.0, 150.0) * DEGREE - rng.uniform(0.3, 0.6) * a
    p = rng.uniform(0.35, 0.45) * _ray(a) + rng.uniform(0.35, 0.45) * _ray(b)
    return flat(p[:, 0], p[:, 1]), about_z(0.0 * a)


@aside
def curtain_on_a_clothoid(rng: np.random.Generator, n: int) -> Path:
    """A rail whose bend grows evenly with the way."""
    s = np.linspace(0.0, rng.uniform(0.5, 0.8), n)
    heading = rng.uniform(0.8, 1.5) * (s / s[-1]) ** 2
    step = np.gradient(s)
    return flat(np.cumsum(np.cos(heading) * step), np.cumsum(np.sin(heading) * step)), about_z(heading)


@aside
def bin_above_the_seats(rng: np.random.Generator, n: int) -> Path:
    """A bin that hangs on two unequal arms."""
    first, second, body, apart = 0.3, rng.uniform(0.36, 0.44), 0.25, rng.uniform(0.16, 0.22)
    a = np.linspace(-100.0 * DEGREE, rng.uniform(-55.0, -40.0) * DEGREE, n)
    A = first * _ray(a)
    d = np.array([apart, 0.05]) - A
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(np.clip((body**2 + far**2 - second**2) / (2.0 * body * far), -1.0, 1.0))
    turn = np.arctan2(d[:, 1], d[:, 0]) - beta
    p = A + rng.uniform(0.3, 0.4) * _ray(turn - 0.9)
    return flat(p[:, 0], p[:, 1]), about_z(turn)


@aside
def sofa_that_lifts_as_it_comes(rng: np.random.Generator, n: int) -> Path:
    """A seat that is drawn out, and lifted over a hump by a cam."""
    t = np.linspace(0.0, 1.0, n)
    p = flat(rng.uniform(0.4, 0.6) * t, 0.0 * t)
    p[:, 2] = rng.uniform(0.05, 0.1) * np.sin(np.pi * t**1.5)
    return p, about_z(0.0 * t)


@aside
def footrest_of_a_recliner(rng: np.random.Generator, n: int) -> Path:
    """A board that turns on the end of a bar, half as fast as the bar and the other way."""
    a = np.linspace(0.0, rng.uniform(60.0, 85.0) * DEGREE, n)
    b = -rng.uniform(0.3, 0.6) * a
    p = rng.uniform(0.3, 0.4) * _ray(a) + rng.uniform(0.15, 0.25) * _ray(b + 0.5)
    return flat(p[:, 0], p[:, 1]), about_z(b)


@aside
def rib_of_an_umbrella(rng: np.random.Generator, n: int) -> Path:
    """The tip of a rib that hangs at the top and is spread by a runner on the pole."""
    runner = np.linspace(0.32, rng.uniform(0.12, 0.2), n)
    strut, at, length = 0.22, 0.2, rng.uniform(0.45, 0.6)
    angle = np.arccos(np.clip((at**2 + runner**2 - strut**2) / (2.0 * at * runner), -1.0, 1.0))
    droop = rng.uniform(0.05, 0.12) * np.sin(angle)  # the rib bends under the cloth
    return flat(length * np.sin(angle) * (1.0 - droop), -length * np.cos(angle) - droop * length), about_z(angle)


@aside
def hook_of_a_crane(rng: np.random.Generator, n: int) -> Path:
    """A boom that is raised while the rope runs out; the hook hangs still."""
    a = np.linspace(15.0 * DEGREE, rng.uniform(60.0, 75.0) * DEGREE, n)
    p = rng.uniform(0.6, 0.8) * _ray(a)
    p[:, 1] -= rng.uniform(0.15, 0.35) * (a - a[0])
    return flat(p[:, 0], p[:, 1]), about_z(0.0 * a)


@aside
def hatch_on_a_growing_arm(rng: np.random.Generator, n: int) -> Path:
    """A flap that is drawn out of its hinge by a tenth to a fifth of its length as it opens."""
    a = np.linspace(0.0, rng.uniform(70.0, 100.0) * DEGREE, n)
    r = rng.uniform(0.35, 0.5) * (1.0 + rng.uniform(0.1, 0.2) * (a / a[-1]) ** 2)
    p = r[:, None] * _ray(a)
    return flat(p[:, 0], p[:, 1]), about_z(a)


@aside
def cross_of_a_cardan_shaft(rng: np.random.Generator, n: int) -> Path:
    """A lever behind a universal joint that is led about two axes at once."""
    a = np.linspace(0.0, rng.uniform(40.0, 70.0) * DEGREE, n)
    b = rng.uniform(0.4, 0.7) * np.sin(2.0 * a)
    R = Rotation.from_rotvec(np.outer(a, [1.0, 0.0, 0.0])) * Rotation.from_rotvec(np.outer(b, [0.0, 1.0, 0.0]))
    return R.apply([0.1, 0.0, rng.uniform(0.35, 0.5)]), R


@aside
def pendulum_between_cheeks(rng: np.random.Generator, n: int) -> Path:
    """A cord that winds about two cheeks: a cycloid."""
    a = np.linspace(-rng.uniform(1.6, 2.2), rng.uniform(0.4, 1.0), n)
    wheel = rng.uniform(0.1, 0.16)
    return flat(wheel * (a + np.sin(a)), wheel * (1.0 - np.cos(a))), about_z(0.5 * a)


@aside
def trolley_on_a_hanging_rope(rng: np.random.Generator, n: int) -> Path:
    """A pulley on a rope that sags: a catenary."""
    x = np.linspace(-rng.uniform(0.3, 0.4), rng.uniform(0.2, 0.35), n)
    c = rng.uniform(0.18, 0.3)
    return flat(x, c * np.cosh(x / c)), about_z(np.arctan(np.sinh(x / c)))


@aside
def slider_round_the_corner(rng: np.random.Generator, n: int) -> Path:
    """A door in a rail: straight, a bend of 15 to 25 cm, straight again."""
    straight, bend, radius = rng.uniform(0.15, 0.25), rng.uniform(50.0, 90.0) * DEGREE, rng.uniform(0.15, 0.25)
    s = np.linspace(0.0, 2.0 * straight + bend * radius, n)
    heading = np.clip((s - straight) / radius, 0.0, bend)
    step = np.gradient(s)
    return flat(np.cumsum(np.cos(heading) * step), np.cumsum(np.sin(heading) * step)), about_z(heading)
