"""What a family of effects is: all that tells one kind of error from another, as data and functions.

Everything else in modcal treats all effects alike and asks the family of one where they differ; nothing asks for a
family's name. A built-in family is a file in ``effects/families`` that names it ``FAMILY``; a package's is named by
an entry point (:mod:`sources`). Apart from where they lie the two are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from modcal_core.effects.drivers import DriverKind, Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.entry import ReportEntry, unnamed
from modcal_core.effects.shapes import ShapeKind
from modcal_core.effects.sizes import Sizes, sizes_of
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism

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


def always(_: Effect) -> bool:
    """Whatever its amplitudes."""
    return True


def nothing_plainer(_: Effect) -> Effect | None:
    """The effect is as plain as it can be."""
    return None


def nothing_else(_effect: Effect, _samples: Samples) -> tuple[str, ...]:
    """Nothing beyond what the scan itself found to explain as much."""
    return ()


def everywhere(_: Effect, drivers: Drivers) -> np.ndarray:
    """At all samples, (N,)."""
    return np.ones(len(drivers), bool)


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
    plausible: Callable[[Effect], bool] = always
    plainer: Callable[[Effect], Effect | None] = nothing_plainer
    sizes: Callable[[Effect, Mechanism], Sizes] = sizes_of
    sentence: Callable[[ReportEntry], str] = unnamed
    same_as: Callable[[Effect, Samples], tuple[str, ...]] = nothing_else
    certain: Callable[[Effect, Drivers], np.ndarray] = everywhere
    claimed: bool = True
