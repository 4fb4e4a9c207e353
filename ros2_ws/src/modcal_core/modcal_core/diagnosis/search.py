"""Find what the model lacks, add it, and go on until the rest is noise.

Each round scans the candidates on everything but the held-out set, picks the plainest effect that explains what can be
explained, fits it together with all others to *train*, and keeps it only if it also predicts *explain*, which that fit
has not seen. An effect that later becomes needless is taken out; one that another explains better is exchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from modcal_core.calibration import (
    FITTED,
    AnyDistance,
    Fit,
    Model,
    errors,
    identify,
    squared_residuals,
    uncertainty,
    without,
)
from modcal_core.diagnosis.causes import Cause, Diagnosis, evidence_map
from modcal_core.diagnosis.choice import SIGNIFICANT, EffectChoice, better_choice, choose, other_forms
from modcal_core.diagnosis.evidence import MIN_FREEDOM, Evidence, Scanner
from modcal_core.diagnosis.pruning import (
    DRAWN_IN,
    MIN_GAIN,
    isolated_outliers,
    joint_size,
    needless,
    rejected_share,
    with_uncontradicted,
)
from modcal_core.diagnosis.rounds import chosen_together, surely_worth
from modcal_core.effects import Drivers, Effect, candidates, family_named, nothing_plainer
from modcal_core.measurements import Samples, spread_rows

MAX_EFFECTS = 30  # for time
_MAX_SCANNED = 1000  # samples; a longer recording is thinned evenly
_MAX_FITTED = 3000  # samples while searching; in the end all of *train* is fitted
# Standard deviations to which a fit is brought while searching; of many rows as near as leaves its squares to lose no
# more than this share of what an effect must take from them. In the end it is FITTED
_TOLERANCE, _LEFT = 0.05, 1e-4
# A fit whose effect has not taken _HALF of what it must on *explain* ends where further steps cannot change that: where
# they may gain _LITTLE of it on *train*, and a step so long moves *explain* by less (two deviations of its noise along
# a step of length s are 2 · 2 s √0.4, in 40 % as many rows)
_HALF, _LITTLE, _NO_CHANCE = 0.5, 0.05, 0.04
_MAX_STEPS = 15  # of such a fit: usual are three to eight, and where a wave's cycles keep changing for more it has none
_MAX_REVISITED = 400  # samples up to which choices are weighed against each other, before and after
_MAX_REFUSED = 3  # choices in a row that did not predict, before the search ends
_JUDGED = 2  # fits of which is remembered what *explain* says of them: that which stands, and one beside it
_HALVED = 0.5  # of the rejected, at most, that may be left where an effect is to explain what was rejected
_MAX_SINGLE = 0.05  # share of the samples up to which rejected ones are taken for single wrong readings
_TRADES = 0.3  # correlation with a later effect from which one may have stood in for it
_ROUNDING = 1e-9  # of a covariance at unit diagonal
_NEEDLESS = 3.0  # standard deviations below which an amplitude may be nothing; the largest of several is asked


@dataclass(frozen=True)
class Sought:
    """What effects are looked for in. train: samples that are fitted. explain: samples that decide. suspects: what to
    look for besides the candidates. known: causes of effects that the fit has already; they stay. least_freedom: rows
    beyond what is fitted, with fewer of which nothing is looked for. only: which candidates are.
    """

    train: Samples
    explain: Samples
    distances: tuple[AnyDistance, ...] = ()
    progress: Callable[[str], None] = lambda _: None
    suspects: Callable[[Drivers], Iterable[Effect]] = lambda _: ()
    known: Sequence[Cause] = ()
    least_freedom: int = MIN_FREEDOM
    only: Callable[[Effect], bool] = lambda _: True


def diagnose(fit: Fit, sought: Sought) -> Diagnosis:
    """The effects that the fit to *train* lacks, judged on *explain*.

    Where the fit rejects more than single wrong readings make up, what it rejects may be the effect that is looked for.
    Then nothing is rejected while searching, if what is found that way leaves less to be rejected.
    """
    many = rejected_share(fit)
    if many > _MAX_SINGLE and not sought.known:
        whole = identify(fit.start, sought.train, fit.parameters, sought.distances, begin=fit.values, reject=False)
        found = _searched(whole, sought, reject=False)
        if found.causes and rejected_share(found.fit) <= min(_HALVED * many, _MAX_SINGLE):
            return found
    return _searched(fit, sought)


def _searched(fit: Fit, sought: Sought, reject: bool = True) -> Diagnosis:
    """See :func:`diagnose`. reject: leave out what lies far outside while searching."""
    train, explain, distances = sought.train, sought.explain, sought.distances
    both = train.join(explain)
    alone = isolated_outliers(fit, both) if reject else np.zeros(len(both), bool)
    both = both.select(_evenly(np.flatnonzero(~alone), _MAX_SCANNED))
    drivers = fit.model.drivers(both)
    scanner = Scanner([*filter(sought.only, candidates(drivers)), *sought.suspects(drivers)], drivers)
    fitted = train.select(_evenly(np.arange(len(train)), _MAX_FITTED))
    search = _EffectSearch(fit, scanner, fitted, explain, distances, tuple(sought.known), reject)
    left: EffectChoice | None = None
    refused: set[tuple[str, str, str, str]] = set()
    scans: list[Evidence] = []
    missed = 0
    evidence: Evidence | None = None
    while scanner.enough(search.fit, sought.least_freedom) and len(search.causes) < MAX_EFFECTS:
        if evidence is None:  # after a choice that was refused, the fit is as it was, and so is what it leaves
            evidence = scanner.evidence(search.fit, trials=True)
            scans = [*scans[:1], evidence]
            if evidence.p_value > SIGNIFICANT:
                left = None
                break
        choice = choose(evidence, scanner, search.fit, refused)
        if choice is None or missed > _MAX_REFUSED:
            break
        if choice.p_value > SIGNIFICANT and train.moving.any():
            left = (
                left or choice
            )  # neighbours in motion share their errors: that *explain* is predicted shows too little
            break
        sought.progress(choice.effect.label)
        if search.add_several(evidence, choice, refused) or search.add(choice):
            left, missed, evidence = None, 0, None
        else:  # also more of the same, which is not worth having: another may be
            refused.add(choice.effect.key)
            left, missed = left or choice, missed + 1
    search.make_plainer()
    search.settle()
    final = search.fit
    again: np.ndarray | None = None
    if final.model.effects:
        start = fit.start.with_effects(final.model.effects)
        final = identify(start, train, fit.parameters, distances, tolerance=FITTED, begin=final.values)
        taken_in, again = with_uncontradicted(final, train, distances)
        final = search.prune(taken_in, train)
    effects = final.model.effects
    causes = tuple(replace(c, effect=e) for c, e in zip(search.causes, effects, strict=False))
    maps = tuple(evidence_map(scan, fit.model.chain.names) for scan in scans)
    return Diagnosis(final, causes, left, maps, again)


@dataclass
class _EffectSearch:
    """The fit so far, and how it changes: effects added, taken out, exchanged."""

    fit: Fit
    scanner: Scanner
    train: Samples
    explain: Samples
    distances: tuple[AnyDistance, ...]
    known: tuple[Cause, ...] = ()
    reject: bool = True

    def __post_init__(self) -> None:
        self.causes: list[Cause] = list(self.known)
        self._geometric = self.fit
        self._judged: list[tuple[Fit, float]] = []  # fits that *explain* was asked of last, and its answers
        rows = 3 * (len(self.train) + int(self.train.is_pose.sum()))
        # a step of so many deviations gains its square
        must = MIN_GAIN * rows  # what an effect must take of the squares
        self._tolerance = max(_TOLERANCE, float(np.sqrt(_LEFT * must)))
        self._clear = min(float(np.sqrt(_LITTLE * must)), _NO_CHANCE * must)
        self._weighs = len(self.scanner.drivers) <= _MAX_REVISITED
        self._stale = False  # whether the causes' own fits are those of another order

    def add(self, choice: EffectChoice) -> bool:
        """Whether the effect, fitted with all others to *train*, predicts *explain* better."""
        before, causes = self.fit, list(self.causes)
        missed = self._mean_square(before)
        effect, self.fit = self._in_best_form(choice.effect, missed)
        rivals = tuple(rival for rival in choice.rivals if rival.key != effect.key)
        same = tuple(name for name in choice.same_as if name != effect.label)
        self.causes.append(Cause(effect, choice.p_value, same, rivals, self.fit))
        better = self._mean_square(self.fit) < (1.0 - MIN_GAIN) * missed
        if better and len(self.causes) > 1 + len(self.known) and self._weighs:
            self.make_plainer()
            if self._weakest() == (len(self.causes) - 1, True):  # nothing beside the others, it would be taken out
                self.fit, self.causes = before, causes
                return False
            self._exchange()
            self._take_out()
            # every round must bring something, or rounds could go in circles
            better = self._mean_square(self.fit) < (1.0 - MIN_GAIN) * missed
        if not better:
            self.fit, self.causes = before, causes
        return better

    def add_several(self, evidence: Evidence, first: EffectChoice, refused: set[tuple[str, str, str, str]]) -> bool:
        """Whether effects that a scan shows together, fitted at once, each surely predict *explain* better beside those
        before them. Those of which that is not sure are left to another round.
        """
        if self._weighs:  # there each is weighed against all before it
            return False
        most = MAX_EFFECTS - len(self.causes)
        chosen = chosen_together(first, evidence, self.scanner, self.fit, refused, most)
        if len(chosen) < 2:
            return False
        old = self.fit.model.effects
        fit = self._refit(self.fit, (*old, *(one.started for one in chosen)))
        known = uncertainty(fit.model, self.train, fit.parameters, fit, self.distances)
        worth = surely_worth(fit.model, known, len(old), self._mean_square(self.fit), self._missed_by)
        if not worth:
            return False
        if len(worth) < len(chosen):
            fit = self._refit(fit, (*old, *(fit.model.effects[len(old) + i] for i, _ in worth)))
        for i, model in worth:
            one, nested = chosen[i].choice, replace(fit, model=model)
            self.causes.append(Cause(one.effect, one.p_value, one.same_as, one.rivals, nested))
        self.fit = fit
        return True

    def _in_best_form(self, effect: Effect, missed: float) -> tuple[Effect, Fit]:
        """The effect, or another form of it with as many amplitudes that leaves less of all but the held-out set.

        missed: what *explain* is missed by without it.
        """
        forms = other_forms(effect, self.scanner.effects)
        if not forms:
            return effect, self._with(self.fit, effect, missed)
        seen = self.train.join(self.explain)
        fits = [(form, self._with(self.fit, form)) for form in (effect, *forms)]
        likely = [(e, f) for e, f in fits if family_named(e.family).plausible(f.model.effects[-1])]
        return min(likely or fits, key=lambda pair: self._mean_square(pair[1], seen))

    def _with(self, fit: Fit, effect: Effect, missed: float = np.inf) -> Fit:
        """The fit with this effect too. missed: by which it ends early where the effect leads to nothing."""
        started = effect.started(self.scanner.amplitudes(fit, effect))
        asked = False

        def hopeless(model: Model, length: float) -> bool:
            nonlocal asked
            if asked or length > self._clear:
                return False
            asked = True
            return self._missed_by(model) > (1.0 - _HALF * MIN_GAIN) * missed

        return self._refit(fit, (*fit.model.effects, started), hopeless if np.isfinite(missed) else None)

    def _refit(
        self,
        fit: Fit,
        effects: tuple[Effect, ...],
        hopeless: Callable[[Model, float], bool] | None = None,
        spread: bool = False,
    ) -> Fit:
        """The fit of these effects. spread: with how well they are known, where nobody asks for that in between."""
        # about the same start as ever, so that priors keep their meaning
        start = self._geometric.start.with_effects(effects)
        return identify(
            start,
            self.train,
            fit.parameters,
            self.distances,
            tolerance=self._tolerance,
            begin=self.fit.values,
            reject=self.reject,
            most=_MAX_STEPS,
            hopeless=hopeless,
            spread=spread or self._weighs,
        )

    def _exchange(self) -> None:
        """Weigh earlier effects that trade with the last against the candidates again, with the later ones known."""
        for i in self._trading():
            effects = self.fit.model.effects
            found = better_choice(i, self.fit, self.scanner)
            if found is None:
                continue
            better, started = found
            new = self._refit(self.fit, (*effects[:i], started, *effects[i + 1 :]))
            if self._mean_square(new) < self._mean_square(self.fit):
                self.fit = new
                said = self.causes[i]
                self.causes[i] = Cause(better.effect, said.p_value, better.same_as, better.rivals, new)
                self._stale = True

    def _trading(self) -> list[int]:
        """The numbers of earlier effects that can be exchanged for the last, going by correlations of their values."""
        fit, effects = self.fit, self.fit.model.effects
        C = uncertainty(fit.model, self.train, fit.parameters, fit, self.distances).covariance
        edges = len(fit.parameters) + np.cumsum([0, *(len(e.values) for e in effects)])
        own = [slice(a, b) for a, b in pairwise(edges.tolist())]
        half = np.linalg.cholesky(_at_unit(C)) if len(effects) > 1 else C
        bases = [np.linalg.qr(half[rows].T)[0] for rows in own]
        return [
            i for i in range(len(self.known), len(effects) - 1) if np.linalg.norm(bases[i].T @ bases[-1], 2) > _TRADES
        ]

    def _take_out(self) -> None:
        """Drop effects that are nothing beside the others."""
        self.make_plainer()
        while True:
            weakest, needless = self._weakest()
            if not needless:
                return
            del self.causes[weakest]
            effects = self.fit.model.effects
            self.fit = self._refit(self.fit, effects[:weakest] + effects[weakest + 1 :])
            self._stale = True

    def _weakest(self) -> tuple[int, bool]:
        """The number of the effect that is least beside the others, and whether it is nothing: of one alone it is not
        said.
        """
        effects = self.fit.model.effects
        size = [float(np.max(np.abs(e.amplitudes) / np.maximum(e.std[: len(e.amplitudes)], 1e-300))) for e in effects]
        size[: len(self.known)] = [np.inf] * len(self.known)
        size = self._together(size)
        weakest = int(np.argmin(size))
        return weakest, size[weakest] < _NEEDLESS and len(size) >= 2 + len(self.known)

    def _together(self, size: list[float]) -> list[float]:
        """Sizes of the effects, of those that seem nothing the size of all their amplitudes together."""
        effects = self.fit.model.effects
        small = [i for i, x in enumerate(size) if x < _NEEDLESS and len(effects[i].amplitudes) > 1]
        if small:
            known = uncertainty(self.fit.model, self.train, self.fit.parameters, self.fit, self.distances)
            for i in small:
                size[i] = max(size[i], joint_size(effects, i, known))
        return size

    def make_plainer(self) -> None:
        """Put a family's plainer effect in the place of each that is not needed in full."""
        effects = self.fit.model.effects
        if not self._weighs and any(family_named(e.family).plainer is not nothing_plainer for e in effects):
            self.fit = self._refit(self.fit, effects, spread=True)  # by how well each is known
        while self._made_plainer():
            pass

    def _made_plainer(self) -> bool:
        """Whether an effect was found not to be needed in full, and its family's plainer one put in its place."""
        effects = self.fit.model.effects
        for i, effect in enumerate(effects):
            plain = family_named(effect.family).plainer(effect)
            if plain is not None:
                self.fit = self._refit(self.fit, (*effects[:i], plain, *effects[i + 1 :]), spread=True)
                self.causes[i] = replace(self.causes[i], effect=plain)
                self._stale = True
                return True
        return False

    def settle(self) -> None:
        """Fit the first, the first two, … effects again where their order has changed since."""
        if not self._stale:
            return
        effects = self.fit.model.effects
        for i, cause in list(enumerate(self.causes))[len(self.known) :]:
            fit = self.fit if i + 1 == len(effects) else self._refit(self.fit, effects[: i + 1])
            self.causes[i] = replace(cause, fit=fit)

    def prune(self, final: Fit, train: Samples) -> Fit:
        """The fit to all of *train* without effects that it does not need; their causes go with them."""
        stay = len(self.known)
        pruned, gone, known = needless(final, train, self.explain, self._geometric.noise, self.distances, stay)
        if gone:
            known = known or uncertainty(pruned.model, train, pruned.parameters, pruned, self.distances)
            kept = [cause for i, cause in enumerate(self.causes) if i not in gone]
            nested = (without(pruned.model, known, range(i + 1, len(kept))) for i in range(stay, len(kept)))
            later = [replace(c, fit=replace(pruned, model=m)) for c, m in zip(kept[stay:], nested, strict=True)]
            self.causes = [*kept[:stay], *later]
        return pruned

    def _mean_square(self, fit: Fit, samples: Samples | None = None) -> float:
        """Mean squared error on *explain*, or on other samples, each sample's drawn in so that none rules alone."""
        if samples is not None:
            return self._missed_by(fit.model, samples)
        missed = next((missed for judged, missed in self._judged if judged is fit), None)
        missed = self._missed_by(fit.model) if missed is None else missed
        self._judged = [(fit, missed), *(pair for pair in self._judged if pair[0] is not fit)][:_JUDGED]
        return missed

    def _missed_by(self, model: Model, samples: Samples | None = None) -> float:
        """The same of a model."""
        # what readings scatter by themselves counts too: the spread is what is left beside it, and may be nothing
        samples = self.explain if samples is None else samples
        square = squared_residuals(errors(model, samples), samples, self._geometric.noise)
        return float(np.mean(np.minimum(square, DRAWN_IN * np.median(square) + 1e-300)))


def _at_unit(C: np.ndarray) -> np.ndarray:
    """A covariance (K, K) as correlations, and positive definite beyond rounding."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(C), 1e-300))
    return np.asarray(C * np.outer(scale, scale) + _ROUNDING * np.eye(len(C)))


def _evenly(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[spread_rows(len(rows), most)]
