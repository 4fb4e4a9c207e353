"""Drivers: what an error may depend on, as numbers beside every sample.

A driver has the name that people and reports use: ``position:J``, ``load:J``, ``direction:J``, ``velocity``,
``acceleration:J``, ``time``, ``temperature:F``, ``signal:TOPIC``, ``reading``, ``constant``; ``following:J`` is the
commanded position less the measured one, ``path:J`` how far the joint is ahead of followers with play,
``tip_acceleration_x`` … what the target has along the tip's axes. Others are ways to know a load and are reported as
``load:J``: ``effort:J`` is the torque that the actuator itself reports, ``payload:J`` that of 1 kg at the tip,
``offset_x:J`` … what it changes by for each metre beside the tip, and ``moment:J``, ``weight:J`` or, of 1 kg at the
tip, ``tip_weight:J`` the two components across the axis; ``clock`` is the time of what does not move the arm. A family
may bring more.

Time goes on for as long again as the recording lasted, for a session rarely ends with it; from there it returns to the
recording's end, so that days later nothing is extrapolated. Temperatures go on for as far again as they were seen, for
arms go on warming, and stop there; signals, of which nothing is known, stop at the ends of what was seen. An effect
whose driver a recording lacks altogether is replaced by what it was on average.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from modcal_core.effects.shapes import Shape, brought_kind
from modcal_core.geometry import Array
from modcal_core.measurements import PART, WIDTHS, Samples, is_told, others_by_name, staircase, told_at
from modcal_core.robots import (
    DOWN,
    HeldBehind,
    Inertias,
    Mechanism,
    forward,
    gravity_wrench,
    moved_centres,
    offset_wrench,
    payload_wrench,
)

# --- Payloads of earlier recordings, as differences to the final one


@dataclass(frozen=True)
class Carried:
    """Before each of some moments the load at the tip differed from the one in the end, which the arm's bodies contain.

    until: the moments, rising stamps [s]. mass: by how much, (k,) [kg]; of an arm whose masses nobody knows in units of
    what it carries in the end. moment: the same of mass times place in the tip link, (k, 3) [kg m].
    """

    until: tuple[float, ...]
    mass: Array
    moment: Array

    def at(self, stamps: Array) -> tuple[Array, Array]:
        """Differences of mass (N,) and of mass times place (3, N) at these stamps; none where a stamp is unknown."""
        k = np.searchsorted(np.array(self.until), stamps, side="right")
        mass, moment = np.append(self.mass, 0.0), np.concatenate([self.moment, np.zeros((1, 3))])
        return mass[k], moment[k].T


# --- Where drivers stop: what was recorded of them, beyond which a frozen effect is not continued


@dataclass(frozen=True)
class DriverLimits:
    """watched: first and last stamp [s] of the recording, None where unknown. clock: whether stamps are times; an order
    of rows stands still at its middle. ranges: smallest and largest value of temperatures and signals by name, and of
    those whose lag is undone by name and lag (:func:`undelayed`).
    """

    watched: tuple[float, float] | None = None
    clock: bool = True
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def time(self, stamps: Array) -> Array:
        """The time [s] that effects go by at these stamps (N,): continuous, and never outside what may be continued."""
        stamps = np.asarray(stamps, dtype=float)
        if self.watched is None:
            return stamps
        first, last = self.watched
        if not self.clock:
            return np.full(stamps.shape, 0.5 * (first + last))
        length = last - first
        later = stamps - last
        return np.where(later <= length, np.maximum(stamps, first), last + np.maximum(2.0 * length - later, 0.0))

    def value(self, name: str, lag: float, x: Array) -> Array:
        """Values of a temperature or signal seen through a lag, no further than they may be continued.

        An undone lag goes by a slope, of which another recording may hold any: it has a range of its own.
        """
        if (key := undelayed(name, lag)) not in self.ranges:
            return x
        low, high = self.ranges[key]
        beyond = high - low if name.startswith("temperature:") else 0.0
        return np.clip(x, low - beyond, high + beyond)


def undelayed(name: str, lag: float) -> str:
    """The name under which the range of a signal with a lag is kept: its own, where no lag is undone."""
    return f"{name} with its lag of {-lag:.3g} s undone" if lag < 0.0 else name


_LOADS = ("effort", "payload", "moment", "weight", "tip_weight", "offset_x", "offset_y", "offset_z")
_FEW = 3  # messages that are no course of a sensor; what was told holds from one on
_MAX_POINTS = 20_000  # of a signal; a faster one is thinned
_MAX_KEPT = 96e6  # bytes of drivers and shapes that are kept for one set of samples
_STEP = 0.01  # s between postures whose differences are the tip's acceleration and jerk
_DIFFERENCES = np.array([[0.0, 1.0, -2.0, 1.0, 0.0], [-0.5, 1.0, 0.0, -1.0, 0.5]])  # second and third, central
_SMOOTH = 30.0  # s; a signal's slope is taken over this long, so that its noise does not drown it


@dataclass(frozen=True)
class NominalArm:
    """The nominal arm that loads are computed from. inertias: None where the description states no mass. limits: where
    time, temperatures and signals stop, of a frozen model; None while it is fitted. earlier: what it carried before
    what its inertias contain; None where that did not change. centre: of the mass that a recorded number says is
    carried, in the tip link (3,) [m]; None: at its origin. tool: about where the target is, in the tip link (3,) [m].
    """

    chain: Mechanism
    inertias: Inertias | None = None
    limits: DriverLimits | None = None
    earlier: Carried | None = None
    centre: Array | None = None
    tool: Array | None = None

    @property
    def weighed(self) -> bool:
        """Whether gravity's loads can be computed."""
        return self.inertias is not None and self.inertias.known


