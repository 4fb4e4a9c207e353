"""Tracks of things that are no one joint, and real tracks otherwise: plain trigonometry, no code of what is tested.

A kind is a path of drawn values: positions (n, 3) [m] and rotations of the handle. ``seen`` puts it somewhere in a room
and adds noise. Kinds and the order of their draws stay as they are, so that figures stay comparable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy import arctan, arctan2, clip, cos, linspace, maximum, pi, sin
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from modcal_core.articulation import Track

Array = np.ndarray
Path = tuple[Array, Rotation]
DEGREE = pi / 180.0
X, Y, Z = np.eye(3)
OUTLIERS = 0.05


class Draw:
    """Random numbers of a track of n poses, whose places along it are t, from 0 to 1. Called: one uniform number."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng, self.n, self.t = rng, n, linspace(0.0, 1.0, n)

    def __call__(self, low: float, high: float) -> float:
        return self.rng.uniform(low, high)

    def first(self, share: int) -> int:
        """Poses of the first part, one in so many; rest: of the others."""
        return self.n // share

    def rest(self, share: int) -> int:
        return self.n - self.n // share

    def to(self, low: float, high: float, n: int | None = None, start: float = 0.0) -> Array:
        """Evenly from the start to a random end."""
        return linspace(start, self(low, high), self.n if n is None else n)

    def turn(self, low: float, high: float, n: int | None = None, start: float = 0.0) -> Array:
        """The same in degrees; comes back in radians."""
        return DEGREE * self.to(low, high, n, start)

    def smooth(self, size: float, knots: int, columns: int | None = None, mean: float = 0.0) -> Array:
        """A spline through so many random values, (n,) or (n, columns)."""
        shape = (knots,) if columns is None else (knots, columns)
        return CubicSpline(linspace(0.0, 1.0, knots), self.rng.normal(mean, size, shape))(self.t)

    def door(self, low: float, high: float, near: float, far: float, share: int) -> Path:
        """The rest of the track as a door: its angle [deg] and radius between these."""
        return door(self.turn(low, high, self.rest(share)), self(near, far))


Kind = Callable[[Draw], Path]


def about(axis: Sequence[float] | Array, angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, axis))


def turned(p: Array, angle: Array, axis: Sequence[float] | Array = Z) -> Path:
    return p, about(axis, angle)


def on(a: Array, p: Callable[[Array], Array], angle: Callable[[Array], Array] = lambda a: a, axis: Any = Z) -> Path:
    """Positions by a parameter, and what the handle turns by."""
    return p(a), about(axis, angle(a))


def kept(p: Array) -> Path:
    return turned(p, np.zeros(len(p)))


def on_ball(w: Array, point: Sequence[float] | Array) -> Path:
    R = Rotation.from_rotvec(w)
    return R.apply(point), R


