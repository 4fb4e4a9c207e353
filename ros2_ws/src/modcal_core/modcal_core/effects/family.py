"""What a family of effects is: all that tells one kind of error from another, as data and functions.

Everything else in modcal treats all effects alike and asks the family of one where they differ; nothing asks for a
family's name. A built-in family is a file in ``effects/families`` that names it ``FAMILY``; a package's is named by
an entry point (:func:`modcal_core.effects.shapes.brought`). Apart from where they lie the two are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from modcal_core.effects.drivers import DriverKind, Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import ShapeKind
from modcal_core.effects.sizes import Quantity, Sizes, sizes_of
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism

# --- An entry of a report, and the words that families make their sentences of

_ROUGH = 0.1  # of a size: with a standard deviation beyond, it is given with its spread
_DETERMINED = 3.0  # standard deviations from zero: below, the recording does not tell a size from none


@dataclass(frozen=True)
class ReportEntry:
    """What a report has of one effect, or of several of one family, place and driver, with names as in reports.

    sizes: by name. same_as: what explains it as well, by name.
    """

    place: str
    direction: str
    driver: str
    sizes: Mapping[str, Quantity]
    same_as: tuple[str, ...] = ()

    @property
    def of_driver(self) -> str:
        """The driver in words: ``load of elbow_joint``."""
        return self.driver.replace(":", " of ")

    def thousandths(self, name: str) -> str:
        """A size in millimetres, or whatever its unit is thousand times smaller, with its spread where it is rough."""
        value, std, unit = self.sizes[name]
        return in_words((1e3 * value, 1e3 * std, f"m{unit}"))

    def determined(self, name: str) -> bool:
        """Whether the size is three of its standard deviations from zero, so that it may be stated."""
        value, std, _ = self.sizes[name]
        return abs(value) > _DETERMINED * std

    @property
    def total(self) -> str:
        """The directions put together: lengths, angles."""
        out = []
        for unit in ("m", "rad"):
            parts = [q for q in self.sizes.values() if q[2] == unit or q[2].startswith(f"{unit}/")]
            total = sum(value**2 for value, _, _ in parts) ** 0.5
            if total:
                out.append(f"{1e3 * total:.3g} m{parts[0][2]}")
        return " and ".join(out) or "nothing that was recorded"


def in_words(quantity: Quantity) -> str:
    """A size with its unit, and ± one standard deviation where that is more than a tenth of it."""
    value, std, unit = quantity
    spread = f" ± {std:.2g}" if std > _ROUGH * abs(value) else ""
    return f"{value:.3g}{spread} {unit}"


def unnamed(entry: ReportEntry) -> str:
    """What can be said where no family has a better sentence."""
    size = entry.total
    how = "" if size.startswith("nothing") else f" ({size})"
    return (
        f"{entry.place} ({entry.direction}) has an error of no known family that correlates with {entry.of_driver}{how}"
    )


def over_time(entry: ReportEntry) -> str:
    """What moved at one time, settles, or follows a driver slowly."""
    if "at" in entry.sizes:
        at, _, unit = entry.sizes["at"]
        when = f"stamp {at:.1f} s" if unit == "s" else f"row {at:.0f}"
        return f"{entry.place} moved by {entry.total} at one moment ({when})"
    if "time_constant" in entry.sizes:
        tau, _, unit = entry.sizes["time_constant"]
        return f"{entry.place} settles by {entry.total} with a time constant of {tau:.0f} {unit}"
    return f"{entry.place} moves with {entry.of_driver} ({entry.total})"


PLAIN, USUAL, FREE = 0, 1, 2  # complexities: one plain cause, what takes more to believe, a free shape


def no_candidates(_: Drivers) -> Iterator[Effect]:
    """No candidates, for a family that is not found by the scan."""
    yield from ()


def complexity_of_shape(effect: Effect) -> int:
    """FREE for a free shape, USUAL for everything else."""
    return FREE if effect.shape.is_free else USUAL


def complexity_of_joint(effect: Effect) -> int:
    """PLAIN for a joint that errs about its axis with a driver of its own, for which few causes are needed."""
    own = effect.direction == AXIS and effect.driver.partition(":")[2] == effect.place
    return PLAIN if own and not effect.shape.is_free else complexity_of_shape(effect)


def nothing_plainer(_: Effect) -> Effect | None:
    """The effect is as plain as it can be."""
    return None


@dataclass(frozen=True)
class Family:
    """One family of effects. Only name and candidates must be given.

    name: in reports and in ``calibration.yaml``.
    candidates(drivers): every place, direction, driver and shape that it is looked for with in these samples, without
    values. Settings that are not linear (where something begins) are scanned by one candidate for each value.
    shapes, drivers: kinds of its own, by name; a driver's by the part of its name before the colon, and it is called
    with the drivers and the part behind the colon.

    How it is weighed against others. complexity(effect): PLAIN, USUAL or FREE; of effects that explain nearly as much
    the plainest is taken. plausible(effect): whether its amplitudes, in their first estimate, can be such a cause.
    plainer(effect): the effect to take instead when its fitted values show that it is not needed in full, else None.

    What a report says. sizes(effect, chain): named quantities (value, standard deviation, unit). sentence(entry): what
    a technician should know, without a full stop. same_as(effect, samples): what else it may be, by name, that the
    scan cannot see. certain(effect, drivers): at which samples (N,) it is known how the effect acts; only these can be
    outliers. claimed: whether its effects are causes that a report names; of others it says together what they gain.
    """

    name: str
    candidates: Callable[[Drivers], Iterator[Effect]]
    shapes: Mapping[str, ShapeKind] = field(default_factory=dict)
    drivers: Mapping[str, DriverKind] = field(default_factory=dict)
    complexity: Callable[[Effect], int] = complexity_of_shape
    plausible: Callable[[Effect], bool] = lambda _: True
    plainer: Callable[[Effect], Effect | None] = nothing_plainer
    sizes: Callable[[Effect, Mechanism], Sizes] = sizes_of
    sentence: Callable[[ReportEntry], str] = unnamed
    same_as: Callable[[Effect, Samples], tuple[str, ...]] = lambda _effect, _samples: ()  # beyond what the scan found
    certain: Callable[[Effect, Drivers], np.ndarray] = lambda _, drivers: np.ones(len(drivers), bool)
    claimed: bool = True
