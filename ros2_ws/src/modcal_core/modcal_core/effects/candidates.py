"""Everything that is looked for: each effect of the vocabulary at every place it can sit, before any has a size.

One function names one kind of effect; adding a kind is adding a function to :data:`KINDS`, or installing a package that
brings one (:mod:`~modcal_core.effects.registry`). What has no name yet comes last, as free shapes of any driver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from modcal_core.effects import registry
from modcal_core.effects.drivers import Circumstances
from modcal_core.effects.effect import ACROSS, ALL, AXIS, JOINTS, LENGTH, RADIAL, SHIFT, Effect, length_direction
from modcal_core.effects.shapes import Shape
from modcal_core.geometry.so3 import Array

LEAST_SPEED = 1e-3  # rad/s or m/s
MOST_CYCLES = 400.0  # a turn: twice a ratio of 200
WHOLE_CYCLES = 3  # up to here an error repeats a whole number of times a turn: encoders, eccentric gears
LEAST_RANGE = 0.05  # rad or m; a joint that moved less drives nothing that could be told
SMOOTH = 7  # functions in a smooth free shape
FINE_STEP = 0.05  # rad between the functions of a fine one, which needs a dense recording
STATIONS_PER_FUNCTION = 6
MOST_BREAKS = 160
BREAKS_NEARBY = 12  # the same, where it is known about when
LEAST_SIDE = 4  # stations on either side of a step
HARDENINGS = (0.3, 1.0, 3.0, 10.0)  # share of the cubic term at the usual load
LAGS = (-240.0, -120.0, -60.0, -30.0, 0.0, 30.0, 60.0, 120.0, 240.0, 480.0)  # s
MOST_SIGNALS = 40


def vocabulary(at: Circumstances) -> Iterator[Effect]:
    """All candidates for these samples, without values."""
    for kind in KINDS:
        yield from kind(at)
    yield from registry.candidates(at)


def plainness(effect: Effect) -> int:
    """0 for what has one plain cause, 1 for what takes more to believe, 2 for a free shape."""
    own = effect.driver.partition(":")[2] == effect.place
    if effect.family == "gear_harmonic" and effect.shape.kind == "spline":
        return 1
    if effect.family == "unknown" or effect.shape.kind in ("spline", "waves", "polynomial"):
        return 2
    if effect.family == "thermal" and effect.driver.startswith("temperature:"):
        return 0  # what was measured is plainer than the passing of time
    plain = (
        effect.family in ("compliance", "gear_ratio", "gear_harmonic", "backlash") and effect.direction == AXIS and own
    )
    return 0 if plain else 1


def compliance(at: Circumstances) -> Iterator[Effect]:
    """A joint that gives way to its load, or a bearing that tilts under the moment across its axis."""
    for j, name in enumerate(at.arm.chain.names):
        for kind in _load_kinds(at, j):
            load = at.driver(f"{kind}:{name}")
            scale = float(np.sqrt(np.mean(load**2)))
            yield Effect("compliance", name, AXIS, f"{kind}:{name}", Shape("linear"))
            for beta in HARDENINGS:
                settings = {"scale": scale, "beta": beta}
                yield Effect("compliance", name, AXIS, f"{kind}:{name}", Shape("hardening", settings))
        if at.arm.weighed and at.arm.chain.revolute[j]:
            yield Effect("compliance", name, ACROSS, f"moment:{name}", Shape("linear"))


def payload(at: Circumstances) -> Iterator[Effect]:
    """A joint that gives way to a mass at the tip that the description does not know."""
    for j, name in enumerate(at.arm.chain.names):
        if at.arm.weighed and _varies(at.payload[j, 5]) and "effort" not in _load_kinds(at, j):
            yield Effect("payload", name, AXIS, f"load:{name},payload:{name}", Shape("several"))


def load_since(at: Circumstances, moment: float) -> Iterator[Effect]:
    """Joints that give way to a mass that was put into the hand about this time [s]."""
    between = breaks(at)
    for j, name in enumerate(at.arm.chain.names):
        if _varies(at.payload[j, 5 if at.arm.chain.revolute[j] else 2]):
            for k in np.argsort(np.abs(between - moment))[:BREAKS_NEARBY]:
                settings = {"at": float(between[k])}
                yield Effect("payload", name, AXIS, f"payload:{name},time", Shape("since", settings))


def gears(at: Circumstances) -> Iterator[Effect]:
    """A wrong ratio, and what repeats with the turns of gear, motor or encoder."""
    for j, name in _moving_joints(at):
        driver = f"position:{name}"
        yield Effect("gear_ratio", name, AXIS, driver, Shape("linear"))
        if not at.arm.chain.revolute[j]:
            continue
        for cycles in range(1, WHOLE_CYCLES + 1):
            yield Effect("gear_harmonic", name, AXIS, driver, Shape("turn", {"cycles": float(cycles)}))
        for cycles in cycle_grid(float(np.ptp(at.samples.q[:, j]))):
            yield Effect("gear_harmonic", name, AXIS, driver, Shape("sine", {"cycles": float(cycles)}))
            if cycles <= 0.5 * MOST_CYCLES:  # strain wave gears err twice in each turn of their wave as well
                yield Effect("gear_harmonic", name, AXIS, driver, Shape("double", {"cycles": float(cycles)}))


def cycle_grid(joint_range: float) -> Array:
    """Cycles a turn, close enough that none is missed over this range [rad]."""
    step = float(np.clip(0.3 * 2.0 * np.pi / joint_range, 0.15, 0.5))
    return np.arange(WHOLE_CYCLES + 1.0, MOST_CYCLES + step, step)


def fine_curve(at: Circumstances) -> Iterator[Effect]:
    """Any shape of many cycles a turn, where the recording is dense enough to draw it."""
    for j, name in _moving_joints(at):
        low, high = float(at.samples.q[:, j].min()), float(at.samples.q[:, j].max())
        count = round((high - low) / FINE_STEP) + 3
        if at.arm.chain.revolute[j] and at.samples.stations > STATIONS_PER_FUNCTION * count:
            settings = {"low": low, "high": high, "count": float(count)}
            yield Effect("gear_harmonic", name, AXIS, f"position:{name}", Shape("spline", settings))


def backlash(at: Circumstances) -> Iterator[Effect]:
    """A joint that rests on one side of its play or the other: by where it came from, or by its load."""
    for j, name in enumerate(at.arm.chain.names):
        came = at.samples.approach[:, j]
        if min((came > 0).mean(), (came < 0).mean()) > 0.05:
            yield Effect("backlash", name, AXIS, f"direction:{name}", Shape("linear"))
        for kind in _load_kinds(at, j):
            load = at.driver(f"{kind}:{name}")
            if min((load > 0).mean(), (load < 0).mean()) > 0.05:
                yield Effect("backlash", name, AXIS, f"{kind}:{name}", Shape("sign"))


def coupling(at: Circumstances) -> Iterator[Effect]:
    """A joint that moves along with another one."""
    for _, driver in _moving_joints(at):
        for name in at.arm.chain.names:
            if name != driver:
                yield Effect("coupling", name, AXIS, f"position:{driver}", Shape("linear"))


def axis_wobble(at: Circumstances) -> Iterator[Effect]:
    """An axis that tilts as it turns."""
    for j, name in _moving_joints(at):
        for cycles in (1.0, 2.0) if at.arm.chain.revolute[j] else ():
            yield Effect("axis_wobble", name, ACROSS, f"position:{name}", Shape("turn", {"cycles": cycles}))


def thermal(at: Circumstances) -> Iterator[Effect]:
    """Links and joints that follow a recorded temperature, or that warm up."""
    names = [n for n in at.signal_names() if n.startswith("temperature:")][:MOST_SIGNALS]
    for place, direction in _growing(at):
        for name in names:
            for lag in LAGS:
                shape = Shape("lagged", {"lag": lag}) if lag else Shape("linear")
                yield Effect("thermal", place, direction, name, shape)
        for shape in _warm_ups(at) if place not in ("base", "tool") else ():
            yield Effect("thermal", place, direction, "time", shape)


def drift(at: Circumstances) -> Iterator[Effect]:
    """What moves slowly, and what settles at the foot of arm or tracker or at the tool."""
    span = _span(at)
    if span is None:
        return
    since = {"since": span[0]}
    for place, direction in [*_growing(at), ("base", ALL), ("tool", ALL if at.samples.is_pose.any() else SHIFT)]:
        yield Effect("drift", place, direction, "time", Shape("ramp", since))
        if place in ("base", "tool"):
            for shape in _warm_ups(at):
                yield Effect("drift", place, direction, "time", shape)


def step(at: Circumstances) -> Iterator[Effect]:
    """A tool that was bumped, a tracker or an arm that was moved, a joint that slipped."""
    places = [
        ("base", ALL),
        ("tool", ALL if at.samples.is_pose.any() else SHIFT),
        *((n, AXIS) for n in at.arm.chain.names),
    ]
    for moment in breaks(at):
        for place, direction in places:
            yield Effect("step", place, direction, "time", Shape("until", {"at": float(moment)}))


def breaks(at: Circumstances) -> Array:
    """Moments between stations at which something may have happened [s]."""
    stamps = np.unique(at.samples.stamps)
    between = 0.5 * (stamps[1:] + stamps[:-1])[LEAST_SIDE - 1 : -LEAST_SIDE or None]
    if len(between) <= MOST_BREAKS:
        return np.asarray(between)
    return np.asarray(between[np.linspace(0, len(between) - 1, MOST_BREAKS).astype(int)])


def delay(at: Circumstances) -> Iterator[Effect]:
    """Readings that come late, or one joint's position that does."""
    if not np.abs(np.nan_to_num(at.samples.velocity)).max(initial=0.0) > LEAST_SPEED:
        return
    yield Effect("latency", "tracker", JOINTS, "velocity", Shape("linear"))
    for _, name in _moving_joints(at):
        yield Effect("joint_lag", name, AXIS, "velocity", Shape("linear"))


