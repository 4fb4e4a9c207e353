"""What the diagnosis found, as entries of the report: one for each place and driver, with sizes and a sentence.

The story is that of the final model: what an entry is worth is what its removal from that model costs on held-out,
everything else fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from modcal_core.calibration import (
    REJECT_Z,
    Calibration,
    Errors,
    Fit,
    Model,
    Readmitted,
    beyond_normal,
    errors,
    outlying,
)
from modcal_core.diagnosis import Cause, Diagnosis, Loads, by_weight, one_motion_names
from modcal_core.effects import (
    ALL,
    AXIS,
    ZERO,
    Effect,
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
from modcal_core.geometry import error_values, se3
from modcal_core.hypotheses import LIMIT_OF_REACH
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import kinds
from modcal_core.robots import Mechanism
from modcal_core.verdict import TOGETHER, Case, Contribution, Proofs, Verdict, entries_of, resampled


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
    RMS by which it moves the tool [m], None of what only readings show. shown: whether it may be named as a cause, by
    stations that were not used, in any partition of them.
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
                tool=None if first.direction == ZERO else at_tool(shipped, together, few),
                shown=rivals is not None,
            )
        )
    drivers = shipped.drivers(samples)
    wrong = case.wrong & outlying(shipped, diagnosis.fit.noise, samples)
    for effect in shipped.effects:  # where it is unknown how one acts, a large residual is no outlier
        wrong &= family_named(effect.family).certain(effect, drivers)
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
    """The payload as an entry of the report, worth what its removal alone costs; none where none was found."""
    if loads is None or not loads.payloads or loads.relative or not len(scored):
        return ()
    sizes: dict[str, Quantity] = {}
    for k, found in enumerate(loads.payloads, 1):
        number = f"_{k}" if len(loads.payloads) > 1 else ""
        sizes[f"mass{number}"] = (found.mass, found.mass_std, "kg")
        if found.place is not None and found.place_std is not None:
            for axis, at, std in zip("xyz", found.place, found.place_std, strict=True):
                sizes[f"centre_{axis}{number}"] = (float(at), float(std), "m")
    arm = loads.before
    if loads.down is not None and arm.inertias is not None:
        arm = replace(arm, inertias=arm.inertias.pulled(loads.down))
    bare = replace(model, arm=arm)  # without what was found to be carried
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


def counted(count: int, thing: str) -> str:
    """A number and what it counts, in the plural where it is one: ``1 station``, ``2 stations``."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def fit_notes(nominal: Fit, final: Fit, accepted: Samples) -> tuple[str, ...]:
    """Sentences on the nominal arm where it misses by more than a robot of that description should, on how each kind
    of reading that is no position scatters about the model, and on :func:`one_instrument_notes`.
    """
    out = []
    size, limit = errors(nominal.model, accepted).size_mm(), 1e3 * LIMIT_OF_REACH * nominal.model.chain.reach()
    if size is not None and size.rms > limit:
        out.append(
            f"The nominal model misses by {size.rms:.0f} mm RMS, a robot of that description should by less than "
            f"{limit:.0f} mm. The fitted geometry makes up for it where stations are; see whether the description is "
            "that of this robot, and whether a joint's zero has changed, before it is used elsewhere."
        )
    for name, scatter in final.noise.others.items():
        said = f"{1e3 * scatter:.3g} mm" if kinds()[name].unit == "m" else f"{1e6 * scatter:.3g} µrad"
        out.append(f"Readings of kind {name} scatter about the model by {said}.")
    return (*out, *one_instrument_notes(final))


_ALIKE = 5e-3  # m, rad: no two instruments stand so close, and turned so alike


def one_instrument_notes(fit: Fit) -> tuple[str, ...]:
    """A sentence for two frames with the same coordinates, surely: those of one instrument under two names have."""
    model, out = fit.model, []
    row = {(p.frame, p.direction): i for i, p in enumerate(fit.parameters) if p.place == 0}
    for a, b in combinations(range(len(model.frames)), 2):
        if model.leader(a) == model.leader(b):
            continue
        apart = np.abs(error_values(se3.inverse(model.T_frame_base[a]) @ model.T_frame_base[b]))
        own = [[row[model.leader(f), d] for f in (a, b) if (model.leader(f), d) in row] for d in range(6)]
        signs = np.array([1.0, -1.0])
        std = [float(np.sqrt(signs[: len(i)] @ fit.covariance[np.ix_(i, i)] @ signs[: len(i)])) for i in own]
        if (apart + 2.0 * np.array(std) < _ALIKE).all():
            out.append(
                f"Frames {model.frames[a]} and {model.frames[b]} have the same coordinates, to "
                f"{1e3 * np.linalg.norm(apart[:3]):.2g} mm: give the readings of one instrument one frame_id; now each "
                "frame has a place of its own."
            )
    return tuple(out)


def finding_notes(stated: Sequence[Finding], unproved: Sequence[Finding]) -> tuple[str, ...]:
    """Sentences on the moves of base and tool that were stated, with their fitted sizes, and on effects that predict
    together and that held-out stations do not prove one by one.
    """
    out = [f"As stated, in every model: {'; '.join(move.what for move in stated)}."] if stated else []
    if unproved:
        are = "is" if len(unproved) == 1 else "are"
        names = ", ".join(dict.fromkeys(f"{finding.family} of {finding.place}" for finding in unproved))
        out.append(
            f"{counted(len(unproved), 'further effect')} in the model {are} not proved by stations that were not used, "
            f"and named as no cause: {names}."
        )
    return tuple(out)


