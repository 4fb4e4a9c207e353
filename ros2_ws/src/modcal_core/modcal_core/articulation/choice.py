"""Which kind of joint it is: probabilities, the fit of the most probable kind, and whether enough was seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation import furniture
from modcal_core.articulation.added import added_models
from modcal_core.articulation.added_evidence import AddedTerms
from modcal_core.articulation.added_fit import AddedFit, fit_added
from modcal_core.articulation.evidence import Row, Terms, row, still, weigh
from modcal_core.articulation.fit import Fit, fit
from modcal_core.articulation.joints import KINDS, Kind
from modcal_core.articulation.motion import Motion
from modcal_core.articulation.nodes import Nodes
from modcal_core.articulation.scene import DISTORTIONS, LOG_DISTORTIONS, LOG_PLAYS, LOOSE, PLAYS, SWAYS, Scene
from modcal_core.articulation.track import FEWEST, Track
from modcal_core.geometry.so3 import Array

SURE = 0.95  # probability from which a kind is said


@dataclass(frozen=True)
class Choice:
    """probabilities: of every kind, 1 together. fit: of the most probable of the four kinds of the house. enough:
    whether to rely on the kind.

    why: one sentence for a person. fits: of every kind. follows: whether the rotations that were seen are the handle's;
    when a grasp turns in the hand, the fit rests on positions alone. play: how far the object departs from ideal [m].
    added: fits of the models that packages add, by name. kind: the most probable of all, which may be one of these.
    """

    probabilities: dict[Kind, float]
    fit: Fit
    enough: bool
    why: str
    fits: dict[Kind, Fit]
    follows: bool
    play: float
    added: dict[str, AddedFit] = field(default_factory=dict)
    best: AddedFit | None = None

    @property
    def kind(self) -> str:
        """The most probable kind."""
        return self.leading.model.kind

    @property
    def leading(self) -> Fit | AddedFit:
        """The fit of the most probable kind, one of a package included."""
        return self.best or self.fit


def choose(track: Track, rng: np.random.Generator | None = None, nodes: int = 12) -> Choice:
    """The choice between rigid, prismatic, revolute, screw and what packages add, for one track.

    rng: picks samples for first guesses. Raises BadTable where a package's model is none.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    fits = {kind: fit(track, kind, rng) for kind in KINDS}
    models = added_models()
    added = {own.name: fit_added(track, own, rng) for own in models}
    all_fits: list[Fit | AddedFit] = [*fits.values(), *added.values()]
    richest = max(all_fits, key=lambda f: f.log_likelihood)  # what it cannot explain, none can
    good = np.logical_not(gross(richest, track))
    kept = track.part(good) if good.sum() >= FEWEST else track
    scenes = _scenes(kept, richest, nodes)
    if not scenes:
        return _still(kept, fits)
    rows = {kind: _rows(scenes, fits[kind].motion, Terms.of) for kind in KINDS[1:]}
    for found in added.values():
        rows[found.motion.kind] = _rows(scenes, found.motion, AddedTerms.of)
    priors = (LOG_DISTORTIONS[:, None] + LOG_PLAYS).ravel()
    shares = {added[own.name].motion.kind: own.model.share for own in models}
    probabilities, kind, i, j = weigh(rows, scenes[0].moved, priors, shares)
    if probabilities["rigid"] > probabilities[kind]:
        kind = "rigid"
    follows = kind == "rigid" or not (track.oriented and bool(LOOSE[j]))
    if not follows and kind in added:
        own = added[kind].motion.own
        added = {**added, kind: fit_added(track.points(), own, rng)}
    elif not follows:
        fits = {**fits, kind: fit(track.points(), kind, rng)}
    of_house = kind if kind in fits else max(KINDS, key=lambda k: probabilities[k])
    enough, leading = probabilities[kind] >= SURE, added.get(kind) or fits[kind]
    return Choice(probabilities, fits[of_house], enough, _why(probabilities, leading, enough, track), fits, follows,
                  float(PLAYS[i % len(PLAYS)]), added, added.get(kind))  # fmt: skip


def _rows(scenes: list[Scene], motion: Motion, look: Callable[[Scene, Motion, float], Terms]) -> list[Row]:
    """A kind's rows: of each scene, one for every play."""
    rows: list[Row] = []
    column = 2
    for k, scene in enumerate(scenes):
        # there and back, as what is most probable at one play is a good guess for the next
        line: list[Row] = []
        for play in PLAYS if k % 2 == 0 else PLAYS[::-1]:
            line.append(row(scene, motion, float(play), column=column, look=look))
            motion, column = line[-1].motion, line[-1].column
        rows += line if k % 2 == 0 else line[::-1]
    return rows


