"""Known distances beside what a fit makes of them: whether the data contradict what was stated.

Where a ball rests in sockets the readings are joint positions alone. What a fit leaves of them is measured in the
lengths that it fits: an arm that is a tenth shorter leaves a tenth less, and least squares draw all lengths together
wherever nothing but the drawing holds them. That is no evidence. What is random are the joints, and in their density
the determinant of the map from joints to what is left undoes it: only what is left *in units of the joints' levers*
counts, which scale does not change. So the scale is told by how far an arm is expected to be from its drawing. How far
this one is, its lengths tell together: an arm whose lengths are within half a millimetre of the drawing is not 2 % too
long in all of them. The scale is found from fits that hold it: with all known distances a little longer, and a little
shorter.

Without all of them the arm's own lengths, as well as they are known, give the scale. What the readings and the arm then
say of each distance is compared with what is stated; one factor that all stated distances share is estimated from that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from modcal_core.calibration.covariance import Uncertainty, uncertainty
from modcal_core.calibration.distances import CONTRADICTED, AnyDistance, Distance, distance_rows
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import errors
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples
from modcal_core.robots import is_serial_arm, tool_frames

# --- What fixed points and the arm's drawing say of the scale, where known distances are left aside

_STEP = 0.02  # of all distances; of the order in which an arm's drawing tells its scale
_FARTHEST = 0.1  # of all distances, in one round: beyond, a parabola through the three is no guide
_TRIED = np.geomspace(0.8, 1.25, 12).tolist()  # factors that are begun from, twice as far apart as steps are
_ROUNDS = 8  # iterations; where the distances are right the first ones are the last
_SETTLED = 0.1  # standard deviations of the scale, and as a share of that deviation
_GOOD = 1e-3  # m; of the order in which arms are off as they leave their maker
_ALONG = 0.5  # cosine with the first joint's axis, from which a length is rather the base's place along it
_ANYWHERE = 1.0  # m; farther than any fit has a base
_MIN_SHOWN = 4.0  # lengths of the arm that the readings tell, from which it is judged how far they are off
_MIN_OFF = 2e-4  # m; what drawings allow of lengths as an arm's links have (ISO 2768, medium: 0.2 to 0.5 mm)


@dataclass(frozen=True)
class ScaleEstimate:
    """By which share of itself every known distance would be longer for all the readings say, and its deviation."""

    longer: float
    std: float


def scale_without_distances(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> ScaleEstimate | None:
    """What the readings and the arm's drawing say of the scale; None where not all readings are of fixed points.

    fit: of these samples with the known distances. Another kind of reading tells the scale by itself.
    """
    fixed = all(samples.is_same_point(f) for f in range(len(samples.frames)))
    if not fixed or not distances or not is_serial_arm(fit.model.chain):
        return None
    cost_of = partial(_cost, samples=samples, distances=distances)
    shown = _shown(fit)
    told = shown >= _MIN_SHOWN
    try:
        # from a good arm on: with lengths that are expected far off, wrong distances could be those of a bad one
        fit = _expecting(fit, _GOOD) if told else fit
        about = min(_TRIED, key=partial(cost_of, fit)) if told else 1.0
        for _ in range(_ROUNDS):
            found = _settled(partial(cost_of, fit), about)
            if found is None or not told:
                break
            middle = _held(fit, samples, distances, found[0])
            shown, before = _shown(middle), about
            fit, about = _expecting(fit, _off(middle, shown)), found[0]
            if abs(about - before) < _SETTLED * found[1]:
                break
    except NotEnoughData:
        return None
    if found is None:
        return None
    # widened as so few values tell it: a contradiction is then as rare as a normal one's
    beyond = float(scipy.special.ndtr(-CONTRADICTED))
    wider = -float(scipy.special.stdtrit(shown, beyond)) / CONTRADICTED if told else 1.0
    return ScaleEstimate(found[0] - 1.0, found[0] * found[1] * wider)


def _settled(cost: Callable[[float], float], about: float) -> tuple[float, float] | None:
    """The factor that costs least, near another, and its deviation as a share of it; None where there is none."""
    last = np.inf
    for _ in range(_ROUNDS):
        low, here, high = (cost(about * (1.0 + step)) for step in (-_STEP, 0.0, _STEP))
        bent = high + low - 2.0 * here
        if bent <= 0.0:
            return None
        step, std = 0.5 * _STEP * (low - high) / bent, _STEP * float(np.sqrt(2.0 / bent))
        about *= 1.0 + float(np.clip(step, -_FARTHEST, _FARTHEST))
        # rejections that come and go make the cost uneven: then steps grow no shorter
        if abs(step) < _SETTLED * std or 0.5 * last < abs(step) < _FARTHEST:
            break
        last = abs(step)
    return about, std


def _lengths(fit: Fit) -> np.ndarray:
    """Which parameters are lengths of the arm, and not the base's place along the first joint's axis, (P,)."""
    chain = fit.model.serial
    axis = chain.joint_basis[1].T @ chain.origins[1, :3, :3].T @ chain.axes[0] if chain.n > 1 else np.zeros(3)
    of_base = [p.place == 1 and not p.turns and abs(float(axis[p.direction])) > _ALONG for p in fit.parameters]
    own = [p.of_arm and not p.turns and bool(np.isfinite(p.prior_std)) for p in fit.parameters]
    return np.array(own) & ~np.array(of_base)


def _shown(fit: Fit) -> float:
    """How many of the arm's lengths the readings tell, and not what was expected of them."""
    own = _lengths(fit)
    expected = np.array([p.prior_std for p in fit.parameters])[own]
    return float(np.sum(1.0 - np.minimum(fit.std[own] / expected, 1.0) ** 2))


