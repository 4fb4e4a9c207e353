"""What can be wrong with an arm that nobody declared: each fault bends the truth, and says what would be a right name.

A fault is drawn for one arm: its place, its size (some tenths of a millimetre at the tool) and its shape are random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from arms import GROW, TILT_X, TILT_Y, TURN, Arm, Array
from scipy.integrate import cumulative_trapezoid
from sites import Bend, carrying, off, sprung, turned, twisted, unit

ANY = "*"
ACROSS = slice(TILT_X, TILT_Y + 1)


@dataclass(frozen=True)
class Fault:
    """One planted effect: the families, places and drivers that name it rightly, and what it does.

    latency: of the tracker's stamps [s]; lag: of each joint's reported positions [s]; outliers: readings that are off;
    sensor: a frame and its temperature over time; silent: cannot be identified, so naming anything is wrong.
    """

    family: tuple[str, ...]
    place: tuple[str, ...]
    driver: tuple[str, ...]
    size: str
    bend: Bend = lambda s, d: None
    latency: float = 0.0
    lag: dict[int, float] = field(default_factory=dict)
    outliers: int = 0
    sensor: tuple[str, Callable[[Array], Array]] | None = None
    silent: bool = False


@dataclass(frozen=True)
class Draw:
    """What a fault is drawn from: an arm, random postures of it, how long the first recording takes [s]."""

    rng: np.random.Generator
    arm: Arm
    q: Array
    duration: float

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def joint(self, among: Any = None) -> int:
        return int(self.rng.choice(np.arange(self.arm.n) if among is None else among))

    def scaled(self, low: float, high: float, values: Array) -> float:
        """The factor that brings values to an RMS between low and high."""
        return self.uniform(low, high) / float(np.sqrt(np.mean(values**2)))

    def loaded(self, least: float = 0.08, kind: Any = TURN) -> tuple[Array, Array]:
        """Joints that carry a share of the weight worth speaking of, and the RMS torque of every joint."""
        torque = self.arm.loads(self.q)[..., kind]
        size = np.sqrt(np.mean(torque**2 if kind == TURN else np.sum(torque**2, axis=-1), axis=0))
        return np.flatnonzero(size > least * size.max()), size

    def soft(self, kind: Any = TURN) -> tuple[int, str, float, float]:
        """A loaded joint: its number and name, by how much it bends, and the stiffness for that."""
        joints, torque = self.loaded(kind=kind)
        i, bent = self.joint(joints), self.uniform(2e-4, 6e-4)
        return i, self.arm.names[i], bent, torque[i] / bent

    def own(self, i: int, family: tuple[str, ...], size: str, error: Callable[[Array], Array]) -> Fault:
        """A joint that is off by a function of its own position."""
        name = self.arm.names[i]
        return Fault(family, (name,), (f"position:{name}",), size, turned(i, lambda s: error(s.q[:, i])))

    def link(self) -> tuple[int, tuple[str, ...]]:
        """The joint at the far end of a long link, and the names under which that link's growth may go."""
        i = self.joint([i for i in range(1, self.arm.n) if self.arm.lengths[i] > 0.25])
        return i, (self.arm.parents[i], self.arm.names[i - 1], self.arm.names[i])


def compliance(draw: Draw) -> Fault:
    """One joint is elastic about its axis."""
    i, name, bent, k = draw.soft()
    size = f"{k:.0f} N m/rad, {1e3 * bent:.2f} mrad"
    return Fault(("compliance",), (name,), (f"load:{name}",), size, sprung((i, TURN), k))


def compliance_all(draw: Draw) -> Fault:
    """Every joint is elastic about its axis."""
    names, (joints, torque), bent = draw.arm.names, draw.loaded(), draw.uniform(2e-4, 4e-4)
    # joints that carry little are as stiff as the weakest that carries something
    stiffness = np.maximum(torque, torque[joints].min()) / (bent * draw.rng.uniform(0.7, 1.3, draw.arm.n))
    loads, size = tuple(f"load:{name}" for name in names), f"{stiffness.min():.0f} to {stiffness.max():.0f} N m/rad"
    return Fault(("compliance",), names, loads, size, sprung(np.s_[:, TURN], stiffness))


