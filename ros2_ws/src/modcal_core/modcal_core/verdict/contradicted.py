"""What the data of a calibration contradict: known distances, stated places, readings that are none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from modcal_core.calibration import Cell, Errors, Fit, KnownDistance, contradicted_places, contradicted_together
from modcal_core.calibration import contradictions as contradictions_of_distances
from modcal_core.hypotheses import computed_in_part
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism
from modcal_core.verdict.readings import doubtful
from modcal_core.verdict.sanity import long_tool


def contradictions(
    fit: Fit,
    train: Samples,
    samples: Samples,
    scored: Samples,
    wrong: np.ndarray,
    errors: Mapping[str, Errors],
    distances: Sequence[KnownDistance],
    cell: Cell,
    chain: Mechanism,
) -> tuple[str, ...]:
    """A sentence for each contradiction; each makes the verdict *open*.

    fit: of the samples ``train``. samples: all of them. scored: those that the ``errors`` of nominal, geometric and
    final model are of. wrong (N,): samples that were rejected. distances: of the cell, as the fit has them. chain: the
    nominal arm.
    """
    return (
        *contradictions_of_distances(distances),
        *contradicted_together(fit, train, cell.distances),
        *contradicted_places(fit, cell.tool, cell.known),
        *doubtful(errors, scored, samples, chain),
        *computed_in_part(samples, chain, wrong),
        *samples.origin.doubts,
        *long_tool(fit.model),
    )