def scale(at: Circumstances) -> Iterator[Effect]:
    """A tracker whose metre is not a metre."""
    yield Effect("scale", "tracker", RADIAL, "reading", Shape("linear"))


def free_position(at: Circumstances) -> Iterator[Effect]:
    """Any smooth dependence of a joint, or of the tilt of its axis, on the position of any joint."""
    for i, driver in _moving_joints(at):
        low, high = float(at.samples.q[:, i].min()), float(at.samples.q[:, i].max())
        shape = Shape("spline", {"low": low, "high": high, "count": float(SMOOTH)})
        for name in at.arm.chain.names:
            yield Effect("unknown", name, AXIS, f"position:{driver}", shape)
            yield Effect("unknown", name, ACROSS, f"position:{driver}", shape)


def free_pair(at: Circumstances) -> Iterator[Effect]:
    """Any smooth dependence of a joint on the positions of two joints together."""
    shape = Shape("waves", {"order": 2.0})
    if at.samples.stations < 2.5 * shape.size:
        return
    moving = [name for _, name in _moving_joints(at)]
    for name in at.arm.chain.names:
        for a, first in enumerate(moving):
            for second in moving[a + 1 :]:
                # the joint itself is named first, where it is one of the two
                pair = (second, first) if second == name else (first, second)
                yield Effect("unknown", name, AXIS, f"position:{pair[0]},position:{pair[1]}", shape)