def payload(draw: Draw) -> Fault:
    """Every joint is elastic, and the flange carries a mass that the robot description does not know."""
    mass = draw.uniform(2.0, 5.0)
    draw.arm.carry(mass)
    springs, family, bodies = compliance_all(draw), ("payload", "compliance"), ("tool", *draw.arm.hand)
    draw.arm.carry(0.0)
    size, bend = f"{springs.size}, {mass:.1f} kg", carrying(springs.bend, mass)
    return Fault(family, (*springs.place, *bodies), (f"load:{ANY}",), size, bend)


def hardening_spring(draw: Draw) -> Fault:
    """A joint's stiffness grows with its deflection."""
    i, name, bent, k = draw.soft()
    harder = draw.uniform(2.0, 5.0)
    k /= 1.0 + harder
    size = f"{k:.0f} N m/rad, {1 + harder:.1f} times that at {1e3 * bent:.2f} mrad"
    return Fault(("compliance",), (name,), (f"load:{name}",), size, sprung((i, TURN), k, harder * k / bent**2))


def bearing_tilt(draw: Draw) -> Fault:
    """A joint's bearing gives way across the axis, the same in both directions across."""
    i, name, bent, k = draw.soft(ACROSS)
    places, size = (name, draw.arm.links[i]), f"{k:.0f} N m/rad, {1e3 * bent:.2f} mrad"
    return Fault(("compliance",), places, (f"load:{name}",), size, sprung((i, ACROSS), k))


def _harmonic(draw: Draw, orders: tuple[int, ...], low: float = 1.5e-4, high: float = 3e-4) -> Fault:
    sizes, phases = draw.rng.uniform(low, high, len(orders)), draw.rng.uniform(0, 2 * np.pi, len(orders))
    size = ", ".join(f"{1e3 * a:.2f} mrad at {k} a turn" for a, k in zip(sizes, orders, strict=True))
    return draw.own(draw.joint(), ("gear_harmonic",), size, lambda q: np.sin(np.outer(q, orders) + phases) @ sizes)


def gear_harmonic(draw: Draw, orders: int = 1) -> Fault:
    """A gear's transmission error, once a turn of its input."""
    ratio = int(draw.rng.integers(50, 162))
    return _harmonic(draw, tuple(ratio * k for k in range(1, orders + 1)))


def gear_harmonic_2n(draw: Draw) -> Fault:
    """A strain-wave gear's transmission error, once and twice a turn of its input."""
    return gear_harmonic(draw, 2)


def encoder_eccentricity(draw: Draw) -> Fault:
    """An encoder's disc is off its centre: once a turn, and in half of the arms twice."""
    return _harmonic(draw, (1,) if draw.rng.random() < 0.5 else (1, 2), low=2e-4, high=4e-4)


def load_backlash(draw: Draw) -> Fault:
    """A joint rests on the side of its play to which gravity pulls it."""
    torque, joints = draw.arm.loads(draw.q)[..., TURN], draw.loaded(0.02)[0]
    even = np.minimum((torque > 0).mean(axis=0), (torque < 0).mean(axis=0))
    i, play = draw.joint(joints[even[joints] > 0.2]), draw.uniform(4e-4, 1e-3)
    name = draw.arm.names[i]

    def bend(s: Any, d: Any) -> None:
        d.x[:, i, TURN] -= 0.5 * play * np.sign(draw.arm.holding(d.x)[:, i, TURN])

    return Fault(("backlash",), (name,), (f"load:{name}",), f"{1e3 * play:.2f} mrad", bend)


def approach_backlash(draw: Draw) -> Fault:
    """A joint rests on the side of its play from which it came."""
    i, play = draw.joint(), draw.uniform(4e-4, 1e-3)
    name, bend = draw.arm.names[i], turned(i, lambda s: -0.5 * play * s.came[:, i])
    return Fault(("backlash",), (name,), (f"direction:{name}",), f"{1e3 * play:.2f} mrad", bend)


