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


Spec = Callable[[Draw], Any] | tuple[float, float]  # what is drawn; two numbers: one between them
Kind = Callable[[Draw], Path]


def of(*specs: Spec) -> Callable[[Callable[..., Path]], Kind]:
    """A kind: the path of what is drawn, in this order."""
    return lambda path: lambda k: path(*(spec(k) if callable(spec) else k(*spec) for spec in specs))


def along(k: Draw) -> Array:
    return k.t


def first(share: int) -> Callable[[int], int]:
    """Poses of the first part, one in so many."""
    return lambda n: n // share


def rest(share: int) -> Callable[[int], int]:
    return lambda n: n - n // share


def to(low: float, high: float, count: Callable[[int], int] = int, start: float = 0.0) -> Spec:
    """Evenly from the start to a random end; count: poses of a part."""
    return lambda k: linspace(start, k(low, high), count(k.n))


def turn(low: float, high: float, count: Callable[[int], int] = int, start: float = 0.0) -> Spec:
    """The same in degrees; comes back in radians."""
    return lambda k: DEGREE * linspace(start, k(low, high), count(k.n))


def smooth(size: float, knots: int, columns: int | None = None) -> Spec:
    """A spline through so many random values, (n,) or (n, columns)."""
    shape = (knots,) if columns is None else (knots, columns)
    return lambda k: CubicSpline(linspace(0.0, 1.0, knots), k.rng.normal(0.0, size, shape))(k.t)


def about(axis: Sequence[float] | Array, angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, axis))


def turned(p: Array, angle: Array, axis: Sequence[float] | Array = Z) -> Path:
    return p, about(axis, angle)


def kept(p: Array) -> Path:
    return turned(p, np.zeros(len(p)))


def on_ball(R: Rotation, point: Sequence[float] | Array) -> Path:
    return R.apply(point), R


