"""What the diagnosis found, as entries of the report: one for each place and driver, with sizes and a sentence.

The story is that of the final model: what an entry is worth is what its removal from that model costs on held-out,
everything else fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration.distributions import beyond_normal
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import REJECT_Z
from modcal_core.calibration.removal import without
from modcal_core.calibration.score import Errors, errors, outlying
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.diagnosis.causes import Diagnosis
from modcal_core.effects.effect import ALL, AXIS, Effect, is_large_move, is_move
from modcal_core.effects.entry import ReportEntry
from modcal_core.effects.families import outliers
from modcal_core.effects.registry import claimed, family, with_companions
from modcal_core.effects.sizes import Quantity
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.effect_sizes import at_tool, parameters
from modcal_core.verdict.contributions import resampled

_MAX_SEEN = 500  # samples at which the size at the tool is taken


@dataclass(frozen=True)
class Finding:
    """One entry. effects: what it consists of, fitted to all samples (a gear may have several lines). before, after:
    RMS error on held-out without it and with it [m], all else in the final model. gain_mm2, ci95: mean square that its
    removal costs on held-out [mm²], with the 95 % interval over stations; None where there is nothing to remove. tool:
    RMS by which it moves the tool [m]. sampled: sign flips that p_value was compared with.
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
    sampled: int = 0

    @property
    def shown(self) -> bool:
        """Whether held-out stations show that it brings something."""
        # large moves were let in by what positions and orientations of unseen stations gain together
        return self.ci95 is None or self.ci95[0] > 0.0 or any(is_large_move(effect) for effect in self.effects)

    @property
    def chance(self) -> str:
        """Chance that noise looks as good, as text: what sampling shows, and what is extrapolated."""
        least = 1.0 / (self.sampled + 1)
        if not self.sampled or self.p_value >= least:
            return f"{self.p_value:.2g}"
        return f"below 1/{self.sampled + 1} by sampling; extrapolated {self.p_value:.0e}"

    @property
    def sentence(self) -> str:
        """What a technician should know of it."""
        entry = ReportEntry(self.place, self.direction, self.driver, self.parameters, self.same_as)
        said = family(self.family).sentence(entry)
        moved = f" (it moves the tool by {1e3 * self.tool:.3f} mm RMS)" if self.tool is not None else ""
        return f"{said}; {self._gain}{moved}."

    @property
    def _gain(self) -> str:
        if self.gain_mm2 is None:
            return f"the error is {1e3 * self.after:.3f} mm without, {1e3 * self.before:.3f} mm with"
        if not self.shown:
            return "the held-out stations do not show that it helps"
        return f"without it the error would be {1e3 * self.before:.3f} instead of {1e3 * self.after:.3f} mm"


def findings(
    diagnosis: Diagnosis, shipped: Model, samples: Samples, wrong: np.ndarray, scored: Samples, known: Uncertainty
) -> tuple[Finding, ...]:
    """Entries in the order found; the same place and driver found again joins its entry.

    shipped: the model fitted to all samples, its effects in the same order. wrong: samples far from the scored fit.
    scored: the held-out samples it is judged by. known: how well the scored fit's values are known.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, effect in enumerate(shipped.effects):
        if not claimed(effect):
            continue
        # each move is an entry of its own
        key = (*effect.key, effect.shape.settings["at"]) if is_move(effect) else effect.key
        groups.setdefault(key, []).append(i)
    left = errors(diagnosis.fit.model, scored).position_norm ** 2 if groups and len(scored) else None
    few = samples.select(spread_rows(len(samples), _MAX_SEEN))
    entries = []
    for numbers in groups.values():
        effects = tuple(shipped.effects[i] for i in numbers)
        together = with_companions(shipped.effects, numbers)
        companions = tuple(shipped.effects[i] for i in together[len(numbers) :])
        causes = [diagnosis.causes[i] for i in numbers]
        same = dict.fromkeys(
            name
            for e, c in zip(effects, causes, strict=True)
            for name in (*_link_name(e, shipped), *family(e.family).same_as(e, samples), *c.same_as)
        )
        before, after, gain, interval = _worth(diagnosis.fit.model, known, together, scored, left)
        first = effects[0]
        entries.append(
            Finding(
                *(first.family, first.place, first.direction, first.public_driver),
                parameters=parameters(effects, shipped.chain, companions),
                p_value=min(c.p_value for c in causes),
                before=before,
                after=after,
                same_as=tuple(same),
                effects=(*effects, *companions),
                gain_mm2=gain,
                ci95=interval,
                tool=at_tool(shipped, together, few),
                sampled=min(c.sampled for c in causes),
            )
        )
    wrong = wrong & outlying(shipped, diagnosis.fit.noise, samples) & _certain(shipped, samples)
    return (*_outliers(diagnosis.fit, samples, wrong), *entries)


def _worth(
    model: Model, known: Uncertainty, numbers: Sequence[int], scored: Samples, with_them: Array | None
) -> tuple[float, float, float | None, tuple[float, float] | None]:
    """(RMS without these effects, with them [m], what removal costs [mm²], its 95 % interval) on the scored samples.

    with_them: squares that the whole model leaves, (N,) [m²]; None where none are scored.
    """
    if with_them is None:
        return float("nan"), float("nan"), None, None
    without_them = errors(without(model, known, numbers), scored).position_norm ** 2
    cost, interval = resampled(1e6 * (without_them - with_them), scored.station)
    return float(np.sqrt(without_them.mean())), float(np.sqrt(with_them.mean())), cost, interval


def _link_name(effect: Effect, model: Model) -> tuple[str, ...]:
    """What grows or creeps in front of a joint is the link there: its name, where the robot states it."""
    names, links = model.chain.names, model.chain.links
    if effect.direction == AXIS or effect.place not in names or not links:
        return ()
    return (f"{links[names.index(effect.place)]} {effect.direction} by {effect.public_driver}",)


def _certain(model: Model, samples: Samples) -> np.ndarray:
    """False where it is unknown how an effect acts, (N,), so that a large residual there is no outlier."""
    drivers = model.drivers(samples)
    known = [family(effect.family).certain(effect, drivers) for effect in model.effects]
    return np.all([np.ones(len(samples), bool), *known], axis=0)


def _outliers(fit: Fit, samples: Samples, wrong: np.ndarray) -> tuple[Finding, ...]:
    if not wrong.any():
        return ()
    count = (float(len(np.unique(samples.station[wrong]))), 0.0, "1")
    with_them, without_them = (_rms(errors(fit.model, s)) for s in (samples, samples.select(np.flatnonzero(~wrong))))
    by_chance = min(1.0, len(samples) * beyond_normal(REJECT_Z))  # that noise makes any of them
    return (
        Finding(outliers.NAME, "tracker", ALL, "constant", {"stations": count}, by_chance, with_them, without_them),
    )


def _rms(residuals: Errors) -> float:
    return float(np.sqrt(np.mean(residuals.position_norm**2))) if len(residuals.position) else float("nan")
