"""What the diagnosis found, as entries of the report: one for each place and driver, with sizes and a sentence.

The story is that of the final model: what an entry is worth is what its removal from that model costs on held-out,
everything else fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.calibration import REJECT_Z, Errors, Fit, Model, beyond_normal, errors, outlying
from modcal_core.diagnosis import Cause, Diagnosis, Loads, by_weight, one_motion_names
from modcal_core.effects import (
    ALL,
    AXIS,
    Effect,
    NominalArm,
    Quantity,
    ReportEntry,
    Sizes,
    curve_sizes,
    family_named,
    is_large_move,
    unit_of,
    with_companions,
)
from modcal_core.effects.families import outliers, payload
from modcal_core.measurements import Samples, spread_rows
from modcal_core.robots import Mechanism
from modcal_core.verdict import Case, Contribution, Proofs, Verdict, entries_of, resampled


def parameters(effects: Sequence[Effect], chain: Mechanism, companions: Sequence[Effect] = ()) -> Sizes:
    """Named sizes of the effects of one entry; later ones numbered. companions: curves that its first is one with."""
    out: Sizes = {}
    curves = [i for i, effect in enumerate(effects) if effect.direction == AXIS and effect.shape.kind == "spline"]
    for i, effect in enumerate(effects):
        sizes = family_named(effect.family).sizes(effect, chain)
        if companions and i in curves[:1]:
            sizes |= curve_sizes(effect, unit_of(effect, chain), companions)
        for name, quantity in sizes.items():
            out[name if i == 0 else f"{name}_{i + 1}"] = quantity
    return out


def _in_rows(sizes: Sizes, samples: Samples) -> Sizes:
    """Sizes with rows for seconds, where stamps only count rows."""
    gaps = np.diff(np.unique(samples.stamps))
    if samples.clock or not len(gaps):
        return sizes
    row, out = float(np.median(gaps)), dict(sizes)
    for name, (value, std, unit) in sizes.items():
        if unit == "s":
            out[name] = value / row, std / row, "rows"
        elif unit.endswith("/s"):
            out[name] = value * row, std * row, f"{unit[:-1]}row"
    return out


def at_tool(model: Model, effects: Sequence[int], samples: Samples) -> float:
    """RMS distance [m] by which the effects of these numbers together move the tool at the samples."""
    kept = tuple(e for i, e in enumerate(model.effects) if i not in set(effects))
    gap = model.predict_samples(samples)[:, :3, 3] - model.with_effects(kept).predict_samples(samples)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


_TOLD = 2  # rivals that a sentence gives; report.json has all of them
MAX_SEEN = 500  # samples at which the size at the tool is taken
_LEAST_CHANCE = 1e-6
_OF_THE_ARM = 1e-3  # of the reach, which effects of an arm seldom move its tool by
_OF_THE_REST = 20.0  # times the RMS miss of the others; an effect that acts at few postures grows towards them
_LEVER = 0.1  # of the reach; an error of the arm that turns the tool moves it by the angle times this, at least
_SAME_POSTURE = 0.01  # rad or m; teeth of a gear are some 0.06 rad apart


@dataclass(frozen=True)
class Finding:
    """One entry. effects: what it consists of, fitted to all samples (a gear may have several lines). before, after:
    RMS error on held-out without it and with it [m], all else in the final model. gain_mm2, ci95: mean square that its
    removal costs on held-out [mm²], with the 95 % interval over stations; None where there is nothing to remove. tool:
    RMS by which it moves the tool [m]. shown: whether it may be named as a cause, by stations that were not used, in
    any partition of them.
    """

    family: str
    place: str
    direction: str
    driver: str
    parameters: dict[str, Quantity]
    p_value: float
    before: float
    after: float
    same_as: tuple[str, ...] = ()
    effects: tuple[Effect, ...] = field(default=())
    gain_mm2: float | None = None
    ci95: tuple[float, float] | None = None
    tool: float | None = None
    shown: bool = True

    @property
    def chance(self) -> str:
        """Chance that noise looks as good, as text: no law of noise is known farther out."""
        return f"{self.p_value:.2g}" if self.p_value >= _LEAST_CHANCE else f"below {_LEAST_CHANCE:.0e}"

    @property
    def sentence(self) -> str:
        """What a technician should know of it."""
        moved = f" (it moves the tool by {1e3 * self.tool:.3f} mm RMS)" if self.tool is not None else ""
        if not self.same_as:
            return f"{self.what}; {self._gain}{moved}."
        more = len(self.same_as) - _TOLD
        others = "; ".join(self.same_as[:_TOLD]) + (f"; {more} more" if more > 0 else "")
        gain = self._gain[0].upper() + self._gain[1:]
        return f"One of these, which the readings do not tell apart: {self.what}; {others}. {gain}{moved}."

    @property
    def what(self) -> str:
        """The effect and its sizes, without what it brings."""
        entry = ReportEntry(self.place, self.direction, self.driver, self.parameters, self.same_as)
        return family_named(self.family).sentence(entry)

    @property
    def _gain(self) -> str:
        if self.gain_mm2 is None:
            return f"the error is {1e3 * self.after:.3f} mm without, {1e3 * self.before:.3f} mm with"
        if not self.shown:
            return "the held-out stations do not show that it helps"
        return f"without it the error would be {1e3 * self.before:.3f} instead of {1e3 * self.after:.3f} mm"


def findings(
    diagnosis: Diagnosis, shipped: Model, case: Case, judged: Verdict, worth: Sequence[Contribution]
) -> tuple[Finding, ...]:
    """Entries in the order found; the same place and driver found again joins its entry.

    shipped: the model fitted to all samples, its effects in the same order. case: of the scored fit. judged: its
    verdict. worth: what its effects contribute.
    """
    proofs, samples = Proofs(case, judged), case.samples
    of = {part.numbers: part for part in worth}
    few = samples.select(spread_rows(len(samples), MAX_SEEN))
    after = rms(case.errors["final"])
    entries = []
    for numbers in entries_of(shipped.effects):
        effects = tuple(shipped.effects[i] for i in numbers)
        together = with_companions(shipped.effects, numbers)
        companions = tuple(shipped.effects[i] for i in together[len(numbers) :])
        causes = [diagnosis.causes[i] for i in numbers]
        same = dict.fromkeys(
            name
            for e, c in zip(effects, causes, strict=True)
            for name in (*_link_name(e, shipped), *family_named(e.family).same_as(e, samples), *_one_motion(c))
        )
        part, first = of.get(together), effects[0]
        # large moves were let in by positions and orientations together
        asked = part is None or part.ci95_mm2[0] > 0.0 or any(map(is_large_move, effects))
        rivals = proofs.of(together, [rival for c in causes for rival in c.rivals]) if asked else None
        entries.append(
            Finding(
                *(first.family, first.place, first.direction, first.public_driver),
                parameters=_in_rows(parameters(effects, shipped.chain, companions), samples),
                p_value=min(c.p_value for c in causes),
                before=float("nan") if part is None else float(np.sqrt(max(after**2 + 1e-6 * part.mm2, 0.0))),
                after=after,
                same_as=(*same, *(rivals or ())),
                effects=(*effects, *companions),
                gain_mm2=None if part is None else part.mm2,
                ci95=None if part is None else part.ci95_mm2,
                tool=at_tool(shipped, together, few),
                shown=rivals is not None,
            )
        )
    wrong = case.wrong & outlying(shipped, diagnosis.fit.noise, samples) & _certain(shipped, samples)
    wrong &= _not_the_arm(shipped, samples, case.wrong)
    return (*_outliers(diagnosis.fit, samples, wrong), *entries)


def _one_motion(cause: Cause) -> tuple[str, ...]:
    """What moves as a cause does, whatever the readings; of a scan's rivals the final model is asked again."""
    alike = one_motion_names(cause.effect)
    return tuple(name for name in cause.same_as if not cause.rivals or name in alike)


