"""How an effect follows its driver: a few functions of one number, linear in their amplitudes.

A shape has settings that are not linear (cycles a turn, the moment of a step, a time constant). They are found by
scanning; the ones in :data:`REFINED` are then fitted together with everything else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from modcal_core.effects.registry import added_shape, basis_of
from modcal_core.geometry.so3 import Array

REFINED = {"sine": ("cycles",), "double": ("cycles",), "settle": ("tau",), "hardening": ("beta",), "lagged": ("lag",)}
SPLINE_DEGREE = 3
PERIODIC = ("sine", "turn", "double")
_FINE = 32  # of a long list of cycles, that are products of one wave with few others


@dataclass(frozen=True)
class Shape:
    """kind: one of linear, lagged, several, since, hardening, turn, sine, double, sign, ramp, step, until, settle,
    spline, polynomial and waves, or one that a package adds. settings: by name, see ``basis``.
    """

    kind: str
    settings: Mapping[str, float] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of basis functions."""
        if self.kind == "spline":
            return int(self.settings["count"])
        if self.kind == "polynomial":
            return int(self.settings["degree"])
        if self.kind == "waves":
            order = int(self.settings["order"])
            return 2 * (order + order * (order + 1) + order * order)
        if added := added_shape(self.kind):
            return added.size
        return {"sine": 2, "turn": 2, "several": 2, "double": 4}.get(self.kind, 1)

    @property
    def refined(self) -> tuple[str, ...]:
        """Names of the settings that are fitted with the amplitudes."""
        if added := added_shape(self.kind):
            return tuple(added.refined)
        return REFINED.get(self.kind, ())

    def expected(self, name: str) -> float:
        """How far a refined setting may lie from its value before its prior minds."""
        if added := added_shape(self.kind):
            return added.refined[name].expected
        return 0.5 if name == "cycles" else max(0.5 * abs(self.settings[name]), 1e-3)

    def with_settings(self, settings: Mapping[str, float]) -> Shape:
        """The same kind of shape with some settings changed."""
        return Shape(self.kind, {**self.settings, **settings})

    def basis(self, x: Array) -> Array:
        """Basis functions (b, N) at drivers x (N,); ``several``, ``since`` and ``waves`` take two drivers (2, N).

        linear: x. lagged: x, a signal that was delayed by ``lag`` already. several: each of the drivers. since: the
        first driver, from the time ``at`` on, the second being time. hardening: the y with y + beta y³ = x / scale, as
        a spring gives way that gets stiffer. turn, sine: sin and cos of ``cycles`` a turn, a small whole number that
        stays or one that is fitted. double: the same and twice as many cycles. sign: ±1. ramp: x − since. step: 0
        before ``at``, 1 from then on. until: the same less 1, so that what holds in the end needs no effect. settle:
        exp(−(x − since) / tau). spline: ``count`` cubic B-splines between ``low`` and ``high``, fading to nothing
        outside. polynomial: powers to ``degree`` of x scaled to ±1 over ``low`` … ``high`` and held outside. waves:
        sines and cosines of all sums of up to ``order`` turns of either driver.
        """
        s = self.settings
        if self.kind in ("linear", "lagged"):
            return x[None]
        if self.kind == "several":
            return x
        if self.kind == "since":
            return (x[0] * (x[1] >= s["at"]))[None]
        if self.kind == "hardening":
            root = np.sqrt(3.0 * max(s["beta"], 1e-6))
            return (2.0 / root * np.sinh(np.arcsinh(1.5 * root * x / s["scale"]) / 3.0))[None]
        if self.kind in PERIODIC:
            return periodic(self.kind, np.array([s["cycles"]]), x)[0]
        if self.kind == "sign":
            return np.sign(x)[None]
        if self.kind == "ramp":
            return (x - s["since"])[None]
        if self.kind == "step":
            return (x >= s["at"]).astype(float)[None]
        if self.kind == "until":
            return -(x < s["at"]).astype(float)[None]
        if self.kind == "settle":
            return np.exp(-np.clip((x - s["since"]) / max(s["tau"], 1e-9), -50.0, 700.0))[None]
        if self.kind == "spline":
            return self._splines(x)
        if self.kind == "polynomial":
            u = np.clip((2.0 * x - s["low"] - s["high"]) / max(s["high"] - s["low"], 1e-12), -1.0, 1.0)
            return np.stack([u ** (k + 1) for k in range(int(s["degree"]))])
        if self.kind == "waves":
            return self._waves(x)
        if added := added_shape(self.kind):
            return basis_of(self.kind, added, x, s)
        raise ValueError(f"no shape '{self.kind}'")

    def _splines(self, x: Array) -> Array:
        count, low, high = int(self.settings["count"]), self.settings["low"], self.settings["high"]
        step = (high - low) / (count - SPLINE_DEGREE)
        # counted in knots from the first centre; beyond the last knot every function is zero: nothing is claimed where
        # nothing was seen
        at = np.clip((x - low) / step + 1.0, -3.0, count + 2.0)
        unknown = np.isnan(at)
        at = np.where(unknown, 0.0, at)
        knot = np.floor(at)
        u = at - knot
        v = 1.0 - u
        near = (v**2 * v / 6.0, 2.0 / 3.0 - u**2 * (1.0 - 0.5 * u), 2.0 / 3.0 - v**2 * (1.0 - 0.5 * v), u**2 * u / 6.0)
        # only the four functions about a driver are not zero there
        out = np.zeros((count + 10, len(x)))
        first, column = knot.astype(int) + 4, np.arange(len(x))
        for i, value in enumerate(near):
            out[first + i, column] = value
        out[:, unknown] = np.nan
        return out[5 : count + 5]

    def _waves(self, x: Array) -> Array:
        order = int(self.settings["order"])
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
