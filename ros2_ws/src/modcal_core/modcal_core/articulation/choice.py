"""Which kind of joint it is, or none of these: probabilities, the fit of the most probable kind, whether to rely on it.

The probabilities compare joint types with each other. Whether the best is good enough is asked besides: what it leaves
(``misfit``), and whether it predicts travel that it was not fitted to. A pull that is none of these is cut where two
motions meet (``two_motions``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.evidence import EvidenceRow, hidden, of_fine, row, size_priors, still, unproved, weigh
from modcal_core.articulation.fit import JointFit, fit
from modcal_core.articulation.furniture import FINE
from modcal_core.articulation.joint_motion import ArticulationModel, Kind, Motion
from modcal_core.articulation.misfit import NONE, OUTLIERS, Misfit, bend_explains, misfit, prediction_doubt, scales
from modcal_core.articulation.models.registry import STILL, all_models, log_shares
from modcal_core.articulation.scene import LOOSE, PLAYS, SIZES, SWAYS, NodeScene
from modcal_core.articulation.track import FEWEST, Track, backwards, pooled, telling, travelled
from modcal_core.articulation.two_motions import best_cut, two_explain, where
from modcal_core.geometry import Array

# pooled samples of a whole track: 1 to 3 cm of the paths that handles have, short beside what is alike (10 cm)
NODES = 48
_GROSS = 4.0  # times noise, or the usual play of furniture: Gaussian noise across a line does so once in 3000
SURE = 0.95  # probability from which a kind is said


@dataclass(frozen=True)
class Choice:
    """probabilities: of every kind, 1 together. fit: of the most probable one. enough: whether to rely on the kind.

    why: one sentence for a person. fits: of every kind. follows: whether the rotations that were seen are the handle's;
    when a grasp turns in the hand, the fit rests on positions alone. misfit: what the best kind leaves; where that is
    too much, ``kind`` is "none". doubt: why not to rely on it. phases: two motions one after the other, where a pull
    that is none of these is cut into them.
    """

    probabilities: dict[Kind, float]
    fit: JointFit
    enough: bool
    why: str
    fits: dict[Kind, JointFit]
    follows: bool
    misfit: Misfit
    doubt: str = ""
    phases: tuple[Phase, ...] = ()

    @property
    def kind(self) -> Kind:
        """The most probable kind; "none" where that leaves too much."""
        return NONE if self.misfit.fails else self.best

    @property
    def best(self) -> Kind:
        """The most probable kind, however much it leaves."""
        return self.fit.model.kind


@dataclass(frozen=True)
class Phase:
    """One of two motions. begin, end: its path [m], of the whole. choice: of its own samples."""

    begin: float
    end: float
    choice: Choice


def choose(track: Track, rng: np.random.Generator | None = None, nodes: int = NODES) -> Choice:
    """The choice between all joint types, the built-in ones and those that packages add, for one track.

    Lone outliers, and most samples of a rest, have no say. rng: picks samples for first guesses. Raises BadTable where
    a package's model is none.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    rows = telling(track)
    whole = len(rows) == len(track)
    told = track if whole else track.part(rows)
    choice = _chosen(told, rng, nodes)
    if choice.misfit.fails:
        choice = _cut(told, choice, rng, nodes)
    if whole:
        return choice
    model = next(model for model in all_models() if model.name == choice.best)
    used = track if choice.follows else track.points()
    found = _settled(used, model, choice.fit.motion, choice.misfit.white)[0]  # a configuration for every sample
    # the sentence tells of all samples, as everything else that is told
    why = choice.why if choice.misfit.fails else _why(choice.probabilities, found, choice.misfit, choice.doubt, track)
    return replace(choice, fit=found, fits={**choice.fits, choice.best: found}, why=why)


def _cut(track: Track, choice: Choice, rng: np.random.Generator, nodes: int) -> Choice:
    """The same choice with two phases, where each of them is a joint; else as it is."""
    cut = best_cut(track)
    if cut is None:
        return choice
    order = -1 if backwards(track.positions) else 1
    sides = (np.arange(cut), np.arange(cut, len(track)))[::order]
    parts = [_chosen(track.part(rows), rng, nodes) for rows in sides][::order]
    if any(part.misfit.fails for part in parts) or sum(p.misfit.position for p in parts) > choice.misfit.position:
        return choice
    ends = (0.0, where(track, cut), float(travelled(track)[-1]))
    phases = tuple(Phase(a, b, part) for a, b, part in zip(ends[:-1], ends[1:], parts, strict=True))
    seen = (track.part(rows) for rows in sides[::order])
    words = [f"{part.best}, it {_seen(part.fit, own)}" for part, own in zip(parts, seen, strict=True)]
    told = f"two motions: 0–{1e2 * ends[1]:.0f} cm {words[0]}; then {words[1]}"
    return replace(choice, why=f"{choice.why}; {told}", phases=phases)


