"""More tracks of things that are no one joint.

``SHAPING`` were looked at while trust by a share of the path and the rule of a smooth bend were chosen; ``FRESH`` were
written after both, and run once.
"""

from __future__ import annotations

import numpy as np
from paths import DEGREE, Array, Maker, Path, about_z
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

SHAPING: dict[str, Maker] = {}
FRESH: dict[str, Maker] = {}


def shaping(maker: Maker) -> Maker:
    SHAPING[maker.__name__] = maker
    return maker


def fresh(maker: Maker) -> Maker:
    FRESH[maker.__name__] = maker
    return maker


def _about(axis: list[float], angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, axis))


def _still(n: int) -> Rotation:
    return Rotation.from_rotvec(np.zeros((n, 3)))


def _arc(angle: Array, radius: float) -> Array:
    """From the origin along y, bending towards −x."""
    return radius * np.stack([np.cos(angle) - 1.0, np.sin(angle), np.zeros_like(angle)], axis=1)


def _straight(far: float, n: int, along: list[float]) -> Array:
    return np.outer(np.linspace(0.0, far, n), along)


def _then(first: Path, second: Path) -> Path:
    """The second after the first, from where that ends, in the frame in which the handle stands there."""
    (p, R), (q, S) = first, second
    return np.concatenate([p, p[-1] + R[-1].apply(q)]), Rotation.concatenate([R, R[-1] * S])


def _walk(heading: Array, s: Array) -> Array:
    """A way in the plane with a heading [rad] at each length s [m]."""
    step = np.gradient(s)
    return np.stack([np.cumsum(np.cos(heading) * step), np.cumsum(np.sin(heading) * step), 0.0 * s], axis=1)


@shaping
def eccentric_cam(rng: np.random.Generator, n: int) -> Path:
    """A crank whose length follows a lobe."""
    a = np.linspace(0.0, rng.uniform(80.0, 130.0) * DEGREE, n)
    r = rng.uniform(0.25, 0.4) + rng.uniform(0.02, 0.04) * np.cos(2.0 * a + rng.uniform(0.0, 6.0))
    return r[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1), about_z(a)


@shaping
def parallelogram_flap(rng: np.random.Generator, n: int) -> Path:
    """A flap on two nearly parallel arms: positions go round, the flap turns by a third. Points alone are a hinge."""
    a = np.linspace(0.0, rng.uniform(50.0, 80.0) * DEGREE, n)
    return _arc(a, rng.uniform(0.3, 0.45)), about_z(rng.uniform(0.2, 0.4) * a)


@shaping
def draw_latch_then_slide(rng: np.random.Generator, n: int) -> Path:
    """A latch of 7 cm is turned, and then a slide is drawn."""
    k = n // 4
    R = _about([0.0, 1.0, 0.0], np.linspace(0.0, rng.uniform(60.0, 90.0) * DEGREE, k))
    turn = R.apply([0.0, 0.0, 0.07]) - [0.0, 0.0, 0.07]
    return _then(
        (turn, R), (R[-1].inv().apply(_straight(rng.uniform(0.2, 0.4), n - k, [1.0, 0.0, 0.0])), _still(n - k))
    )


@shaping
def plug_door_of_a_bus(rng: np.random.Generator, n: int) -> Path:
    """Swings out, and then slides along the side."""
    k = n // 3
    a = np.linspace(0.0, rng.uniform(25.0, 40.0) * DEGREE, k)
    R, p = about_z(a), _arc(a, rng.uniform(0.3, 0.45))
    return _then((p, R), (R[-1].inv().apply(_straight(rng.uniform(0.25, 0.45), n - k, [0.0, 1.0, 0.0])), _still(n - k)))


@shaping
def boom_that_turns_then_extends(rng: np.random.Generator, n: int) -> Path:
    a = np.linspace(0.0, rng.uniform(60.0, 100.0) * DEGREE, n)
    r = rng.uniform(0.35, 0.5) + rng.uniform(0.15, 0.3) * np.clip(a / a[-1] - 0.4, 0.0, 1.0) ** 2
    return r[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1), about_z(a)


@shaping
def hinge_that_lifts_late(rng: np.random.Generator, n: int) -> Path:
    """A rising hinge whose ramp begins at 30 to 40 degrees."""
    a = np.linspace(0.0, rng.uniform(70.0, 95.0) * DEGREE, n)
    z = rng.uniform(0.04, 0.08) * np.clip(a - rng.uniform(30.0, 40.0) * DEGREE, 0.0, None)
    p = _arc(a, rng.uniform(0.5, 0.7))
    p[:, 2] = z
    return p, about_z(a)