def at(x: Any, y: Any, z: Any = 0.0) -> Array:
    """Positions (n, 3) of coordinates, any of which may be one number."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=1)


def polar(radius: Any, angle: Array) -> Array:
    return at(radius * cos(angle), radius * sin(angle))


def rise(z: Array) -> Array:
    return np.outer(z, Z)


def arc(angle: Array, radius: float) -> Array:
    """From the origin along y, bending towards −x."""
    return at(radius * (cos(angle) - 1.0), radius * sin(angle))


def door(angle: Array, radius: float) -> Path:
    return turned(arc(angle, radius), angle)


def lever(angle: Array, axis: Array, arm: Array) -> Path:
    R = about(axis, angle)
    return R.apply(arm) - arm, R


def slide(way: Array, axis: Sequence[float] | Array = X) -> Path:
    return kept(np.outer(way, axis))


def walk(heading: Array, s: Array) -> Array:
    """A way in the plane with a heading [rad] at each length s [m]."""
    step = np.gradient(s)
    return at(np.cumsum(cos(heading) * step), np.cumsum(sin(heading) * step))


def rail(heading: Array, s: Array) -> Path:
    return turned(walk(heading, s), heading)


def on_rail(s: Array, heading: Callable[[Array], Array]) -> Path:
    return rail(heading(s), s)


def bent(t: Array, lead: float, radius: float, angle: float, far: float) -> Path:
    """A rail that is straight, bends round by an angle, and is straight again."""
    s = (lead + angle * radius + far) * t
    return rail(clip((s - lead) / radius, 0.0, angle), s)


def graph(x: Array, y: Array, slope: Array) -> Path:
    return turned(at(x, y), arctan(slope))


def cardan(a: Array, sway: float, arm: float) -> Path:
    R = about(X, a) * about(Y, sway * sin(2.0 * a))
    return R.apply([0.1, 0.0, arm]), R


def carried(way: float, t: Array, bend: float) -> Path:
    p = walk(bend * 3.0 * clip(t - 0.45, 0.0, 1.0) ** 2, way * (10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5))
    return turned(p, 0.3 * sin(3.0 * t), [0.3, 0.8, 0.5])


def droop(s: Array, late: Array, down: float, tilt: float) -> Path:
    return turned(at(s, 0.0, -down * late), tilt * clip(late / 0.03, 0.0, 1.0), Y)


def landing(radius: float, pitch: float, a: Array, k: Draw) -> Path:
    on_a_helix = turned(polar(radius, a) - rise(pitch * a), a)
    return and_on(on_a_helix, slide(k.to(0.15, 0.3, k.n - len(a)), [-sin(a[-1]), cos(a[-1]), 0.0]))


def then(start: Path, end: Path) -> Path:
    """One after the other, in the frame in which the handle stands there."""
    (p, R), (q, S) = start, end
    return np.concatenate([p, p[-1] + R[-1].apply(q)]), Rotation.concatenate([R, R[-1] * S])


def and_on(start: Path, end: Path) -> Path:
    (p, R), (q, S) = start, end
    return np.concatenate([p, p[-1] + q]), Rotation.concatenate([R, S * R[-1]])


def two(a: Array, b: Array, near: float, far: float) -> Path:
    """Two hinges, the second at the end of the first; the handle turns with the second."""
    return turned(polar(near, a) + polar(far, b), b)


def four_bar(
    bars: Sequence[float], pivot: Sequence[float], a: Array, handle: Sequence[tuple[float, float]], side: float = 1.0
) -> Path:
    """Crank, coupler and rocker; pivot: of the rocker, the crank's is the origin. handle: on the coupler, polar."""
    crank, coupler, rocker = bars
    pin = polar(crank, a)
    d = np.array([*pivot, 0.0]) - pin
    far = np.linalg.norm(d, axis=1)
    beta = np.arccos(clip((coupler**2 + far**2 - rocker**2) / (2.0 * coupler * far), -1.0, 1.0))
    angle = arctan2(d[:, 1], d[:, 0]) + side * beta
    return turned(pin + sum(polar(radius, angle + by) for radius, by in handle), angle)


def garage(up: float, on: float, t: Array, bend: float = 0.3) -> Path:
    s = (up + 0.5 * pi * bend + on) * t
    a = clip((s - up) / bend, 0.0, 0.5 * pi)
    x = bend * (1.0 - cos(a)) + maximum(s - up - 0.5 * pi * bend, 0.0)
    return turned(at(x, 0.0, np.minimum(s, up) + bend * sin(a)), a, Y)


def van(bend: float, out: float, t: Array) -> Path:
    s = (out + bend * 50.0 * DEGREE) * t
    a, side = clip(s / bend, 0.0, 50.0 * DEGREE), maximum(s - bend * 50.0 * DEGREE, 0.0)
    return turned(at(bend * sin(a), bend * (1.0 - cos(a))) + polar(side, a), 0.3 * a)


def nut(a: Array, bend: float) -> Path:
    b = bend * (a / a[-1]) ** 2
    return at(0.3 * b**2, 0.0, 0.02 * a) + about(Y, b).apply(polar(0.1, a)), about(Y, b) * about(Z, a)