def hysteresis(draw: Draw) -> Fault:
    """Friction on a spring that a cable or a flexspline is: of Bouc and Wen, or of LuGre, integrated along the path."""
    i, size, scale = draw.joint(), draw.uniform(2e-4, 5e-4), draw.uniform(0.1, 0.7)
    bouc, hard, beta = draw.rng.random() < 0.5, draw.uniform(1.0, 2.0), draw.uniform(0.4, 1.0)
    begin, name = draw.uniform(-1.0, 1.0), draw.arm.names[i]

    def state(s: Any) -> Array:
        t, q = s.path or (s.t, s.q)
        z, out, slow = begin, np.full(len(t), begin), np.diff(t)
        for k, dx in enumerate(np.diff(q[:, i])):
            steps = int(np.ceil(abs(dx) / (0.02 * scale)))
            for _ in range(steps):
                by, way = dx / steps / scale, np.sign(dx)
                if bouc:
                    z += by * (1.0 - abs(z) ** hard * (beta * np.sign(way * z) + 1.0 - beta))
                else:
                    z += by * (1.0 - way * z / (1.0 + 0.3 * np.exp(-((dx / slow[k] / 0.1) ** 2))))
            out[k + 1] = z
        return np.interp(s.t, t, out)

    what = f"{1e3 * size:.2f} mrad over {scale:.2f} rad, {'Bouc-Wen' if bouc else 'LuGre'}"
    return Fault(("hysteresis",), (name,), (f"path:{name}",), what, turned(i, lambda s: -size * state(s)))


def hysteresis_moving(draw: Draw) -> Fault:
    """The same, read in motion."""
    return hysteresis(draw)


