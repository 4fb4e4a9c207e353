"""What a calibration knows of itself, the directions that its readings do not show included.

What a fit leaves out, others can say as well to the instrument that was there, and not to the tool: a scale beside
sockets, a joint's zero beside a base. So the covariance holds every direction, each as wide as arms are likely to be
off. A frozen calibration takes what it says of the arm to other readings, and nothing of base and tool, which may have
been moved since.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import Calibration, Uncertainty
from modcal_core.claim.neighbourhood import ARM, UNNAMED, Neighbourhood


def known(about: Neighbourhood, width: float) -> Uncertainty:
    """The covariance of all parameters and of the values of effects. width: of links, in usual errors."""
    rows = np.flatnonzero(about.kind != UNNAMED)
    std = about.std[rows] * np.where(about.kind[rows] == ARM, width, 1.0)
    size, V = np.linalg.eigh(about.H[np.ix_(rows, rows)] * np.outer(std, std))
    half = std[:, None] * V / np.sqrt(1.0 + np.maximum(size, 0.0))
    wide = tuple(replace(p, prior_std=float(x)) for p, x in zip(about.parameters, std, strict=False))
    return Uncertainty(wide, half @ half.T)


def with_carried(about: Neighbourhood, calibration: Calibration) -> Neighbourhood:
    """The neighbourhood of other readings, with what the calibration knows of the arm and its effects beside them."""
    kept = calibration.uncertainty
    if kept is None:
        return about
    P, names = len(kept.parameters), [p.name for p in about.parameters]
    pairs = [(j, names.index(p.name)) for j, p in enumerate(kept.parameters) if p.of_arm and p.name in names]
    if not pairs:
        return about
    widths = [kept.parameters[j].prior_std for j, _ in pairs]
    effects = calibration.calibrated.effects
    whole = P + sum(len(e.values) for e in effects) == len(kept.covariance)
    if whole and [e.key for e in effects] == [e.key for e in about.model.effects[: len(effects)]]:
        pairs += [(P + k, len(names) + k) for k in range(len(kept.covariance) - P)]
    own, at = np.array(pairs).T
    prior = np.array(widths + [np.inf] * (len(own) - len(widths)))
    C = kept.covariance[np.ix_(own, own)]
    std = np.sqrt(np.maximum(np.diag(C), 1e-300))
    told = np.linalg.inv(C / np.outer(std, std)) / np.outer(std, std) - np.diag(prior**-2.0)
    H, g, x = about.H.copy(), about.g.copy(), about.shipped[at]
    H[np.ix_(at, at)] += told
    g[at] += told @ x
    count = float(np.sum(told * C))  # of directions that it tells, each off by its deviation
    return replace(about, H=H, g=g, square=about.square + float(x @ told @ x) + count, rows=about.rows + count)