def _link_name(effect: Effect, model: Model) -> tuple[str, ...]:
    """What grows or creeps in front of a joint is the link there: its name, where the robot states it."""
    names, links = model.chain.names, model.chain.links
    if effect.direction == AXIS or effect.place not in names or not links:
        return ()
    return (f"{links[names.index(effect.place)]} {effect.direction} by {effect.public_driver}",)


def _certain(model: Model, samples: Samples) -> np.ndarray:
    """False where it is unknown how an effect acts, (N,), so that a large residual there is no outlier."""
    drivers = model.drivers(samples)
    known = [family_named(effect.family).certain(effect, drivers) for effect in model.effects]
    return np.all([np.ones(len(samples), bool), *known], axis=0)


def _not_the_arm(model: Model, samples: Samples, wrong: np.ndarray) -> np.ndarray:
    """True for samples that no arm misses so, (N,): an effect that the model lacks may act at a few postures alone.

    It does not where a sample that is not wrong came to the same posture alike, and does not move a tool that far, for
    itself and beside the others.
    """
    e, reach = errors(model, samples), model.chain.reach()
    miss = e.position_norm.copy()
    miss[samples.is_pose] = np.maximum(miss[samples.is_pose], _LEVER * reach * e.rotation_norm)
    if not wrong.any() or wrong.all():
        return wrong
    from scipy.spatial import cKDTree  # takes a tenth of a second to load

    at = np.hstack([samples.q, samples.approach])
    beside = cKDTree(at[~wrong]).query(at, distance_upper_bound=_SAME_POSTURE)[0] < np.inf
    most = min(_OF_THE_ARM * reach, _OF_THE_REST * float(np.sqrt(np.mean(miss[~wrong] ** 2))))
    return np.asarray(beside | (miss > most))


