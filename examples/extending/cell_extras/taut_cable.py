"""A family of effects: a cable along the arm hangs loose until a joint has turned so far, and from there on pulls.

place: the joint. direction: about its axis. driver: its own position. shape: nothing up to ``slack``, then a straight
line. Its amplitude is the turn that the pull makes, in rad per rad beyond ``slack``; ``slack`` is fitted with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from modcal_core.effects import AXIS, Drivers, Effect, Family, ReportEntry, Setting, Shape, ShapeKind

_ROUNDING = 0.02  # rad; a cable does not become taut within nothing, and what is fitted must be smooth


def taut(x: NDArray[np.float64], settings: Mapping[str, float]) -> NDArray[np.float64]:
    """The function (1, N) of joint positions x (N,) [rad]: how far beyond where the cable becomes taut."""
    beyond = x - settings["slack"]
    return 0.5 * (beyond + np.sqrt(beyond**2 + _ROUNDING**2))[None]


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint, with the cable becoming taut somewhere in the inner part of what it has moved through."""
    for j, name in enumerate(drivers.arm.chain.names):
        low, high = np.percentile(drivers.samples.q[:, j], [20.0, 80.0])
        for slack in np.linspace(low, high, 7) if high - low > 0.2 else ():
            yield Effect("taut_cable", name, AXIS, f"position:{name}", Shape("taut", {"slack": float(slack)}))


def sentence(entry: ReportEntry) -> str:
    """What a technician should know of it."""
    return f"{entry.place} is pulled at by a cable that becomes taut"


FAMILY = Family(
    "taut_cable",
    candidates,
    shapes={"taut": ShapeKind(taut, refined={"slack": Setting(expected=0.5, unit="rad")})},
    sentence=sentence,
)
