"""A joint that errs by how it arrived and how far it had gone before: cables, harmonic drives, hoses.

The error is a sum of followers with play (Prandtl–Ishlinskii). How large each is goes by a gamma density of the way on
which it changes sides: its mean is twice the scale, its order the knee. With a knee of 2 the error goes over to the
other side as 1 − exp(−x / scale) of the way x, as friction on a spring does (Dahl 1968); with more, straighter and then
at once. Backlash is the same with no scale at all, and the plainer name where a recording
does not tell one from the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.registry import both_signs, moving_joints
from modcal_core.effects.shapes import Setting, Settings, Shape, ShapeKind
from modcal_core.effects.sizes import Sizes, unit_of, value
from modcal_core.geometry import Array
from modcal_core.measurements import WIDTHS
from modcal_core.robots import Mechanism

NAME = "hysteresis"
SCALES = (0.06, 0.15, 0.4, 1.0)  # rad or m
_LEAST = 0.01  # rad or m; below, hardly a station is on the way from one side to the other
_UNSURE = 0.05  # of the error from the middle to a side, by which its beginning may tell
# between the ways on which followers change sides, twice their widths
_BETWEEN = 2.0 * np.sqrt(WIDTHS[1:] * WIDTHS[:-1])


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that turned back, for some scales."""
    for _, name in moving_joints(drivers):
        for scale in SCALES:
            shape = Shape(NAME, {"scale": scale, "knee": 2.0})
            if both_signs(drivers.basis(f"path:{name}", 0.0, shape)[0]):
                yield Effect(NAME, name, AXIS, f"path:{name}", shape)


def saturating(x: Array, s: Settings) -> Array:
    """From followers' shares of their widths (2 widths, N) the error between its sides, −1 … 1, as (1, N)."""
    return np.asarray(0.5 * _ends(x, s).sum(axis=0, keepdims=True))


def _ends(x: Array, s: Settings) -> Array:
    """The error at the least and at the most, (2, N)."""
    return np.asarray(_shares(s["knee"], s["scale"]) @ x.reshape(2, len(WIDTHS), -1))


@lru_cache(maxsize=64)  # the same at every tick of a corrector
def _shares(knee: float, scale: float) -> Array:
    """How large the follower of each width is, (widths,); together 1."""
    from scipy.special import gammainc  # half a second to load, where no joint has a hysteresis

    return np.diff(np.r_[0.0, gammainc(knee, 0.5 * knee * _BETWEEN / scale), 1.0])


def certain(effect: Effect, drivers: Drivers) -> np.ndarray:
    """False as long as the error depends on what the joint did before anything was recorded."""
    least, most = _ends(drivers.values(effect.driver), effect.shape.settings)
    return np.asarray(most - least < _UNSURE)


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """From side to side, and the way after which 1 − 1/e of it is made up."""
    unit = unit_of(effect, chain)
    size, std, _ = value(effect, 0, 2.0)
    return {"width": (abs(size), std, unit), "scale": value(effect, 1, 1.0, unit)}


def sentence(entry: ReportEntry) -> str:
    """The width, and on which way it is made up."""
    scale, _, unit = entry.sizes["scale"]
    return (
        f"{entry.place} has {entry.thousandths('width')} of hysteresis, which it makes up over some {scale:.2g} {unit} "
        "after turning back"
    )


FAMILY = Family(
    NAME,
    candidates,
    shapes={NAME: ShapeKind(saturating, refined={"scale": Setting(least=_LEAST), "knee": Setting(2.0, least=1.0)})},
    sizes=sizes,
    sentence=sentence,
    certain=certain,
)