def _off(fit: Fit, shown: float) -> float:
    """How far [m] the arm's lengths are from the drawing: the deviation under which the readings are likeliest.

    The squares of the values over how many of them the readings tell (MacKay 1992).
    """
    return max(float(np.sqrt(np.sum(fit.values[_lengths(fit)] ** 2) / max(shown, 1.0))), _MIN_OFF)


def _expecting(fit: Fit, off: float) -> Fit:
    """The fit with the arm's lengths expected to be so far from the drawing [m], and where its base is not at all."""
    own = _lengths(fit).tolist()
    parameters = [
        replace(p, prior_std=off if mine else _ANYWHERE) if p.of_arm and not p.turns else p
        for p, mine in zip(fit.parameters, own, strict=True)
    ]
    return replace(fit, parameters=tuple(parameters))


def _held(fit: Fit, samples: Samples, distances: Sequence[AnyDistance], factor: float) -> Fit:
    """The fit with all known distances times a factor, effects as they are."""
    start = fit.start.with_effects(fit.model.effects)
    known = [replace(d, distance=factor * d.distance) for d in distances]
    return identify(start, samples, fit.parameters, known, keep_effects=True, begin=fit.values)


def _cost(fit: Fit, factor: float, samples: Samples, distances: Sequence[AnyDistance]) -> float:
    """What speaks against a fit with all known distances times a factor: what it leaves in units of the joints' levers,
    and how far it is from the drawing.
    """
    held = _held(fit, samples, distances, factor)
    square = fit.weights @ errors(held.model, samples).position_norm ** 2
    prior = np.array([p.prior_std for p in held.parameters])
    left = 3.0 * float(fit.weights.sum()) * np.log(square / _lever(held.model, samples.q) ** 2)
    return float(left + np.sum((held.values / prior) ** 2))


def _lever(model: Model, q: Array) -> float:
    """RMS motion of the tool per unit of a joint that turns, over postures q (N, n) [m]."""
    f = tool_frames(model.serial, model.T_tip_tool, q)
    levers = [so3.cross(f.axes[j, 2], f.p[-1] - f.p[j]) for j in np.flatnonzero(model.serial.revolute)]
    return float(np.sqrt(np.mean(np.square(levers))))


_ROUNDING = 1e-9  # share of a stated distance's variance; where less is left, nothing but the statement tells it


@dataclass(frozen=True)
class KnownDistance:
    """A known distance: its ends by name, as stated with its deviation [m], and what the readings make of it.

    residual: stated minus that of the fit [m]. found, std: what the readings say of it by themselves, without this
    statement, and its deviation, with what the model does not explain of the two ends [m].
    """

    name: str
    stated: float
    stated_std: float
    residual: float
    found: float
    std: float

    @property
    def contradicted(self) -> bool:
        """Whether stated and found differ by more than their deviations allow."""
        return abs(self.stated - self.found) > CONTRADICTED * float(np.hypot(self.stated_std, self.std))

    @property
    def sentence(self) -> str:
        """What a person should know of a contradiction."""
        return (
            f"The known distance {self.name} is stated as {1e3 * self.stated:.3f} ± {1e3 * self.stated_std:.3f} mm, "
            f"the readings say {1e3 * self.found:.3f} ± {1e3 * self.std:.3f} mm"
        )


