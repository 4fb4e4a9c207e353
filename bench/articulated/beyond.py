"""Tracks of things that are no one joint: plain trigonometry, no code of what is tested.

``DESIGN`` were looked at while thresholds were chosen; ``KEPT`` were not before all was done, but before the rule of
two motions; ``LATER`` were written after that rule, and run once; ``LAST`` were written after the tracker kept to that
rule as well, and run once. More are in ``more_beyond``, ``unseen`` and ``put_aside``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from more_beyond import FRESH, SHAPING
from paths import DEGREE, Array, Maker, Path
from put_aside import ASIDE
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from unseen import UNSEEN

DESIGN: dict[str, Maker] = {}
KEPT: dict[str, Maker] = {}
LATER: dict[str, Maker] = {}
LAST: dict[str, Maker] = {}


@dataclass(frozen=True)
class Seen:
    """positions (n, 3) [m]; rotations (n, 3, 3), or None where points alone were seen."""

    positions: Array
    rotations: Array | None


def seen(kind: str, seed: int) -> Seen:
    """What a camera notes of a kind: even seeds see poses, odd ones points."""
    rng = np.random.default_rng([seed, *kind.encode()])
    n = int(rng.integers(120, 300))
    p, R = {**DESIGN, **KEPT, **LATER, **LAST, **SHAPING, **FRESH, **UNSEEN, **ASIDE}[kind](rng, n)
    world, hold = Rotation.random(rng=rng), Rotation.random(rng=rng)
    p = world.apply(p) + rng.uniform(-1.0, 1.0, 3) + rng.normal(0.0, np.exp(rng.uniform(-8.1, -6.2)), (n, 3))
    R = world * R * hold * Rotation.from_rotvec(rng.normal(0.0, DEGREE * rng.uniform(0.1, 0.8), (n, 3)))
    return Seen(p, R.as_matrix() if seed % 2 == 0 else None)


def _about_z(angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))


def _arc(angle: Array, radius: float) -> Array:
    """From the origin along y, bending towards −x."""
    return radius * np.stack([np.cos(angle) - 1.0, np.sin(angle), np.zeros_like(angle)], axis=1)


def _then(first: Path, second: Path) -> Path:
    """The second after the first, from where that ends, in the frame in which the handle stands there."""
    (p, R), (q, S) = first, second
    return np.concatenate([p, p[-1] + R[-1].apply(q)]), Rotation.concatenate([R, R[-1] * S])


def _still(n: int) -> Rotation:
    return Rotation.from_rotvec(np.zeros((n, 3)))


def design(maker: Maker) -> Maker:
    DESIGN[maker.__name__] = maker
    return maker


def kept(maker: Maker) -> Maker:
    KEPT[maker.__name__] = maker
    return maker


@design
def lever_then_door(rng: np.random.Generator, n: int) -> Path:
    """A lever of 11 cm is pressed by 40°, then the door turns about an upright axis."""
    k = n // 3
    a = np.linspace(0.0, rng.uniform(35.0, 50.0) * DEGREE, k)
    press = Rotation.from_rotvec(np.outer(a, [1.0, 0.0, 0.0]))
    lever = 0.11 * np.stack([np.zeros(k), np.cos(a) - 1.0, np.sin(a)], axis=1)
    b = np.linspace(0.0, rng.uniform(40.0, 80.0) * DEGREE, n - k)
    radius = rng.uniform(0.6, 0.8)
    turned = _about_z(b)
    return _then((lever, press), (press[-1].inv().apply(_arc(b, radius)), press[-1].inv() * turned * press[-1]))


@design
def slide_then_turn(rng: np.random.Generator, n: int) -> Path:
    """A front slides out by some 12 cm and then tips down."""
    k = n // 3
    out = np.outer(np.linspace(0.0, rng.uniform(0.08, 0.16), k), [1.0, 0.0, 0.0])
    b = np.linspace(0.0, rng.uniform(40.0, 80.0) * DEGREE, n - k)
    return _then((out, _still(k)), (_arc(b, rng.uniform(0.2, 0.4)), _about_z(b)))


@design
def folding_door(rng: np.random.Generator, n: int) -> Path:
    """Two leaves, the second one's end runs in a rail along x; the handle sits within the second leaf."""
    leaf, at = rng.uniform(0.3, 0.45), rng.uniform(0.4, 0.7)
    a = np.linspace(3.0 * DEGREE, rng.uniform(50.0, 75.0) * DEGREE, n)
    p = leaf * np.stack([np.cos(a) + at * np.cos(a), np.sin(a) - at * np.sin(a), np.zeros(n)], axis=1)
    return p, _about_z(-a)


