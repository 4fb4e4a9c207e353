"""How an effect follows its driver: a few functions of one number, linear in their amplitudes.

A shape has settings that are not linear (cycles a turn, the time of a step, a time constant). They are found by
scanning; those that its kind calls *refined* are then fitted together with everything else. :data:`KINDS` has the kinds
that families share; a family may bring more.

Both are read here, without knowing what a family is; :mod:`modcal_core.effects.registry` says what may be one. A
package says

    [project.entry-points."modcal.effects"]
    taut_cable = "my_package.taut_cable:FAMILY"
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from modcal_core.effects import families
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import added

# --- Where families come from: the files of ``effects/families``, and what installed packages name as entry points

GROUP = "modcal.effects"


@cache
def brought() -> tuple[tuple[str, Any], ...]:
    """(how to call it in a message to people, what it names), built-in families first.

    Raises BadTable where a package cannot be loaded.
    """
    names = [module.name for module in pkgutil.iter_modules(families.__path__)]
    order = {name: k for k, name in enumerate(families.ORDER)}
    names.sort(key=lambda name: (order.get(name, len(order)), name))
    files = [(f"effects/families/{name}.py", import_module(f"{families.__name__}.{name}").FAMILY) for name in names]
    return (*files, *added(GROUP))


def brought_kind(what: str, name: str) -> Any:
    """The kind of this name among the shapes, or drivers, that a family brings; None where none does."""
    found = (getattr(source, what, {}).get(name) for _, source in brought())
    return next((kind for kind in found if kind is not None), None)


Settings = Mapping[str, float]
SPLINE_DEGREE = 3  # continuous curvature, which is what a smooth cause has
PERIODIC = ("sine", "turn", "double")
SLOWEST = 240.0  # s; time constant of the slowest sensor whose lag is undone: glued to the outside of a casting
WHOLE_CYCLES = 3  # up to here an error repeats a whole number of times a turn: encoders, eccentric gears
_FINE = 32  # of a long list of cycles, that are products of one wave with few others


@dataclass(frozen=True)
class Setting:
    """A number of a shape. expected: how far a refined one may lie from where the scan found it before its prior minds
    (a standard deviation); None for half of its value. unit, name: as in reports, "" for the setting's own name. least:
    what a refined one cannot be below.
    """

    expected: float | None = None
    unit: str = "1"
    name: str = ""
    least: float = -np.inf


@dataclass(frozen=True)
class ShapeKind:
    """One way to follow a driver.

    basis(x, settings): its functions (size, N) at drivers x (N,), or (c, N) where the driver names c separated by
    commas. size: how many functions, or how to tell from the settings. refined: the settings that are fitted, by name;
    basis must be smooth in them. fixed: settings that stay where the scan found them and that reports show. slopes: by
    refined setting, the change of the functions per unit of it (size, N), given drivers, settings and functions; where
    none is known, differences are taken.
    """

    basis: Callable[[Array, Settings], Array]
    size: int | Callable[[Settings], int] = 1
    refined: Mapping[str, Setting] = field(default_factory=dict)
    fixed: Mapping[str, Setting] = field(default_factory=dict)
    slopes: Mapping[str, Callable[[Array, Settings, Array], Array]] = field(default_factory=dict)


@dataclass(frozen=True)
class Shape:
    """kind: one of :data:`KINDS`, or one that a family brings. settings: by name."""

    kind: str
    settings: Settings = field(default_factory=dict)

    @property
    def of_kind(self) -> ShapeKind:
        """What is known of its kind. Raises BadTable for a kind that nobody knows."""
        found = KINDS.get(self.kind) or brought_kind("shapes", self.kind)
        if found is None:
            raise BadTable(f"shape {self.kind}", "is not known", "install the package that provides it")
        return found

    @property
    def size(self) -> int:
        """Number of basis functions."""
        size = self.of_kind.size
        return size if isinstance(size, int) else size(self.settings)

    @property
    def refined(self) -> tuple[str, ...]:
        """Names of the settings that are fitted with the amplitudes."""
        return tuple(self.of_kind.refined)

    @property
    def is_free(self) -> bool:
        """Whether it is a curve that takes nearly any course, rather than the law of one cause."""
        return self.kind in FREE

    def expected(self, name: str) -> float:
        """Prior standard deviation of a refined setting about its value from the scan."""
        stated = self.of_kind.refined[name].expected
        return max(0.5 * abs(self.settings[name]), 1e-3) if stated is None else stated

    def with_settings(self, settings: Settings) -> Shape:
        """The same kind of shape with some settings changed, none below the least that it can be."""
        changed = {**self.settings, **settings}
        for name, own in self.of_kind.refined.items():
            if name in changed:
                changed[name] = max(changed[name], own.least)
        return Shape(self.kind, changed)

    def basis(self, x: Array) -> Array:
        """Basis functions (b, N) at drivers x (N,), or (c, N) for a kind that follows c drivers.

        Raises BadTable when those of a kind that is not built in are not that, or not finite.
        """
        kind = self.of_kind
        if self.kind in KINDS:
            return kind.basis(x, self.settings)
        out = np.asarray(kind.basis(x, self.settings), dtype=float)
        wanted = (self.size, x.shape[-1])
        if out.shape != wanted or not np.isfinite(out).all():
            limit = f"is {out.shape}, not {wanted}" if out.shape != wanted else "is not finite"
            raise BadTable(f"shape {self.kind} at {dict(self.settings)}", limit, "fix the package that provides it")
        return out


def hardening(x: Array, s: Settings) -> Array:
    """The y with y + beta y³ = x / scale, as a spring deflects that gets stiffer."""
    straight, beta = x / s["scale"], s["beta"]
    if beta < 1e-6:  # and as its expansion goes on below none, smooth in beta
        return np.asarray((straight - beta * straight**3)[None])
    root = np.sqrt(3.0 * beta)
    return np.asarray((2.0 / root * np.sinh(np.arcsinh(1.5 * root * straight) / 3.0))[None])


def settle(x: Array, s: Settings) -> Array:
    """exp(−(x − since) / tau)."""
    return np.asarray(np.exp(-np.clip((x - s["since"]) / max(s["tau"], 1e-9), -50.0, 700.0))[None])


def polynomial(x: Array, s: Settings) -> Array:
    """Powers to ``degree`` of x scaled to ±1 over ``low`` … ``high`` and held outside."""
    u = np.clip((2.0 * x - s["low"] - s["high"]) / max(s["high"] - s["low"], 1e-12), -1.0, 1.0)
    return np.stack([u ** (k + 1) for k in range(int(s["degree"]))])


def near_functions(x: Array, low: Array | float, step: Array | float, count: Array | float) -> tuple[Array, Array]:
    """Cubic B-splines, the k-th about ``low + (k - 1) step``: number of the first of the four that are not zero at x,
    like x, and the four values, (4, *x.shape). Those before 0 and from ``count`` on do not exist. NaN gives NaN.
    """
    # counted in knots from the first centre; beyond the last knot every function is zero: nothing is claimed where
    # nothing was seen
    at = np.clip((x - low) / step + 1.0, -3.0, count + 2.0)
    unknown = np.isnan(at)
    at = np.where(unknown, 0.0, at)
    knot = np.floor(at)
    u = np.where(unknown, np.nan, at - knot)
    v = 1.0 - u
    near = (v**2 * v / 6.0, 2.0 / 3.0 - u**2 * (1.0 - 0.5 * u), 2.0 / 3.0 - v**2 * (1.0 - 0.5 * v), u**2 * u / 6.0)
    return knot.astype(int) - 1, np.stack(near)


def splines(x: Array, s: Settings) -> Array:
    """``count`` cubic B-splines between ``low`` and ``high``, fading to nothing outside."""
    count, low, high = int(s["count"]), s["low"], s["high"]
    first, near = near_functions(x, low, (high - low) / (count - SPLINE_DEGREE), float(count))
    # only the four functions about a driver are not zero there
    out = np.zeros((count + 10, len(x)))
    column = np.arange(len(x))
    for i, value in enumerate(near):
        out[first + (5 + i), column] = value
    out[:, np.isnan(x)] = np.nan
    return out[5 : count + 5]


def waves(x: Array, s: Settings) -> Array:
    """Sines and cosines of all sums of up to ``order`` turns of either of two drivers."""
    order = int(s["order"])
    turns = [(a, b) for a in range(order + 1) for b in range(-order, order + 1) if a > 0 or b > 0]
    phase = np.stack([a * x[0] + b * x[1] for a, b in turns])
    return np.concatenate([np.sin(phase), np.cos(phase)])


def periodic(kind: str, cycles: Array, x: Array) -> Array:
    """Basis functions (C, b, N) of shapes of a PERIODIC kind with these cycles a turn (C,), at drivers x (N,)."""
    turn = _turns(cycles, x)
    parts = (turn, turn * turn) if kind == "double" else (turn,)
    out = np.empty((len(cycles), 2 * len(parts), len(x)))
    for i, part in enumerate(parts):
        out[:, 2 * i], out[:, 2 * i + 1] = part.imag, part.real
    return out


def _turns(cycles: Array, x: Array) -> Array:
    """``exp(i c x)`` for cycles c (C,) at x (N,), (C, N); evenly spaced ones, as a scan has, by products of few."""
    step = (cycles[-1] - cycles[0]) / max(len(cycles) - 1, 1)
    if len(cycles) < 2 * _FINE or np.abs(cycles - cycles[0] - step * np.arange(len(cycles))).max() > 1e-9 * step:
        return np.asarray(np.exp(1j * cycles[:, None] * x))
    fine = np.exp(1j * (step * np.arange(_FINE))[:, None] * x)
    coarse = np.exp(1j * cycles[::_FINE, None] * x)
    return np.asarray((coarse[:, None] * fine).reshape(-1, len(x))[: len(cycles)])


def _of_cycles(kind: str, size: int, *, refined: bool) -> ShapeKind:
    """sin and cos of ``cycles`` a turn, a number that stays or one that is fitted; of 4 functions twice as many too."""
    cycles = {"cycles": Setting(0.5, name="cycles_per_turn")}

    def basis(x: Array, s: Settings) -> Array:
        return np.asarray(periodic(kind, np.array([s["cycles"]]), x)[0])

    def by_cycles(x: Array, _: Settings, functions: Array) -> Array:
        # of sin and cos of m c x: m x cos and - m x sin
        out = functions.reshape(-1, 2, len(x))[:, ::-1] * x
        out *= np.arange(1, len(out) + 1)[:, None, None]
        out[:, 1] *= -1.0
        return np.asarray(out.reshape(functions.shape))

    if not refined:
        return ShapeKind(basis, size, fixed=cycles)
    return ShapeKind(basis, size, refined=cycles, slopes={"cycles": by_cycles})


_AT, _SINCE = {"at": Setting(unit="s")}, {"since": Setting(unit="s")}
KINDS: Mapping[str, ShapeKind] = {
    "linear": ShapeKind(lambda x, _: x[None]),
    # a signal that was delayed by the setting already
    "lagged": ShapeKind(lambda x, _: x[None], refined={"lag": Setting(unit="s", least=-SLOWEST)}),
    "several": ShapeKind(lambda x, _: x, 2),
    "product": ShapeKind(lambda x, _: np.asarray((x[0] * x[1])[None])),
    "products": ShapeKind(lambda x, _: np.asarray(x[:3] * x[3]), 3),
    # a load, and that of one kilogram times how many there are
    "carried": ShapeKind(lambda x, _: np.asarray((x[0] + x[1] * x[2])[None])),
    # the first driver from a time on, the second being time
    "since": ShapeKind(lambda x, s: np.asarray((x[0] * (x[1] >= s["at"]))[None]), fixed=_AT),
    "hardening": ShapeKind(hardening, refined={"beta": Setting()}),
    "turn": _of_cycles("turn", 2, refined=False),
    "sine": _of_cycles("sine", 2, refined=True),
    "double": _of_cycles("double", 4, refined=True),
    "sign": ShapeKind(lambda x, _: np.asarray(np.sign(x)[None])),
    "ramp": ShapeKind(lambda x, s: np.asarray((x - s["since"])[None])),
    "step": ShapeKind(lambda x, s: np.asarray((x >= s["at"]).astype(float)[None]), fixed=_AT),
    # a step that is zero at the end, so that the final state needs no effect
    "until": ShapeKind(lambda x, s: np.asarray(-(x < s["at"]).astype(float)[None]), fixed=_AT),
    "between": ShapeKind(lambda x, s: ((x >= s["since"]) & (x < s["at"])).astype(float)[None], fixed=_SINCE | _AT),
    "settle": ShapeKind(settle, refined={"tau": Setting(unit="s", name="time_constant")}),
    "spline": ShapeKind(splines, lambda s: int(s["count"])),
    "polynomial": ShapeKind(polynomial, lambda s: int(s["degree"])),
    "waves": ShapeKind(waves, lambda s: 4 * int(s["order"]) * (int(s["order"]) + 1)),
}
FREE = ("spline", "polynomial", "waves")
