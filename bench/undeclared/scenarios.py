"""What can be wrong with an arm that nobody declared: each fault bends the truth, and says what would be a right name.

A fault is drawn for one arm: its place, its size (some tenths of a millimetre at the tool) and its shape are random.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from arm import GROW, TILT_X, TILT_Y, TURN, Arm, Array
from fault import ANY, Bend, Deviation, Draw, Fault, Stations
from scipy.integrate import cumulative_trapezoid


def _springs(stiffness: dict[tuple[int, int], tuple[float, float]], payload: float = 0.0) -> Bend:
    """Springs (linear, cubic) on coordinates (joint, kind), and a payload."""

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        for (i, kind), (linear, cubic) in stiffness.items():
            deviation.linear[i, kind], deviation.cubic[i, kind] = linear, cubic
        deviation.payload += payload

    return bend


def _loaded(draw: Draw, least: float = 0.08) -> tuple[Array, Array]:
    """Joints that carry a share of the weight worth speaking of, and the RMS torque of every joint."""
    rms = np.sqrt(np.mean(draw.torques()[..., TURN] ** 2, axis=0))
    return np.flatnonzero(rms > least * rms.max()), rms


def compliance(draw: Draw) -> Fault:
    """One joint is elastic about its axis."""
    joints, rms = _loaded(draw)
    i, bent = draw.joint(joints), draw.uniform(2e-4, 6e-4)
    name, k = draw.arm.names[i], rms[i] / bent
    bend = _springs({(i, TURN): (k, 0.0)})
    return Fault(("compliance",), (name,), (f"load:{name}",), f"{k:.0f} N m/rad, {1e3 * bent:.2f} mrad", bend)


def compliance_all(draw: Draw) -> Fault:
    """Every joint is elastic about its axis."""
    return _all_elastic(draw, ("compliance",), 0.0, ())


def payload(draw: Draw) -> Fault:
    """Every joint is elastic, and the flange carries a mass that the robot description does not know."""
    mass = draw.uniform(2.0, 5.0)
    draw.arm.carry(mass)
    fault = _all_elastic(draw, ("payload", "compliance"), mass, ("tool", *draw.arm.hand))
    draw.arm.carry(0.0)
    return fault


def _all_elastic(draw: Draw, family: tuple[str, ...], mass: float, places: tuple[str, ...]) -> Fault:
    joints, rms = _loaded(draw)
    bent = draw.uniform(2e-4, 4e-4)
    # joints that carry little are as stiff as the weakest that carries something
    stiffness = np.maximum(rms, rms[joints].min()) / (bent * draw.rng.uniform(0.7, 1.3, draw.arm.n))
    bend = _springs({(i, TURN): (float(k), 0.0) for i, k in enumerate(stiffness)}, mass)
    loads = (ANY,) if mass else draw.arm.names
    size = f"{stiffness.min():.0f} to {stiffness.max():.0f} N m/rad" + (f", {mass:.1f} kg" if mass else "")
    return Fault(family, (*draw.arm.names, *places), tuple(f"load:{name}" for name in loads), size, bend)


def hardening_spring(draw: Draw) -> Fault:
    """A joint's stiffness grows with its deflection."""
    joints, rms = _loaded(draw)
    i, bent, harder = draw.joint(joints), draw.uniform(2e-4, 6e-4), draw.uniform(2.0, 5.0)
    name, k = draw.arm.names[i], rms[i] / bent / (1.0 + harder)
    bend = _springs({(i, TURN): (k, harder * k / bent**2)})
    size = f"{k:.0f} N m/rad, {1 + harder:.1f} times that at {1e3 * bent:.2f} mrad"
    return Fault(("compliance",), (name,), (f"load:{name}",), size, bend)


