"""The two rods of a Delta's parallelogram that differ in length: the platform tilts, and differently everywhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import PAIRS, Effect
from modcal_core.effects.family import PLAIN, Family, ReportEntry
from modcal_core.effects.shapes import Setting, Settings, Shape, ShapeKind
from modcal_core.effects.sizes import Sizes, settings_of, value
from modcal_core.geometry import Array
from modcal_core.robots import ARMS, Mechanism, is_delta

NAME = "parallelogram"
_RADIUS = 0.05  # m; by how much a platform's radius may be other than stated, or than nothing
_LEVER = 0.15  # m; how far the tool may be from where a level platform leaves it open, to which the tilt is a lever
_GUESSES = ((0, 0, 0), (0, 0, 1), (1, 1, 1))  # coordinates of the drawing's tool that the fit may have left at nothing

_SETTINGS = {
    "radius": Setting(_RADIUS, "m", "platform_radius"),
    **{axis: Setting(_LEVER, "m", f"lever_{axis}") for axis in "xyz"},
}


def pairs(x: Array, _: Settings) -> Array:
    """One for each arm."""
    return np.tile(x, (ARMS, 1))


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """The rods of all three arms together: one pair alone turns the platform against the two others."""
    chain = drivers.arm.chain
    if is_delta(chain):
        known = {"radius": chain.platform_radius, "known_radius": chain.platform_radius}
        for guess in dict.fromkeys(tuple(np.asarray(g) * chain.tool[:3]) for g in _GUESSES):
            lever = dict(zip("xyz", map(float, guess), strict=True))
            yield Effect(NAME, "tool", PAIRS, "constant", Shape("pairs", {**known, **lever}))


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """By how much the rods of each arm differ, per spacing, and the platform's radius."""
    each = {f"rods_{name}": value(effect, i, 1.0, "rad") for i, name in enumerate(chain.names[:ARMS])}
    return {**each, **settings_of(effect)}


def sentence(entry: ReportEntry) -> str:
    """What differs, arm by arm."""
    arms = [(name.removeprefix("rods_"), size) for name, size in entry.sizes.items() if name.startswith("rods_")]
    said = ", ".join(f"{arm} {1e3 * v:.2f} ± {1e3 * std:.2f} mm" for arm, (v, std, _) in arms)
    return f"the two rods of a parallelogram differ, per metre of their spacing by {said}: the platform tilts"


FAMILY = Family(
    NAME,
    candidates,
    shapes={"pairs": ShapeKind(pairs, ARMS, _SETTINGS)},
    complexity=lambda _: PLAIN,
    sizes=sizes,
    sentence=sentence,
)