@design
def waved_about(rng: np.random.Generator, n: int) -> Path:
    """A hand that holds nothing: a smooth way through seven random places and orientations."""
    knots = np.linspace(0.0, 1.0, 7)
    p = CubicSpline(knots, rng.normal(0.0, 0.15, (7, 3)))(np.linspace(0.0, 1.0, n))
    v = CubicSpline(knots, rng.normal(0.0, 0.4, (7, 3)))(np.linspace(0.0, 1.0, n))
    return p, Rotation.from_rotvec(v)


@design
def four_bar_lid(rng: np.random.Generator, n: int) -> Path:
    """A lid on two arms of different length: its handle follows a coupler curve."""
    crank, rocker, ground, coupler = 0.15, rng.uniform(0.25, 0.32), 0.3, 0.3
    a = np.linspace(20.0 * DEGREE, rng.uniform(95.0, 120.0) * DEGREE, n)
    A = crank * np.stack([np.cos(a), np.sin(a)], axis=1)
    d = np.array([ground, 0.0]) - A
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(np.clip((coupler**2 + far**2 - rocker**2) / (2.0 * coupler * far), -1.0, 1.0))
    turn = np.arctan2(d[:, 1], d[:, 0]) + beta
    at = rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.25)
    c, s = np.cos(turn), np.sin(turn)
    p = np.stack([A[:, 0] + at[0] * c - at[1] * s, A[:, 1] + at[0] * s + at[1] * c, np.zeros(n)], axis=1)
    return p, _about_z(turn)


@kept
def bolt_then_gate(rng: np.random.Generator, n: int) -> Path:
    """A bolt is drawn sideways by some centimetres, then the gate turns."""
    k = n // 4
    out = np.outer(np.linspace(0.0, rng.uniform(0.05, 0.09), k), [1.0, 0.0, 0.0])
    b = np.linspace(0.0, rng.uniform(40.0, 80.0) * DEGREE, n - k)
    return _then((out, _still(k)), (_arc(b, rng.uniform(0.5, 0.9)), _about_z(b)))


@kept
def window_on_a_stay(rng: np.random.Generator, n: int) -> Path:
    """A window that turns while its hinge slides in a slot."""
    a = np.linspace(0.0, rng.uniform(50.0, 75.0) * DEGREE, n)
    slot = np.outer(rng.uniform(0.25, 0.4) * np.sin(a), [1.0, 0.0, 0.0])
    return _arc(a, rng.uniform(0.35, 0.6)) + slot, _about_z(a)


@kept
def two_hinges_at_once(rng: np.random.Generator, n: int) -> Path:
    """A lamp's arm: two hinges that turn each as it likes."""
    knots, fine = np.linspace(0.0, 1.0, 4), np.linspace(0.0, 1.0, n)
    a = CubicSpline(knots, rng.normal(0.0, 0.7, 4))(fine)
    b = CubicSpline(knots, rng.normal(0.0, 0.9, 4))(fine) + 1.2
    p = 0.4 * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return p + 0.3 * np.stack([np.cos(a + b), np.sin(a + b), 0.0 * a], axis=1), _about_z(a + b)


@kept
def sectional_garage_door(rng: np.random.Generator, n: int) -> Path:
    """Up a rail, round a bend of 30 cm, and on along the ceiling."""
    up, bend = rng.uniform(0.25, 0.5), 0.3
    s = np.linspace(0.0, up + 0.5 * np.pi * bend + rng.uniform(0.2, 0.5), n)
    a = np.clip((s - up) / bend, 0.0, 0.5 * np.pi)
    x = bend * (1.0 - np.cos(a)) + np.maximum(s - up - 0.5 * np.pi * bend, 0.0)
    z = np.minimum(s, up) + bend * np.sin(a)
    return np.stack([x, np.zeros(n), z], axis=1), Rotation.from_rotvec(np.outer(a, [0.0, 1.0, 0.0]))