def bearing_tilt(draw: Draw) -> Fault:
    """A joint's bearing gives way across the axis, the same in both directions across."""
    across = np.sqrt(np.mean(np.sum(draw.torques()[..., TILT_X : TILT_Y + 1] ** 2, axis=-1), axis=0))
    i, bent = draw.joint(np.flatnonzero(across > 0.08 * across.max())), draw.uniform(2e-4, 6e-4)
    name, k = draw.arm.names[i], across[i] / bent
    bend = _springs({(i, TILT_X): (k, 0.0), (i, TILT_Y): (k, 0.0)})
    places, size = (name, draw.arm.links[i]), f"{k:.0f} N m/rad, {1e3 * bent:.2f} mrad"
    return Fault(("compliance",), places, (f"load:{name}",), size, bend)


def _harmonic(draw: Draw, orders: tuple[int, ...], low: float = 1.5e-4, high: float = 3e-4) -> Fault:
    sizes, phases = draw.rng.uniform(low, high, len(orders)), draw.rng.uniform(0, 2 * np.pi, len(orders))

    def error(q: Array) -> Array:
        return np.sin(np.outer(q, orders) + phases) @ sizes

    size = ", ".join(f"{1e3 * a:.2f} mrad at {k} a turn" for a, k in zip(sizes, orders, strict=True))
    return draw.own(draw.joint(), ("gear_harmonic",), size, error)


def gear_harmonic(draw: Draw) -> Fault:
    """A gear's transmission error, once a turn of its input."""
    return _harmonic(draw, (int(draw.rng.integers(50, 162)),))


def gear_harmonic_2n(draw: Draw) -> Fault:
    """A strain-wave gear's transmission error, once and twice a turn of its input."""
    ratio = int(draw.rng.integers(50, 162))
    return _harmonic(draw, (ratio, 2 * ratio))


def encoder_eccentricity(draw: Draw) -> Fault:
    """An encoder's disc is off its centre: once a turn, and in half of the arms twice."""
    return _harmonic(draw, (1,) if draw.rng.random() < 0.5 else (1, 2), low=2e-4, high=4e-4)


def load_backlash(draw: Draw) -> Fault:
    """A joint rests on the side of its play to which gravity pulls it."""
    torque = draw.torques()[..., TURN]
    joints = _loaded(draw, 0.02)[0]
    even = np.minimum((torque > 0).mean(axis=0), (torque < 0).mean(axis=0))
    i, play = draw.joint(joints[even[joints] > 0.2]), draw.uniform(4e-4, 1e-3)
    name = draw.arm.names[i]

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, i, TURN] -= 0.5 * play * np.sign(arm.holding(deviation.x)[:, i, TURN])

    return Fault(("backlash",), (name,), (f"load:{name}",), f"{1e3 * play:.2f} mrad", bend)


def approach_backlash(draw: Draw) -> Fault:
    """A joint rests on the side of its play from which it came."""
    i, play = draw.joint(), draw.uniform(4e-4, 1e-3)
    name = draw.arm.names[i]

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, i, TURN] -= 0.5 * play * stations.way[:, i]

    return Fault(("backlash",), (name,), (f"direction:{name}",), f"{1e3 * play:.2f} mrad", bend)


def _growth(draw: Draw) -> tuple[int, tuple[str, ...]]:
    """The joint at the far end of a long link, and the names under which that link's growth may go."""
    long = [i for i in range(1, draw.arm.n) if draw.arm.lengths[i] > 0.25]
    i = draw.joint(np.array(long))
    return i, (draw.arm.parents[i], draw.arm.names[i - 1], draw.arm.names[i])


def _grows(i: int, growth: Callable[[Array], Array]) -> Bend:
    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, i, GROW] += growth(stations.t)

    return bend


