"""All families there are: the built-in ones and those of installed packages, entered and checked in the same way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

from modcal_core.effects import drivers as known_drivers
from modcal_core.effects import shapes as known_shapes
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect
from modcal_core.effects.family import Family, no_candidates
from modcal_core.effects.sources import brought
from modcal_core.errors import BadTable


@cache
def families() -> dict[str, Family]:
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


def family(name: str) -> Family:
    """The family of this name; one that says only what its effects show, where nobody here knows it."""
    return families().get(name) or Family(name, no_candidates)


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """All that is looked for in these samples, without values.

    Raises BadTable for a candidate that belongs to another family, or cannot be evaluated.
    """
    known: set[tuple[str, str]] = set()  # thousands have the same shape and driver
    for name, own in families().items():
        for effect in own.candidates(drivers):
            if name != effect.family:
                raise BadTable(f"effect {name}", f"yields one of family {effect.family}", "yield its own only")
            if (effect.shape.kind, effect.driver) not in known:
                require_known(effect)
                known.add((effect.shape.kind, effect.driver))
            yield effect


def complexity(effect: Effect) -> int:
    """How much it takes to believe an effect: 0 plain, 1 usual, 2 a free shape."""
    return family(effect.family).complexity(effect)


def claimed(effect: Effect) -> bool:
    """Whether a report names it as a cause; otherwise it only makes predictions better."""
    return family(effect.family).claimed


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
    everyone = families().values()
    shapes = {*known_shapes.KINDS, *(name for own in everyone for name in own.shapes)}
    drivers = {*known_drivers.KINDS, *known_drivers.SIGNALS, *(name for own in everyone for name in own.drivers)}
    return frozenset(shapes), frozenset(drivers)


def _unknown(effect: Effect, what: str) -> BadTable:
    return BadTable(f"effect {effect.family} at {effect.place}", f"no {what}", "install the package that provides it")