@shaping
def hose_in_the_hand(rng: np.random.Generator, n: int) -> Path:
    """A smooth way of slowly changing curvature."""
    knots, fine = np.linspace(0.0, 1.0, 4), np.linspace(0.0, 1.0, n)
    heading = CubicSpline(knots, np.cumsum(rng.normal(0.0, 0.5, 4)))(fine)
    p = _walk(heading, np.linspace(0.0, rng.uniform(0.5, 0.8), n))
    p[:, 2] = 0.1 * CubicSpline(knots, rng.normal(0.0, 0.5, 4))(fine)
    return p, about_z(heading)


@shaping
def elliptic_rail(rng: np.random.Generator, n: int) -> Path:
    a = np.linspace(0.0, rng.uniform(80.0, 110.0) * DEGREE, n)
    A, B = rng.uniform(0.4, 0.5), rng.uniform(0.22, 0.3)
    p = np.stack([A * np.sin(a), B * (1.0 - np.cos(a)), 0.0 * a], axis=1)
    return p, about_z(np.arctan2(B * np.sin(a), A * np.cos(a)))


@shaping
def lid_on_a_rack(rng: np.random.Generator, n: int) -> Path:
    """A lid whose pinion rolls along a rack while it turns."""
    a = np.linspace(0.0, rng.uniform(70.0, 100.0) * DEGREE, n)
    r, p = rng.uniform(0.05, 0.09), _arc(a, rng.uniform(0.35, 0.5))
    p[:, 0] += r * a
    return p, about_z(a)


@shaping
def carried_away(rng: np.random.Generator, n: int) -> Path:
    """A hand that reaches out straight, and then bends off."""
    t = np.linspace(0.0, 1.0, n)
    s = rng.uniform(0.5, 0.7) * (10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5)
    heading = rng.uniform(0.7, 1.3) * 3.0 * np.clip(t - 0.45, 0.0, 1.0) ** 2
    return _walk(heading, s), Rotation.from_rotvec(np.outer(0.3 * np.sin(3.0 * t), [0.3, 0.8, 0.5]))


@shaping
def screw_of_changing_pitch(rng: np.random.Generator, n: int) -> Path:
    a = np.linspace(0.0, rng.uniform(1.2, 2.2) * np.pi, n)
    p = _arc(a, rng.uniform(0.1, 0.2))
    p[:, 2] = rng.uniform(0.01, 0.02) * a**2
    return p, about_z(a)


@shaping
def drawer_that_droops(rng: np.random.Generator, n: int) -> Path:
    """Its second stage hangs by 5 to 9 degrees."""
    s = np.linspace(0.0, rng.uniform(0.4, 0.6), n)
    late = np.clip(s - rng.uniform(0.18, 0.28), 0.0, 1.0)
    p = np.stack([s, 0.0 * s, -rng.uniform(0.08, 0.16) * late], axis=1)
    return p, _about([0.0, 1.0, 0.0], rng.uniform(0.08, 0.16) * np.clip(late / 0.03, 0.0, 1.0))


@fresh
def rail_like_an_s(rng: np.random.Generator, n: int) -> Path:
    """One way round, and then the other way round."""
    k = n // 2
    a, b = (np.linspace(0.0, rng.uniform(35.0, 60.0) * DEGREE, m) for m in (k, n - k))
    second = _arc(b, rng.uniform(0.25, 0.45)) * [-1.0, 1.0, 1.0]
    return _then((_arc(a, rng.uniform(0.25, 0.45)), about_z(a)), (second, about_z(-b)))


@fresh
def point_of_a_connecting_rod(rng: np.random.Generator, n: int) -> Path:
    """A slider-crank; the handle sits on the rod."""
    a = np.linspace(0.0, rng.uniform(100.0, 150.0) * DEGREE, n)
    crank, rod, at = rng.uniform(0.15, 0.22), rng.uniform(0.45, 0.6), rng.uniform(0.3, 0.6)
    tilt = np.arcsin(crank * np.sin(a) / rod)
    pin = crank * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return pin + at * rod * np.stack([np.cos(tilt), -np.sin(tilt), 0.0 * a], axis=1), about_z(-tilt)