def thermal_sensor(draw: Draw) -> Fault:
    """A link grows with a temperature that a sensor sees late: a warm-up under a duty that changes."""
    i, places = _growth(draw)
    link, clock = draw.arm.parents[i], np.arange(0.0, 4000.0, 1.0)
    warm, late = draw.uniform(100.0, 200.0), draw.uniform(60.0, 200.0)
    switches = np.cumsum(draw.rng.uniform(25.0, 80.0, len(clock) // 25))
    duty = draw.rng.uniform(0.0, 1.0, len(switches) + 1)[np.searchsorted(switches, clock)]
    duty[clock < switches[0]] = 1.0
    above = _follow(draw.uniform(50.0, 90.0) * duty, warm)
    seen = _follow(above, late)
    used = above[clock < draw.duration]
    per_kelvin = draw.scaled(1e-4, 3e-4, used - used.mean())
    bend = _grows(i, lambda t: per_kelvin * np.interp(t, clock, above))
    size = f"{1e6 * per_kelvin:.0f} µm/K, {np.ptp(used):.0f} K, sensor {late:.0f} s late"
    sensor = (link, lambda t: 22.0 + np.interp(t, clock, seen))
    return Fault(("thermal",), places, (f"temperature:{link}",), size, bend, sensor=sensor)


def _follow(target: Array, time_constant: float) -> Array:
    """A first-order follower of a target given every second, at rest at zero."""
    clock = np.arange(len(target), dtype=float)
    rise = np.exp(clock / time_constant)
    return cumulative_trapezoid(target * rise, clock, initial=0.0) / rise / time_constant


def thermal_none(draw: Draw) -> Fault:
    """A link grows while it warms up, and no sensor is there."""
    i, places = _growth(draw)
    size, tau = draw.uniform(5e-4, 1e-3), draw.duration * draw.uniform(0.25, 0.4)
    bend = _grows(i, lambda t: size * (1.0 - np.exp(-t / tau)))
    return Fault(("thermal", "drift"), places, ("time",), f"{1e3 * size:.2f} mm in {tau:.0f} s", bend)


def tripod_settling(draw: Draw) -> Fault:
    """The tracker's tripod sinks and turns, ever more slowly."""
    turn, sink = draw.uniform(1.5e-4, 3e-4), draw.uniform(2e-4, 5e-4)
    tau, across = draw.duration * draw.uniform(0.2, 0.4), draw.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(across), np.sin(across), 0.0])

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        settled = 1.0 - np.exp(-stations.t / tau)
        deviation.tracker += settled[:, None] * np.concatenate([[0.0, 0.0, -sink], turn * axis])

    places = ("base", "tracker", draw.arm.root, draw.arm.parents[0])
    size = f"{1e3 * sink:.2f} mm and {1e3 * turn:.2f} mrad in {tau:.0f} s"
    return Fault(("drift", "thermal"), places, ("time",), size, bend)


def tool_bump(draw: Draw) -> Fault:
    """The tool is knocked at some moment, and stays where it then is."""
    when, shift, turn = draw.duration * draw.uniform(0.3, 0.7), draw.uniform(2e-4, 5e-4), draw.uniform(5e-4, 1e-3)
    ways = draw.rng.normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    step = np.concatenate([shift * ways[0], turn * ways[1]])

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.tool += np.where(stations.t[:, None] > when, step, 0.0)

    size = f"{1e3 * shift:.2f} mm and {1e3 * turn:.2f} mrad after {when:.0f} s"
    return Fault(("step",), ("tool", *draw.arm.hand), ("time",), size, bend)


def wrist_coupling(draw: Draw) -> Fault:
    """A wrist joint is turned a little by its neighbour's gear."""
    last = draw.arm.n - 1
    i, j = [(last, last - 1), (last - 1, last), (last - 1, last - 2), (last - 2, last - 1)][draw.joint(np.arange(4))]
    c, names = draw.sign() * draw.uniform(3e-4, 8e-4), draw.arm.names

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, i, TURN] += c * stations.q[:, j]

    return Fault(("coupling",), (names[i],), (f"position:{names[j]}",), f"{1e3 * c:.2f} mrad/rad", bend)


def latency(draw: Draw) -> Fault:
    """The tracker's stamps are late while the arm moves. It is the same at every joint, so any place is right."""
    late = draw.uniform(2e-3, 8e-3)
    return Fault(("latency",), (ANY,), ("velocity",), f"{1e3 * late:.1f} ms", latency=late)


def joint_lag(draw: Draw) -> Fault:
    """One joint's reported position is an old one while the arm moves."""
    i, late = draw.joint(), draw.uniform(5e-3, 15e-3)
    name = draw.arm.names[i]
    drivers = ("velocity", f"velocity:{name}")
    return Fault(("joint_lag", "latency"), (name,), drivers, f"{1e3 * late:.1f} ms", lag={i: late})