def _chosen(track: Track, rng: np.random.Generator, nodes: int) -> Choice:
    models = all_models()
    fits = {model.name: fit(track, model, rng) for model in models}
    richest = max(fits.values(), key=lambda f: f.log_likelihood)  # what it cannot explain, none can
    good = np.logical_not(gross(richest, track))
    # what is more than a quarter, as of what a joint leaves, are no outliers but the motion
    kept = track.part(good) if good.sum() >= FEWEST and good.mean() >= 1.0 - OUTLIERS else track
    noise = white_noise(richest.motion.residuals(kept, richest.motion.configurations(kept, scales(richest))))
    choice = _weighed(track, kept, noise, nodes, fits, models, rng)
    if choice.best == STILL.name and choice.misfit.fails and kept is not track:
        return _weighed(track, track, noise, nodes, fits, models, rng)  # what moved was taken for outliers
    return choice


def _weighed(
    track: Track,
    kept: Track,
    noise: tuple[float, float],
    nodes: int,
    fits: dict[Kind, JointFit],
    models: Sequence[ArticulationModel],
    rng: np.random.Generator,
) -> Choice:
    """The choice by the samples that are kept, judged on all of the track."""
    scenes = _scenes(kept, noise, nodes)
    if not scenes:
        return _still(track, kept, noise, fits, models)
    shares = log_shares(models)
    rows = {kind: _rows(scenes, fits[kind].motion) for kind in shares}
    probabilities, kind, i, j = weigh(rows, size_priors(noise[0]), shares, scenes[1.0], counted=True)
    if probabilities[STILL.name] > probabilities[kind]:
        kind = STILL.name
    follows = kind == STILL.name or not (track.oriented and bool(LOOSE[j]))
    used = track if follows else track.points()
    by_name = {model.name: model for model in models}
    left = misfit(fits[kind], used, noise)
    if kind != STILL.name:
        motion = rows[kind][i].motion
        if not follows:
            motion = replace(motion, R=None)  # type: ignore[type-var]  # every motion is a dataclass
        found, left = _settled(used, by_name[kind], motion, noise)
        fits = {**fits, kind: found}
    doubt = ""
    if probabilities[kind] >= SURE and kind != STILL.name and not left.fails:
        rivals = sorted((k for k in shares if k != kind), key=lambda k: -probabilities[k])[:2]
        own = fits if follows else {**fits, **{k: fit(used, by_name[k], rng) for k in rivals}}
        doubt = prediction_doubt(used, kind, rivals, own, by_name, left)
        doubt = doubt or (two_explain(used) if fits[kind].motion.flat else "")  # phases are lines or circles too
        if not doubt:  # it may be another curve than the joint's: a bend explains what is left, or a hinge is far
            a = fits[kind].motion.configurations(used, scales(fits[kind]))
            doubt = bend_explains(used, fits[kind].motion.residuals(used, a)[:, :3], a)
            doubt = doubt or unproved(fits[kind].motion, a) or hidden(fits[kind].motion, a, left.position)
    enough = probabilities[kind] >= SURE and not left.fails and not doubt
    why = _why(probabilities, fits[kind], left, doubt, track)
    return Choice(probabilities, fits[kind], enough, why, fits, follows, left, doubt)


def _settled(
    track: Track, model: ArticulationModel, motion: Motion, noise: tuple[float, float]
) -> tuple[JointFit, Misfit]:
    """The fit that begins at the most probable motion, and what it leaves; that motion itself where it is too much.

    A fit takes every sample's error as its own. Where rotations of a part of the path agree to a tenth of a degree it
    may follow them, and leave another part by a centimetre, although both are within what handles and cameras do.
    """
    found = fit(track, model, start=motion)
    left = misfit(found, track, noise)
    if left.fails:
        held = fit(track, model, start=motion, climbs=False)
        instead = misfit(held, track, noise)
        if not instead.fails:
            return held, instead
    return found, left


