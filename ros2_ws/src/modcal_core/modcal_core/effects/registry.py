"""All families there are: the built-in ones and those of installed packages, entered and checked in the same way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from modcal_core.effects import drivers as known_drivers
from modcal_core.effects import shapes as known_shapes
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import ALL, AXIS, LENGTH, SHIFT, Effect
from modcal_core.effects.family import Family, no_candidates
from modcal_core.effects.shapes import Shape, brought
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import PART


@cache
def known_families() -> dict[str, Family]:
    """The families by name, in the order they are looked for.

    Raises BadTable for what is no family, or takes a name that is taken.
    """
    out: dict[str, Family] = {}
    shapes, drivers = set(known_shapes.KINDS), {*known_drivers.KINDS, *known_drivers.SIGNALS}
    for offender, found in brought():
        if not isinstance(found, Family):
            raise BadTable(offender, f"names a {type(found).__name__}", "name a Family")
        if found.name in out:
            raise BadTable(offender, f"family {found.name} is already used", "choose another")
        for what, names, taken in (("shape", found.shapes, shapes), ("driver", found.drivers, drivers)):
            for name in names:
                if name in taken:
                    raise BadTable(offender, f"{what} {name} is already used", "choose another name")
                taken.add(name)
        out[found.name] = found
    return out


def family_named(name: str) -> Family:
    """The family of this name; one that says only what its effects show, where nobody here knows it."""
    return known_families().get(name) or Family(name, no_candidates)


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """All that is looked for in these samples, without values.

    Raises BadTable for a candidate that belongs to another family, or cannot be evaluated.
    """
    known: set[tuple[str, str]] = set()  # thousands have the same shape and driver
    for name, own in known_families().items():
        for effect in own.candidates(drivers):
            if name != effect.family:
                raise BadTable(f"effect {name}", f"yields one of family {effect.family}", "yield its own only")
            if (effect.shape.kind, effect.driver) not in known:
                require_known(effect)
                known.add((effect.shape.kind, effect.driver))
            yield effect


def complexity(effect: Effect) -> int:
    """How much it takes to believe an effect: 0 plain, 1 usual, 2 a free shape."""
    return family_named(effect.family).complexity(effect)


def claimed(effect: Effect) -> bool:
    """Whether a report names it as a cause; otherwise it only makes predictions better."""
    return family_named(effect.family).claimed


def with_companions(effects: Sequence[Effect], numbers: Sequence[int]) -> tuple[int, ...]:
    """The numbers of some effects, and of those without a name that follow the same driver there: one curve together.

    A wave whose cycles were fitted has none: small curves are too smooth to stand in for it.
    """
    keys = {effects[i].key[1:] for i in numbers if not effects[i].refined}
    return *numbers, *(i for i, e in enumerate(effects) if not claimed(e) and e.key[1:] in keys)


def companionless(effects: Sequence[Effect]) -> tuple[int, ...]:
    """The numbers of the effects without a name that go with no other."""
    named = tuple(i for i, effect in enumerate(effects) if claimed(effect))
    return tuple(sorted({*range(len(effects))} - {*with_companions(effects, named)}))


def require_known(effect: Effect) -> None:
    """Raises BadTable for an effect whose shape or driver nobody here knows: it would be left out in silence."""
    shapes, drivers = _known()
    if effect.shape.kind not in shapes:
        raise _unknown(effect, f"shape {effect.shape.kind}")
    for driver in effect.driver.split(","):
        if driver.partition(":")[0] not in drivers:
            raise _unknown(effect, f"driver {driver}")


@cache
def _known() -> tuple[frozenset[str], frozenset[str]]:
    """Kinds of shapes and of drivers, by name."""
    everyone = known_families().values()
    shapes = {*known_shapes.KINDS, *(name for own in everyone for name in own.shapes)}
    drivers = {*known_drivers.KINDS, *known_drivers.SIGNALS, *(name for own in everyone for name in own.drivers)}
    return frozenset(shapes), frozenset(drivers)


def _unknown(effect: Effect, what: str) -> BadTable:
    return BadTable(f"effect {effect.family} at {effect.place}", f"no {what}", "install the package that provides it")


# --- What a recording lets one look for: joints that moved, loads that vary, times between stations, what may grow

MIN_RANGE = 0.05  # rad or m; a joint that moved less drives nothing that could be told
MIN_SPEED = 1e-3  # rad/s or m/s
MAX_BREAKS = 160  # times of a step that are tried, for time; the best is looked for more finely afterwards
MOSTLY = 0.5  # share of the samples at which a driver must be known; at the others something stands in for it
_MIN_FOLLOWING = 2e-6  # rad or m; a joint that is as close to its commands errs by less than any instrument sees
MIN_SIDE = 4  # stations on either side of a step
MAX_SIGNALS = 40  # of a recording, for time
KILOGRAMS, NEWTONS = ("_kg", "/kg"), ("_n", "newton", "newtons")  # ends of names of numbers, their unit
MAX_CARRIED = 8  # of these, that are tried as loads, for time
_CONSTANT = 1e-3  # of its size; a load that changes by less is a constant, and drives nothing that could be told
_MIN_OF_A_SIGN = 0.05  # share of the samples; fewer could all be single wrong readings
WARM_UPS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)  # time constants, as shares of the recording


def moving_joints(drivers: Drivers) -> list[tuple[int, str]]:
    """Number and name of each joint that moved."""
    q = drivers.samples.q
    return [(j, name) for j, name in enumerate(drivers.arm.chain.names) if np.ptp(q[:, j]) > MIN_RANGE]


def in_motion(drivers: Drivers) -> bool:
    """Whether readings were taken while joints moved."""
    return bool(np.abs(np.nan_to_num(drivers.samples.velocity)).max(initial=0.0) > MIN_SPEED)


def followed(drivers: Drivers, j: int) -> bool:
    """Whether it is known by how much a joint follows its commands, and that varies."""
    apart = drivers.samples.following[:, j]
    known = np.isfinite(apart)
    return bool(known.mean() >= MOSTLY and np.ptp(apart[known]) > _MIN_FOLLOWING) if known.any() else False


def varies(x: Array) -> bool:
    """Whether a load is more than a constant."""
    return bool(np.ptp(x) > _CONSTANT * max(float(np.abs(x).max()), 1e-3))


def loads(drivers: Drivers, j: int) -> dict[str, Array]:
    """The load of a joint in the ways it is known and varies, by driver, (N,) each.

    By gravity, failing masses by 1 kg at the tip; and as the actuator reports it, where it mostly does.
    """
    name = drivers.arm.chain.names[j]
    out = {}
    for kind in ("load" if drivers.arm.weighed else "payload", "effort"):
        if kind == "effort" and np.isfinite(drivers.samples.effort[:, j]).mean() < MOSTLY:
            continue
        load = drivers.values(f"{kind}:{name}")
        if varies(load):
            out[f"{kind}:{name}"] = load
    return out


def both_signs(x: Array) -> bool:
    """Whether a number is positive at some samples and negative at others, often enough to compare the two."""
    return bool(min((x > 0).mean(), (x < 0).mean()) > _MIN_OF_A_SIGN)


def base_and_tool(drivers: Drivers) -> list[tuple[str, str]]:
    """Place and directions in which base and tool can be seen to move: of readings without orientation a shift."""
    return [("base", ALL), ("tool", ALL if drivers.samples.is_pose.any() else SHIFT)]


def growing(drivers: Drivers) -> list[tuple[str, str]]:
    """Places and directions in which something may grow or creep: every link along itself, every joint, three ways."""
    out: list[tuple[str, str]] = []
    chain = drivers.arm.chain
    for k, name in enumerate(chain.names, chain.first_place):
        if k:
            out += [(name, d) for d in ("x", "y", "z")]
            if chain.length_direction(k).any():
                out.append((name, LENGTH))
        out.append((name, AXIS))
    return out


def carried_signals(drivers: Drivers) -> list[str]:
    """Names of recorded numbers that may say what the arm carries: by themselves in a message, in kilograms or newtons.

    Any other number is none: a tilt, or an uncertainty, that goes with the posture looks like a payload.
    """
    some = signals(drivers, temperatures=False)
    return [n for n in some if PART not in n and n.lower().endswith((*KILOGRAMS, *NEWTONS))][:MAX_CARRIED]


def signals(drivers: Drivers, *, temperatures: bool) -> list[str]:
    """Names of recorded temperatures, or of all other recorded signals."""
    return [n for n in drivers.signal_names() if n.startswith("temperature:") == temperatures][:MAX_SIGNALS]


def span(drivers: Drivers, by: str = "time") -> tuple[float, float] | None:
    """First and last value [s] of a driver that is a time; None if it stands still, as outside what was watched."""
    times = drivers.values(by)
    low, high = float(times.min()), float(times.max())
    return (low, high) if high > low else None


def warm_ups(drivers: Drivers) -> list[Shape]:
    """Settling since the beginning, with time constants from a small part of the recording to all of it."""
    within = span(drivers)
    if within is None:
        return []
    length = within[1] - within[0]
    return [Shape("settle", {"since": within[0], "tau": share * length}) for share in WARM_UPS]


def breaks(drivers: Drivers) -> Array:
    """Times between stations at which something may have happened [s]."""
    stamps = np.unique(drivers.values("time"))
    between = 0.5 * (stamps[1:] + stamps[:-1])[MIN_SIDE - 1 : -MIN_SIDE or None]
    if len(between) <= MAX_BREAKS:
        return np.asarray(between)
    return np.asarray(between[np.linspace(0, len(between) - 1, MAX_BREAKS).astype(int)])
