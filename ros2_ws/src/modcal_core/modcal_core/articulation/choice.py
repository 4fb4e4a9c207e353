"""Which kind of joint it is: probabilities, the fit of the most probable kind, and whether enough was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.evidence import EvidenceRow, row, still, weigh
from modcal_core.articulation.fit import JointFit, fit
from modcal_core.articulation.models.model import ArticulationModel, Kind
from modcal_core.articulation.models.registry import STILL, all_models, log_shares
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.nodes import Nodes
from modcal_core.articulation.scene import DISTORTIONS, LOG_DISTORTIONS, LOG_PLAYS, LOOSE, PLAYS, SWAYS, NodeScene
from modcal_core.articulation.track import FEWEST, Track
from modcal_core.geometry.so3 import Array

_GROSS = 4.0  # times noise, or the usual play of furniture: Gaussian noise across a line does so once in 3000
SURE = 0.95  # probability from which a kind is said


@dataclass(frozen=True)
class Choice:
    """probabilities: of every kind, 1 together. fit: of the most probable one. enough: whether to rely on the kind.

    why: one sentence for a person. fits: of every kind. follows: whether the rotations that were seen are the handle's;
    when a grasp turns in the hand, the fit rests on positions alone. play: how far the object departs from ideal [m].
    """

    probabilities: dict[Kind, float]
    fit: JointFit
    enough: bool
    why: str
    fits: dict[Kind, JointFit]
    follows: bool
    play: float

    @property
    def kind(self) -> Kind:
        """The most probable kind."""
        return self.fit.model.kind


def choose(track: Track, rng: np.random.Generator | None = None, nodes: int = 12) -> Choice:
    """The choice between all joint types, the built-in ones and those that packages add, for one track.

    rng: picks samples for first guesses. Raises BadTable where a package's model is none.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    models = all_models()
    fits = {model.name: fit(track, model, rng) for model in models}
    richest = max(fits.values(), key=lambda f: f.log_likelihood)  # what it cannot explain, none can
    good = np.logical_not(gross(richest, track))
    kept = track.part(good) if good.sum() >= FEWEST else track
    scenes = _scenes(kept, richest, nodes)
    if not scenes:
        return _still(kept, fits, models)
    shares = log_shares(models)
    rows = {kind: _rows(scenes, fits[kind].motion) for kind in shares}
    priors = (LOG_DISTORTIONS[:, None] + LOG_PLAYS).ravel()
    probabilities, kind, i, j = weigh(rows, scenes[0].moved, priors, shares)
    if probabilities[STILL.name] > probabilities[kind]:
        kind = STILL.name
    follows = kind == STILL.name or not (track.oriented and bool(LOOSE[j]))
    if not follows:
        model = next(model for model in models if model.name == kind)
        fits = {**fits, kind: fit(track.points(), model, rng)}
    enough = probabilities[kind] >= SURE
    return Choice(probabilities, fits[kind], enough, _why(probabilities, fits[kind], enough, track), fits, follows,
                  float(PLAYS[i % len(PLAYS)]))  # fmt: skip


def _rows(scenes: list[NodeScene], motion: Motion) -> list[EvidenceRow]:
    """A kind's rows: of each scene, one for every play."""
    rows: list[EvidenceRow] = []
    column = 2
    for k, scene in enumerate(scenes):
        # there and back, as what is most probable at one play is a good guess for the next
        line: list[EvidenceRow] = []
        for play in PLAYS if k % 2 == 0 else PLAYS[::-1]:
            line.append(row(scene, motion, float(play), column=column))
            motion, column = line[-1].motion, line[-1].column
        rows += line if k % 2 == 0 else line[::-1]
    return rows


def gross(found: JointFit, track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) are off by more than four times what noise, or the usual play of furniture, does."""
    sigma = _scales(found)
    e = found.motion.residuals(track, found.motion.configurations(track, sigma))
    off = np.linalg.norm(e[:, :3], axis=1) > _GROSS * max(sigma[0], float(PLAYS[2]))
    if e.shape[1] == 6:
        off |= np.linalg.norm(e[:, 3:], axis=1) > _GROSS * max(sigma[1], float(SWAYS[2]))
    return off


def _scenes(track: Track, richest: JointFit, most: int) -> list[NodeScene]:
    """The nodes of a track with each size of distortion; none where nothing moved."""
    nodes = Nodes(track.oriented, most)
    for i in range(len(track)):
        nodes.add(track.positions[i], None if track.rotations is None else track.rotations[i])
    pooled = nodes.track()
    if pooled is None:
        return []
    sigma = white_noise(richest.motion.residuals(track, richest.motion.configurations(track, _scales(richest))))
    apart, counts = nodes.apart(), nodes.counts[: nodes.k]
    return [NodeScene.of(pooled, apart, counts, sigma, float(size)) for size in DISTORTIONS]


def _scales(found: JointFit) -> tuple[float, float]:
    return found.sigma_position, found.sigma_rotation if np.isfinite(found.sigma_rotation) else 1.0


def white_noise(e: Array) -> tuple[float, float]:
    """Noise of one sample [m, rad] that its neighbour in time does not share, from residuals (n, 3) or (n, 6)."""
    steps = np.diff(e, axis=0)
    # medians of χ² with two and three degrees of freedom, times the two samples in a difference
    position = float(np.sqrt(np.median((steps[:, :3] ** 2).sum(axis=1)) / 2.77))
    rotation = float(np.sqrt(np.median((steps[:, 3:] ** 2).sum(axis=1)) / 4.73)) if e.shape[1] == 6 else 0.0
    return position, rotation


def _still(track: Track, fits: dict[Kind, JointFit], models: Sequence[ArticulationModel]) -> Choice:
    """All samples lie within a few nodes: nothing moved, or too little to tell how."""
    rigid = still(2.0 * track.extent())
    probabilities: dict[Kind, float] = {STILL.name: rigid}
    for kind, log_share in log_shares(models).items():
        probabilities[kind] = (1.0 - rigid) * float(np.exp(log_share))
    best = max(probabilities, key=lambda kind: probabilities[kind])
    enough = probabilities[best] >= SURE
    why = _why(probabilities, fits[best], enough, track)
    return Choice(probabilities, fits[best], enough, why, fits, True, float(PLAYS[2]))


def _why(probabilities: dict[Kind, float], chosen: JointFit, enough: bool, track: Track) -> str:
    seen = chosen.model.sentence(chosen.configurations[chosen.weights > 0.2], track.extent(), chosen.std)
    percent = {kind: f"{100.0 * p:.0f} %" for kind, p in probabilities.items()}
    if enough:
        return f"{chosen.model.kind} ({percent[chosen.model.kind]}): it {seen}"
    ranked = sorted(percent, key=lambda kind: -probabilities[kind])[:2]
    return f"not enough motion yet: {percent[ranked[0]]} {ranked[0]}, {percent[ranked[1]]} {ranked[1]}; it {seen}"