def thermal_sensor(draw: Draw) -> Fault:
    """A link grows with a temperature that a sensor sees late: a warm-up under a duty that changes."""
    i, places = draw.link()
    link, clock = draw.arm.parents[i], np.arange(0.0, 4000.0, 1.0)
    warm, late = draw.uniform(100.0, 200.0), draw.uniform(60.0, 200.0)
    switches = np.cumsum(draw.rng.uniform(25.0, 80.0, len(clock) // 25))
    duty = draw.rng.uniform(0.0, 1.0, len(switches) + 1)[np.searchsorted(switches, clock)]
    duty[clock < switches[0]] = 1.0
    above = _follow(draw.uniform(50.0, 90.0) * duty, warm)
    seen, used = _follow(above, late), above[clock < draw.duration]
    per_kelvin = draw.scaled(1e-4, 3e-4, used - used.mean())
    size = f"{1e6 * per_kelvin:.0f} µm/K, {np.ptp(used):.0f} K, sensor {late:.0f} s late"
    sensor = (link, lambda t: 22.0 + np.interp(t, clock, seen))
    bend = off("x", np.s_[:, i, GROW], lambda s: per_kelvin * np.interp(s.t, clock, above))
    return Fault(("thermal",), places, (f"temperature:{link}",), size, bend, sensor=sensor)


def _follow(target: Array, time_constant: float) -> Array:
    """A first-order follower of a target given every second, at rest at zero."""
    clock = np.arange(len(target), dtype=float)
    rise = np.exp(clock / time_constant)
    return cumulative_trapezoid(target * rise, clock, initial=0.0) / rise / time_constant


def thermal_none(draw: Draw) -> Fault:
    """A link grows while it warms up, and no sensor is there."""
    i, places = draw.link()
    grown, tau = draw.uniform(5e-4, 1e-3), draw.duration * draw.uniform(0.25, 0.4)
    bend = off("x", np.s_[:, i, GROW], lambda s: grown * (1.0 - np.exp(-s.t / tau)))
    return Fault(("thermal", "drift"), places, ("time",), f"{1e3 * grown:.2f} mm in {tau:.0f} s", bend)


def tripod_settling(draw: Draw) -> Fault:
    """The tracker's tripod sinks and turns, ever more slowly."""
    turn, sink = draw.uniform(1.5e-4, 3e-4), draw.uniform(2e-4, 5e-4)
    tau, across = draw.duration * draw.uniform(0.2, 0.4), draw.uniform(0, 2 * np.pi)
    twist = np.array([0.0, 0.0, -sink, turn * np.cos(across), turn * np.sin(across), 0.0])
    places = ("base", "tracker", draw.arm.root, draw.arm.parents[0])
    size = f"{1e3 * sink:.2f} mm and {1e3 * turn:.2f} mrad in {tau:.0f} s"
    bend = twisted("tracker", twist, lambda s: 1.0 - np.exp(-s.t / tau))
    return Fault(("drift", "thermal"), places, ("time",), size, bend)


def tool_bump(draw: Draw) -> Fault:
    """The tool is knocked at some moment, and stays where it then is."""
    when, shift, turn = draw.duration * draw.uniform(0.3, 0.7), draw.uniform(2e-4, 5e-4), draw.uniform(5e-4, 1e-3)
    twist = np.concatenate(unit(draw.rng.normal(size=(2, 3))) * [[shift], [turn]])
    size = f"{1e3 * shift:.2f} mm and {1e3 * turn:.2f} mrad after {when:.0f} s"
    bend = twisted("tool", twist, lambda s: s.t > when)
    return Fault(("step",), ("tool", *draw.arm.hand), ("time",), size, bend)


def wrist_coupling(draw: Draw) -> Fault:
    """A wrist joint is turned a little by its neighbour's gear."""
    last, names = draw.arm.n - 1, draw.arm.names
    i, j = [(last, last - 1), (last - 1, last), (last - 1, last - 2), (last - 2, last - 1)][draw.joint(np.arange(4))]
    c = draw.sign() * draw.uniform(3e-4, 8e-4)
    size, bend = f"{1e3 * c:.2f} mrad/rad", turned(i, lambda s: c * s.q[:, j])
    return Fault(("coupling",), (names[i],), (f"position:{names[j]}",), size, bend)


def latency(draw: Draw) -> Fault:
    """The tracker's stamps are late while the arm moves. It is the same at every joint, so any place is right."""
    late = draw.uniform(2e-3, 8e-3)
    return Fault(("latency",), (ANY,), ("velocity",), f"{1e3 * late:.1f} ms", latency=late)


def joint_lag(draw: Draw) -> Fault:
    """One joint's reported position is an old one while the arm moves."""
    i, late = draw.joint(), draw.uniform(5e-3, 15e-3)
    drivers = ("velocity", f"velocity:{draw.arm.names[i]}")
    return Fault(("joint_lag", "latency"), (draw.arm.names[i],), drivers, f"{1e3 * late:.1f} ms", lag={i: late})


def tracker_scale(draw: Draw) -> Fault:
    """The tracker's unit of length is off, which is the same as an arm, a base and a tool of another size."""
    ppm = draw.sign() * 200.0

    def bend(s: Any, d: Any) -> None:
        d.scale *= 1.0 + 1e-6 * ppm

    return Fault(("scale",), ("tracker",), ("reading",), f"{ppm:+.0f} ppm", bend, silent=True)


def hose_drag(draw: Draw) -> Fault:
    """A hose that becomes taut with two joints' positions pulls one of them round.

    The controller makes up for gravity, not for the hose: what is left is the hose's part of the deflection.
    """
    i = draw.joint(np.arange(draw.arm.n - 2))
    j = i + 1 if i == 0 or draw.rng.random() < 0.5 else i - 1
    centre, half = draw.arm.range.mean(axis=0), 0.5 * np.ptp(draw.arm.range, axis=0)
    si, sj, slack, arm_angle = draw.sign(), draw.sign(), draw.uniform(-0.3, 0.3), draw.uniform(0, 2 * np.pi)

    def pull(q: Array) -> Array:
        u, v = ((q - centre) / half)[:, [i, j]].T
        taut = 0.3 * np.logaddexp(0.0, (si * u + sj * v - slack) / 0.3)
        return taut * (1.0 + 0.6 * np.sin(1.5 * u * v + arm_angle))

    sample, (a, b) = pull(draw.q), (draw.arm.names[i], draw.arm.names[j])
    scale = draw.scaled(1.5e-4, 3e-4, sample - sample.mean())
    families = ("unknown", "coupling", "gear_harmonic", "compliance", "gear_ratio")
    size, bend = f"{1e3 * scale * sample.std():.2f} mrad", turned(i, lambda s: scale * pull(s.q))
    return Fault(families, (a,), (f"position:{a}", f"position:{b}"), size, bend)


def triangular_wave(draw: Draw) -> Fault:
    """A joint's error goes up and down in straight lines some times a turn."""
    cycles, height = int(draw.rng.integers(3, 10)), draw.uniform(2e-4, 4e-4)
    phase, size = draw.uniform(0, 2 * np.pi), f"{1e3 * height:.2f} mrad, {cycles} a turn"
    wave = lambda q: height * 2.0 / np.pi * np.arcsin(np.sin(cycles * q + phase))  # noqa: E731
    return draw.own(draw.joint(), ("gear_harmonic", "unknown"), size, wave)


def gear_ratio(draw: Draw) -> Fault:
    """A joint moves a little more or less than it says."""
    e = draw.sign() * draw.uniform(1e-4, 3e-4)
    return draw.own(draw.joint(), ("gear_ratio",), f"{1e6 * e:+.0f} ppm", lambda q: e * q)


def axis_wobble(draw: Draw) -> Fault:
    """A joint's axis tilts on an ellipse while the joint turns, once or twice a turn."""
    i, order, phase = draw.joint(), int(draw.rng.integers(1, 3)), draw.uniform(0, 2 * np.pi)
    a = draw.uniform(2e-4, 5e-4)
    b = a * draw.uniform(-0.6, 0.3)  # a circle the joint's own way is a tilt that turns with it: no fault at all

    def tilts(s: Any) -> Array:
        angle = order * s.q[:, i] + phase
        return np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)

    name, link = draw.arm.names[i], draw.arm.links[i]
    size, bend = f"{1e3 * a:.2f} by {1e3 * abs(b):.2f} mrad, {order} a turn", off("x", np.s_[:, i, ACROSS], tilts)
    return Fault(("axis_wobble",), (name, link), (f"position:{name}",), size, bend)


def tracker_outliers(draw: Draw) -> Fault:
    """A few readings are far off."""
    return Fault(("outliers",), (ANY,), (ANY,), "6 readings, 1 to 5 mm", outliers=6)


Maker = Callable[[Draw], Fault]
MOVING = latency, joint_lag, hysteresis_moving
SINGLE: tuple[Maker, ...] = (
    compliance, compliance_all, hardening_spring, bearing_tilt, gear_harmonic, gear_harmonic_2n, encoder_eccentricity,
    load_backlash, approach_backlash, thermal_sensor, thermal_none, tripod_settling, tool_bump, wrist_coupling, latency,
    tracker_scale, hose_drag, triangular_wave, gear_ratio, axis_wobble, payload, tracker_outliers, joint_lag,
    hysteresis, hysteresis_moving,
)  # fmt: skip
TWO: tuple[tuple[Maker, ...], ...] = (
    (gear_harmonic, compliance), (approach_backlash, gear_harmonic), (thermal_none, compliance),
    (tool_bump, gear_ratio), (wrist_coupling, bearing_tilt), (tripod_settling, triangular_wave),
)  # fmt: skip
SCENARIOS: dict[str, tuple[Maker, ...]] = {"none": ()}
SCENARIOS |= {"+".join(m.__name__ for m in makers): makers for makers in (*((one,) for one in SINGLE), *TWO)}