def bayonet(k: Draw) -> Path:
    few, push, out = k.n // 4, k(0.03, 0.06), k(0.15, 0.3)
    a = np.concatenate([np.zeros(few), DEGREE * linspace(0.0, k(40.0, 70.0), few)])
    a = np.concatenate([a, np.full(k.n - 2 * few, a[-1])])
    away = -push + linspace(0.0, out, k.n - 2 * few)
    z = np.concatenate([linspace(0.0, -push, few), np.full(few, -push), away])
    return turned(polar(k(0.2, 0.3), a) + np.outer(z, Z), a)


def tractrix(length: float, s: Array, begin: float, handle: float) -> Path:
    heading = np.full(len(s), DEGREE * begin)
    for i in range(1, len(s)):
        heading[i] = heading[i - 1] - sin(heading[i - 1]) * (s[i] - s[i - 1]) / length
    return turned(np.outer(s, X) - polar(handle * length, heading), heading)


def arm_at_random(k: Draw) -> Path:
    links = 0.35 * Z, 0.4 * X, 0.35 * X, 0.1 * Z, 0.1 * X, 0.12 * Z
    p, R = np.zeros((k.n, 3)), about(Z, np.zeros(k.n))
    for link, axis in zip(links, (Z, Y, Y, Z, Y, Z), strict=True):
        R = R * about(axis, k.smooth(0.45, 5, mean=0.3))
        p = p + R.apply(link)
    return p, R


def hose(k: Draw) -> Path:
    heading = CubicSpline(linspace(0.0, 1.0, 4), np.cumsum(k.rng.normal(0.0, 0.5, 4)))(k.t)
    return turned(walk(heading, k.to(0.5, 0.8)) + rise(0.1 * k.smooth(0.5, 4)), heading)


def umbrella(runner: Array, length: float, sag: float) -> Path:
    strut, pin = 0.22, 0.2
    angle = np.arccos(clip((pin**2 + runner**2 - strut**2) / (2.0 * pin * runner), -1.0, 1.0))
    droop = sag * sin(angle)
    return turned(length * at(sin(angle) * (1.0 - droop), -cos(angle) - droop), angle)


def cradle(a: Array, runner: float, above: float, sway: float) -> Path:
    y = runner + above * cos(a) + sway * sin(2.0 * a)
    return turned(at(runner * a + above * sin(a), y), -a)


def pantograph(a: Array, length: float, sag: float) -> Path:
    out = length * cos(a)
    return turned(at(out, 0.0, -sag * (out - out[0]) ** 2), 0.4 * (out - out[0]), Y)


def second_leaf(a: Array, begin: float, gain: float, near: float, far: float) -> Path:
    late = clip(a - DEGREE * begin, 0.0, None)
    return two(a, a + gain * late**2 / (late + 0.2), near, far)


def rope(t: Array, a: float, b: float) -> Path:
    x, y = a * sin(t), b * cos(t)
    return at(x, y, 0.7 - np.sqrt(0.49 - x**2 - y**2)), Rotation.from_rotvec(at(y, -x) / 0.7)