@kept
def pushed_over_the_table(rng: np.random.Generator, n: int) -> Path:
    """A box that is pushed about and turns as it likes."""
    knots, fine = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, n)
    xy = CubicSpline(knots, rng.normal(0.0, 0.2, (5, 2)))(fine)
    a = CubicSpline(knots, rng.normal(0.0, 0.6, 5))(fine)
    return np.column_stack([xy, np.zeros(n)]), _about_z(a)


@kept
def joystick(rng: np.random.Generator, n: int) -> Path:
    """A ball joint, moved about both ways."""
    knots, fine = np.linspace(0.0, 1.0, 6), np.linspace(0.0, 1.0, n)
    v = np.column_stack([CubicSpline(knots, rng.normal(0.0, 0.45, (6, 2)))(fine), np.zeros(n)])
    R = Rotation.from_rotvec(v)
    return R.apply([0.0, 0.0, rng.uniform(0.25, 0.45)]), R


@kept
def door_with_a_new_grasp(rng: np.random.Generator, n: int) -> Path:
    """Half way the hand lets go and takes the door 8 to 15 cm farther in."""
    a = np.linspace(0.0, rng.uniform(60.0, 90.0) * DEGREE, n)
    radius = np.where(np.arange(n) < n // 2, 0.75, 0.75 - rng.uniform(0.08, 0.15))
    p = radius[:, None] * np.stack([np.cos(a), np.sin(a), np.zeros(n)], axis=1)
    return p, _about_z(a)


def later(maker: Maker) -> Maker:
    LATER[maker.__name__] = maker
    return maker


@later
def geared_arm_of_a_screen(rng: np.random.Generator, n: int) -> Path:
    """Two links of a wall mount whose joints turn against each other, the second one farther."""
    a = np.linspace(0.0, rng.uniform(50.0, 80.0) * DEGREE, n)
    b = -rng.uniform(1.3, 1.8) * a
    p = 0.3 * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return p + rng.uniform(0.2, 0.28) * np.stack([np.cos(a + b), np.sin(a + b), 0.0 * a], axis=1), _about_z(a + b)


@later
def door_of_a_van(rng: np.random.Generator, n: int) -> Path:
    """Out round a bend of some 15 cm, and then back along the side."""
    bend, out = rng.uniform(0.12, 0.18), rng.uniform(0.25, 0.4)
    s = np.linspace(0.0, out + bend * 50.0 * DEGREE, n)
    a = np.clip(s / bend, 0.0, 50.0 * DEGREE)
    along = np.maximum(s - bend * 50.0 * DEGREE, 0.0)
    x = bend * np.sin(a) + along * np.cos(a)
    y = bend * (1.0 - np.cos(a)) + along * np.sin(a)
    return np.stack([x, y, 0.0 * s], axis=1), _about_z(0.3 * a)


@later
def up_and_over_door(rng: np.random.Generator, n: int) -> Path:
    """A panel whose lower end runs up a wall and whose upper end runs along the ceiling."""
    a, length = np.linspace(0.0, rng.uniform(60.0, 85.0) * DEGREE, n), rng.uniform(0.6, 0.9)
    at = rng.uniform(0.25, 0.4)
    p = length * np.stack([(1.0 - at) * np.sin(a), np.zeros(n), at * np.cos(a)], axis=1)
    return p, Rotation.from_rotvec(np.outer(a, [0.0, 1.0, 0.0]))


@later
def pin_in_a_wavy_slot(rng: np.random.Generator, n: int) -> Path:
    """A slider whose slot goes to one side and back, by three centimetres."""
    s = np.linspace(0.0, rng.uniform(0.3, 0.45), n)
    side = rng.uniform(0.02, 0.035) * np.sin(2.0 * np.pi * s / rng.uniform(0.3, 0.5))
    return np.stack([s, side, 0.0 * s], axis=1), _still(n)


@later
def barrel_that_rolls(rng: np.random.Generator, n: int) -> Path:
    """A handle on a barrel that rolls along the floor."""
    a, radius, at = np.linspace(0.0, rng.uniform(70.0, 110.0) * DEGREE, n), 0.25, rng.uniform(0.18, 0.24)
    p = np.stack([radius * a - at * np.sin(a - 0.6), np.zeros(n), at * np.cos(a - 0.6)], axis=1)
    return p, Rotation.from_rotvec(np.outer(a, [0.0, 1.0, 0.0]))


@later
def hinge_of_two_pins(rng: np.random.Generator, n: int) -> Path:
    """A door that turns about one pin as far as it goes, and from there on about another."""
    k = n // 2
    a = np.linspace(0.0, rng.uniform(30.0, 45.0) * DEGREE, k)
    b = np.linspace(0.0, rng.uniform(30.0, 45.0) * DEGREE, n - k)
    return _then((_arc(a, 0.7), _about_z(a)), (_arc(b, rng.uniform(0.3, 0.45)), _about_z(b)))


@later
def tray_that_drops(rng: np.random.Generator, n: int) -> Path:
    """A keyboard's tray comes straight out, and then down at a slant."""
    k = n // 2
    out = np.outer(np.linspace(0.0, rng.uniform(0.15, 0.25), k), [1.0, 0.0, 0.0])
    slant = rng.uniform(20.0, 35.0) * DEGREE
    down = np.outer(np.linspace(0.0, rng.uniform(0.1, 0.2), n - k), [np.cos(slant), 0.0, -np.sin(slant)])
    return _then((out, _still(k)), (down, _still(n - k)))


@later
def cord_on_a_drum(rng: np.random.Generator, n: int) -> Path:
    """A crank whose arm is drawn in as it turns."""
    a = np.linspace(0.0, rng.uniform(110.0, 170.0) * DEGREE, n)
    radius = 0.3 - rng.uniform(0.03, 0.05) * a
    return radius[:, None] * np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1), _about_z(a)


