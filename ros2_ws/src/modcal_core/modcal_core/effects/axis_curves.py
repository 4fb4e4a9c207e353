"""Curves about joints' axes, all at once: what a node that predicts one posture after another asks of every curve.

An effect gives its functions for whatever follows. Where only their sum is wanted, of the hundreds of functions of some
twenty curves four each are not zero at a posture (:func:`~modcal_core.effects.shapes.near_functions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.effects.effect import AXIS, Effect, axis_direction, place_index
from modcal_core.effects.shapes import SPLINE_DEGREE, near_functions
from modcal_core.geometry.so3 import Array
from modcal_core.robots.mechanism import Mechanism

_PAD = SPLINE_DEGREE + 2  # functions before the first and behind the last one, which are nothing


@dataclass(frozen=True)
class AxisCurves:
    """Cubic curves of joints' positions that move joints along or about their axes, m of them.

    of: which effects of those given they are, (m,). joint: column of the position that each follows. place, direction:
    what it moves. low, step: first end of its range and the way from function to function. count: of its functions.
    amplitudes: (m, most functions and what stands before and behind them).
    """

    of: tuple[int, ...]
    joint: np.ndarray
    place: np.ndarray
    direction: np.ndarray
    low: Array
    step: Array
    count: np.ndarray
    amplitudes: Array

    @classmethod
    def among(cls, effects: Sequence[Effect], chain: Mechanism) -> AxisCurves:
        """The curves about joint axes among the effects."""
        of = tuple(i for i, effect in enumerate(effects) if _is_curve(effect, chain))
        chosen = [effects[i] for i in of]
        place = np.array([place_index(e.place, chain) for e in chosen], dtype=int)
        low, high, count = (np.array([e.shape.settings[k] for e in chosen]) for k in ("low", "high", "count"))
        amplitudes = np.zeros((len(of), int(count.max(initial=0)) + 2 * _PAD))
        for row, effect in zip(amplitudes, chosen, strict=True):
            row[_PAD : _PAD + len(effect.amplitudes)] = effect.amplitudes
        return cls(
            of,
            np.array([chain.names.index(e.driver.partition(":")[2]) for e in chosen], dtype=int),
            place,
            np.array([axis_direction(chain, k - chain.first_place) for k in place], dtype=int),
            low,
            (high - low) / (count - SPLINE_DEGREE),
            count.astype(int),
            amplitudes,
        )

    def __len__(self) -> int:
        return len(self.of)

    def functions(self, q: Array) -> tuple[np.ndarray, Array]:
        """Number of the first of each curve's four functions that are not zero at postures q (N, n), (m, N), from −4 to
        ``count`` + 1, and their values (4, m, N).
        """
        x = q.T[self.joint]
        return near_functions(x, self.low[:, None], self.step[:, None], self.count[:, None])

    def add_to(self, twists: dict[int, Array], q: Array) -> None:
        """Put their motions at postures q (N, n) into twists (6, N) by place."""
        if not self.of:
            return
        first, value = self.functions(q)
        rows = np.arange(len(self))[:, None]
        sizes = sum(part * self.amplitudes[rows, first + (_PAD + i)] for i, part in enumerate(value))
        for place, direction, size in zip(self.place.tolist(), self.direction.tolist(), sizes, strict=True):
            if place not in twists:
                twists[place] = np.zeros((6, len(q)))
            twists[place][direction] += size

    def columns(self, q: Array) -> list[tuple[slice, Array]]:
        """For each curve at one posture q (n,) which of its amplitudes count there, and what a unit of each moves."""
        if not self.of:
            return []
        first, value = self.functions(q[None])
        out = []
        for begin, count, functions in zip(first[:, 0].tolist(), self.count.tolist(), value[:, :, 0].T, strict=True):
            low, high = min(max(begin, 0), count), max(min(begin + len(functions), count), 0)
            out.append((slice(low, max(low, high)), functions[low - begin : max(low, high) - begin]))
        return out


def _is_curve(effect: Effect, chain: Mechanism) -> bool:
    kind, _, joint = effect.driver.partition(":")
    curve = effect.shape.kind == "spline" and effect.direction == AXIS and effect.lag == 0.0
    return curve and kind == "position" and joint in chain.names and len(effect.amplitudes) > 0
