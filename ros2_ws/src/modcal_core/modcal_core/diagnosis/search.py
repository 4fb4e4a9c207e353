"""Find what the model lacks, add it, and go on until the rest is noise.

Each round scans the candidates on everything but the held-out set, picks the plainest effect that explains what can be
explained, fits it together with all others to *train*, and keeps it only if it also predicts *explain*, which that fit
has not seen. An effect that later becomes needless is taken out; one that another explains better is exchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

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
)
from modcal_core.diagnosis.causes import Cause, Diagnosis, evidence_map
from modcal_core.diagnosis.choice import SIGNIFICANT, EffectChoice, choose, other_forms
from modcal_core.diagnosis.evidence import MIN_FREEDOM, Evidence, Scanner
from modcal_core.diagnosis.pruning import (
    DRAWN_IN,
    MIN_GAIN,
    isolated_outliers,
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
_TOLERANCE = 0.05  # standard deviations to which a fit is brought while searching; in the end it is FITTED
_MAX_STEPS = 15  # of such a fit: usual are three to eight, and where a wave's cycles keep changing for more it has none
_MAX_REFUSED = 3  # choices in a row that did not predict, before the search ends
_HALVED = 0.5  # of the rejected, at most, that may be left where an effect is to explain what was rejected
_MAX_SINGLE = 0.05  # share of the samples up to which rejected ones are taken for single wrong readings


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
            # neighbours in motion share their errors: that *explain* is predicted shows too little
            left = left or choice
            break
        sought.progress(choice.effect.label)
        if search.add_several(evidence, choice, refused) or search.add(choice):
            left, missed, evidence = None, 0, None
        else:  # also more of the same, which is not worth having: another may be
            refused.add(choice.effect.key)
            left, missed = left or choice, missed + 1
    search.make_plainer()
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
    """The fit so far, and how it changes: effects added, made plainer, taken out."""

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

    def add(self, choice: EffectChoice) -> bool:
        """Whether the effect, fitted with all others to *train*, predicts *explain* better."""
        effect, fit = self._in_best_form(choice.effect)
        if self._missed_by(fit.model) >= (1.0 - MIN_GAIN) * self._missed_by(self.fit.model):
            return False
        rivals = tuple(rival for rival in choice.rivals if rival.key != effect.key)
        same = tuple(name for name in choice.same_as if name != effect.label)
        self.causes.append(Cause(effect, choice.p_value, same, rivals))
        self.fit = fit
        return True

    def add_several(self, evidence: Evidence, first: EffectChoice, refused: set[tuple[str, str, str, str]]) -> bool:
        """Whether effects that a scan shows together, fitted at once, each surely predict *explain* better beside those
        before them. Those of which that is not sure are left to another round.
        """
        most = MAX_EFFECTS - len(self.causes)
        chosen = chosen_together(first, evidence, self.scanner, self.fit, refused, most)
        if len(chosen) < 2:
            return False
        old = self.fit.model.effects
        fit = self._refit(self.fit, (*old, *(one.started for one in chosen)))
        known = uncertainty(fit.model, self.train, fit.parameters, fit, self.distances)
        worth = surely_worth(fit.model, known, len(old), self._missed_by(self.fit.model), self._missed_by)
        if not worth:
            return False
        if len(worth) < len(chosen):
            fit = self._refit(fit, (*old, *(fit.model.effects[len(old) + i] for i in worth)))
        for i in worth:
            one = chosen[i].choice
            self.causes.append(Cause(one.effect, one.p_value, one.same_as, one.rivals))
        self.fit = fit
        return True

    def _in_best_form(self, effect: Effect) -> tuple[Effect, Fit]:
        """The effect, or another form of it with as many amplitudes that leaves less of all but the held-out set."""
        forms = other_forms(effect, self.scanner.effects)
        if not forms:
            return effect, self._with(self.fit, effect)
        seen = self.train.join(self.explain)
        fits = [(form, self._with(self.fit, form)) for form in (effect, *forms)]
        likely = [(e, f) for e, f in fits if family_named(e.family).plausible(f.model.effects[-1])]
        return min(likely or fits, key=lambda pair: self._missed_by(pair[1].model, seen))

    def _with(self, fit: Fit, effect: Effect) -> Fit:
        """The fit with this effect too."""
        return self._refit(fit, (*fit.model.effects, effect.started(self.scanner.amplitudes(fit, effect))))

    def _refit(self, fit: Fit, effects: tuple[Effect, ...], spread: bool = False) -> Fit:
        """The fit of these effects. spread: with how well they are known, too."""
        # about the same start as ever, so that priors keep their meaning
        start = self._geometric.start.with_effects(effects)
        return identify(
            start,
            self.train,
            fit.parameters,
            self.distances,
            tolerance=_TOLERANCE,
            begin=self.fit.values,
            reject=self.reject,
            most=_MAX_STEPS,
            spread=spread,
        )

    def make_plainer(self) -> None:
        """Put a family's plainer effect in the place of each that is not needed in full."""
        effects = self.fit.model.effects
        if any(family_named(e.family).plainer is not nothing_plainer for e in effects):
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
                return True
        return False

    def prune(self, final: Fit, train: Samples) -> Fit:
        """The fit to all of *train* without effects that it does not need; their causes go with them."""
        pruned, gone = needless(final, train, self.explain, self._geometric.noise, self.distances, len(self.known))
        self.causes = [cause for i, cause in enumerate(self.causes) if i not in gone]
        return pruned

    def _missed_by(self, model: Model, samples: Samples | None = None) -> float:
        """Mean squared error on *explain*, or on other samples, each sample's drawn in so that none rules alone."""
        # what readings scatter by themselves counts too: the spread is what is left beside it, and may be nothing
        samples = self.explain if samples is None else samples
        square = squared_residuals(errors(model, samples), samples, self._geometric.noise)
        return float(np.mean(np.minimum(square, DRAWN_IN * np.median(square) + 1e-300)))


def _evenly(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[spread_rows(len(rows), most)]
