"""JᵀWJ and JᵀWr without ever holding all of J.

Samples are taken block by block, so memory stays flat however long the recording is. Most columns of an effect are one
direction at one place times a number for each sample, ``u φ``. Products of such columns need the six components of u
only once: ``(u φ)ᵀ W (v ψ) = φᵀ diag(uᵀWv) ψ``, six times less work where an effect is a curve with a hundred knots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.linearise import RowView, geometry_rows, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Term, all_columns
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

BLOCK = 2000  # samples


@dataclass(frozen=True)
class Block:
    """Some of the samples. rows: of a linearisation of all, (3 n + 3 m,). at: their drivers, None where not kept."""

    part: Samples
    rows: np.ndarray
    at: Drivers | None = None


def blocks(samples: Samples) -> Iterator[Block]:
    """All samples, block by block."""
    N, pose = len(samples), samples.is_pose
    M = int(pose.sum())
    turned = np.cumsum(pose) - 1
    for first in range(0, N, BLOCK):
        rows = np.arange(first, min(first + BLOCK, N))
        part = samples if len(rows) == N else samples.select(rows)
        angles = 3 * N + turned[rows[pose[rows]]]
        yield Block(part, np.concatenate([rows, N + rows, 2 * N + rows, angles, M + angles, 2 * M + angles]))


def normal_equations(
    start: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    samples: Samples,
    row_weight: Array,
    parts: Iterable[Block] | None = None,
) -> tuple[Array, Array]:
    """(JᵀWJ, JᵀWr) of the parameters, then of the effects' values where there are any, at these values.

    row_weight: of the rows of a linearisation, (3 N + 3 M,). parts: the samples in blocks, where they are at hand.
    """
    H, g = np.zeros((len(values), len(values))), np.zeros(len(values))
    for block in blocks(samples) if parts is None else parts:
        at = block.at or start.drivers(block.part)
        _add(start, parameters, values, block.part, at, row_weight[block.rows], H, g)
    return H, g


def _add(
    start: Model,
    parameters: Sequence[ModelParameter],
    values: Array,
    part: Samples,
    at: Drivers,
    weight: Array,
    H: Array,
    g: Array,
) -> None:
    """Add what one block of samples says."""
    P = len(parameters)
    now = model_at(start, parameters, values)
    view = RowView.of(now, part, at)
    residual = np.concatenate([view.position.ravel(), view.rotation.ravel()])
    terms = all_columns(now.effects, at) if len(values) > P else []
    whole = [j for j, t in enumerate(terms) if len(t) != 1]
    J = np.concatenate(
        [geometry_rows(view, start, parameters, values), *(view.moved_by(terms[j])[None] for j in whole)]
    )
    dense = np.r_[np.arange(P), P + np.array(whole, dtype=int)]
    JW = J * weight
    H[np.ix_(dense, dense)] += JW @ J.T
    g[dense] += JW @ residual
    groups = _groups(terms, view)
    for a, group in enumerate(groups):
        index = P + group.index
        weighted = group.unit * weight
        cross = group.numbers @ view.by_sample(JW * group.unit).T
        H[np.ix_(index, dense)] += cross
        H[np.ix_(dense, index)] += cross.T
        g[index] += group.numbers @ view.by_sample(weighted * residual)
        for other in groups[a:]:
            block = (group.numbers * view.by_sample(weighted * other.unit)) @ other.numbers.T
            H[np.ix_(index, P + other.index)] += block
            if other is not group:
                H[np.ix_(P + other.index, index)] += block.T


@dataclass(frozen=True)
class _Group:
    """Columns of one direction at one place. unit: (3 N + 3 M,). numbers: (b, N). index: among the effects' values."""

    unit: Array
    numbers: Array
    index: np.ndarray


def _groups(terms: list[list[Term]], view: RowView) -> list[_Group]:
    members: dict[tuple[int, int], list[int]] = {}
    for j, t in enumerate(terms):
        if len(t) == 1:
            members.setdefault((t[0].place, t[0].direction), []).append(j)
    return [
        _Group(view.unit_column(*key), np.stack([terms[j][0].size for j in index]), np.array(index))
        for key, index in members.items()
    ]