def _outliers(fit: Fit, samples: Samples, wrong: np.ndarray) -> tuple[Finding, ...]:
    if not wrong.any():
        return ()
    count = (float(len(np.unique(samples.station[wrong]))), 0.0, "1")
    with_them, without_them = (rms(errors(fit.model, s)) for s in (samples, samples.select(np.flatnonzero(~wrong))))
    by_chance = min(1.0, len(samples) * beyond_normal(REJECT_Z))  # that noise makes any of them
    return (
        Finding(outliers.NAME, "tracker", ALL, "constant", {"stations": count}, by_chance, with_them, without_them),
    )


def rms(residuals: Errors) -> float:
    """RMS of the position errors [m]; NaN where there are none."""
    return float(np.sqrt(np.mean(residuals.position_norm**2))) if len(residuals.position) else float("nan")


def load_findings(loads: Loads | None, model: Model, scored: Samples) -> tuple[Finding, ...]:
    """The payload as an entry of the report; none where none was found.

    What it is worth is what its removal costs, compliances and all else being kept.
    """
    if loads is None or not loads.payloads or loads.relative or not len(scored):
        return ()
    sizes: dict[str, Quantity] = {}
    many = len(loads.payloads) > 1
    for k, found in enumerate(loads.payloads, 1):
        number = f"_{k}" if many else ""
        sizes[f"mass{number}"] = (found.mass, found.mass_std, "kg")
        if found.place is not None and found.place_std is not None:
            for axis, at, std in zip("xyz", found.place, found.place_std, strict=True):
                sizes[f"centre_{axis}{number}"] = (float(at), float(std), "m")
    bare = replace(model, arm=_unloaded(loads))
    with_it, without_it = (errors(m, scored).position_norm ** 2 for m in (model, bare))
    cost, interval = resampled(1e6 * (without_it - with_it), scored.station)
    sure = max(abs(p.mass) / p.mass_std for p in loads.payloads if p.mass_std > 0.0)
    driver = next((e.public_driver for e in model.effects if by_weight(e)), "constant")
    moved = model.predict_samples(scored)[:, :3, 3] - bare.predict_samples(scored)[:, :3, 3]
    return (
        Finding(
            *(payload.NAME, "tool", ALL, driver),
            parameters=sizes,
            p_value=max(2.0 * beyond_normal(sure), 1e-300),
            before=float(np.sqrt(without_it.mean())),
            after=float(np.sqrt(with_it.mean())),
            gain_mm2=cost,
            ci95=interval,
            tool=float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
            shown=interval[0] > 0.0,
        ),
    )


def _unloaded(loads: Loads) -> NominalArm:
    """The arm without what was found to be carried."""
    if loads.down is None or loads.before.inertias is None:
        return loads.before
    return replace(loads.before, inertias=loads.before.inertias.pulled(loads.down))