def public_driver(driver: str) -> str:
    """The name of a driver in reports."""
    first = driver.partition(",")[0]
    kind, _, rest = first.partition(":")
    if kind == "clock":
        return "time"
    return f"load:{rest}" if kind in _LOADS else first.partition(PART)[0]


class Kept:
    """Cache of arrays by what they are computed from: a fit asks for the same ones at every step."""

    def __init__(self) -> None:
        self._arrays: dict[Hashable, Array] = {}
        self._made: dict[Hashable, tuple[tuple[Any, ...], Any]] = {}
        self._bytes = 0

    def of(self, key: Hashable, compute: Callable[[], Array]) -> Array:
        """The array of a key, not to be written to. All are let go when they have become too many."""
        found = self._arrays.get(key)
        if found is None:
            found = compute()
            self._bytes += found.nbytes
            if self._bytes > _MAX_KEPT:
                self._arrays.clear()
                self._made.clear()
                self._bytes = found.nbytes
            self._arrays[key] = found
        return found

    def made_of(self, parts: tuple[Any, ...], make: Callable[..., Any]) -> Any:
        """What is made of arrays that are kept here, or of what was made of them."""
        key = make, *map(id, parts)
        if key not in self._made:
            self._made[key] = parts, make(*parts)  # the parts themselves stay, so that no other takes their numbers
        return self._made[key][1]

    def made_as(self, name: tuple[Hashable, ...], make: Callable[[], Any]) -> Any:
        """What is made under a name."""
        if name not in self._made:
            self._made[name] = (), make()
        return self._made[name][1]