def at(x: Any, y: Any, z: Any = 0.0) -> Array:
    """Positions (n, 3) of coordinates, any of which may be one number."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=1)


def polar(radius: Any, angle: Array) -> Array:
    return at(radius * cos(angle), radius * sin(angle))


def arc(angle: Array, radius: float, z: Any = 0.0) -> Array:
    """From the origin along y, bending towards −x."""
    return at(radius * (cos(angle) - 1.0), radius * sin(angle), z)


def door(angle: Array, radius: float, z: Any = 0.0) -> Path:
    return turned(arc(angle, radius, z), angle)


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


def bent(t: Array, lead: float, radius: float, angle: float, far: float) -> Path:
    """A rail that is straight, bends round by an angle, and is straight again."""
    s = (lead + angle * radius + far) * t
    return rail(clip((s - lead) / radius, 0.0, angle), s)


def then(start: Path, end: Path) -> Path:
    """One after the other, in the frame in which the handle stands there."""
    (p, R), (q, S) = start, end
    return np.concatenate([p, p[-1] + R[-1].apply(q)]), Rotation.concatenate([R, R[-1] * S])


def and_on(start: Path, end: Path) -> Path:
    """One after the other, along the axes of the room."""
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
        R = R * about(axis, CubicSpline(linspace(0.0, 1.0, 5), k.rng.normal(0.3, 0.45, 5))(k.t))
        p = p + R.apply(link)
    return p, R


def hose(k: Draw) -> Path:
    heading = CubicSpline(linspace(0.0, 1.0, 4), np.cumsum(k.rng.normal(0.0, 0.5, 4)))(k.t)
    p = walk(heading, linspace(0.0, k(0.5, 0.8), k.n))
    return turned(p + np.outer(0.1 * CubicSpline(linspace(0.0, 1.0, 4), k.rng.normal(0.0, 0.5, 4))(k.t), Z), heading)


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
    "lever_then_door": of(turn(35, 50, first(3)), turn(40, 80, rest(3)), (0.6, 0.8))(
        lambda a, b, r: and_on(lever(a, X, 0.11 * Y), door(b, r))
    ),
    "slide_then_turn": of(to(0.08, 0.16, first(3)), turn(40, 80, rest(3)), (0.2, 0.4))(
        lambda s, a, r: then(slide(s), door(a, r))
    ),
    "folding_door": of((0.3, 0.45), (0.4, 0.7), turn(50, 75, start=3))(
        lambda r, share, a: turned(r * at((1.0 + share) * cos(a), (1.0 - share) * sin(a)), -a)
    ),
    "waved_about": of(smooth(0.15, 7, 3), smooth(0.4, 7, 3))(lambda p, w: (p, Rotation.from_rotvec(w))),
    "four_bar_lid": of((0.25, 0.32), turn(95, 120, start=20), (0.25, 0.5), (0.1, 0.25))(
        lambda rocker, a, x, y: four_bar((0.15, 0.3, rocker), (0.3, 0.0), a, ((x, 0.0), (y, 0.5 * pi)))
    ),
}
KEPT: dict[str, Kind] = {
    "bolt_then_gate": of(to(0.05, 0.09, first(4)), turn(40, 80, rest(4)), (0.5, 0.9))(
        lambda s, a, r: then(slide(s), door(a, r))
    ),
    "window_on_a_stay": of(turn(50, 75), (0.25, 0.4), (0.35, 0.6))(
        lambda a, slot, r: turned(arc(a, r) + at(slot * sin(a), 0.0), a)
    ),
    "two_hinges_at_once": of(smooth(0.7, 4), smooth(0.9, 4))(lambda a, b: two(a, a + b + 1.2, 0.4, 0.3)),
    "sectional_garage_door": of((0.25, 0.5), (0.2, 0.5), along)(garage),
    "pushed_over_the_table": of(smooth(0.2, 5, 2), smooth(0.6, 5))(lambda p, a: turned(at(*p.T), a)),
    "joystick": of(smooth(0.45, 6, 2), (0.25, 0.45))(lambda w, r: on_ball(Rotation.from_rotvec(at(*w.T)), r * Z)),
    "door_with_a_new_grasp": of(turn(60, 90), along, (0.08, 0.15))(
        lambda a, t, r: turned(polar(np.where(np.arange(len(t)) < len(t) // 2, 0.75, 0.75 - r), a), a)
    ),
}
LATER: dict[str, Kind] = {
    "geared_arm_of_a_screen": of(turn(50, 80), (1.3, 1.8), (0.2, 0.28))(
        lambda a, gear, r: two(a, a - gear * a, 0.3, r)
    ),
    "door_of_a_van": of((0.12, 0.18), (0.25, 0.4), along)(van),
    "up_and_over_door": of(turn(60, 85), (0.6, 0.9), (0.25, 0.4))(
        lambda a, r, share: turned(r * at((1.0 - share) * sin(a), 0.0, share * cos(a)), a, Y)
    ),
    "pin_in_a_wavy_slot": of(to(0.3, 0.45), (0.02, 0.035), (0.3, 0.5))(
        lambda s, side, wave: kept(at(s, side * sin(2.0 * pi * s / wave)))
    ),
    "barrel_that_rolls": of(turn(70, 110), (0.18, 0.24))(
        lambda a, r: turned(at(0.25 * a - r * sin(a - 0.6), 0.0, r * cos(a - 0.6)), a, Y)
    ),
    "hinge_of_two_pins": of(turn(30, 45, first(2)), turn(30, 45, rest(2)), (0.3, 0.45))(
        lambda a, b, r: then(door(a, 0.7), door(b, r))
    ),
    "tray_that_drops": of(to(0.15, 0.25, first(2)), (20, 35), to(0.1, 0.2, rest(2)))(
        lambda s, slant, d: then(slide(s), slide(d, [cos(DEGREE * slant), 0.0, -sin(DEGREE * slant)]))
    ),
    "cord_on_a_drum": of(turn(110, 170), (0.03, 0.05))(lambda a, r: turned(polar(0.3 - r * a, a), a)),
}
LAST: dict[str, Kind] = {
    "flush_sliding_door": of(to(0.05, 0.08, first(4)), to(0.3, 0.6, rest(4)))(
        lambda s, t: then(slide(s, [0.5, -0.866, 0.0]), slide(t))
    ),
    "knob_then_drawer": of(lambda k: linspace(0.0, 0.5 * pi, k.n // 3), to(0.2, 0.4, rest(3)))(
        lambda a, s: and_on(lever(a, X, 0.06 * Y), slide(s))
    ),
    "rail_that_bends_more_and_more": of(to(0.4, 0.7), (0.2, 0.3))(lambda s, r: rail(0.5 * s**2 / s[-1] / r, s)),
    "lid_on_a_scissor": of(turn(55, 70, start=15), (0.5, 0.7))(
        lambda a, r: turned(r * at(0.6 * cos(a) ** 2, 0.0, sin(a)), 0.15 * sin(3.0 * a), Y)
    ),
    "handle_on_a_rope": of(to(0.8, 1.6), (0.2, 0.3), (0.08, 0.15))(lambda t, a, b: rope(2.0 * pi * t, a, b)),
    "nut_on_a_bent_rod": of(to(2.0, 3.0), (0.2, 0.3))(lambda a, bend: nut(pi * a, bend)),
    "column_that_tilts_and_telescopes": of(along, (0.8, 1.2), (0.1, 0.2))(
        lambda t, tilt, out: turned(
            (0.4 + out * t)[:, None] * at(sin(0.6 * sin(pi * tilt * t)), 0.0, cos(0.6 * sin(pi * tilt * t))),
            0.6 * sin(pi * tilt * t),
            Y,
        )
    ),
    "chair_on_castors": of(along, (0.6, 1.2))(
        lambda t, a: turned(0.8 / len(t) * at(np.cumsum(cos(a * t**2)), np.cumsum(sin(a * t**2))), -0.5 * sin(4.0 * t))
    ),
    "drawer_out_of_its_rail": of(
        to(0.15, 0.25, first(2)), lambda k: linspace(0.0, 1.0, k.n - k.n // 2), (0.1, 0.2), (0.15, 0.3)
    )(lambda s, t, y, z: then(slide(s), turned(at(0.1 * t, y * t**2, z * sin(1.5 * t)), t, [0.3, -0.4, 0.5]))),
    "planetary_crank": of(turn(90, 150), (0.1, 0.14), (0.05, 0.09))(
        lambda a, wheel, far: two(a, -(0.35 - wheel) / wheel * a, 0.35 - wheel, far)
    ),
}
SHAPING: dict[str, Kind] = {
    "eccentric_cam": of(turn(80, 130), (0.25, 0.4), (0.02, 0.04), (0, 6))(
        lambda a, r, lobe, by: turned(polar(r + lobe * cos(2.0 * a + by), a), a)
    ),
    "parallelogram_flap": of(turn(50, 80), (0.3, 0.45), (0.2, 0.4))(lambda a, r, share: turned(arc(a, r), share * a)),
    "draw_latch_then_slide": of(turn(60, 90, first(4)), to(0.2, 0.4, rest(4)))(
        lambda a, s: and_on(lever(a, Y, 0.07 * Z), slide(s))
    ),
    "plug_door_of_a_bus": of(turn(25, 40, first(3)), (0.3, 0.45), to(0.25, 0.45, rest(3)))(
        lambda a, r, s: and_on(door(a, r), slide(s, Y))
    ),
    "boom_that_turns_then_extends": of(turn(60, 100), (0.35, 0.5), (0.15, 0.3))(
        lambda a, r, out: turned(polar(r + out * clip(a / a[-1] - 0.4, 0.0, 1.0) ** 2, a), a)
    ),
    "hinge_that_lifts_late": of(turn(70, 95), (0.04, 0.08), (30, 40), (0.5, 0.7))(
        lambda a, up, begin, r: door(a, r, up * clip(a - DEGREE * begin, 0.0, None))
    ),
    "hose_in_the_hand": hose,
    "elliptic_rail": of(turn(80, 110), (0.4, 0.5), (0.22, 0.3))(
        lambda a, A, B: turned(at(A * sin(a), B * (1.0 - cos(a))), arctan2(B * sin(a), A * cos(a)))
    ),
    "lid_on_a_rack": of(turn(70, 100), (0.05, 0.09), (0.35, 0.5))(
        lambda a, r, far: turned(arc(a, far) + at(r * a, 0.0), a)
    ),
    "carried_away": of((0.5, 0.7), along, (0.7, 1.3))(
        lambda out, t, bend: turned(
            walk(bend * 3.0 * clip(t - 0.45, 0.0, 1.0) ** 2, out * (10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5)),
            0.3 * sin(3.0 * t),
            [0.3, 0.8, 0.5],
        )
    ),
    "screw_of_changing_pitch": of(to(1.2, 2.2), (0.1, 0.2), (0.01, 0.02))(
        lambda a, r, rise: door(pi * a, r, rise * (pi * a) ** 2)
    ),
    "drawer_that_droops": of(to(0.4, 0.6), (0.18, 0.28), (0.08, 0.16), (0.08, 0.16))(
        lambda s, begin, down, tilt: turned(
            at(s, 0.0, -down * clip(s - begin, 0.0, 1.0)),
            tilt * clip(clip(s - begin, 0.0, 1.0) / 0.03, 0.0, 1.0),
            Y,
        )
    ),
}
FRESH: dict[str, Kind] = {
    "rail_like_an_s": of(turn(35, 60, first(2)), turn(35, 60, rest(2)), (0.25, 0.45), (0.25, 0.45))(
        lambda a, b, far, r: then(door(a, r), turned(arc(b, far) * [-1.0, 1.0, 1.0], -b))
    ),
    "point_of_a_connecting_rod": of(turn(100, 150), (0.15, 0.22), (0.45, 0.6), (0.3, 0.6))(
        lambda a, crank, rod, share: two(a, -np.arcsin(crank * sin(a) / rod), crank, share * rod)
    ),
    "oval_of_a_toy_train": of((0.15, 0.3), (0.15, 0.22), (0.1, 0.25), along)(
        lambda lead, r, far, t: bent(t, lead, r, pi, far)
    ),
    "window_that_tilts_and_then_turns": of(turn(8, 14, first(3)), (0.6, 0.9), turn(40, 70, rest(3)), (0.4, 0.6))(
        lambda a, r, b, far: then(lever(a, X, r * Z), door(b, far))
    ),
    "wheel_that_is_drawn_out_as_it_turns": of(turn(120, 200), (0.12, 0.2), (0.08, 0.14))(
        lambda a, r, out: door(a, r, out * clip(a - 0.5, 0.0, None) ** 1.5)
    ),
    "trolley_that_changes_lanes": of((0.4, 0.8), (0.6, 0.9), along)(lambda a, s, t: rail(a * sin(pi * t) ** 2, s * t)),
    "eye_of_a_ball": of((0.8, 1.3), (0.3, 0.6), (0.2, 0.4), (0.3, 0.5), along)(
        lambda a, b, c, r, t: on_ball(Rotation.from_rotvec(at(a * t, b * t**2, c * sin(2.0 * t))), r * Z)
    ),
    "pantograph_of_a_lamp": of((65, 75), lambda k: (k(20, 35), k.n), (0.5, 0.7), (0.25, 0.45))(
        lambda begin, k, r, sag: pantograph(DEGREE * linspace(begin, *k), r, sag)
    ),
    "stair_of_a_snail": of(turn(140, 220), (0.12, 0.18), (0.03, 0.05), (0.03, 0.06))(
        lambda a, r, grow, up: turned(polar(r + grow * a, a) + np.outer(up * a, Z), a)
    ),
    "lid_of_a_piano": of(turn(90, 150, first(2)), turn(30, 50, rest(2)), (0.2, 0.3), (0.6, 0.8))(
        lambda a, b, r, far: and_on(door(a, r), door(b, far))
    ),
}
UNSEEN: dict[str, Kind] = {
    "link_of_watt": of((0.18, 0.26), to(0.5, 0.7, start=-0.2), (0.5, 0.8))(
        lambda r, a, share: four_bar((0.4, r, 0.4), (0.8, r), a, ((share * r, 0.0),))
    ),
    "spiral_of_archimedes": of(turn(100, 170), (0.15, 0.25), (0.05, 0.09))(
        lambda a, r, grow: turned(polar(r + grow * a, a), a)
    ),
    "parabolic_chute": of(to(0.45, 0.65), (1.2, 2.4))(
        lambda x, steep: turned(at(x, steep * x**2), arctan(2.0 * steep * x))
    ),
    "flipper_door": of(lambda k: linspace(0.0, 0.5 * pi, k.n // 2), (0.25, 0.4), to(0.2, 0.35, rest(2)))(
        lambda a, r, s: and_on(turned(r * at(sin(a), 1.0 - cos(a)), a), slide(s, -X))
    ),
    "bayonet_with_a_long_lever": bayonet,
    "trammel": of(turn(95, 125, start=10), (0.45, 0.55), (0.2, 0.3))(
        lambda a, x, y: turned(at(x * cos(a), y * sin(a)), -a)
    ),
    "cradle_that_rocks": of(turn(30, 45, start=-25), (0.35, 0.5), (0.3, 0.45), (0.05, 0.12))(cradle),
    "table_on_a_turntable": of(turn(60, 100), (1.6, 2.6), (0.25, 0.35), (0.1, 0.16))(
        lambda a, gear, r, far: two(a, gear * a, r, far)
    ),
    "trailer_that_is_swung": of((0.35, 0.5), to(0.5, 0.8), (75, 88), (1.2, 1.6))(tractrix),
    "arm_at_random": arm_at_random,
    "rail_of_the_third_degree": of(to(0.45, 0.65), (0.08, 0.2))(
        lambda s, d: turned(at(s, d * (s / s[-1]) ** 3), arctan(np.gradient(d * (s / s[-1]) ** 3, s)))
    ),
    "toggle_clamp": of((0.16, 0.2), (0.2, 0.24), turn(140, 180, start=30), (0.3, 0.45))(
        lambda r, ground, a, far: four_bar((0.1, r, 0.18), (ground, 0.0), a, ((far, 0.8),))
    ),
    "spiral_slide_with_a_landing": of(
        (0.2, 0.3), (0.06, 0.12), turn(80, 130, lambda n: 2 * n // 3), to(0.15, 0.3, lambda n: n - 2 * n // 3)
    )(
        lambda r, pitch, a, s: and_on(
            turned(polar(r, a) - np.outer(pitch * a, Z), a), slide(s, [-sin(a[-1]), cos(a[-1]), 0.0])
        )
    ),
    "second_hinge_that_joins_in": of(turn(60, 85), (20, 30), (0.8, 1.4), (0.3, 0.4), (0.3, 0.4))(second_leaf),
    "lane_that_comes_back": of((0.04, 0.07), along, (0.5, 0.8))(
        lambda d, t, s: kept(at(s * t, d * 0.5 * (1.0 - cos(2.0 * pi * t)), 0.15 * d * 0.5 * (1.0 - cos(2.0 * pi * t))))
    ),
}
ASIDE: dict[str, Kind] = {
    "lamp_on_two_parallelograms": of(turn(75, 100, start=20), (120, 150), (0.3, 0.6), (0.35, 0.45), (0.35, 0.45))(
        lambda a, begin, gear, r, far: kept(polar(r, a) + polar(far, DEGREE * begin - gear * a))
    ),
    "curtain_on_a_clothoid": of(to(0.5, 0.8), (0.8, 1.5))(lambda s, bend: rail(bend * (s / s[-1]) ** 2, s)),
    "bin_above_the_seats": of((0.36, 0.44), (0.16, 0.22), turn(-55, -40, start=-100), (0.3, 0.4))(
        lambda second, apart, a, r: four_bar((0.3, 0.25, second), (apart, 0.05), a, ((r, -0.9),), -1.0)
    ),
    "sofa_that_lifts_as_it_comes": of((0.4, 0.6), (0.05, 0.1), along)(
        lambda s, up, t: kept(at(s * t, 0.0, up * sin(pi * t**1.5)))
    ),
    "footrest_of_a_recliner": of(turn(60, 85), (0.3, 0.6), (0.3, 0.4), (0.15, 0.25))(
        lambda a, gear, r, far: turned(polar(r, a) + polar(far, 0.5 - gear * a), -gear * a)
    ),
    "rib_of_an_umbrella": of(to(0.12, 0.2, start=0.32), (0.45, 0.6), (0.05, 0.12))(umbrella),
    "hook_of_a_crane": of(turn(60, 75, start=15), (0.6, 0.8), (0.15, 0.35))(
        lambda a, r, down: kept(polar(r, a) - np.outer(down * (a - a[0]), Y))
    ),
    "hatch_on_a_growing_arm": of(turn(70, 100), (0.35, 0.5), (0.1, 0.2))(
        lambda a, r, grow: turned(polar(r * (1.0 + grow * (a / a[-1]) ** 2), a), a)
    ),
    "cross_of_a_cardan_shaft": of(turn(40, 70), (0.4, 0.7), (0.35, 0.5))(
        lambda a, b, r: on_ball(about(X, a) * about(Y, b * sin(2.0 * a)), [0.1, 0.0, r])
    ),
    "pendulum_between_cheeks": of(lambda k: linspace(-k(1.6, 2.2), k(0.4, 1.0), k.n), (0.1, 0.16))(
        lambda a, r: turned(r * at(a + sin(a), 1.0 - cos(a)), 0.5 * a)
    ),
    "trolley_on_a_hanging_rope": of(lambda k: linspace(-k(0.3, 0.4), k(0.2, 0.35), k.n), (0.18, 0.3))(
        lambda x, c: turned(at(x, c * np.cosh(x / c)), arctan(np.sinh(x / c)))
    ),
    "slider_round_the_corner": of((0.15, 0.25), (50, 90), (0.15, 0.25), along)(
        lambda lead, bend, r, t: bent(t, lead, r, DEGREE * bend, lead)
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