def _rows(scenes: dict[float, NodeScene], motion: Motion) -> list[EvidenceRow]:
    rows: list[EvidenceRow] = []
    column = 2
    for distorted, play, _ in SIZES:  # what is most probable at one play is a good guess for the next
        rows.append(row(scenes[distorted], motion, play, column=column))
        motion, column = rows[-1].motion, rows[-1].column
        if distorted in FINE[0]:
            rows[-1] = replace(rows[-1], evidence=rows[-1].evidence + of_fine(motion))
    return rows


def gross(found: JointFit, track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) are off by more than four times what noise, or the usual play of furniture, does."""
    sigma = scales(found)
    e = found.motion.residuals(track, found.motion.configurations(track, sigma))
    off = np.linalg.norm(e[:, :3], axis=1) > _GROSS * max(sigma[0], float(PLAYS[2]))
    if e.shape[1] == 6:
        off |= np.linalg.norm(e[:, 3:], axis=1) > _GROSS * max(sigma[1], float(SWAYS[2]))
    return off


def sound(found: JointFit, track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) count for what is said of a motion: those that are not gross, or all where all are."""
    good = np.logical_not(gross(found, track if found.model.oriented else track.points()))
    return good if good.any() else np.ones(len(track), dtype=bool)


def _scenes(track: Track, sigma: tuple[float, float], most: int) -> dict[float, NodeScene]:
    """The nodes of a track with each size of distortion; none where nothing moved. sigma: noise of a sample."""
    nodes = pooled(track, most, sigma[0])
    seen = nodes.track(FEWEST)
    if seen is None:
        return {}
    apart, counts = nodes.apart(), nodes.counts[: nodes.k]
    return {size: NodeScene.of(seen, apart, counts, sigma, size) for size, _, _ in SIZES}


def white_noise(e: Array) -> tuple[float, float]:
    """Noise of one sample [m, rad] that its neighbour in time does not share, from residuals (n, 3) or (n, 6)."""
    steps = np.diff(e, axis=0)
    # medians of χ² with two and three degrees of freedom, times the two samples in a difference
    position = float(np.sqrt(np.median((steps[:, :3] ** 2).sum(axis=1)) / 2.77))
    rotation = float(np.sqrt(np.median((steps[:, 3:] ** 2).sum(axis=1)) / 4.73)) if e.shape[1] == 6 else 0.0
    return position, rotation


def _still(
    track: Track,
    kept: Track,
    noise: tuple[float, float],
    fits: dict[Kind, JointFit],
    models: Sequence[ArticulationModel],
) -> Choice:
    """All samples but gross ones lie within a few nodes: nothing moved, or too little to tell how.

    What has moved by a few centimetres is none of the joint types only where all of them leave too much, not where a
    handle at rest would.
    """
    rigid = still(2.0 * kept.extent())
    probabilities: dict[Kind, float] = {STILL.name: rigid}
    for kind, log_share in log_shares(models).items():
        probabilities[kind] = (1.0 - rigid) * float(np.exp(log_share))
    ranked = sorted(probabilities, key=lambda kind: -probabilities[kind])
    lefts = {kind: misfit(fits[kind], track, noise) for kind in ranked}
    best = next((kind for kind in ranked if not lefts[kind].fails), ranked[0])
    left = lefts[best]
    why = _why(probabilities, fits[best], left, "", track)
    enough = probabilities[best] >= SURE and not left.fails
    return Choice(probabilities, fits[best], enough, why, fits, True, left)


def _seen(chosen: JointFit, track: Track) -> str:
    return chosen.model.sentence(chosen.configurations[sound(chosen, track)], track.extent(), chosen.std)


def _why(probabilities: dict[Kind, float], chosen: JointFit, left: Misfit, doubt: str, track: Track) -> str:
    kind, seen = chosen.model.kind, _seen(chosen, track)
    percent = {one: f"{100.0 * p:.0f} %" for one, p in probabilities.items()}
    if left.fails:
        return f"none of these: the best, {kind}, {left.said}"
    if doubt:
        return f"not sure yet: {kind} ({percent[kind]}), but {doubt}; it {seen}"
    if probabilities[kind] >= SURE:
        return f"{kind} ({percent[kind]}): it {seen}"
    ranked = sorted(percent, key=lambda one: -probabilities[one])[:2]
    return f"not enough motion yet: {percent[ranked[0]]} {ranked[0]}, {percent[ranked[1]]} {ranked[1]}; it {seen}"