@dataclass(frozen=True)
class Drivers:
    """Drivers at N samples. A driver that the samples do not carry is zero: the effect is then not applied."""

    samples: Samples
    arm: NominalArm
    kept: Kept = field(default_factory=Kept, compare=False, repr=False)

    def __len__(self) -> int:
        return len(self.samples)

    def values(self, name: str, lag: float = 0.0) -> Array:
        """The driver (N,), or its components (c, N). lag: [s] by which a recorded signal's effect follows it."""
        return self.kept.of(("driver", name, lag), lambda: self._values(name, lag))

    def basis(self, name: str, lag: float, shape: Shape) -> Array:
        """The functions (b, N) of a shape that follows a driver."""
        key = "basis", name, lag, shape.kind, *sorted(shape.settings.items())
        return self.kept.of(key, lambda: shape.basis(self.values(name, lag)))

    def _values(self, name: str, lag: float) -> Array:
        if "," in name:
            return np.stack([self.values(part, lag) for part in name.split(",")])
        kind, _, of = name.partition(":")
        if kind in SIGNALS:
            return self._signal(name, lag)
        if found := KINDS.get(kind) or brought_kind("drivers", kind):
            return np.asarray(found(self, of), dtype=float)
        return self._signal(name, lag)

    def signal_names(self) -> tuple[str, ...]:
        """Recorded signals that cover the samples and change."""
        return tuple(
            track.name
            for track in self.samples.signals
            if len(track.stamps) > 1
            and np.ptp(track.values[:, 0]) > 0.0
            and (len(track.stamps) > _FEW or is_told(track.values[np.argsort(track.stamps), 0]))
        )

    @cached_property
    def gravity(self) -> Array:
        """Weight beyond each joint, (n, 6, N); zero where the arm has not been weighed."""
        chain = self.arm.chain
        if self.arm.inertias is None or not self.arm.weighed:
            return np.zeros((chain.n, 6, len(self)))
        inertias, count = self.arm.inertias, len(self)
        moved = moved_centres(inertias.branches, inertias.mass, self._positions, count) if inertias.branches else None
        own = gravity_wrench(chain, inertias, self.samples.q, moved)
        return own if self.arm.earlier is None else own + self._differing

    @property
    def _positions(self) -> dict[str, Array]:
        """Positions (N,) of the joints that are known, the arm's and others that were recorded, by name."""
        return {**others_by_name(self.samples), **dict(zip(self.samples.names, self.samples.q.T, strict=True))}

    @property
    def _down(self) -> Array:
        return DOWN if self.arm.inertias is None else self.arm.inertias.down

    @property
    def _held(self) -> HeldBehind | None:
        return None if self.arm.inertias is None else self.arm.inertias.held

    @cached_property
    def payload(self) -> Array:
        """Weight of 1 kg at the tip, or at the centre of what is carried where that is known, (n, 6, N)."""
        unit = payload_wrench(self.arm.chain, self.samples.q, self._down, self._held)
        if self.arm.centre is not None:
            unit = unit + np.einsum("d,djcN->jcN", self.arm.centre, self.offset)
        return unit if self.arm.earlier is None or self.arm.weighed else unit + self._differing

    @property
    def _differing(self) -> Array:
        """Wrench of the tip load beyond its final value at each joint, (n, 6, N)."""
        assert self.arm.earlier is not None
        mass, moment = self.arm.earlier.at(self.samples.stamps)
        unit = payload_wrench(self.arm.chain, self.samples.q, self._down, self._held)
        return unit * mass + np.einsum("dN,djcN->jcN", moment, self.offset)

    @cached_property
    def offset(self) -> Array:
        """What the latter changes by for each metre that the mass lies beside the tip, along x, y, z: (3, n, 6, N)."""
        return offset_wrench(self.arm.chain, self.samples.q, self._down, self._held)

    @cached_property
    def tip_motion(self) -> Array:
        """Acceleration and jerk of the target on the nominal arm along the tip's axes, (2, 3, N) [m/s², m/s³]."""
        samples, at = self.samples, np.append(np.zeros(3) if self.arm.tool is None else self.arm.tool, 1.0)
        v, a, j = np.nan_to_num(samples.velocity), samples.mean_acceleration, samples.mean_jerk
        times = _STEP * np.arange(-2.0, 3.0)
        T = [forward(self.arm.chain, samples.q + s * (v + s * (a / 2.0 + s * j / 6.0))) for s in times]
        p = np.stack([(pose @ at)[:, :3] for pose in T])
        change = np.tensordot(_DIFFERENCES / _STEP ** np.array([[2.0], [3.0]]), p, axes=1)
        return np.asarray(np.einsum("nij,kni->kjn", T[2][:, :3, :3], change))

    def _signal(self, name: str, lag: float) -> Array:
        stamps = self.samples.stamps
        for track in self.samples.signals:
            if track.name == name:
                order = np.argsort(track.stamps, kind="stable")
                t, x = track.stamps[order], track.values[order, 0]
                keep = np.r_[True, np.diff(t) > 0.0] & np.isfinite(x)
                t, x = t[keep], x[keep]
                told = not name.startswith("temperature:") and is_told(x)
                if told and lag == 0.0:
                    out = told_at(t, x, stamps, self.samples.moving)
                elif told:
                    step = float(t[-1] - t[0]) / _MAX_POINTS
                    out = delayed(*staircase(t, x, step), lag, stamps, step)
                else:
                    out = delayed(t, x, lag, stamps) if len(t) > 1 else np.full(len(self), x[0] if len(x) else 0.0)
                return out if self.arm.limits is None else self.arm.limits.value(name, lag, out)
        return np.zeros(len(self))


DriverKind = Callable[[Drivers, str], Array]  # of the drivers and of what stands behind the colon, (N,)


def _effort(drivers: Drivers, joint: str) -> Array:
    """Efforts of a joint. Missing ones are replaced by gravity's torque or, for an arm without masses, by the mean of
    the others.
    """
    effort = drivers.samples.effort[:, _column(drivers, joint)]
    known = np.isfinite(effort)
    if known.all():
        return effort
    if drivers.arm.weighed:
        return np.where(known, effort, -_load(drivers, joint))
    return np.where(known, effort, effort[known].mean() if known.any() else 0.0)


def _load(drivers: Drivers, joint: str) -> Array:
    j = _column(drivers, joint)
    return drivers.gravity[j, _along(drivers, j)]


def _offset(drivers: Drivers, joint: str, axis: int) -> Array:
    j = _column(drivers, joint)
    return drivers.offset[axis, j, _along(drivers, j)]


def _of_tip(drivers: Drivers, _: str, row: tuple[int, int]) -> Array:
    return np.asarray(drivers.tip_motion[row])