# Of each set, what it may be used for: design and shaping were looked at while thresholds and rules were chosen; the
# others were written afterwards, and run once.
DESIGN: dict[str, Kind] = {
    "lever_then_door": lambda k: and_on(lever(k.turn(35, 50, k.first(3)), X, 0.11 * Y), k.door(40, 80, 0.6, 0.8, 3)),
    "slide_then_turn": lambda k: then(slide(k.to(0.08, 0.16, k.first(3))), k.door(40, 80, 0.2, 0.4, 3)),
    "folding_door": lambda k: turned(
        k(0.3, 0.45) * at((1.0 + (share := k(0.4, 0.7))) * cos(a := k.turn(50, 75, start=3)), (1.0 - share) * sin(a)),
        -a,
    ),
    "waved_about": lambda k: (k.smooth(0.15, 7, 3), Rotation.from_rotvec(k.smooth(0.4, 7, 3))),
    "four_bar_lid": lambda k: four_bar(
        (0.15, 0.3, k(0.25, 0.32)),
        (0.3, 0.0),
        k.turn(95, 120, start=20),
        [(k(0.25, 0.5), 0.0), (k(0.1, 0.25), 0.5 * pi)],
    ),
}
KEPT: dict[str, Kind] = {
    "bolt_then_gate": lambda k: then(slide(k.to(0.05, 0.09, k.first(4))), k.door(40, 80, 0.5, 0.9, 4)),
    "window_on_a_stay": lambda k: on(k.turn(50, 75), lambda a: at(k(0.25, 0.4) * sin(a), 0.0) + arc(a, k(0.35, 0.6))),
    "two_hinges_at_once": lambda k: two(a := k.smooth(0.7, 4), a + k.smooth(0.9, 4) + 1.2, 0.4, 0.3),
    "sectional_garage_door": lambda k: garage(k(0.25, 0.5), k(0.2, 0.5), k.t),
    "pushed_over_the_table": lambda k: turned(at(*k.smooth(0.2, 5, 2).T), k.smooth(0.6, 5)),
    "joystick": lambda k: on_ball(at(*k.smooth(0.45, 6, 2).T), k(0.25, 0.45) * Z),
    "door_with_a_new_grasp": lambda k: on(
        k.turn(60, 90), lambda a: polar(np.where(np.arange(k.n) < k.n // 2, 0.75, 0.75 - k(0.08, 0.15)), a)
    ),
}
LATER: dict[str, Kind] = {
    "geared_arm_of_a_screen": lambda k: two(a := k.turn(50, 80), a - k(1.3, 1.8) * a, 0.3, k(0.2, 0.28)),
    "door_of_a_van": lambda k: van(k(0.12, 0.18), k(0.25, 0.4), k.t),
    "up_and_over_door": lambda k: on(
        k.turn(60, 85),
        lambda a: k(0.6, 0.9) * at((1.0 - (share := k(0.25, 0.4))) * sin(a), 0.0, share * cos(a)),
        axis=Y,
    ),
    "pin_in_a_wavy_slot": lambda k: kept(at(s := k.to(0.3, 0.45), k(0.02, 0.035) * sin(2.0 * pi * s / k(0.3, 0.5)))),
    "barrel_that_rolls": lambda k: on(
        k.turn(70, 110), lambda a: at(0.25 * a - (r := k(0.18, 0.24)) * sin(a - 0.6), 0.0, r * cos(a - 0.6)), axis=Y
    ),
    "hinge_of_two_pins": lambda k: then(door(k.turn(30, 45, k.first(2)), 0.7), k.door(30, 45, 0.3, 0.45, 2)),
    "tray_that_drops": lambda k: then(
        slide(k.to(0.15, 0.25, k.first(2))),
        (lambda a: slide(k.to(0.1, 0.2, k.rest(2)), [cos(a), 0.0, -sin(a)]))(DEGREE * k(20, 35)),
    ),
    "cord_on_a_drum": lambda k: on(k.turn(110, 170), lambda a: polar(0.3 - k(0.03, 0.05) * a, a)),
}
LAST: dict[str, Kind] = {
    "flush_sliding_door": lambda k: then(
        slide(k.to(0.05, 0.08, k.first(4)), [0.5, -0.866, 0.0]), slide(k.to(0.3, 0.6, k.rest(4)))
    ),
    "knob_then_drawer": lambda k: and_on(
        lever(linspace(0.0, 0.5 * pi, k.first(3)), X, 0.06 * Y), slide(k.to(0.2, 0.4, k.rest(3)))
    ),
    "rail_that_bends_more_and_more": lambda k: on_rail(k.to(0.4, 0.7), lambda s: 0.5 * s**2 / s[-1] / k(0.2, 0.3)),
    "lid_on_a_scissor": lambda k: on(
        k.turn(55, 70, start=15),
        lambda a: k(0.5, 0.7) * at(0.6 * cos(a) ** 2, 0.0, sin(a)),
        lambda a: 0.15 * sin(3.0 * a),
        Y,
    ),
    "handle_on_a_rope": lambda k: rope(2.0 * pi * k.to(0.8, 1.6), k(0.2, 0.3), k(0.08, 0.15)),
    "nut_on_a_bent_rod": lambda k: nut(pi * k.to(2.0, 3.0), k(0.2, 0.3)),
    "column_that_tilts_and_telescopes": lambda k: on(
        0.6 * sin(pi * k(0.8, 1.2) * k.t),
        lambda a: (0.4 + k(0.1, 0.2) * k.t)[:, None] * at(sin(a), 0.0, cos(a)),
        axis=Y,
    ),
    "chair_on_castors": lambda k: on(
        k(0.6, 1.2) * k.t**2, lambda a: 0.8 / k.n * np.cumsum(polar(1.0, a), axis=0), lambda a: -0.5 * sin(4.0 * k.t)
    ),
    "drawer_out_of_its_rail": lambda k: then(
        slide(k.to(0.15, 0.25, k.first(2))),
        on(
            linspace(0.0, 1.0, k.rest(2)),
            lambda t: at(0.1 * t, k(0.1, 0.2) * t**2, k(0.15, 0.3) * sin(1.5 * t)),
            axis=[0.3, -0.4, 0.5],
        ),
    ),
    "planetary_crank": lambda k: two(
        a := k.turn(90, 150), -(0.35 - (wheel := k(0.1, 0.14))) / wheel * a, 0.35 - wheel, k(0.05, 0.09)
    ),
}
SHAPING: dict[str, Kind] = {
    "eccentric_cam": lambda k: on(
        k.turn(80, 130), lambda a: polar(k(0.25, 0.4) + k(0.02, 0.04) * cos(2.0 * a + k(0, 6)), a)
    ),
    "parallelogram_flap": lambda k: on(k.turn(50, 80), lambda a: arc(a, k(0.3, 0.45)), lambda a: k(0.2, 0.4) * a),
    "draw_latch_then_slide": lambda k: and_on(
        lever(k.turn(60, 90, k.first(4)), Y, 0.07 * Z), slide(k.to(0.2, 0.4, k.rest(4)))
    ),
    "plug_door_of_a_bus": lambda k: and_on(
        door(k.turn(25, 40, k.first(3)), k(0.3, 0.45)), slide(k.to(0.25, 0.45, k.rest(3)), Y)
    ),
    "boom_that_turns_then_extends": lambda k: on(
        k.turn(60, 100), lambda a: polar(k(0.35, 0.5) + k(0.15, 0.3) * clip(a / a[-1] - 0.4, 0.0, 1.0) ** 2, a)
    ),
    "hinge_that_lifts_late": lambda k: on(
        k.turn(70, 95), lambda a: rise(k(0.04, 0.08) * clip(a - DEGREE * k(30, 40), 0.0, None)) + arc(a, k(0.5, 0.7))
    ),
    "hose_in_the_hand": hose,
    "elliptic_rail": lambda k: (
        lambda a, A, B: turned(at(A * sin(a), B * (1.0 - cos(a))), arctan2(B * sin(a), A * cos(a)))
    )(k.turn(80, 110), k(0.4, 0.5), k(0.22, 0.3)),
    "lid_on_a_rack": lambda k: on(k.turn(70, 100), lambda a: at(k(0.05, 0.09) * a, 0.0) + arc(a, k(0.35, 0.5))),
    "carried_away": lambda k: carried(k(0.5, 0.7), k.t, k(0.7, 1.3)),
    "screw_of_changing_pitch": lambda k: on(
        pi * k.to(1.2, 2.2), lambda a: arc(a, k(0.1, 0.2)) + rise(k(0.01, 0.02) * a**2)
    ),
    "drawer_that_droops": lambda k: droop(
        s := k.to(0.4, 0.6), clip(s - k(0.18, 0.28), 0.0, 1.0), k(0.08, 0.16), k(0.08, 0.16)
    ),
}
FRESH: dict[str, Kind] = {
    "rail_like_an_s": lambda k: (lambda a, b, far, r: then(door(a, r), turned(arc(b, far) * [-1.0, 1.0, 1.0], -b)))(
        k.turn(35, 60, k.first(2)), k.turn(35, 60, k.rest(2)), k(0.25, 0.45), k(0.25, 0.45)
    ),
    "point_of_a_connecting_rod": lambda k: two(
        a := k.turn(100, 150),
        -np.arcsin((crank := k(0.15, 0.22)) * sin(a) / (rod := k(0.45, 0.6))),
        crank,
        k(0.3, 0.6) * rod,
    ),
    "oval_of_a_toy_train": lambda k: bent(k.t, k(0.15, 0.3), k(0.15, 0.22), pi, k(0.1, 0.25)),
    "window_that_tilts_and_then_turns": lambda k: then(
        lever(k.turn(8, 14, k.first(3)), X, k(0.6, 0.9) * Z), k.door(40, 70, 0.4, 0.6, 3)
    ),
    "wheel_that_is_drawn_out_as_it_turns": lambda k: on(
        k.turn(120, 200), lambda a: arc(a, k(0.12, 0.2)) + rise(k(0.08, 0.14) * clip(a - 0.5, 0.0, None) ** 1.5)
    ),
    "trolley_that_changes_lanes": lambda k: rail(k(0.4, 0.8) * sin(pi * k.t) ** 2, k(0.6, 0.9) * k.t),
    "eye_of_a_ball": lambda k: on_ball(
        at(k(0.8, 1.3) * k.t, k(0.3, 0.6) * k.t**2, k(0.2, 0.4) * sin(2.0 * k.t)), k(0.3, 0.5) * Z
    ),
    "pantograph_of_a_lamp": lambda k: pantograph(k.turn(20, 35, start=k(65, 75)), k(0.5, 0.7), k(0.25, 0.45)),
    "stair_of_a_snail": lambda k: on(
        k.turn(140, 220), lambda a: polar(k(0.12, 0.18) + k(0.03, 0.05) * a, a) + rise(k(0.03, 0.06) * a)
    ),
    "lid_of_a_piano": lambda k: (lambda a, b, r, far: and_on(door(a, r), door(b, far)))(
        k.turn(90, 150, k.first(2)), k.turn(30, 50, k.rest(2)), k(0.2, 0.3), k(0.6, 0.8)
    ),
}
UNSEEN: dict[str, Kind] = {
    "link_of_watt": lambda k: four_bar(
        (0.4, r := k(0.18, 0.26), 0.4), (0.8, r), k.to(0.5, 0.7, start=-0.2), [(k(0.5, 0.8) * r, 0.0)]
    ),
    "spiral_of_archimedes": lambda k: on(k.turn(100, 170), lambda a: polar(k(0.15, 0.25) + k(0.05, 0.09) * a, a)),
    "parabolic_chute": lambda k: graph(x := k.to(0.45, 0.65), (steep := k(1.2, 2.4)) * x**2, 2.0 * steep * x),
    "flipper_door": lambda k: and_on(
        on(linspace(0.0, 0.5 * pi, k.first(2)), lambda a: k(0.25, 0.4) * at(sin(a), 1.0 - cos(a))),
        slide(k.to(0.2, 0.35, k.rest(2)), -X),
    ),
    "bayonet_with_a_long_lever": bayonet,
    "trammel": lambda k: on(
        k.turn(95, 125, start=10), lambda a: at(k(0.45, 0.55) * cos(a), k(0.2, 0.3) * sin(a)), lambda a: -a
    ),
    "cradle_that_rocks": lambda k: cradle(k.turn(30, 45, start=-25), k(0.35, 0.5), k(0.3, 0.45), k(0.05, 0.12)),
    "table_on_a_turntable": lambda k: two(a := k.turn(60, 100), k(1.6, 2.6) * a, k(0.25, 0.35), k(0.1, 0.16)),
    "trailer_that_is_swung": lambda k: tractrix(k(0.35, 0.5), k.to(0.5, 0.8), k(75, 88), k(1.2, 1.6)),
    "arm_at_random": arm_at_random,
    "rail_of_the_third_degree": lambda k: graph(
        s := k.to(0.45, 0.65), y := k(0.08, 0.2) * (s / s[-1]) ** 3, np.gradient(y, s)
    ),
    "toggle_clamp": lambda k: four_bar(
        (0.1, k(0.16, 0.2), 0.18), (k(0.2, 0.24), 0.0), k.turn(140, 180, start=30), [(k(0.3, 0.45), 0.8)]
    ),
    "spiral_slide_with_a_landing": lambda k: landing(k(0.2, 0.3), k(0.06, 0.12), k.turn(80, 130, 2 * k.n // 3), k),
    "second_hinge_that_joins_in": lambda k: second_leaf(
        k.turn(60, 85), k(20, 30), k(0.8, 1.4), k(0.3, 0.4), k(0.3, 0.4)
    ),
    "lane_that_comes_back": lambda k: kept(
        np.outer(k(0.04, 0.07) * 0.5 * (1.0 - cos(2.0 * pi * k.t)), [0.0, 1.0, 0.15]) + at(k(0.5, 0.8) * k.t, 0.0)
    ),
}
ASIDE: dict[str, Kind] = {
    "lamp_on_two_parallelograms": lambda k: kept(
        two(a := k.turn(75, 100, start=20), DEGREE * k(120, 150) - k(0.3, 0.6) * a, k(0.35, 0.45), k(0.35, 0.45))[0]
    ),
    "curtain_on_a_clothoid": lambda k: on_rail(k.to(0.5, 0.8), lambda s: k(0.8, 1.5) * (s / s[-1]) ** 2),
    "bin_above_the_seats": lambda k: four_bar(
        (0.3, 0.25, k(0.36, 0.44)), (k(0.16, 0.22), 0.05), k.turn(-55, -40, start=-100), [(k(0.3, 0.4), -0.9)], -1.0
    ),
    "sofa_that_lifts_as_it_comes": lambda k: kept(at(k(0.4, 0.6) * k.t, 0.0, k(0.05, 0.1) * sin(pi * k.t**1.5))),
    "footrest_of_a_recliner": lambda k: (
        lambda a, gear, r, far: turned(polar(r, a) + polar(far, 0.5 - gear * a), -gear * a)
    )(k.turn(60, 85), k(0.3, 0.6), k(0.3, 0.4), k(0.15, 0.25)),
    "rib_of_an_umbrella": lambda k: umbrella(k.to(0.12, 0.2, start=0.32), k(0.45, 0.6), k(0.05, 0.12)),
    "hook_of_a_crane": lambda k: (lambda a, boom, down: kept(polar(boom, a) - np.outer(down * (a - a[0]), Y)))(
        k.turn(60, 75, start=15), k(0.6, 0.8), k(0.15, 0.35)
    ),
    "hatch_on_a_growing_arm": lambda k: on(
        k.turn(70, 100), lambda a: polar(k(0.35, 0.5) * (1.0 + k(0.1, 0.2) * (a / a[-1]) ** 2), a)
    ),
    "cross_of_a_cardan_shaft": lambda k: cardan(k.turn(40, 70), k(0.4, 0.7), k(0.35, 0.5)),
    "pendulum_between_cheeks": lambda k: on(
        k.to(0.4, 1.0, start=-k(1.6, 2.2)), lambda a: k(0.1, 0.16) * at(a + sin(a), 1.0 - cos(a)), lambda a: 0.5 * a
    ),
    "trolley_on_a_hanging_rope": lambda k: (lambda x, c: graph(x, c * np.cosh(x / c), np.sinh(x / c)))(
        k.to(0.2, 0.35, start=-k(0.3, 0.4)), k(0.18, 0.3)
    ),
    "slider_round_the_corner": lambda k: (lambda lead, angle, r: bent(k.t, lead, r, angle, lead))(
        k(0.15, 0.25), DEGREE * k(50, 90), k(0.15, 0.25)
    ),
}
SETS = {
    "design": DESIGN,
    "kept": KEPT,
    "later": LATER,
    "last": LAST,
    "shaping": SHAPING,
    "fresh": FRESH,
    "unseen": UNSEEN,
    "aside": ASIDE,
}
KINDS = {name: path for some in SETS.values() for name, path in some.items()}


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