def distances_of(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit to these samples has it."""
    if not distances:
        return ()
    known = known_distances(fit, uncertainty(fit.model, samples, fit.parameters, fit, distances), distances)
    scale = scale_without_distances(fit, samples, distances) if len(distances) == 1 else None
    if scale is None:
        return known
    # the only known distance, beside what fixed points and the drawing say of the scale without it
    std = float(np.hypot(scale.std * known[0].stated, np.sqrt(2.0) * fit.noise.position))
    return (replace(known[0], found=(1.0 + scale.longer) * known[0].stated, std=std),)


def known_distances(fit: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[KnownDistance, ...]:
    """Every known distance as a fit has it.

    known: the uncertainty of the fit's model, the distances included in it. With the stated variance s², the residual r
    and the row J of a distance, its leverage is h = J C Jᵀ / s²; without it the residual were r / (1 − h) and the
    variance of the modelled distance h s² / (1 − h). What the model leaves unexplained of either end comes on top, for
    it is no noise that many readings average away.
    """
    parameters = known.parameters
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in fit.model.effects)])
    rows = distance_rows(fit.model, parameters, values, distances)
    of_found = np.einsum("kd,kl,ld->d", rows.J, known.covariance, rows.J)
    out = []
    for distance, r, v in zip(distances, rows.residual.tolist(), of_found.tolist(), strict=True):
        free = max(1.0 - v / distance.std**2, _ROUNDING)
        std = float(np.sqrt(max(v, 0.0) / free + 2.0 * fit.noise.position**2))
        found = distance.distance - r / free
        out.append(KnownDistance(_name(distance), distance.distance, distance.std, r, found, std))
    return tuple(out)


def _name(distance: AnyDistance) -> str:
    if isinstance(distance, Distance):
        return f"{distance.between[0]} to {distance.between[1]}"
    return f"between the stations at {distance.stamps[0]:.3f} and {distance.stamps[1]:.3f} s"


def contradictions(known: Sequence[KnownDistance]) -> tuple[str, ...]:
    """A sentence for each distance that the data contradict."""
    return tuple(distance.sentence for distance in known if distance.contradicted)


# --- Whether known distances are wrong alike, which each of them alone cannot show


def contradicted_together(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[str, ...]:
    """A sentence where one factor common to all known distances is contradicted by readings and arm.

    The fit is made once more without any of them: what they pull the readings away from would else be taken for the
    noise of these, and make room for themselves. For fixed points see :mod:`modcal_core.calibration.known_distances`.
    """
    if len(distances) < 2:
        return ()
    scale = scale_without_distances(fit, samples, distances)
    if scale is not None:
        each = [d.distance**2 / (d.std**2 + 2.0 * fit.noise.position**2) for d in distances]
        factor, std = -scale.longer, float(np.hypot(scale.std, sum(each) ** -0.5))
    else:
        try:
            free = without_distances(fit, samples)
        except NotEnoughData:  # nothing but the distances tells these parameters
            return ()
        factor, std = common_factor(free, uncertainty(free.model, samples, free.parameters, free), distances)
    if abs(factor) <= CONTRADICTED * std:
        return ()
    return (
        f"The {len(distances)} known distances together are stated {100.0 * factor:+.2f} ± {100.0 * std:.2f} % longer "
        "than readings and arm say: check that they are written down as they were measured, and are in the right unit.",
    )


def without_distances(fit: Fit, samples: Samples) -> Fit:
    """The fit of the same parameters and effects to these samples alone. Raises NotEnoughData where they are few."""
    start = fit.start.with_effects(fit.model.effects)
    return identify(start, samples, fit.parameters, begin=fit.values)


def common_factor(free: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[float, float]:
    """By which share all stated distances are too long, and its deviation.

    free: a fit that has not seen them. known: the uncertainty of its model. Modelled distances have the covariance
    J C Jᵀ, stated ones their variances; what the model leaves unexplained of either end comes on top.
    """
    values = np.concatenate([np.zeros(len(known.parameters)), *(e.values for e in free.model.effects)])
    rows = distance_rows(free.model, known.parameters, values, distances)
    stated: Array = np.array([d.distance for d in distances])
    modelled = rows.J.T @ known.covariance @ rows.J
    total = modelled + np.diag([d.std**2 + 2.0 * free.noise.position**2 for d in distances])
    weighed = np.linalg.solve(total, stated)
    precision = float(stated @ weighed)
    return float(weighed @ rows.residual) / precision, precision**-0.5