@fresh
def oval_of_a_toy_train(rng: np.random.Generator, n: int) -> Path:
    """Straight on, half round, and back."""
    lead, radius = rng.uniform(0.15, 0.3), rng.uniform(0.15, 0.22)
    s = np.linspace(0.0, lead + np.pi * radius + rng.uniform(0.1, 0.25), n)
    heading = np.clip((s - lead) / radius, 0.0, np.pi)
    return _walk(heading, s), about_z(heading)


@fresh
def window_that_tilts_and_then_turns(rng: np.random.Generator, n: int) -> Path:
    """Tilted about its lower edge, and then turned about its side."""
    k = n // 3
    a = np.linspace(0.0, rng.uniform(8.0, 14.0) * DEGREE, k)
    tilt, height = _about([1.0, 0.0, 0.0], a), rng.uniform(0.6, 0.9)
    p = height * np.stack([0.0 * a, -np.sin(a), np.cos(a) - 1.0], axis=1)
    b = np.linspace(0.0, rng.uniform(40.0, 70.0) * DEGREE, n - k)
    return _then((p, tilt), (_arc(b, rng.uniform(0.4, 0.6)), about_z(b)))


@fresh
def wheel_that_is_drawn_out_as_it_turns(rng: np.random.Generator, n: int) -> Path:
    """A valve's wheel: turns in place, and climbs more with every degree."""
    a = np.linspace(0.0, rng.uniform(120.0, 200.0) * DEGREE, n)
    p = _arc(a, rng.uniform(0.12, 0.2))
    p[:, 2] = rng.uniform(0.08, 0.14) * np.clip(a - 0.5, 0.0, None) ** 1.5
    return p, about_z(a)


@fresh
def trolley_that_changes_lanes(rng: np.random.Generator, n: int) -> Path:
    """A bend that comes and goes smoothly, and its opposite."""
    t = np.linspace(0.0, 1.0, n)
    heading = rng.uniform(0.4, 0.8) * np.sin(np.pi * t) ** 2
    return _walk(heading, rng.uniform(0.6, 0.9) * t), about_z(heading)


@fresh
def eye_of_a_ball(rng: np.random.Generator, n: int) -> Path:
    """A point on a ball that is rolled in its socket, about an axis that wanders."""
    t = np.linspace(0.0, 1.0, n)
    v = np.stack(
        [rng.uniform(0.8, 1.3) * t, rng.uniform(0.3, 0.6) * t**2, rng.uniform(0.2, 0.4) * np.sin(2.0 * t)], axis=1
    )
    R = Rotation.from_rotvec(v)
    return R.apply([0.0, 0.0, rng.uniform(0.3, 0.5)]), R


@fresh
def pantograph_of_a_lamp(rng: np.random.Generator, n: int) -> Path:
    """Crossed arms that are drawn out, and sag as they come."""
    a = np.linspace(rng.uniform(65.0, 75.0), rng.uniform(20.0, 35.0), n) * DEGREE
    out, sag = rng.uniform(0.5, 0.7) * np.cos(a), rng.uniform(0.25, 0.45)
    p = np.stack([out, 0.0 * a, -sag * (out - out[0]) ** 2], axis=1)
    return p, _about([0.0, 1.0, 0.0], 0.4 * (out - out[0]))


@fresh
def stair_of_a_snail(rng: np.random.Generator, n: int) -> Path:
    """A helix that widens."""
    a = np.linspace(0.0, rng.uniform(140.0, 220.0) * DEGREE, n)
    r = rng.uniform(0.12, 0.18) + rng.uniform(0.03, 0.05) * a
    p = np.stack([r * np.cos(a), r * np.sin(a), rng.uniform(0.03, 0.06) * a], axis=1)
    return p, about_z(a)


@fresh
def lid_of_a_piano(rng: np.random.Generator, n: int) -> Path:
    """The front leaf is folded back over the lid, and then the lid is lifted by it."""
    k = n // 2
    a = np.linspace(0.0, rng.uniform(90.0, 150.0) * DEGREE, k)
    b = np.linspace(0.0, rng.uniform(30.0, 50.0) * DEGREE, n - k)
    first, R = _arc(a, rng.uniform(0.2, 0.3)), about_z(a)
    return _then((first, R), (R[-1].inv().apply(_arc(b, rng.uniform(0.6, 0.8))), about_z(b)))
