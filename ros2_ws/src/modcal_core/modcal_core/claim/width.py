"""Priors of a fit as wide as links are off, by the readings' own evidence, where readings leave directions open.

Positions in the frame of a tracker, lengths and known distances show the scale, and need no more than the wide priors
of :mod:`~modcal_core.calibration.parameters`. Contacts, gauges, bearings and sockets leave directions to what arms are
like: errors of joints let an arm shrink that only touches planes, as far as its prior lets it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from modcal_core.calibration import Cell, Fit, Model, ModelParameter, fit_geometry
from modcal_core.claim.evidence import widths_of_links
from modcal_core.claim.neighbourhood import ANGLE_RAD, LENGTH_M, arms_near, shows_base
from modcal_core.measurements import RANGE, RAY, Samples

USUAL_WIDTH = 1.0  # what fits begin with, and the narrowest
_WIDER = 1.2  # from which arms are fitted again with priors as wide


def held(parameters: Sequence[ModelParameter], widths: Mapping[int, float] | None = None) -> tuple[ModelParameter, ...]:
    """The parameters with those of the arm held to errors of these widths by place, in usual errors of links.

    widths: None, or of a place that is not there: the usual one. What counts as observed stays as it was.
    """

    def size(p: ModelParameter) -> float:
        usual = LENGTH_M if p.unit == "m" else ANGLE_RAD
        return min(max((widths or {}).get(p.place, USUAL_WIDTH), USUAL_WIDTH) * usual, p.expected)

    return tuple(replace(p, prior_std=size(p), seen_std=p.expected) if p.of_arm else p for p in parameters)


def fit_held(start: Model, samples: Samples, parameters: Sequence[ModelParameter], cell: Cell) -> Fit:
    """The fit of the whole geometry, as of :func:`fit_geometry`, of an arm that is as far off as the readings tell.

    start: the nominal arm, with base and tool where it has them.
    """
    placed = any(shows_base(samples, frame) for frame in range(len(samples.frames)))
    if placed or cell.distances or {RANGE, RAY} & set(samples.kinds):
        return fit_geometry(start, samples, parameters, cell)
    fit = fit_geometry(start, samples, held(parameters), cell)
    widths = widths_of_links(arms_near(fit.model, start.chain, samples, cell, functions=False))
    if max(widths.values(), default=0.0) <= _WIDER:
        return fit
    return fit_geometry(start, samples, held(parameters, widths), cell)