def gross(found: Fit | AddedFit, track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) are off by more than four times what noise, or the usual play of furniture, does."""
    sigma = _scales(found)
    e = found.motion.residuals(track, found.motion.configurations(track, sigma))
    off = np.linalg.norm(e[:, :3], axis=1) > 4.0 * max(sigma[0], float(PLAYS[2]))
    if e.shape[1] == 6:
        off |= np.linalg.norm(e[:, 3:], axis=1) > 4.0 * max(sigma[1], float(SWAYS[2]))
    return off


def _scenes(track: Track, richest: Fit | AddedFit, most: int) -> list[Scene]:
    """The nodes of a track with each size of distortion; none where nothing moved."""
    nodes = Nodes(track.oriented, most)
    for i in range(len(track)):
        nodes.add(track.positions[i], None if track.rotations is None else track.rotations[i])
    pooled = nodes.track()
    if pooled is None:
        return []
    sigma = white_noise(richest.motion.residuals(track, richest.motion.configurations(track, _scales(richest))))
    apart, counts = nodes.apart(), nodes.counts[: nodes.k]
    return [Scene.of(pooled, apart, counts, sigma, float(size)) for size in DISTORTIONS]


def _scales(found: Fit | AddedFit) -> tuple[float, float]:
    return found.sigma_position, found.sigma_rotation if np.isfinite(found.sigma_rotation) else 1.0


def white_noise(e: Array) -> tuple[float, float]:
    """Noise of one sample [m, rad] that its neighbour in time does not share, from residuals (n, 3) or (n, 6)."""
    steps = np.diff(e, axis=0)
    # medians of χ² with two and three degrees of freedom, times the two samples in a difference
    position = float(np.sqrt(np.median((steps[:, :3] ** 2).sum(axis=1)) / 2.77))
    rotation = float(np.sqrt(np.median((steps[:, 3:] ** 2).sum(axis=1)) / 4.73)) if e.shape[1] == 6 else 0.0
    return position, rotation


def _still(track: Track, fits: dict[Kind, Fit]) -> Choice:
    """All samples lie within a few nodes: nothing moved, or too little to tell how."""
    rigid = still(2.0 * track.extent())
    probabilities: dict[Kind, float] = {"rigid": rigid}
    for kind in KINDS[1:]:
        probabilities[kind] = (1.0 - rigid) * furniture.SHARE[kind]
    best: Kind = max(probabilities, key=lambda kind: probabilities[kind])
    enough = probabilities[best] >= SURE
    why = _why(probabilities, fits[best], enough, track)
    return Choice(probabilities, fits[best], enough, why, fits, True, float(PLAYS[2]))


def _why(probabilities: dict[Kind, float], chosen: Fit | AddedFit, enough: bool, track: Track) -> str:
    span = float(np.ptp(chosen.configurations[chosen.weights > 0.2])) if (chosen.weights > 0.2).any() else 0.0
    if isinstance(chosen, AddedFit):
        path = chosen.model.position(np.sort(chosen.configurations[chosen.weights > 0.2]))
        way = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        said = ", ".join(f"{name} {value:.3g} ± {chosen.std[name]:.2g}" for name, value in chosen.model.values.items())
        seen = f"moved {1e2 * way:.0f} cm along its path; {said}"
        return _sentence(probabilities, chosen.model.kind, enough, seen)
    model = chosen.model
    if model.kind == "rigid":
        seen = f"moved by no more than {1e3 * track.extent():.0f} mm"
    elif model.kind == "prismatic":
        seen = f"slid {1e2 * span:.0f} cm along a line"
    else:
        rise = f", rising {2e3 * np.pi * model.pitch:.0f} mm a turn" if model.kind == "screw" else ""
        seen = f"turned {np.degrees(span):.0f}° at {1e2 * model.radius:.0f} cm from its axis{rise}"
    return _sentence(probabilities, model.kind, enough, seen)


def _sentence(probabilities: dict[Kind, float], kind: str, enough: bool, seen: str) -> str:
    percent = {str(k): f"{100.0 * p:.0f} %" for k, p in probabilities.items()}
    if enough:
        return f"{kind} ({percent[kind]}): it {seen}"
    ranked = sorted(percent, key=lambda k: -probabilities[cast("Kind", k)])[:2]
    return f"not enough motion yet: {percent[ranked[0]]} {ranked[0]}, {percent[ranked[1]]} {ranked[1]}; it {seen}"
