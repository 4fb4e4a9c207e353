"""Both tails of what is left: E² beside what the floor and the parameters' uncertainty make together.

The residuals of the scored rows have the covariance M = F²/3 I + J C Jᵀ. Their mean square is about tr M / N, with
ν = (tr M)² / tr M² degrees of freedom (Satterthwaite 1946): what the parameters make is the same few numbers at all
stations, and counts for few. Noise of fewer than three equal axes, stations in one posture and neighbours in time count
for less, too. The floor has degrees of freedom of its own, so that E² / expected follows an F law, at any number of
stations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import block_length, quantile_chi2
from modcal_core.measurements import Samples, spread_rows
from modcal_core.verdict.account import mean_square
from modcal_core.verdict.case import Case, derivatives
from modcal_core.verdict.floor import Floor, axes_of

_MAX = 400  # scored samples; the mean over more is the same
_SURE = 0.975  # either end of a 95 % interval
_NEAR = 0.05  # rad or m; an arm errs alike in postures that are closer, and gears turn by some cycles in as much
_MANY = 1e9  # degrees of freedom of what is stated


@dataclass(frozen=True)
class Tail:
    """square: E² [mm² or deg²]. estimation: what of it the parameters' covariance makes. floor: None where not known.
    freedom: of E². postures: how many it was seen at.
    """

    square: float
    estimation: float
    floor: Floor | None
    freedom: float
    postures: int

    @property
    def expected(self) -> float:
        """What floor and parameters make together."""
        return self.estimation + (0.0 if self.floor is None else self.floor.square)

    @property
    def upper(self) -> float:
        """Upper end of the 95 % interval of E²."""
        return self.square * self.freedom / max(quantile_chi2(0.025, self.freedom), 1e-300)

    def above(self, times: float) -> bool:
        """Whether E² is surely more than so many times what is expected."""
        return self.floor is not None and self.square > times * self._quantile(_SURE) * self.expected

    def below(self, times: float) -> bool:
        """Whether E² is surely less than what is expected over so many times."""
        return self.floor is not None and self.square < self._quantile(1.0 - _SURE) * self.expected / times

    def _quantile(self, share: float) -> float:
        from scipy.special import fdtri

        own = _MANY if self.floor is None or not self.floor.freedom else self.floor.freedom
        return float(fdtri(self.freedom, own, share))


def tail_of(case: Case, floor: Floor | None, angle: bool) -> Tail:
    """The tail of what a case leaves: of positions, or of orientations."""
    keep = case.samples.is_pose[case.held_out] if angle else np.ones(len(case.held_out), bool)
    rows = case.held_out[keep]
    if not len(rows):
        return Tail(0.0, 0.0, floor, 1.0, 0)
    squares = mean_square(case.errors["final"], angle)
    some = rows[spread_rows(len(rows), _MAX)]
    trace, crossed = _parameters(case, some, angle)
    times = len(rows) / len(some)
    own = float(squares.mean())
    noise = (own if floor is None else floor.square) / 3.0
    postures = independent_postures(case.samples.select(rows), case.unit == "block", case.samples)
    n = 3.0 * len(rows)
    number = np.unique(case.samples.station[rows], return_inverse=True)[1]
    each = np.bincount(number, squares) / np.bincount(number)
    spread = (3.0 / axes_of(each, np.ones(len(each)))) * len(rows) / postures
    whole = n * noise + times * trace
    second = n * noise**2 * spread + 2.0 * noise * times * trace + times**2 * crossed
    return Tail(own, trace / len(some), floor, whole**2 / max(second, 1e-300) if whole > 0.0 else 1.0, postures)


def _parameters(case: Case, rows: np.ndarray, angle: bool) -> tuple[float, float]:
    """tr J C Jᵀ and tr (J C Jᵀ)² over some rows [mm² or deg², and their squares]."""
    _, J = derivatives(case.model, case.known.parameters, case.samples.select(rows))
    if not len(J):  # nothing is known of its own error, as of one that cameras made
        return 0.0, 0.0
    part = (np.degrees(J[:, 3:]) if angle else 1e3 * J[:, :3]).reshape(len(J), -1)
    C = case.known.covariance @ (part @ part.T)
    return max(float(np.trace(C)), 0.0), max(float(np.sum(C * C.T)), 0.0)


def independent_postures(samples: Samples, blocks: bool, whole: Samples) -> int:
    """At how many postures samples stand that say something of their own, 1 or more.

    Stations close to each other are one, and so are neighbours in time of a dense recording (``whole``).
    """
    _, first = np.unique(samples.station, return_index=True)
    length = block_length(whole) if blocks or samples.moving.any() else 1
    q, count = samples.q[first], 0
    most = max(len(first) // length, 1)
    while len(q) and count < most:
        q = q[np.abs(q - q[0]).max(axis=1) > _NEAR]
        count += 1
    return max(count, 1)
