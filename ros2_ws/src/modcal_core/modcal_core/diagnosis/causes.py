"""What a diagnosis says: the effects that were chosen, each with why, what is left, and what a scan saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Fit, RowView, beyond_normal
from modcal_core.diagnosis.choice import EffectChoice, one_motion_names
from modcal_core.diagnosis.evidence import Evidence
from modcal_core.effects import AS_LIKELY, AXIS, LENGTH, SHIFT, Effect, columns, public_driver
from modcal_core.effects.families import step
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, joints_instead, spread_rows

_MAX_COMPARED, _STEPS = 300, 4  # samples at which a move is compared with a slip, and steps of its fit
_SHIFTS = ("x", "y", "z", LENGTH, SHIFT)  # one row of a map: five would say nearly the same


@dataclass(frozen=True)
class EvidenceMap:
    """rows: (place, direction), those that shift a place taken together. drivers: of the columns. share: of the squared
    residual that the best candidate explains, (R, C), NaN where none was looked for. p_value: that noise alone would
    have as good a best.
    """

    rows: tuple[tuple[str, str], ...]
    drivers: tuple[str, ...]
    share: Array
    p_value: float

    def strongest(self, most: int) -> list[tuple[str, str, str, float]]:
        """Place, direction, driver and share of the cells that explain most, the best first."""
        flat = np.nan_to_num(self.share, nan=-1.0).ravel()
        best = [int(k) for k in np.argsort(-flat, kind="stable")[:most] if flat[k] >= 0.0]
        cells = [divmod(k, len(self.drivers)) for k in best]
        return [(*self.rows[i], self.drivers[j], float(self.share[i, j])) for i, j in cells]


def evidence_map(evidence: Evidence, joints: Sequence[str]) -> EvidenceMap:
    """The map of a scan. joints: in the order of the chain, which rows and columns follow, base first, tool last."""
    alike: dict[tuple[str, str, str], int] = {}  # thousands of candidates share a few hundred of these
    which = [alike.setdefault((e.place, e.direction, e.driver), len(alike)) for e in evidence.effects]
    most = np.zeros(len(alike))
    np.maximum.at(most, which, evidence.explained)
    best: dict[tuple[str, str], dict[str, float]] = {}
    for (at, direction, follows), most_of in zip(alike, most.tolist(), strict=True):
        cells = best.setdefault((at, SHIFT if direction in _SHIFTS else direction), {})
        driver = public_driver(follows)
        cells[driver] = max(most_of, cells.get(driver, 0.0))
    drivers = tuple(dict.fromkeys(public_driver(driver) for _, _, driver in alike))
    place = {name: k for k, name in enumerate(("base", *joints, "tool", "tracker"))}
    drivers = tuple(sorted(drivers, key=lambda d: (*_kind(d), place.get(d.partition(":")[2], 0), d)))
    rows = tuple(sorted(best, key=lambda row: place.get(row[0], len(place))))
    share = np.array([[best[row].get(driver, np.nan) for driver in drivers] for row in rows])
    return EvidenceMap(rows, drivers, share.reshape(len(rows), len(drivers)), evidence.p_value)


def _kind(driver: str) -> tuple[int, str]:
    """What a driver is sorted by: those that stand for themselves, such as time, come last."""
    kind, colon, _ = driver.partition(":")
    return (0 if kind == "position" else 1 if colon else 2), kind


@dataclass(frozen=True)
class Cause:
    """An effect that was chosen, and why. p_value: that noise would look as good. same_as, rivals: what explains it
    as well, by name and as effects.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    rivals: tuple[Effect, ...]


def causes_of_moves(fit: Fit, samples: Samples) -> tuple[Cause, ...]:
    """The causes of a fit's moves of base and tool, which were found before all others."""
    out = []
    for effect in fit.model.effects:
        at = effect.shape.settings["at"]
        same = (*one_motion_names(effect), *_slips_alike(fit, effect, samples), *joints_instead(samples, at))
        size = float(np.max(np.abs(effect.values) / np.maximum(effect.std, 1e-300)))
        out.append(Cause(effect, max(2.0 * beyond_normal(size), 1e-300), same, ()))
    return tuple(out)


def _slips_alike(fit: Fit, move: Effect, samples: Samples) -> tuple[str, ...]:
    """Names, as in ``same_as``, of joints that move the readings as a move does, had they slipped then."""
    few = samples.select(spread_rows(len(samples), _MAX_COMPARED))
    T = fit.model.with_effects((move,)).predict_samples(few)
    few = replace(few, reading=T[:, :3, 3], R=T[:, :3, :3])
    as_well = 2.0 * AS_LIKELY + len(move.amplitudes) * np.log(few.is_pose.sum() * 3 + len(few) * 3)  # Schwarz
    out = []
    for name in fit.model.chain.names:
        slip, left = step.moved(name, AXIS, move.shape.settings["at"]).started(np.zeros(1)), np.inf
        for _ in range(_STEPS):
            model = fit.model.with_effects((slip,))
            view = RowView.of(model, few, drivers := model.drivers(few))
            r = np.r_[view.position.ravel() / fit.noise.position, view.rotation.ravel() / fit.noise.rotation]
            (terms,) = columns(slip, drivers)
            x = view.moved_by(terms)
            x[: 3 * len(few)] /= fit.noise.position
            x[3 * len(few) :] /= fit.noise.rotation
            size = x @ r / max(x @ x, 1e-300)
            slip, left = slip.with_values(slip.values + size), r @ r - size * (x @ r)
        if left < as_well:
            out.append(f"{name} axis by {move.public_driver}")
    return tuple(out)


@dataclass(frozen=True)
class Diagnosis:
    """fit: to *train*, with the effects. causes: in the order found, with their fitted effects. left: what is
    significant still but could not be turned into an effect that predicts, None where the rest is noise. maps: what
    the first scan saw and what the last one did. again: True for samples of *train* that the fit had rejected and that
    were taken in again, (N,); None where none were.
    """

    fit: Fit
    causes: tuple[Cause, ...]
    left: EffectChoice | None
    maps: tuple[EvidenceMap, ...] = ()
    again: np.ndarray | None = None