def _column(drivers: Drivers, joint: str) -> int:
    return drivers.samples.names.index(joint)


def _along(drivers: Drivers, j: int) -> int:
    """The component of a wrench that a joint carries along its axis or about it."""
    return 5 if drivers.arm.chain.revolute[j] else 2


KINDS: Mapping[str, DriverKind] = {
    "constant": lambda at, _: np.ones(len(at)),
    "stamp": lambda at, _: at.samples.stamps,  # of these samples alone, whatever a calibration has seen
    "time": lambda at, _: at.samples.stamps if at.arm.limits is None else at.arm.limits.time(at.samples.stamps),
    "clock": lambda at, _: at.samples.stamps,  # of the readings, whose course is no other recording's
    "velocity": lambda at, _: np.asarray(np.nan_to_num(at.samples.velocity.T)),  # of all joints, (n, N)
    "reading": lambda at, _: np.ones(len(at)),
    "acceleration": lambda at, joint: at.samples.mean_acceleration[:, _column(at, joint)],
    "jerk": lambda at, joint: at.samples.mean_jerk[:, _column(at, joint)],
    **{f"tip_acceleration_{axis}": partial(_of_tip, row=(0, i)) for i, axis in enumerate("xyz")},
    **{f"tip_jerk_{axis}": partial(_of_tip, row=(1, i)) for i, axis in enumerate("xyz")},
    "position": lambda at, joint: at.samples.q[:, _column(at, joint)],
    "direction": lambda at, joint: at.samples.approach[:, _column(at, joint)],
    # of followers with play, at the least and at the most, as shares of their widths, (2 widths, N)
    "path": lambda at, joint: (at.samples.path[:, _column(at, joint)] / WIDTHS).reshape(len(at), -1).T,
    "following": lambda at, joint: np.asarray(np.nan_to_num(at.samples.following[:, _column(at, joint)])),
    "load": _load,
    "effort": _effort,
    "payload": lambda at, joint: at.payload[(j := _column(at, joint)), _along(at, j)],
    "offset_x": partial(_offset, axis=0),
    "offset_y": partial(_offset, axis=1),
    "offset_z": partial(_offset, axis=2),
    "moment": lambda at, joint: at.gravity[_column(at, joint), 3:5],  # across the joint's axis, (2, N)
    "weight": lambda at, joint: at.gravity[_column(at, joint), 3:5],
    "tip_weight": lambda at, joint: at.payload[_column(at, joint), 3:5],
}
SIGNALS = ("temperature", "signal")  # kinds that are found among the recorded tracks, by their whole name


def delayed(t: Array, x: Array, lag: float, at: Array, step: float = np.inf) -> Array:
    """A signal as seen through a first-order lag, at stamps ``at``, held before its first value and after its last.

    t: rising stamps (m,) [s]. x: values (m,). lag: [s]; a negative one undoes that of a slow sensor. step: [s] between
    points of the grid, at most; by default the usual one between stamps.
    """
    step = max(min(float(np.median(np.diff(t))), step), float(t[-1] - t[0]) / _MAX_POINTS)
    grid = np.arange(t[0], t[-1] + step, step)
    even = np.interp(grid, t, x)
    if lag > 0.0:
        even = _smoothed(even - even[0], float(np.exp(-step / lag))) + even[0]
    elif lag < 0.0:
        even = even - lag * _slope(grid, even)
    return np.asarray(np.interp(at, grid, even))


def _smoothed(x: Array, keep: float) -> Array:
    """The y with ``y_n = keep · y_n−1 + (1 − keep) x_n``, from rest: a triangular system with two diagonals.

    What SciPy has for it lies in a package that takes half a second to load.
    """
    from scipy.linalg.lapack import dtbtrs  # only lagging drivers need it

    bands = np.stack([np.ones(len(x)), np.full(len(x), -keep)])
    y, failed = dtbtrs(bands, (1.0 - keep) * x, uplo="L", diag="U")
    assert not failed
    return np.asarray(y).ravel()


def _slope(t: Array, x: Array) -> Array:
    """Slope of a noisy signal: that of the line fitted to the stretch around each point."""
    half = 0.5 * _SMOOTH
    u, y = t - t.mean(), x - x.mean()
    sums = [np.concatenate([[0.0], np.cumsum(v)]) for v in (np.ones_like(u), u, y, u * u, u * y)]
    first, last = np.searchsorted(t, t - half), np.searchsorted(t, t + half, side="right")
    n, st, sx, stt, stx = (s[last] - s[first] for s in sums)
    width = n * stt - st * st
    return np.where(width > 1e-9, (n * stx - st * sx) / np.maximum(width, 1e-9), 0.0)