def last(maker: Maker) -> Maker:
    LAST[maker.__name__] = maker
    return maker


@last
def flush_sliding_door(rng: np.random.Generator, n: int) -> Path:
    """A sliding front that first comes out at a slant by some centimetres, and then runs along the wall."""
    k = n // 4
    out = np.outer(np.linspace(0.0, rng.uniform(0.05, 0.08), k), [0.5, -0.866, 0.0])
    along = np.outer(np.linspace(0.0, rng.uniform(0.3, 0.6), n - k), [1.0, 0.0, 0.0])
    return _then((out, _still(k)), (along, _still(n - k)))


@last
def knob_then_drawer(rng: np.random.Generator, n: int) -> Path:
    """A handle is turned by a quarter about its own root, 6 cm away, and then the drawer is drawn."""
    k = n // 3
    a = np.linspace(0.0, 90.0 * DEGREE, k)
    R = Rotation.from_rotvec(np.outer(a, [1.0, 0.0, 0.0]))
    turn = R.apply([0.0, 0.06, 0.0]) - [0.0, 0.06, 0.0]
    out = np.outer(np.linspace(0.0, rng.uniform(0.2, 0.4), n - k), [1.0, 0.0, 0.0])
    return _then((turn, R), (R[-1].inv().apply(out), _still(n - k)))


@last
def rail_that_bends_more_and_more(rng: np.random.Generator, n: int) -> Path:
    """A carriage on a clothoid: straight at first, and at the end a circle of 20 to 30 cm."""
    s = np.linspace(0.0, rng.uniform(0.4, 0.7), n)
    a = 0.5 * s**2 / s[-1] / rng.uniform(0.2, 0.3)
    step = np.gradient(s)
    return np.stack([np.cumsum(np.cos(a) * step), np.cumsum(np.sin(a) * step), 0.0 * s], axis=1), _about_z(a)


@last
def lid_on_a_scissor(rng: np.random.Generator, n: int) -> Path:
    """A table top that two crossed legs lift, and that is pushed sideways while it rises."""
    a = np.linspace(15.0 * DEGREE, rng.uniform(55.0, 70.0) * DEGREE, n)
    leg = rng.uniform(0.5, 0.7)
    p = leg * np.stack([0.6 * np.cos(a) ** 2, np.zeros(n), np.sin(a)], axis=1)
    return p, Rotation.from_rotvec(np.outer(0.15 * np.sin(3.0 * a), [0.0, 1.0, 0.0]))


