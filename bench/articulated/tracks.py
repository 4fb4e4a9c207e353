"""Tracks of things that are no one joint, and real tracks otherwise: plain trigonometry, no code of what is tested.

A class is a set of kinds, a method a kind: it draws a path, which is positions (n, 3) [m] and rotations of the handle.
``seen`` puts it somewhere in a room and adds noise. Kinds stay as they are, so that figures stay comparable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from modcal_core.articulation.track import Track

Array = np.ndarray
Path = tuple[Array, Rotation]
DEGREE = np.pi / 180.0
X, Y, Z = np.eye(3)
OUTLIERS = 0.05


class Draw:
    """Random numbers of a track, and values along its n poses. Called: one uniform number."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng, self.n, self.t = rng, n, np.linspace(0.0, 1.0, n)

    def __call__(self, low: float, high: float) -> float:
        return self.rng.uniform(low, high)

    def to(self, low: float, high: float, n: int | None = None, start: float = 0.0) -> Array:
        """Evenly from the start to a random end."""
        return np.linspace(start, self(low, high), self.n if n is None else n)

    def turn(self, low: float, high: float, n: int | None = None, start: float = 0.0) -> Array:
        """The same in degrees; comes back in radians."""
        return DEGREE * self.to(low, high, n, start)

    def smooth(self, size: float, knots: int, columns: int | None = None, mean: float = 0.0) -> Array:
        """A spline through so many random values, (n,) or (n, columns)."""
        shape = (knots,) if columns is None else (knots, columns)
        return CubicSpline(np.linspace(0.0, 1.0, knots), self.rng.normal(mean, size, shape))(self.t)

    def parts(self, share: int) -> tuple[int, int]:
        """Poses of the first part, one in so many, and of the rest."""
        return self.n // share, self.n - self.n // share


def about(axis: Sequence[float] | Array, angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, axis))


def about_z(angle: Array) -> Rotation:
    return about(Z, angle)


def still(n: int) -> Rotation:
    return about(Z, np.zeros(n))