def free_time(at: Circumstances) -> Iterator[Effect]:
    """Any slow course in time."""
    span = _span(at)
    if span is None:
        return
    shape = Shape("polynomial", {"degree": 4.0, "low": span[0], "high": span[1]})
    for place, direction in [*_growing(at), ("base", ALL), ("tool", ALL if at.samples.is_pose.any() else SHIFT)]:
        yield Effect("drift", place, direction, "time", shape)


def free_signal(at: Circumstances) -> Iterator[Effect]:
    """Any recorded number that the error goes along with, whatever its topic."""
    names = [n for n in at.signal_names() if not n.startswith("temperature:")][:MOST_SIGNALS]
    tool = ALL if at.samples.is_pose.any() else SHIFT
    for name in names:
        x = at.driver(name)
        if np.ptp(x) <= 1e-12:
            continue
        bent = Shape("polynomial", {"degree": 3.0, "low": float(x.min()), "high": float(x.max())})
        for place, direction in [("base", ALL), ("tool", tool), *((n, AXIS) for n in at.arm.chain.names)]:
            yield Effect("unknown", place, direction, name, Shape("linear"))
            if direction == AXIS:
                yield Effect("unknown", place, direction, name, bent)


KINDS: tuple[Callable[[Circumstances], Iterator[Effect]], ...] = (
    compliance,
    payload,
    gears,
    backlash,
    coupling,
    axis_wobble,
    thermal,
    drift,
    step,
    delay,
    scale,
    fine_curve,
    free_position,
    free_pair,
    free_time,
    free_signal,
)


def _moving_joints(at: Circumstances) -> list[tuple[int, str]]:
    return [(j, name) for j, name in enumerate(at.arm.chain.names) if np.ptp(at.samples.q[:, j]) > LEAST_RANGE]


def _varies(x: Array) -> bool:
    return bool(np.ptp(x) > 1e-3 * max(float(np.abs(x).max()), 1e-3))


def _load_kinds(at: Circumstances, j: int) -> list[str]:
    """Ways in which the load of a joint is known: by gravity, failing masses by a mass at the tip; and as reported."""
    out = []
    name = at.arm.chain.names[j]
    for kind in ("load" if at.arm.weighed else "payload", "effort"):
        if (kind != "effort" or np.isfinite(at.samples.effort[:, j]).all()) and _varies(at.driver(f"{kind}:{name}")):
            out.append(kind)
    return out


def _growing(at: Circumstances) -> list[tuple[str, str]]:
    """Places and directions in which something may grow or creep: every link along itself, every joint, three ways."""
    out: list[tuple[str, str]] = []
    chain = at.arm.chain
    for k, name in enumerate(chain.names, chain.first_place):
        if k:
            out += [(name, d) for d in ("x", "y", "z")]
            if length_direction(chain, k).any():
                out.append((name, LENGTH))
        out.append((name, AXIS))
    return out


def _span(at: Circumstances) -> tuple[float, float] | None:
    low, high = float(at.samples.stamps.min()), float(at.samples.stamps.max())
    return (low, high) if high > low else None


def _warm_ups(at: Circumstances) -> list[Shape]:
    span = _span(at)
    if span is None:
        return []
    length = span[1] - span[0]
    return [Shape("settle", {"since": span[0], "tau": share * length}) for share in (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)]