@last
def handle_on_a_rope(rng: np.random.Generator, n: int) -> Path:
    """A pendulum that swings in an ellipse."""
    t = np.linspace(0.0, 2.0 * np.pi * rng.uniform(0.8, 1.6), n)
    x, y = rng.uniform(0.2, 0.3) * np.sin(t), rng.uniform(0.08, 0.15) * np.cos(t)
    p = np.stack([x, y, 0.7 - np.sqrt(0.49 - x**2 - y**2)], axis=1)
    return p, Rotation.from_rotvec(np.stack([y, -x, np.zeros(n)], axis=1) / 0.7)


@last
def nut_on_a_bent_rod(rng: np.random.Generator, n: int) -> Path:
    """A crank of 10 cm that turns and climbs along a rod that is bent."""
    a = np.linspace(0.0, rng.uniform(2.0, 3.0) * np.pi, n)
    bend = rng.uniform(0.2, 0.3) * (a / a[-1]) ** 2
    tilt = Rotation.from_rotvec(np.outer(bend, [0.0, 1.0, 0.0]))
    crank = 0.1 * np.stack([np.cos(a), np.sin(a), np.zeros(n)], axis=1)
    rod = np.stack([0.3 * bend**2, np.zeros(n), 0.02 * a], axis=1)
    return rod + tilt.apply(crank), tilt * _about_z(a)


@last
def column_that_tilts_and_telescopes(rng: np.random.Generator, n: int) -> Path:
    """A monitor's post: tilts while it is drawn out, back and forth."""
    t = np.linspace(0.0, 1.0, n)
    a = 0.6 * np.sin(np.pi * rng.uniform(0.8, 1.2) * t)
    out = 0.4 + rng.uniform(0.1, 0.2) * t
    return out[:, None] * np.stack([np.sin(a), np.zeros(n), np.cos(a)], axis=1), Rotation.from_rotvec(
        np.outer(a, [0.0, 1.0, 0.0])
    )


@last
def chair_on_castors(rng: np.random.Generator, n: int) -> Path:
    """Pushed on in a wide bend that tightens, and turned meanwhile."""
    t = np.linspace(0.0, 1.0, n)
    a = rng.uniform(0.6, 1.2) * t**2
    x = np.cumsum(np.cos(a)) * 0.8 / n
    y = np.cumsum(np.sin(a)) * 0.8 / n
    return np.stack([x, y, np.zeros(n)], axis=1), _about_z(-0.5 * np.sin(4.0 * t))


@last
def drawer_out_of_its_rail(rng: np.random.Generator, n: int) -> Path:
    """It comes out, leaves its rail, and is lifted and carried aside in the hand."""
    k = n // 2
    out = np.outer(np.linspace(0.0, rng.uniform(0.15, 0.25), k), [1.0, 0.0, 0.0])
    t = np.linspace(0.0, 1.0, n - k)
    away = np.stack([0.1 * t, rng.uniform(0.1, 0.2) * t**2, rng.uniform(0.15, 0.3) * np.sin(1.5 * t)], axis=1)
    return _then((out, _still(k)), (away, Rotation.from_rotvec(np.outer(t, [0.3, -0.4, 0.5]))))


@last
def planetary_crank(rng: np.random.Generator, n: int) -> Path:
    """A handle on a wheel that rolls inside a ring: a hypotrochoid."""
    a = np.linspace(0.0, rng.uniform(90.0, 150.0) * DEGREE, n)
    ring, wheel, at = 0.35, rng.uniform(0.1, 0.14), rng.uniform(0.05, 0.09)
    b = (ring - wheel) / wheel * a
    p = np.stack([
        (ring - wheel) * np.cos(a) + at * np.cos(b), (ring - wheel) * np.sin(a) - at * np.sin(b), 0.0 * a
    ], axis=1)  # fmt: skip
    return p, _about_z(-b)
