"""What stations have in common while nothing has changed: errors of a joint, of all joints, and of a place.

Errors of stations close to one another are alike, so ten neighbours are not ten witnesses. How many they stand for is
``n² / Σ ρ_ij`` with ρ the correlation by their postures: that many independent values have a mean as well known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.checking.rows import RowKinds
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

_ALIKE = 0.6  # rad or m, over all joints: postures this far apart share 61 % of a pattern
_PERIOD = 0.7  # of a smooth curve of a joint: it is another one after about so many radians
_ROUGH = 0.5  # share of such a curve that changes from station to station, as the many waves of a gear do
_FINE = 0.01  # rad, to which such a curve is one value: the finest gears have a wave each 0.04
_LENGTHS = (_PERIOD, 0.1, _FINE)  # rad, of one that was left: of a turn or two, of ten waves a turn, of a hundred


@dataclass(frozen=True)
class JointPattern:
    """An error that depends on one joint's position. fine: whether it is another one at every station. covariance:
    (n, n), as large as the spread allows. share: of the variances of positions and orientations, (2,).
    """

    fine: bool
    covariance: Array
    share: Array


def witnesses(samples: Samples) -> float:
    """Number of independent stations that these count as, from one to their number."""
    first = np.unique(samples.station, return_index=True)[1]
    return len(first) ** 2 / float(_alike(samples.q[first]).sum())


def of_posture(samples: Samples, rows: RowKinds) -> Array:
    """Covariance (n, n) of what depends on the posture, smoothly, as large as the spread."""
    same = rows.component[:, None] == rows.component
    return np.asarray(
        _alike(samples.q)[np.ix_(rows.sample, rows.sample)] * same * np.sqrt(np.outer(rows.variance, rows.variance))
    )


def of_each_joint(model: Model, samples: Samples, view: RowView, rows: RowKinds) -> list[JointPattern]:
    """The patterns of every joint that turns, one for each length of its curve."""
    out = []
    for j, g in _turning(model, view):
        for length in _LENGTHS:
            alike = _curve(samples.q[:, j], length)[np.ix_(rows.sample, rows.sample)]
            out.append(JointPattern(length == _FINE, *_scaled(np.outer(g, g) * alike, rows)))
    return out


def of_all_joints(model: Model, samples: Samples, view: RowView, rows: RowKinds) -> tuple[Array, Array]:
    """Covariance pattern of joints that repeat badly: independent at every station, with equal shares of the spread."""
    same = samples.station[rows.sample][:, None] == samples.station[rows.sample]
    each = [_scaled(np.outer(g, g) * same, rows)[0] for _, g in _turning(model, view)]
    return _scaled(np.sum(each, axis=0), rows) if each else (np.zeros((len(rows.sample),) * 2), np.zeros(2))


def varying(q: Array, revolute: bool) -> Array:
    """Correlation (n, n) of a joint's curve at its positions (n,) [rad or m]: half smooth, half of any course."""
    q = q if revolute else q / 0.1  # a decimetre of travel as a radian
    return (1.0 - _ROUGH) * _curve(q, _PERIOD) + _ROUGH * _curve(q, _FINE)


def _curve(q: Array, length: float) -> Array:
    """Correlation (n, n) of a smooth periodic curve with this correlation length [rad]."""
    return np.asarray(np.exp(-2.0 * (np.sin(0.5 * (q[:, None] - q)) / length) ** 2))


def _alike(q: Array) -> Array:
    return np.exp(-0.5 * np.sum((q[:, None] - q) ** 2, axis=-1) / _ALIKE**2)


def _turning(model: Model, view: RowView) -> list[tuple[int, Array]]:
    """Every joint that turns, with what the readings move by per unit of its angle, (n,)."""
    chain = model.chain
    return [(j, view.unit_column(chain.first_place + j, 5)) for j in range(len(chain.names)) if chain.revolute[j]]


def _scaled(covariance: Array, rows: RowKinds) -> tuple[Array, Array]:
    """The covariance as large as the spread allows in positions and in orientations, and its shares of both."""
    turned, square = rows.component >= 3, np.diag(covariance)
    size = np.array(
        [float(square[part].mean() / rows.variance[part].mean()) if part.any() else 0.0 for part in (~turned, turned)]
    )
    scale = 1.0 / max(float(size.max()), 1e-300)
    return scale * covariance, np.minimum(scale * size, 1.0)
