"""What holds furniture back beside dry friction, damping and a spring: closers, magnets, gaskets, detents and the like.

Each law is a force at the handle, so that it means the same for a door of any width. It acts on the object's joint,
where MuJoCo integrates it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from modcal_core.errors import BadTable

_AT_REST = 2e-3  # m/s of the handle: below it, dry friction is as if it stood
_ENGAGES = 1e-3  # m: a preload does not act through a closed stop
_CREEPS = 0.05  # m/s up to which what sticks does more than what slides, roughly

Law = Callable[[float, float], float]


@dataclass(frozen=True)
class Resistance:
    """force: at the handle [N], which closes where it is positive, at way [m] and speed [m/s] of the handle.

    size: what it is at most, pulled slowly [N].
    """

    name: str
    size: float
    force: Law


def closer(size: float, damping: float = 40.0) -> Resistance:
    """A door closer: a preload that hardly rises, and oil."""
    return Resistance("closer", size, lambda s, v: size * min(max(s, 0.0) / _ENGAGES, 1.0) + damping * v)


def magnet(size: float, reach: float = 4e-3) -> Resistance:
    """Holds a closed front, and lets it go after some millimetres."""
    return Resistance("magnet", size, lambda s, v: size * max(1.0 - max(s, 0.0) / reach, 0.0) ** 2)


def gasket(size: float, reach: float = 12e-3) -> Resistance:
    """A magnetic seal that is peeled off over a centimetre or two, with some oil in it."""
    return Resistance("gasket", size, lambda s, v: size * math.exp(-max(s, 0.0) / reach) + 10.0 * v)


def stick_slip(size: float, slides: float = 0.4) -> Resistance:
    """Friction that is less, by a share, once it slides."""

    def force(s: float, v: float) -> float:
        dry = size * (slides + (1.0 - slides) * math.exp(-((v / _CREEPS) ** 2)))
        return dry * math.tanh(v / _AT_REST)

    return Resistance("stick_slip", size, force)


def detents(size: float, apart: float = 0.05) -> Resistance:
    """Balls that drop into notches, so far [m] apart."""
    return Resistance("detents", size, lambda s, v: size * math.sin(2.0 * math.pi * max(s, 0.0) / apart))


def over_centre(size: float, at: float = 0.12) -> Resistance:
    """A spring that closes up to some way [m], and opens beyond it."""

    def force(s: float, v: float) -> float:
        return size * min(max(s, 0.0) / (0.15 * at), 1.0) * max(1.0 - max(s, 0.0) / at, -0.6) + 15.0 * v

    return Resistance("over_centre", size, force)


def soft_end(size: float, begins: float = 0.15) -> Resistance:
    """A damper and a spring that come in over the last part of the way."""
    return Resistance(
        "soft_end", size, lambda s, v: min(max(s - begins, 0.0) / 0.05, 1.0) * size + (60.0 * v if s > begins else 0.0)
    )


KNOWN: dict[str, Callable[[float], Resistance]] = {
    law.__name__: law for law in (closer, magnet, gasket, stick_slip, detents, over_centre, soft_end)
}


def resistance(text: str) -> Resistance | None:
    """Resistance from its name and force [N], such as ``closer 25``; None for an empty text. Raises BadTable."""
    if not text.strip():
        return None
    name, _, size = text.strip().partition(" ")
    try:
        force = float(size)
    except ValueError:
        force = math.nan
    if name not in KNOWN or not 0.0 < force <= 500.0:
        raise BadTable(
            f"resistance '{text}'", f"is not one of {', '.join(KNOWN)} and a force", "write it as: closer 25"
        )
    return KNOWN[name](force)
