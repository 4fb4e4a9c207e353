"""Where the simulated arm is going: smooth travel between postures, with time to stand still.

On a fifth-order leg of duration T speeds scale with 1/T, and torques are g(q) + d(s) / T² with d the torque of the same
leg in one second less gravity's, so the shortest allowed T follows from a few places s, with no search.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array
from modcal_core.planning import with_returns
from modcal_core.robots import (
    Chain,
    Drives,
    Mechanism,
    Payload,
    bias_torque,
    passable,
    read_drives,
    read_inertias,
    torque,
    with_payload,
)
from modcal_msgs_py import seconds

_TRIALS = 1000  # postures that are drawn for one that a Delta can go to
_BRAKE = 0.25  # s in which an arm that is sent elsewhere loses the speed it had


class Program:
    """Postures to pass, each by a certain time, in between on a fifth-order course that starts and ends at rest.

    A program that replaces another while the arm moves takes over its velocity and lets it fade within a quarter of a
    second, also on a fifth-order course, so neither position nor velocity jump.
    """

    def __init__(self, start: Array) -> None:
        """Stand at a posture (n,) from the beginning."""
        self._times = [0.0]
        self._postures = [np.array(start, dtype=float)]
        self._begun, self._brake = 0.0, _BRAKE
        self._carried = np.zeros_like(self._postures[0])

    def reset(self, now: float, legs: Sequence[tuple[float, Array]]) -> None:
        """Forget the rest; from now on be at each posture (n,) by its time [s], in order."""
        here, carried = self.state(now)
        self._times = [now, *(t for t, _ in legs)]
        self._postures = [here, *(np.array(q, dtype=float) for _, q in legs)]
        self._begun, self._carried = now, carried
        self._brake = min(_BRAKE, self._times[1] - now) if legs else _BRAKE

    def extend(self, legs: Sequence[tuple[float, Array]], done: float) -> None:
        """Add legs behind the last one, and forget those that lie before a time [s] that nobody asks for again."""
        past = max(bisect_right(self._times, done) - 1, 0)
        self._times = [*self._times[past:], *(t for t, _ in legs)]
        self._postures = [*self._postures[past:], *(np.array(q, dtype=float) for _, q in legs)]

    @property
    def end(self) -> float:
        """When the last posture is reached [s]."""
        return self._times[-1]

    def at(self, now: float) -> Array:
        """The posture (n,) at a time [s]."""
        return self.state(now)[0]

    def state(self, now: float) -> tuple[Array, Array]:
        """The posture (n,) at a time [s], and its derivative (n,) [1/s]."""
        i = bisect_right(self._times, now)
        if i == 0:
            return self._postures[0], self._carried
        if i == len(self._times):
            q, v = self._postures[-1], np.zeros_like(self._carried)
        else:
            span = self._times[i] - self._times[i - 1]
            share = (now - self._times[i - 1]) / span
            way = self._postures[i] - self._postures[i - 1]
            q = self._postures[i - 1] + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * way
            v = (30.0 / span) * (share * (1.0 - share)) ** 2 * way
        if (share := (now - self._begun) / self._brake) < 1.0 and self._carried.any():
            # zero at both ends, slope 1 at the first, no curvature at either
            q = q + self._brake * (share - share**3 * (6.0 - 8.0 * share + 3.0 * share**2)) * self._carried
            v = v + (1.0 - share**2 * (18.0 - 32.0 * share + 15.0 * share**2)) * self._carried
        return q, v


def tour(
    chain: Mechanism, count: int, travel: float, dwell: float, rng: np.random.Generator, returns: int = 0
) -> list[tuple[float, Array]]:
    """Legs that visit random postures (travel, then stand still), for :meth:`Program.reset` at time zero.

    returns: how many of the postures are visited a second time on the way, see :func:`with_returns`.
    """
    span = np.where(chain.revolute, 1.2, 0.3)
    low, high = np.maximum(chain.lower, -span), np.minimum(chain.upper, span)
    middle = np.clip(0.0, chain.lower, chain.upper)
    postures: list[Array] = []
    last = middle
    for _ in range(count):
        for _ in range(_TRIALS):
            q = np.where(low < high, rng.uniform(np.minimum(low, high), np.maximum(low, high)), middle)
            if passable(chain, last, q):
                break
        else:
            q = last
        last = q
        postures.append(q)
    order = with_returns(np.array(postures), returns, partial(passable, chain)).order
    legs: list[tuple[float, Array]] = []
    for k, station in enumerate(order):
        arrive = k * (travel + dwell) + travel
        legs += [(arrive, postures[station]), (arrive + dwell, postures[station])]
    return legs


def legs(chain: Mechanism, trajectory: JointTrajectory, start: Array | None = None) -> list[tuple[float, Array]]:
    """Seconds after the start, and postures (n,) in the chain's order; velocities and efforts are not read.

    start: where the arm is, (n,), where it matters. Raises BadCommand for joints that are not the chain's, positions
    that are none, times that do not rise, points outside the limits, and ways on which a Delta's platform fits no more.
    """
    names = tuple(trajectory.joint_names)
    moved = chain.own_names
    if sorted(names) not in (sorted(chain.names), sorted(moved)):
        raise BadCommand(f"joint_trajectory names {', '.join(names)}", f"this arm has {', '.join(moved)}", "name these")
    order = [names.index(name) for name in moved]
    out: list[tuple[float, Array]] = []
    last = 0.0
    for k, point in enumerate(trajectory.points):
        after = seconds(point.time_from_start)
        q = np.array(point.positions, dtype=float)
        offender = f"joint_trajectory: point {k}"
        if len(q) != len(names) or not np.isfinite(q).all():
            raise BadCommand(offender, "has wrong positions", f"give {len(names)} finite numbers")
        if after <= last:
            raise BadCommand(offender, "is not later than the one before", "make times increase from above zero")
        posture = np.zeros(chain.n)
        posture[chain.own] = q[order]
        q = chain.followed(posture)
        if (q < chain.lower).any() or (q > chain.upper).any():
            raise BadCommand(offender, "lies outside the joint limits", "stay within them")
        if start is not None and not passable(chain, start, q):
            raise BadCommand(
                offender, "the platform of the Delta does not fit along the whole path", "choose another path"
            )
        out.append((after, q))
        last, start = after, q
    return out


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