def readmitted_note(again: Readmitted) -> tuple[str, ...]:
    """A sentence for stations that were rejected first and fitted after all, where they are, and what would tell."""
    if not again.stations:
        return ()
    where = [f"{p.joint} between {p.low:.2f} and {p.high:.2f} ({p.stations} of {p.of} there)" for p in again.places]
    shown = f" They show the curve of {' and of '.join(where)}." if where else ""
    still = f" {again.unscored} of them are left out of the score still." if again.unscored else ""
    return (
        f"{counted(again.stations, 'station')} that the model first missed were taken in again, since no others "
        f"contradict them.{shown}{still} If they are wrong readings, the curve is wrong there; stations there on "
        "another day would tell.",
    )


def moved_note(residuals: Errors, calibration: Calibration, refit_base: bool, refit_tool: bool) -> tuple[str, ...]:
    """A sentence for the person whose robot, tracker or tool stands elsewhere than when it was calibrated."""
    size = residuals.size_mm()
    limit = LIMIT_OF_REACH * calibration.nominal.chain.reach()
    if size is None or size.rms < 1e3 * limit or (refit_base and refit_tool):
        return ()
    return ("The error is larger than an arm's: base or tool have changed: --refit-base, --refit-tool fit them again.",)


def unseen_note(samples: Samples, calibration: Calibration, beyond: float = 0.0) -> tuple[str, ...]:
    """A sentence for joints that go where no calibration saw them. beyond: share of samples that may without a word."""
    low, high = calibration.seen
    margin = 0.02 * (high - low)
    out = (samples.q < low - margin) | (samples.q > high + margin)
    if out.any(axis=1).mean() <= beyond:
        return ()
    worst = [
        f"{name} (seen {low[j]:.2f} … {high[j]:.2f}, here {samples.q[:, j].min():.2f} … {samples.q[:, j].max():.2f})"
        for j, name in enumerate(samples.names)
        if out[:, j].any()
    ]
    instead = calibration.fallback(calibration.calibrated, calibration.geometric)
    count = 0 if instead is None else int((instead.share(samples) > 0.0).sum())
    where = f": at {count} samples, where the full model is not known to be better, geometry alone counts"
    return (
        f"{int(out.any(axis=1).sum())} of {len(samples)} samples lie outside the joint ranges that were calibrated: "
        f"{', '.join(worst)}. Learned curves are not continued there{where if count else ''}.",
    )


def not_asked_note(verdict: Verdict) -> tuple[str, ...]:
    """A sentence on what so few stations do not answer; none where everything could be asked."""
    if not verdict.not_asked:
        return ()
    questions = ", or ".join(f"{question.what} (that needs {question.needs})" for question in verdict.not_asked)
    return (f"These stations are too few to ask {questions}.",)


def residual_notes(case: Case, worth: Sequence[Contribution]) -> tuple[str, ...]:
    """A sentence on the effects of the scored model that no entry contains, largest joint first; none without them."""
    model, scored = case.model, case.scored
    part = next((part for part in worth if part.label == TOGETHER), None)
    if part is None:
        return ()
    few = scored.select(spread_rows(len(scored), MAX_SEEN))
    of_joint: dict[str, list[int]] = {}
    for i in part.numbers:
        of_joint.setdefault(model.effects[i].place, []).append(i)
    size = {joint: 1e3 * at_tool(model, own, few) for joint, own in of_joint.items()}
    shares = ", ".join(f"{joint} {size[joint]:.3f} mm" for joint in sorted(size, key=lambda j: -size[j]))
    with_them = 1e3 * rms(case.errors["final"])
    alone = float(np.sqrt(max(with_them**2 + part.mm2, 0.0)))
    return (
        f"Beside what is named, small curves of joints, each held as small as these stations make likely, were learned "
        f"together (RMS at the tool: {shares}); without them the error would be {alone:.3f} instead of {with_them:.3f} "
        "mm. None of them is claimed as a cause.",
    )


_NORMAL = 1.96  # deviations of a 95 % interval


def load_notes(loads: Loads | None) -> tuple[str, ...]:
    """Sentences on gravity and payloads, with 95 % intervals."""
    if loads is None:
        return ()
    out = []
    if loads.unknown:
        out.append(
            "The stations cannot tell gravity: joints seem to deflect under a weight that pulls another way than the "
            "robot description says, but not which way. State gravity: in the cell file."
        )
    if loads.down is not None:
        way = ", ".join(f"{x:+.3f}" for x in loads.down)
        out.append(
            f"Weight pulls along [{way}] in the base link (± {np.degrees(_NORMAL * loads.down_std):.2g}°), "
            f"{np.degrees(loads.turned):.1f}° from where the robot description says: state gravity: in the cell file, "
            "or tilt the base in the URDF."
        )
    if loads.relative and loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g}" for p in loads.payloads[:-1])
        out.append(
            f"The recordings were loaded differently: {said} of what the tip carries in the last one. No mass is "
            "known, so compliances are per kg of that."
        )
    elif loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g} kg" for p in loads.payloads)
        where = "" if len(loads.payloads) == 1 else " in the recordings, one after the other"
        out.append(f"The tip carries {said}{where} beyond what the robot description states.")
    if loads.centre is not None and loads.centre_std is not None:
        each = zip("xyz", 1e3 * loads.centre, 1e3 * _NORMAL * loads.centre_std, strict=True)
        said = ", ".join(f"{axis} {at:+.0f} ± {wide:.2g} mm" for axis, at, wide in each)
        out.append(f"The payload that the recording states has its centre at {said} in the tip link.")
    return tuple(out)
