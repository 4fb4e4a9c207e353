"""What a calibration knows of itself, the directions that its readings do not show included.

A fit leaves out what others can say as well to the instrument that was there. Beside positions that is what base and
tool can say, and the tool is where it was. Beside contacts, bearings or sockets it may be the size of the arm, which
moves the tool: there the covariance holds every direction of the tool, each as wide as arms are likely to be off.

A frozen calibration takes what it says of the arm to other readings; of base and tool, which may have been moved since,
only where the readings do not surely say so: else the noise of the instrument would count as a move.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from modcal_core.calibration import (
    FINEST,
    Calibration,
    ModelParameter,
    Uncertainty,
    View,
    choose_parameters,
    exact_samples,
    general_samples,
    linearise,
)
from modcal_core.claim.evidence import Drawn
from modcal_core.claim.neighbourhood import FREE, Neighbourhood, with_joints
from modcal_core.geometry import Array, combined
from modcal_core.measurements import POINT, POSE
from modcal_core.measurements.kinds import KIND_NAMES

_SAME = 1e-7  # of the largest; directions that move readings less are said by others
_MOVED = 0.999  # of what base and tool seem to gain by a move where there was none (F test)
_EXACT = 1e-10  # m or rad, and share of a variance; nothing is known better


def known(about: Neighbourhood, drawn: Drawn) -> Uncertainty:
    """The covariance of parameters and of the values of effects, with every direction of the tool."""
    views = [View(POSE, f) for f in range(len(about.model.frames))]
    bare = about.model.with_effects(())
    of_tool = {p.name for p in choose_parameters(bare, views).parameters}
    kept = [not p.of_arm or p.name in of_tool for p in about.parameters]
    rows = np.flatnonzero(np.r_[kept, about.sort[len(kept) :] == FREE])
    std = drawn.std[rows]
    size, V = np.linalg.eigh(about.equations(drawn.noise)[0][np.ix_(rows, rows)] * np.outer(std, std))
    half = std[:, None] * V / np.sqrt(1.0 + np.maximum(size, 0.0))
    own = [p for p, keep in zip(about.parameters, kept, strict=True) if keep]
    wide = tuple(replace(p, prior_std=float(x)) for p, x in zip(own, std, strict=False))
    return Uncertainty(wide, half @ half.T)


def with_carried(about: Neighbourhood, calibration: Calibration, placed: bool) -> Neighbourhood:
    """The neighbourhood of other readings, with what the calibration knows of the arm and its effects beside them.

    placed: base and tool are where the calibration has them; what it knows of them counts, unless they surely moved.
    """
    if calibration.uncertainty is None:
        return about
    moved = _with_carried(about, calibration, of_arm=True)
    names = {p.name for p in about.parameters}
    own = [p for p in calibration.uncertainty.parameters if not p.of_arm]
    if not placed or not own or not names.issuperset(p.name for p in own):
        return with_joints(moved)
    stayed = _with_carried(about, calibration, of_arm=False)
    k, rest = len(own), max(float(about.rows.sum()) - len(own), 1.0)
    by_chance = 0.5 * (rest + k) * np.log1p(k / rest * scipy.special.fdtri(k, rest, _MOVED))
    return with_joints(stayed if _misfit(stayed) - _misfit(moved) < by_chance else moved)


def _misfit(about: Neighbourhood) -> float:
    """What the readings are less likely by, in nats, at the values that all that is known makes most likely."""
    H, g = about.equations(np.ones(len(about.rows)))
    scaled = H * np.outer(about.std, about.std) + np.eye(len(H))
    d = about.std * np.linalg.solve(scaled, about.std * g - about.shipped / about.std)
    square = about.square - 2.0 * about.g @ d + (about.H @ d) @ d
    return float(0.5 * about.rows @ np.log(np.maximum(square, 1e-300)))


def _with_carried(about: Neighbourhood, calibration: Calibration, of_arm: bool) -> Neighbourhood:
    """of_arm: with what is known of the arm alone."""
    kept = calibration.uncertainty
    assert kept is not None
    P, names = len(kept.parameters), len(about.parameters)
    own = [j for j, p in enumerate(kept.parameters) if p.of_arm or (not of_arm and _usable(p))]
    as_kept = np.zeros((len(own), len(about.std)))
    as_kept[:, :names] = _as_kept(about, calibration)[own]
    if of_arm:
        as_kept[:, about.place < 0] = 0.0
    widths = [kept.parameters[j].prior_std for j in own]
    effects = calibration.calibrated.effects
    values = len(kept.covariance) - P
    if values and [e.key for e in effects] == [e.key for e in about.model.effects[: len(effects)]]:
        as_kept = np.r_[as_kept, np.eye(len(about.std))[names : names + values]]
        own, widths = own + list(range(P, P + values)), widths + [np.inf] * values
    C = kept.covariance[np.ix_(own, own)]
    std = np.sqrt(np.maximum(np.diag(C), _EXACT**2))
    size, V = np.linalg.eigh(C / np.outer(std, std))
    half = V / np.sqrt(np.maximum(size, _EXACT)) / std[:, None]
    told = half @ half.T - np.diag(np.array(widths) ** -2.0)
    # a covariance that was changed since, as by a repair, may be wider than its prior somewhere: it says nothing there
    unit = np.where(np.isfinite(widths), widths, std)
    size, V = np.linalg.eigh(told * np.outer(unit, unit))
    told = (V * np.maximum(size, 0.0)) @ V.T / np.outer(unit, unit)
    H = about.stated[0] + as_kept.T @ told @ as_kept
    return replace(about, stated=(H + _of_functions(about, calibration), about.stated[1]))


def _of_functions(about: Neighbourhood, calibration: Calibration) -> Array:
    """H (K, K) of what the calibration's own recording says of effects that nobody named: they left no more than noise
    at its postures, beside whatever geometry says as well.
    """
    out, q = np.zeros_like(about.stated[0]), calibration.postures
    names, more = len(about.parameters), about.model.effects[len(calibration.calibrated.effects) :]
    if calibration.kind not in (POINT, POSE) or not len(q) or not more:
        return out
    model = about.model.with_effects(more)
    samples = exact_samples(model, q, np.zeros(len(q), int), np.full(len(q), POINT, dtype=KIND_NAMES))
    noise = max(float(np.hypot(calibration.noise.position, calibration.scatter[0])), FINEST)
    values = np.concatenate([np.zeros(names), *(e.values for e in more)])
    J = linearise(model, about.parameters, values, samples).J / noise
    rows = J[names:] - np.linalg.lstsq(J[:names].T, J[names:].T, rcond=_SAME)[0].T @ J[:names]
    own = np.arange(len(out) - len(rows), len(out))
    out[np.ix_(own, own)] = rows @ rows.T
    return out


def _as_kept(about: Neighbourhood, calibration: Calibration) -> Array:
    """Each of the neighbourhood's parameters as a motion of those that the calibration keeps, (P, names)."""
    assert calibration.uncertainty is not None
    kept = calibration.uncertainty.parameters
    whole = calibration.calibrated
    model = replace(
        whole, frames=whole.frames[:1], T_frame_base=whole.T_frame_base[:1], effects=(), instruments=(), leaders=()
    )
    kind = POINT if calibration.kind == POINT else POSE
    samples = general_samples(model, [View(kind, 0)], each=60)
    usable, ours = ([j for j, p in enumerate(some) if _usable(p)] for some in (kept, about.parameters))
    every = [*(kept[j] for j in usable), *(about.parameters[j] for j in ours)]
    J = linearise(model, every, np.zeros(len(every)), samples).J
    out = np.zeros((len(kept), len(about.parameters)))
    out[np.ix_(usable, ours)] = combined(J[: len(usable)].T, J[len(usable) :].T)
    return out


def _usable(p: ModelParameter) -> bool:
    """Whether a value is of the arm, the tool or the first frame."""
    return p.instrument < 0 and p.frame <= 0