def at(x: Any, y: Any, z: Any = 0.0) -> Array:
    """Positions (n, 3) of coordinates, any of which may be one number."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=1)


def polar(radius: Any, angle: Array) -> Array:
    """Positions in the plane."""
    return at(radius * np.cos(angle), radius * np.sin(angle))


def arc(angle: Array, radius: float, z: Any = 0.0) -> Array:
    """From the origin along y, bending towards −x."""
    return at(radius * (np.cos(angle) - 1.0), radius * np.sin(angle), z)


def door(angle: Array, radius: float, z: Any = 0.0) -> Path:
    return arc(angle, radius, z), about_z(angle)


def slide(way: Array, axis: Sequence[float] | Array = X) -> Path:
    return np.outer(way, axis), still(len(way))


def walk(heading: Array, s: Array) -> Array:
    """A way in the plane with a heading [rad] at each length s [m]."""
    step = np.gradient(s)
    return at(np.cumsum(np.cos(heading) * step), np.cumsum(np.sin(heading) * step))


def then(first: Path, second: Path) -> Path:
    """The second after the first, in the frame in which the handle stands there."""
    (p, R), (q, S) = first, second
    return np.concatenate([p, p[-1] + R[-1].apply(q)]), Rotation.concatenate([R, R[-1] * S])


def and_on(first: Path, second: Path) -> Path:
    """The second after the first, along the axes of the room."""
    (p, R), (q, S) = first, second
    return np.concatenate([p, p[-1] + q]), Rotation.concatenate([R, S * R[-1]])


def four_bar(crank: float, coupler: float, rocker: float, pivot: Array, a: Array, side: float) -> tuple[Array, Array]:
    """The crank's pin (n, 3), and the angle of the coupler; pivot: of the rocker, the crank's is the origin."""
    pin = polar(crank, a)
    d = pivot - pin
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(np.clip((coupler**2 + far**2 - rocker**2) / (2.0 * coupler * far), -1.0, 1.0))
    return pin, np.arctan2(d[:, 1], d[:, 0]) + side * beta


class Design:
    """Looked at while thresholds were chosen."""

    def lever_then_door(k: Draw) -> Path:  # a lever of 11 cm pressed by 40°, then the door about an upright axis
        first, rest = k.parts(3)
        a = k.turn(35.0, 50.0, first)
        lever = at(0.0, 0.11 * (np.cos(a) - 1.0), 0.11 * np.sin(a)), about(X, a)
        return and_on(lever, door(k.turn(40.0, 80.0, rest), k(0.6, 0.8)))

    def slide_then_turn(k: Draw) -> Path:  # A front slides out by some 12 cm and then tips down
        first, rest = k.parts(3)
        return then(slide(k.to(0.08, 0.16, first)), door(k.turn(40.0, 80.0, rest), k(0.2, 0.4)))

    def folding_door(k: Draw) -> Path:  # two leaves; the second one runs in a rail, the handle sits within it
        leaf, share = k(0.3, 0.45), k(0.4, 0.7)
        a = k.turn(50.0, 75.0, start=3.0)
        return leaf * at((1.0 + share) * np.cos(a), (1.0 - share) * np.sin(a)), about_z(-a)

    def waved_about(k: Draw) -> Path:  # nothing is held: smoothly through seven random poses
        return k.smooth(0.15, 7, 3), Rotation.from_rotvec(k.smooth(0.4, 7, 3))

    def four_bar_lid(k: Draw) -> Path:  # A lid on two arms of different length: its handle follows a coupler curve
        rocker, a = k(0.25, 0.32), k.turn(95.0, 120.0, start=20.0)
        pin, turn = four_bar(0.15, 0.3, rocker, 0.3 * X, a, 1.0)
        return pin + polar(k(0.25, 0.5), turn) + polar(k(0.1, 0.25), turn + 0.5 * np.pi), about_z(turn)


class Kept:
    """Not looked at before all was done, but before the rule of two motions."""

    def bolt_then_gate(k: Draw) -> Path:  # A bolt is drawn sideways by some centimetres, then the gate turns
        first, rest = k.parts(4)
        return then(slide(k.to(0.05, 0.09, first)), door(k.turn(40.0, 80.0, rest), k(0.5, 0.9)))

    def window_on_a_stay(k: Draw) -> Path:  # A window that turns while its hinge slides in a slot
        a = k.turn(50.0, 75.0)
        slot = np.outer(k(0.25, 0.4) * np.sin(a), X)
        return arc(a, k(0.35, 0.6)) + slot, about_z(a)

    def two_hinges_at_once(k: Draw) -> Path:  # A lamp's arm: two hinges that turn each as it likes
        a, b = k.smooth(0.7, 4), k.smooth(0.9, 4) + 1.2
        return polar(0.4, a) + polar(0.3, a + b), about_z(a + b)

    def sectional_garage_door(k: Draw) -> Path:  # up a rail, round a bend of 30 cm, and on along the ceiling
        up, bend = k(0.25, 0.5), 0.3
        s = (up + 0.5 * np.pi * bend + k(0.2, 0.5)) * k.t
        a = np.clip((s - up) / bend, 0.0, 0.5 * np.pi)
        x = bend * (1.0 - np.cos(a)) + np.maximum(s - up - 0.5 * np.pi * bend, 0.0)
        return at(x, 0.0, np.minimum(s, up) + bend * np.sin(a)), about(Y, a)

    def pushed_over_the_table(k: Draw) -> Path:  # A box that is pushed about and turns as it likes
        return at(*k.smooth(0.2, 5, 2).T), about_z(k.smooth(0.6, 5))

    def joystick(k: Draw) -> Path:  # A ball joint, moved about both ways
        R = Rotation.from_rotvec(at(*k.smooth(0.45, 6, 2).T))
        return R.apply(k(0.25, 0.45) * Z), R

    def door_with_a_new_grasp(k: Draw) -> Path:  # half way the hand lets go and takes the door 8 to 15 cm farther in
        a = k.turn(60.0, 90.0)
        return polar(np.where(np.arange(k.n) < k.n // 2, 0.75, 0.75 - k(0.08, 0.15)), a), about_z(a)


class Later:
    """Written after that rule, and run once."""

    def geared_arm_of_a_screen(k: Draw) -> Path:  # two joints against each other, the second farther
        a = k.turn(50.0, 80.0)
        b = a - k(1.3, 1.8) * a
        return polar(0.3, a) + polar(k(0.2, 0.28), b), about_z(b)

    def door_of_a_van(k: Draw) -> Path:  # out round a bend of some 15 cm, and then back along the side
        bend, out = k(0.12, 0.18), k(0.25, 0.4)
        s = (out + bend * 50.0 * DEGREE) * k.t
        a, along = np.clip(s / bend, 0.0, 50.0 * DEGREE), np.maximum(s - bend * 50.0 * DEGREE, 0.0)
        return at(bend * np.sin(a), bend * (1.0 - np.cos(a))) + polar(along, a), about_z(0.3 * a)

    def up_and_over_door(k: Draw) -> Path:  # its ends run up a wall and along the ceiling
        a, length, share = k.turn(60.0, 85.0), k(0.6, 0.9), k(0.25, 0.4)
        return length * at((1.0 - share) * np.sin(a), 0.0, share * np.cos(a)), about(Y, a)

    def pin_in_a_wavy_slot(k: Draw) -> Path:  # A slider whose slot goes to one side and back, by three centimetres
        s = k.to(0.3, 0.45)
        return at(s, k(0.02, 0.035) * np.sin(2.0 * np.pi * s / k(0.3, 0.5))), still(k.n)

    def barrel_that_rolls(k: Draw) -> Path:  # A handle on a barrel that rolls along the floor
        a, far = k.turn(70.0, 110.0), k(0.18, 0.24)
        return at(0.25 * a - far * np.sin(a - 0.6), 0.0, far * np.cos(a - 0.6)), about(Y, a)

    def hinge_of_two_pins(k: Draw) -> Path:  # about one pin as far as it goes, then about another
        first, rest = k.parts(2)
        return then(door(k.turn(30.0, 45.0, first), 0.7), door(k.turn(30.0, 45.0, rest), k(0.3, 0.45)))

    def tray_that_drops(k: Draw) -> Path:  # A keyboard's tray comes straight out, and then down at a slant
        first, rest = k.parts(2)
        out, slant = k.to(0.15, 0.25, first), DEGREE * k(20.0, 35.0)
        return then(slide(out), slide(k.to(0.1, 0.2, rest), [np.cos(slant), 0.0, -np.sin(slant)]))

    def cord_on_a_drum(k: Draw) -> Path:  # A crank whose arm is drawn in as it turns
        a = k.turn(110.0, 170.0)
        return polar(0.3 - k(0.03, 0.05) * a, a), about_z(a)


class Last:
    """Written after the tracker kept to that rule as well, and run once."""

    def flush_sliding_door(k: Draw) -> Path:  # out at a slant by some cm, then along the wall
        first, rest = k.parts(4)
        return then(slide(k.to(0.05, 0.08, first), [0.5, -0.866, 0.0]), slide(k.to(0.3, 0.6, rest)))

    def knob_then_drawer(k: Draw) -> Path:  # turned by a quarter about a root 6 cm away, then drawn
        first, rest = k.parts(3)
        R = about(X, np.linspace(0.0, 90.0 * DEGREE, first))
        return and_on((R.apply(0.06 * Y) - 0.06 * Y, R), slide(k.to(0.2, 0.4, rest)))

    def rail_that_bends_more_and_more(k: Draw) -> Path:  # a clothoid, at last a circle of 20 to 30 cm
        s = k.to(0.4, 0.7)
        a = 0.5 * s**2 / s[-1] / k(0.2, 0.3)
        return walk(a, s), about_z(a)

    def lid_on_a_scissor(k: Draw) -> Path:  # two crossed legs lift it; pushed sideways while it rises
        a = k.turn(55.0, 70.0, start=15.0)
        return k(0.5, 0.7) * at(0.6 * np.cos(a) ** 2, 0.0, np.sin(a)), about(Y, 0.15 * np.sin(3.0 * a))

    def handle_on_a_rope(k: Draw) -> Path:  # A pendulum that swings in an ellipse
        t = 2.0 * np.pi * k.to(0.8, 1.6)
        x, y = k(0.2, 0.3) * np.sin(t), k(0.08, 0.15) * np.cos(t)
        return at(x, y, 0.7 - np.sqrt(0.49 - x**2 - y**2)), Rotation.from_rotvec(at(y, -x) / 0.7)

    def nut_on_a_bent_rod(k: Draw) -> Path:  # A crank of 10 cm that turns and climbs along a rod that is bent
        a = np.pi * k.to(2.0, 3.0)
        bend = k(0.2, 0.3) * (a / a[-1]) ** 2
        return at(0.3 * bend**2, 0.0, 0.02 * a) + about(Y, bend).apply(polar(0.1, a)), about(Y, bend) * about_z(a)

    def column_that_tilts_and_telescopes(k: Draw) -> Path:  # a monitor's post, back and forth
        a = 0.6 * np.sin(np.pi * k(0.8, 1.2) * k.t)
        out = 0.4 + k(0.1, 0.2) * k.t
        return at(out * np.sin(a), 0.0, out * np.cos(a)), about(Y, a)

    def chair_on_castors(k: Draw) -> Path:  # pushed on in a wide bend that tightens, and turned meanwhile
        a = k(0.6, 1.2) * k.t**2
        return 0.8 / k.n * at(np.cumsum(np.cos(a)), np.cumsum(np.sin(a))), about_z(-0.5 * np.sin(4.0 * k.t))

    def drawer_out_of_its_rail(k: Draw) -> Path:  # it leaves its rail, is lifted and carried aside
        first, rest = k.parts(2)
        out, t = k.to(0.15, 0.25, first), np.linspace(0.0, 1.0, rest)
        away = at(0.1 * t, k(0.1, 0.2) * t**2, k(0.15, 0.3) * np.sin(1.5 * t))
        return then(slide(out), (away, about([0.3, -0.4, 0.5], t)))

    def planetary_crank(k: Draw) -> Path:  # A handle on a wheel that rolls inside a ring: a hypotrochoid
        a, wheel, far = k.turn(90.0, 150.0), k(0.1, 0.14), k(0.05, 0.09)
        b = (0.35 - wheel) / wheel * a
        return polar(0.35 - wheel, a) + polar(far, -b), about_z(-b)


class Shaping:
    """Looked at while trust by a share of the path and the rule of a smooth bend were chosen."""

    def eccentric_cam(k: Draw) -> Path:  # A crank whose length follows a lobe
        a = k.turn(80.0, 130.0)
        return polar(k(0.25, 0.4) + k(0.02, 0.04) * np.cos(2.0 * a + k(0.0, 6.0)), a), about_z(a)

    def parallelogram_flap(k: Draw) -> Path:  # positions go round, it turns by a third; points alone are a hinge
        a = k.turn(50.0, 80.0)
        return arc(a, k(0.3, 0.45)), about_z(k(0.2, 0.4) * a)

    def draw_latch_then_slide(k: Draw) -> Path:  # A latch of 7 cm is turned, and then a slide is drawn
        first, rest = k.parts(4)
        R = about(Y, k.turn(60.0, 90.0, first))
        return and_on((R.apply(0.07 * Z) - 0.07 * Z, R), slide(k.to(0.2, 0.4, rest)))

    def plug_door_of_a_bus(k: Draw) -> Path:  # swings out, and then slides along the side
        first, rest = k.parts(3)
        return and_on(door(k.turn(25.0, 40.0, first), k(0.3, 0.45)), slide(k.to(0.25, 0.45, rest), Y))

    def boom_that_turns_then_extends(k: Draw) -> Path:  # A crane's boom, drawn out once it has turned by some 40 %
        a = k.turn(60.0, 100.0)
        return polar(k(0.35, 0.5) + k(0.15, 0.3) * np.clip(a / a[-1] - 0.4, 0.0, 1.0) ** 2, a), about_z(a)

    def hinge_that_lifts_late(k: Draw) -> Path:  # A rising hinge whose ramp begins at 30 to 40 degrees
        a = k.turn(70.0, 95.0)
        z = k(0.04, 0.08) * np.clip(a - DEGREE * k(30.0, 40.0), 0.0, None)
        return door(a, k(0.5, 0.7), z)

    def hose_in_the_hand(k: Draw) -> Path:  # A smooth way of slowly changing curvature
        knots = np.linspace(0.0, 1.0, 4)
        heading = CubicSpline(knots, np.cumsum(k.rng.normal(0.0, 0.5, 4)))(k.t)
        return walk(heading, k.to(0.5, 0.8)) + np.outer(0.1 * k.smooth(0.5, 4), Z), about_z(heading)

    def elliptic_rail(k: Draw) -> Path:  # A quarter of an ellipse
        a, A, B = k.turn(80.0, 110.0), k(0.4, 0.5), k(0.22, 0.3)
        return at(A * np.sin(a), B * (1.0 - np.cos(a))), about_z(np.arctan2(B * np.sin(a), A * np.cos(a)))

    def lid_on_a_rack(k: Draw) -> Path:  # A lid whose pinion rolls along a rack while it turns
        a, r = k.turn(70.0, 100.0), k(0.05, 0.09)
        return arc(a, k(0.35, 0.5)) + np.outer(r * a, X), about_z(a)

    def carried_away(k: Draw) -> Path:  # A hand that reaches out straight, and then bends off
        s = k(0.5, 0.7) * (10.0 * k.t**3 - 15.0 * k.t**4 + 6.0 * k.t**5)
        heading = k(0.7, 1.3) * 3.0 * np.clip(k.t - 0.45, 0.0, 1.0) ** 2
        return walk(heading, s), about([0.3, 0.8, 0.5], 0.3 * np.sin(3.0 * k.t))

    def screw_of_changing_pitch(k: Draw) -> Path:  # A nut that climbs more with every turn
        a, radius = np.pi * k.to(1.2, 2.2), k(0.1, 0.2)
        return door(a, radius, k(0.01, 0.02) * a**2)

    def drawer_that_droops(k: Draw) -> Path:  # its second stage hangs by 5 to 9 degrees
        s = k.to(0.4, 0.6)
        late = np.clip(s - k(0.18, 0.28), 0.0, 1.0)
        return at(s, 0.0, -k(0.08, 0.16) * late), about(Y, k(0.08, 0.16) * np.clip(late / 0.03, 0.0, 1.0))


class Fresh:
    """Written after both, and run once."""

    def rail_like_an_s(k: Draw) -> Path:  # one way round, and then the other way round
        a, b = (k.turn(35.0, 60.0, n) for n in k.parts(2))
        second = arc(b, k(0.25, 0.45)) * [-1.0, 1.0, 1.0]
        return then(door(a, k(0.25, 0.45)), (second, about_z(-b)))

    def point_of_a_connecting_rod(k: Draw) -> Path:  # A slider-crank; the handle sits on the rod
        a, crank, rod, share = k.turn(100.0, 150.0), k(0.15, 0.22), k(0.45, 0.6), k(0.3, 0.6)
        tilt = np.arcsin(crank * np.sin(a) / rod)
        return polar(crank, a) + polar(share * rod, -tilt), about_z(-tilt)

    def oval_of_a_toy_train(k: Draw) -> Path:  # straight on, half round, and back
        lead, radius = k(0.15, 0.3), k(0.15, 0.22)
        s = (lead + np.pi * radius + k(0.1, 0.25)) * k.t
        heading = np.clip((s - lead) / radius, 0.0, np.pi)
        return walk(heading, s), about_z(heading)

    def window_that_tilts_and_then_turns(k: Draw) -> Path:  # about its lower edge, then its side
        first, rest = k.parts(3)
        a, height = k.turn(8.0, 14.0, first), k(0.6, 0.9)
        tilted = height * at(0.0, -np.sin(a), np.cos(a) - 1.0), about(X, a)
        return then(tilted, door(k.turn(40.0, 70.0, rest), k(0.4, 0.6)))

    def wheel_that_is_drawn_out_as_it_turns(k: Draw) -> Path:  # a valve: climbs more with every degree
        a, radius = k.turn(120.0, 200.0), k(0.12, 0.2)
        return door(a, radius, k(0.08, 0.14) * np.clip(a - 0.5, 0.0, None) ** 1.5)

    def trolley_that_changes_lanes(k: Draw) -> Path:  # A bend that comes and goes smoothly, and its opposite
        heading = k(0.4, 0.8) * np.sin(np.pi * k.t) ** 2
        return walk(heading, k(0.6, 0.9) * k.t), about_z(heading)

    def eye_of_a_ball(k: Draw) -> Path:  # A point on a ball that is rolled in its socket, about an axis that wanders
        R = Rotation.from_rotvec(at(k(0.8, 1.3) * k.t, k(0.3, 0.6) * k.t**2, k(0.2, 0.4) * np.sin(2.0 * k.t)))
        return R.apply(k(0.3, 0.5) * Z), R

    def pantograph_of_a_lamp(k: Draw) -> Path:  # crossed arms that are drawn out, and sag as they come
        a = k.turn(20.0, 35.0, start=k(65.0, 75.0))
        out, sag = k(0.5, 0.7) * np.cos(a), k(0.25, 0.45)
        return at(out, 0.0, -sag * (out - out[0]) ** 2), about(Y, 0.4 * (out - out[0]))

    def stair_of_a_snail(k: Draw) -> Path:  # A helix that widens
        a = k.turn(140.0, 220.0)
        r = k(0.12, 0.18) + k(0.03, 0.05) * a
        return polar(r, a) + np.outer(k(0.03, 0.06) * a, Z), about_z(a)

    def lid_of_a_piano(k: Draw) -> Path:  # the front leaf is folded back over the lid, and then the lid is lifted by it
        first, rest = k.parts(2)
        a, b = k.turn(90.0, 150.0, first), k.turn(30.0, 50.0, rest)
        return and_on(door(a, k(0.2, 0.3)), door(b, k(0.6, 0.8)))


class Unseen:
    """Written before the rules of trust over a horizon, and run once, after them."""

    def link_of_watt(k: Draw) -> Path:  # beside the middle of a floating link: nearly straight, and then not
        link, a = k(0.18, 0.26), k.to(0.5, 0.7, start=-0.2)
        pin, turn = four_bar(0.4, link, 0.4, np.array([0.8, link, 0.0]), a, 1.0)
        return pin + polar(k(0.5, 0.8) * link, turn), about_z(turn)

    def spiral_of_archimedes(k: Draw) -> Path:  # A pin in the groove of a scroll: outwards by 5 to 9 cm a radian
        a = k.turn(100.0, 170.0)
        return polar(k(0.15, 0.25) + k(0.05, 0.09) * a, a), about_z(a)

    def parabolic_chute(k: Draw) -> Path:  # A slide along a parabola
        x, steep = k.to(0.45, 0.65), k(1.2, 2.4)
        return at(x, steep * x**2), about_z(np.arctan(2.0 * steep * x))

    def flipper_door(k: Draw) -> Path:  # turned up about its upper edge, then pushed in above the shelf
        first, rest = k.parts(2)
        a = np.linspace(0.0, 90.0 * DEGREE, first)
        up = k(0.25, 0.4) * at(np.sin(a), 1.0 - np.cos(a)), about_z(a)
        return and_on(up, slide(k.to(0.2, 0.35, rest), -X))

    def bayonet_with_a_long_lever(k: Draw) -> Path:  # pushed in, turned by a lever, drawn out
        few, push, out = k.n // 4, k(0.03, 0.06), k(0.15, 0.3)
        a = np.concatenate([np.zeros(few), k.turn(40.0, 70.0, few)])
        a = np.concatenate([a, np.full(k.n - 2 * few, a[-1])])
        away = -push + np.linspace(0.0, out, k.n - 2 * few)
        z = np.concatenate([np.linspace(0.0, -push, few), np.full(few, -push), away])
        return polar(k(0.2, 0.3), a) + np.outer(z, Z), about_z(a)

    def trammel(k: Draw) -> Path:  # a rod with pins in crossed slots: an ellipse, the rod turns the other way
        a = k.turn(95.0, 125.0, start=10.0)
        return at(k(0.45, 0.55) * np.cos(a), k(0.2, 0.3) * np.sin(a)), about_z(-a)

    def cradle_that_rocks(k: Draw) -> Path:  # A handle above two curved runners that roll on the floor
        a = k.turn(30.0, 45.0, start=-25.0)
        runner, above = k(0.35, 0.5), k(0.3, 0.45)
        y = runner + above * np.cos(a) + k(0.05, 0.12) * np.sin(2.0 * a)
        return at(runner * a + above * np.sin(a), y), about_z(-a)

    def table_on_a_turntable(k: Draw) -> Path:  # two turntables, one on the other and geared to it
        a = k.turn(60.0, 100.0)
        b = k(1.6, 2.6) * a
        return polar(k(0.25, 0.35), a) + polar(k(0.1, 0.16), b), about_z(b)

    def trailer_that_is_swung(k: Draw) -> Path:  # a tractrix; the handle sits behind the axle
        length, s = k(0.35, 0.5), k.to(0.5, 0.8)
        heading = np.full(k.n, DEGREE * k(75.0, 88.0))
        for i in range(1, k.n):
            heading[i] = heading[i - 1] - np.sin(heading[i - 1]) * (s[i] - s[i - 1]) / length
        return np.outer(s, X) - polar(k(1.2, 1.6) * length, heading), about_z(heading)

    def arm_at_random(k: Draw) -> Path:  # the tool of an arm of six joints, each of which goes smoothly to and fro
        links = 0.35 * Z, 0.4 * X, 0.35 * X, 0.1 * Z, 0.1 * X, 0.12 * Z
        p, R = np.zeros((k.n, 3)), still(k.n)
        for link, axis in zip(links, (Z, Y, Y, Z, Y, Z), strict=True):
            R = R * about(axis, k.smooth(0.45, 5, mean=0.3))
            p = p + R.apply(link)
        return p, R

    def rail_of_the_third_degree(k: Draw) -> Path:  # straight at first, and off to the side with the cube of the way
        s = k.to(0.45, 0.65)
        side = k(0.08, 0.2) * (s / s[-1]) ** 3
        return at(s, side), about_z(np.arctan(np.gradient(side, s)))

    def toggle_clamp(k: Draw) -> Path:  # short crank and rocker: round a tight corner
        coupler, ground, a = k(0.16, 0.2), k(0.2, 0.24), k.turn(140.0, 180.0, start=30.0)
        pin, turn = four_bar(0.1, coupler, 0.18, ground * X, a, 1.0)
        return pin + polar(k(0.3, 0.45), turn + 0.8), about_z(turn)

    def spiral_slide_with_a_landing(k: Draw) -> Path:  # A helix that ends in a straight
        radius, pitch = k(0.2, 0.3), k(0.06, 0.12)
        a = k.turn(80.0, 130.0, (2 * k.n) // 3)
        helix = polar(radius, a) - np.outer(pitch * a, Z), about_z(a)
        return and_on(helix, slide(k.to(0.15, 0.3, k.n - len(a)), [-np.sin(a[-1]), np.cos(a[-1]), 0.0]))

    def second_hinge_that_joins_in(k: Draw) -> Path:  # the second leaf turns when the first has by 20 to 30°
        a = k.turn(60.0, 85.0)
        late = np.clip(a - DEGREE * k(20.0, 30.0), 0.0, None)
        b = a + k(0.8, 1.4) * late**2 / (late + 0.2)
        return polar(k(0.3, 0.4), a) + polar(k(0.3, 0.4), b), about_z(b)

    def lane_that_comes_back(k: Draw) -> Path:  # A slide that is led to one side and back again, once, by 4 to 7 cm
        side = k(0.04, 0.07) * 0.5 * (1.0 - np.cos(2.0 * np.pi * k.t))
        return at(k(0.5, 0.8) * k.t, side, 0.15 * side), still(k.n)


class Aside:
    """Written before what a path without a joint explains was weighed, and run once."""

    def lamp_on_two_parallelograms(k: Draw) -> Path:  # the upper arm turns less, the head not at all
        a = k.turn(75.0, 100.0, start=20.0)
        b = DEGREE * k(120.0, 150.0) - k(0.3, 0.6) * a
        return polar(k(0.35, 0.45), a) + polar(k(0.35, 0.45), b), still(k.n)

    def curtain_on_a_clothoid(k: Draw) -> Path:  # A rail whose bend grows evenly with the way
        s = k.to(0.5, 0.8)
        heading = k(0.8, 1.5) * (s / s[-1]) ** 2
        return walk(heading, s), about_z(heading)

    def bin_above_the_seats(k: Draw) -> Path:  # A bin that hangs on two unequal arms
        second, apart, a = k(0.36, 0.44), k(0.16, 0.22), k.turn(-55.0, -40.0, start=-100.0)
        pin, turn = four_bar(0.3, 0.25, second, np.array([apart, 0.05, 0.0]), a, -1.0)
        return pin + polar(k(0.3, 0.4), turn - 0.9), about_z(turn)

    def sofa_that_lifts_as_it_comes(k: Draw) -> Path:  # A seat that is drawn out, and lifted over a hump by a cam
        return at(k(0.4, 0.6) * k.t, 0.0, k(0.05, 0.1) * np.sin(np.pi * k.t**1.5)), still(k.n)

    def footrest_of_a_recliner(k: Draw) -> Path:  # on the end of a bar, half as fast, the other way
        a = k.turn(60.0, 85.0)
        b = -k(0.3, 0.6) * a
        return polar(k(0.3, 0.4), a) + polar(k(0.15, 0.25), b + 0.5), about_z(b)

    def rib_of_an_umbrella(k: Draw) -> Path:  # hung at the top, spread by a runner, bent under the cloth
        runner, strut, pin, length = k.to(0.12, 0.2, start=0.32), 0.22, 0.2, k(0.45, 0.6)
        angle = np.arccos(np.clip((pin**2 + runner**2 - strut**2) / (2.0 * pin * runner), -1.0, 1.0))
        droop = k(0.05, 0.12) * np.sin(angle)
        return length * at(np.sin(angle) * (1.0 - droop), -np.cos(angle) - droop), about_z(angle)

    def hook_of_a_crane(k: Draw) -> Path:  # A boom that is raised while the rope runs out; the hook hangs still
        a = k.turn(60.0, 75.0, start=15.0)
        return polar(k(0.6, 0.8), a) - np.outer(k(0.15, 0.35) * (a - a[0]), Y), still(k.n)

    def hatch_on_a_growing_arm(k: Draw) -> Path:  # drawn out of its hinge by 10 to 20 % as it opens
        a = k.turn(70.0, 100.0)
        return polar(k(0.35, 0.5) * (1.0 + k(0.1, 0.2) * (a / a[-1]) ** 2), a), about_z(a)

    def cross_of_a_cardan_shaft(k: Draw) -> Path:  # A lever behind a universal joint that is led about two axes at once
        a = k.turn(40.0, 70.0)
        R = about(X, a) * about(Y, k(0.4, 0.7) * np.sin(2.0 * a))
        return R.apply([0.1, 0.0, k(0.35, 0.5)]), R

    def pendulum_between_cheeks(k: Draw) -> Path:  # A cord that winds about two cheeks: a cycloid
        a = k.to(0.4, 1.0, start=-k(1.6, 2.2))
        return k(0.1, 0.16) * at(a + np.sin(a), 1.0 - np.cos(a)), about_z(0.5 * a)

    def trolley_on_a_hanging_rope(k: Draw) -> Path:  # A pulley on a rope that sags: a catenary
        x = k.to(0.2, 0.35, start=-k(0.3, 0.4))
        c = k(0.18, 0.3)
        return at(x, c * np.cosh(x / c)), about_z(np.arctan(np.sinh(x / c)))

    def slider_round_the_corner(k: Draw) -> Path:  # A door in a rail: straight, a bend of 15 to 25 cm, straight again
        straight, bend, radius = k(0.15, 0.25), DEGREE * k(50.0, 90.0), k(0.15, 0.25)
        s = (2.0 * straight + bend * radius) * k.t
        heading = np.clip((s - straight) / radius, 0.0, bend)
        return walk(heading, s), about_z(heading)


SETS: dict[str, dict[str, Callable[[Draw], Path]]] = {
    made.__name__.lower(): {name: kind for name, kind in vars(made).items() if not name.startswith("_")}
    for made in (Design, Kept, Later, Last, Shaping, Fresh, Unseen, Aside)
}
KINDS = {name: kind for some in SETS.values() for name, kind in some.items()}


def seen(kind: str, seed: int) -> Track:
    """What a camera notes of a kind: even seeds see poses, odd ones points."""
    rng = np.random.default_rng([seed, *kind.encode()])
    n = int(rng.integers(120, 300))
    p, R = KINDS[kind](Draw(rng, n))
    world, hold = Rotation.random(rng=rng), Rotation.random(rng=rng)
    p = world.apply(p) + rng.uniform(-1.0, 1.0, 3) + rng.normal(0.0, np.exp(rng.uniform(-8.1, -6.2)), (n, 3))
    R = world * R * hold * Rotation.from_rotvec(rng.normal(0.0, DEGREE * rng.uniform(0.1, 0.8), (n, 3)))
    return Track(p, R.as_matrix() if seed % 2 == 0 else None)


def _moved(track: Track, rng: np.random.Generator) -> Track:
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    R = None if track.rotations is None else turn @ track.rotations
    return Track(track.positions @ turn.T + shift, R)


def _mirrored(track: Track, rng: np.random.Generator) -> Track:
    flip = np.diag([-1.0, 1.0, 1.0])
    return Track(track.positions @ flip, None if track.rotations is None else flip @ track.rotations @ flip)


def _first(share: float) -> Callable[[Track, np.random.Generator], Track]:
    return lambda track, rng: track.part(np.arange(min(len(track), max(8, int(share * len(track))))))


def _white(bends: Array) -> float:
    """Size of white noise, of its second differences: χ² with 3; 1 + 4 + 1."""
    return float(np.sqrt(np.median((bends**2).sum(axis=1)) / 2.366 / 6.0))


def _noisier(track: Track, rng: np.random.Generator) -> Track:
    """White noise of the track's own size √3 times over, so that both together are twice as large."""
    size = np.sqrt(3.0) * _white(np.diff(track.positions, 2, axis=0))
    p = track.positions + rng.normal(0.0, size, track.positions.shape)
    if track.rotations is None:
        return Track(p)
    R = Rotation.from_matrix(track.rotations)
    sway = np.sqrt(3.0) * _white(np.diff((R[:-1].inv() * R[1:]).as_rotvec(), axis=0))
    return Track(p, (R * Rotation.from_rotvec(rng.normal(0.0, sway, p.shape))).as_matrix())


def _outliers(track: Track, rng: np.random.Generator) -> Track:
    far = rng.random(len(track)) < OUTLIERS
    p = track.positions + far[:, None] * rng.normal(0.0, 0.15, track.positions.shape)
    if track.rotations is None:
        return Track(p)
    turn = Rotation.from_rotvec(far[:, None] * rng.normal(0.0, 0.5, p.shape)).as_matrix()
    return Track(p, track.rotations @ turn)


VARIANTS: dict[str, Callable[[Track, np.random.Generator], Track]] = {
    "as recorded": lambda track, rng: track,
    "moved": _moved,
    "mirrored": _mirrored,
    "reversed": lambda track, rng: track.part(np.arange(len(track))[::-1]),
    "first 70 %": _first(0.7),
    "first 50 %": _first(0.5),
    "first 30 %": _first(0.3),
    "every fifth": lambda track, rng: track.part(np.arange(0, len(track), 5)),
    "noise doubled": _noisier,
    "5 % outliers": _outliers,
}
