"""Travel slowed down to what an arm's drives can do: the speeds and efforts that its URDF states.

On a fifth-order leg of duration T speeds scale with 1/T, and torques are g(q) + d(s) / T² with d the torque of the same
leg in one second less gravity's, so the shortest allowed T follows from a few places s, with no search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import ModcalError
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.dynamics import bias_torque, torque
from modcal_core.robots.inertia import Payload, with_payload
from modcal_core.robots.urdf_drives import Drives, read_drives
from modcal_core.robots.urdf_inertias import read_inertias

_PLACES = np.linspace(0.0, 1.0, 17)  # of a leg; between two of them a quintic's acceleration changes by a tenth
_PEAK = 1.875  # of a quintic's speed, times its mean
_MARGIN = 0.95  # of speed and effort that is used: places are looked at, and the true arm is not the nominal one

Legs = Sequence[tuple[float, Array]]


@dataclass(frozen=True)
class Slowed:
    """legs: with later times. overloads: a sentence for each joint that cannot hold the arm on the way."""

    legs: list[tuple[float, Array]]
    overloads: tuple[str, ...]


def within_limits(legs: Legs, first: Array, urdf_xml: str, chain: Chain, payload: float = 0.0) -> Slowed:
    """The legs from a posture (n,), each long enough for the drives that the URDF states; others are left as they are.

    legs: (time by which to be there [s], posture (n,)), stands being legs that go nowhere. payload: at the tip [kg].
    """
    times = np.array([0.0, *(t for t, _ in legs)])
    postures = np.array([first, *(q for _, q in legs)])
    start, way = postures[:-1], np.diff(postures, axis=0)
    spans = np.diff(times)
    try:
        drives = read_drives(urdf_xml, chain)
    except ModcalError:  # numbers that are none: nothing is known of the drives
        return Slowed(list(legs), ())
    moves = np.abs(way).max(axis=1) > 0.0
    needed = np.where(moves, _PEAK * (np.abs(way) / (_MARGIN * drives.speed)).max(axis=1), 0.0)
    spans = np.maximum(spans, needed)
    by_effort, overloads = _by_effort(start[moves], way[moves], spans[moves], urdf_xml, chain, drives, payload)
    spans[moves] = np.maximum(spans[moves], by_effort)
    return Slowed(list(zip(np.cumsum(spans).tolist(), postures[1:], strict=True)), overloads)


def _by_effort(
    start: Array, way: Array, spans: Array, urdf_xml: str, chain: Chain, drives: Drives, payload: float
) -> tuple[Array, tuple[str, ...]]:
    """The least duration of each leg (m,) [s] by the drives' efforts, and what they cannot hold."""
    inertias = read_inertias(urdf_xml, chain)
    if not len(way) or not inertias.known or not np.isfinite(drives.torque).any():
        return np.zeros(len(way)), ()
    loaded = with_payload(inertias, chain, Payload.checked(payload, (0.0, 0.0, 0.0), (0.0,) * 6))
    s = _PLACES[:, None]
    share, speed, bend = s**3 * (10 - 15 * s + 6 * s**2), 30 * (s * (1 - s)) ** 2, 60 * s * (1 - s) * (1 - 2 * s)
    q, v, a = ((base + shape * way[:, None]).reshape(-1, chain.n) for base, shape in (
        (start[:, None], share), (0.0, speed), (0.0, bend)
    ))  # fmt: skip
    weight = bias_torque(chain, loaded, q, np.zeros_like(v))
    moving = torque(chain, loaded, q, v, a) - weight
    friction = drives.coulomb + drives.viscous * np.abs(v) / np.repeat(spans, len(_PLACES))[:, None]
    room = np.where(np.isfinite(drives.torque), _MARGIN * drives.torque, np.inf) - friction
    left = room - np.sign(moving) * weight  # what the drive has for moving, in the direction of it
    held = np.abs(weight) <= room
    squared = np.where(held & (left > 0.0), np.abs(moving) / np.maximum(left, 1e-9), 0.0)
    needed = np.sqrt(squared.max(axis=1).reshape(len(way), -1).max(axis=1))
    worst = (np.abs(weight) / drives.torque).max(axis=0)
    fits: list[bool] = np.all(held, axis=0).tolist()
    overloads = tuple(
        f"{name}: gravity takes {share:.0%} of its effort of {most:g} on the way, which no motion can help."
        for name, share, most, fine in zip(chain.names, worst, drives.torque, fits, strict=True)
        if not fine
    )
    return needed, overloads
