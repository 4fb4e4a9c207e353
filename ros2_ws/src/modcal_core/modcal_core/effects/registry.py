"""Effects that installed packages add: one file names place, direction, driver and shape, an entry point registers it.

    [project.entry-points."modcal.effects"]
    taut_cable = "my_package.taut_cable:EFFECT"

names an :class:`AddedEffect`. From then on it is scanned, chosen, fitted, stored and reported like any other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.packages import added

if TYPE_CHECKING:
    from modcal_core.effects.drivers import Circumstances
    from modcal_core.effects.effect import Effect

GROUP = "modcal.effects"
# What the house has, which no package may name anew.
FAMILIES = (
    *("compliance", "gear_harmonic", "gear_ratio", "backlash", "coupling", "axis_wobble", "thermal", "drift", "step"),
    *("payload", "latency", "joint_lag", "scale", "outliers", "unknown"),
)
SHAPES = (
    *(
        "linear",
        "lagged",
        "several",
        "since",
        "hardening",
        "turn",
        "sine",
        "double",
        "sign",
        "ramp",
        "step",
        "until",
        "settle",
    ),
    *("spline", "polynomial", "waves"),
)
DRIVERS = (
    *("constant", "time", "velocity", "reading", "position", "direction", "load", "effort", "payload", "moment"),
    *("temperature", "signal"),
)


@dataclass(frozen=True)
class Setting:
    """A number of a shape that is fitted with the amplitudes. expected: how far it may lie from where the scan found
    it before its prior minds (a standard deviation). unit: as in reports.
    """

    expected: float
    unit: str = "1"


@dataclass(frozen=True)
class AddedShape:
    """How an effect follows its driver, where no shape of the house does.

    basis(x, settings): its functions (size, N) at drivers x (N,), or (c, N) where the driver names c separated by
    commas. refined: the settings that are fitted, by name; basis must be smooth in them.
    """

    basis: Callable[[Array, Mapping[str, float]], Array]
    size: int = 1
    refined: Mapping[str, Setting] = field(default_factory=dict)


@dataclass(frozen=True)
class AddedEffect:
    """One effect of a package.

    family: its name in reports. candidates: every place, direction, driver and shape that it is looked for with at
    these circumstances, without values. shapes: its own, by name. drivers: its own, by the part of their name before
    the colon; each is called with the circumstances and the part behind it, and returns (N,). story: what a technician
    should know, behind the name of the place ("elbow_joint …").
    """

    family: str
    candidates: Callable[[Circumstances], Iterator[Effect]]
    shapes: Mapping[str, AddedShape] = field(default_factory=dict)
    drivers: Mapping[str, Callable[[Circumstances, str], Array]] = field(default_factory=dict)
    story: str = ""


@cache
def added_effects() -> dict[str, AddedEffect]:
    """The effects of installed packages, by family. Raises BadTable for what is none, or takes another's name."""
    out: dict[str, AddedEffect] = {}
    shapes, drivers = set(SHAPES), set(DRIVERS)
    for offender, effect in added(GROUP):
        if not isinstance(effect, AddedEffect):
            raise BadTable(offender, f"names a {type(effect).__name__}", "name an AddedEffect")
        if effect.family in FAMILIES or effect.family in out:
            raise BadTable(offender, f"family {effect.family} is taken", "choose another")
        for what, names, taken in (("shape", effect.shapes, shapes), ("driver", effect.drivers, drivers)):
            for name in names:
                if name in taken:
                    raise BadTable(offender, f"{what} {name} is taken", "choose another name")
                taken.add(name)
        out[effect.family] = effect
    return out


def candidates(at: Circumstances) -> Iterator[Effect]:
    """All candidates of packages. Raises BadTable for one that belongs to another family, or cannot be evaluated."""
    for family, own in added_effects().items():
        for effect in own.candidates(at):
            if effect.family != family:
                raise BadTable(f"effect {family}", f"yields one of family {effect.family}", "yield its own only")
            require_known(effect)
            yield effect


def require_known(effect: Effect) -> None:
    """Raises BadTable for an effect whose shape or driver nobody here knows: it would be left out in silence."""
    known = (*SHAPES, *(name for own in _own() for name in own.shapes))
    if effect.shape.kind not in known:
        raise _unknown(effect, f"shape {effect.shape.kind}")
    known = (*DRIVERS, *(name for own in _own() for name in own.drivers))
    for driver in effect.driver.split(","):
        if driver.partition(":")[0] not in known:
            raise _unknown(effect, f"driver {driver}")


def added_shape(kind: str) -> AddedShape | None:
    """The shape of a package by its name; None for one of the house, or that nobody knows."""
    return None if kind in SHAPES else next((a.shapes[kind] for a in _own() if kind in a.shapes), None)


def added_driver(kind: str) -> Callable[[Circumstances, str], Array] | None:
    """The driver of a package by the first part of its name; None for one of the house, or that nobody knows."""
    return None if kind in DRIVERS else next((a.drivers[kind] for a in _own() if kind in a.drivers), None)


def basis_of(kind: str, shape: AddedShape, x: Array, settings: Mapping[str, float]) -> Array:
    """The functions (size, N) of a package's shape. Raises BadTable when they are not that, or not finite."""
    out = np.asarray(shape.basis(x, settings), dtype=float)
    wanted = (shape.size, x.shape[-1])
    if out.shape != wanted or not np.isfinite(out).all():
        limit = f"is {out.shape}, not {wanted}" if out.shape != wanted else "is not finite"
        raise BadTable(f"shape {kind} at {dict(settings)}", limit, "mend the package that brings it")
    return out


def _own() -> list[AddedEffect]:
    return list(added_effects().values())


def _unknown(effect: Effect, what: str) -> BadTable:
    return BadTable(f"effect {effect.family} at {effect.place}", f"no {what}", "install the package that brings it")