def tracker_scale(draw: Draw) -> Fault:
    """The tracker's unit of length is off, which is the same as an arm, a base and a tool of another size."""
    off = draw.sign() * 2e-4

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.scale *= 1.0 + off

    return Fault(("scale",), ("tracker",), ("reading",), f"{1e6 * off:+.0f} ppm", bend, silent=True)


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

    sample = pull(draw.q)
    scale = draw.scaled(1.5e-4, 3e-4, sample - sample.mean())

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.x[:, i, TURN] += scale * pull(stations.q)

    a, b = draw.arm.names[i], draw.arm.names[j]
    families = ("unknown", "coupling", "gear_harmonic", "compliance", "gear_ratio")
    return Fault(families, (a,), (f"position:{a}", f"position:{b}"), f"{1e3 * scale * sample.std():.2f} mrad", bend)


def triangular_wave(draw: Draw) -> Fault:
    """A joint's error goes up and down in straight lines some times a turn."""
    cycles, height = int(draw.rng.integers(3, 10)), draw.uniform(2e-4, 4e-4)
    phase = draw.uniform(0, 2 * np.pi)

    def error(q: Array) -> Array:
        return height * 2.0 / np.pi * np.arcsin(np.sin(cycles * q + phase))

    return draw.own(draw.joint(), ("gear_harmonic", "unknown"), f"{1e3 * height:.2f} mrad, {cycles} a turn", error)


def gear_ratio(draw: Draw) -> Fault:
    """A joint moves a little more or less than it says."""
    e = draw.sign() * draw.uniform(1e-4, 3e-4)
    return draw.own(draw.joint(), ("gear_ratio",), f"{1e6 * e:+.0f} ppm", lambda q: e * q)


def axis_wobble(draw: Draw) -> Fault:
    """A joint's axis tilts on an ellipse while the joint turns, once or twice a turn."""
    i, order, phase = draw.joint(), int(draw.rng.integers(1, 3)), draw.uniform(0, 2 * np.pi)
    a = draw.uniform(2e-4, 5e-4)
    b = a * draw.uniform(-0.6, 0.3)  # a circle the joint's own way is a tilt that turns with it: no fault at all

    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        angle = order * stations.q[:, i] + phase
        deviation.x[:, i, TILT_X] += a * np.cos(angle)
        deviation.x[:, i, TILT_Y] += b * np.sin(angle)

    name, link = draw.arm.names[i], draw.arm.links[i]
    size = f"{1e3 * a:.2f} by {1e3 * abs(b):.2f} mrad, {order} a turn"
    return Fault(("axis_wobble",), (name, link), (f"position:{name}",), size, bend)


def tracker_outliers(draw: Draw) -> Fault:
    """A few readings are far off."""
    return Fault(("outliers",), (ANY,), (ANY,), "6 readings, 1 to 5 mm", outliers=6)


Maker = Callable[[Draw], Fault]
MOVING = ("latency", "joint_lag")
SCENARIOS: dict[str, tuple[Maker, ...]] = {
    "none": (),
    **{
        maker.__name__: (maker,)
        for maker in (
            compliance, compliance_all, hardening_spring, bearing_tilt, gear_harmonic, gear_harmonic_2n,
            encoder_eccentricity, load_backlash, approach_backlash, thermal_sensor, thermal_none, tripod_settling,
            tool_bump, wrist_coupling, latency, tracker_scale, hose_drag, triangular_wave, gear_ratio, axis_wobble,
            payload, tracker_outliers, joint_lag,
        )
    },
    **{
        "+".join(maker.__name__ for maker in pair): pair
        for pair in (
            (gear_harmonic, compliance), (approach_backlash, gear_harmonic), (thermal_none, compliance),
            (tool_bump, gear_ratio), (wrist_coupling, bearing_tilt), (tripod_settling, triangular_wave),
        )
    },
}  # fmt: skip
