"""The claim of a camera calibration: how far the arm's model is off at the tool, RMS over postures, in millimetres.

What counts is where the model has the flange in the frame of the other half: the target's where the camera is carried,
the camera's where the target is. True arms are drawn as for every instrument (:mod:`modcal_core.claim`): the images'
equations say what they show, all errors of all links how arms are off. The same draws say how far the nominal arm is
off, camera and target placed by the same images. What joints do not repeat is part of both.

The interval holds if what is stated is true. A statement that may be wrong has draws of its own, and counts by its
likelihood in the chance of an arm made worse. The advice compares the arms draw by draw: what is open of lens, sheet
and the camera's place moves both alike. What the user states of the nominal arm is no draw, and there the interval has
to be below it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import COMMON, POSE, READOUT, SCALE
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.statements import SIZE, DoubtedStatement
from modcal_core.claim import ANGLE, FREE, LENGTH, ArmEvidence, draw
from modcal_core.geometry import Array, se3, so3

_ENDS = (0.5, 0.005, 0.955)  # median, and ends of a 95 % interval: about the shortest where errors have a long tail
_DRAWS = 2000  # for these ends to within a few per cent of themselves
_OPEN = 1e6  # deviations; a value of which nothing is expected needs no wider prior
_RESTS = 3.0  # times better is the stated size known than the images show it: they say nothing against it
AS_STATED = "as stated"
ALL_BUT_IMAGES = "lens, sheet and clock"


@dataclass(frozen=True)
class DrawnErrors:
    """RMS errors at the tool over postures [m] in D draws, (D,) each: of the calibrated arm, of its model without what
    joints do not repeat, and of the nominal arm. chance: of what was drawn from.
    """

    calibrated: Array
    model: Array
    nominal: Array
    chance: float = 1.0


@dataclass(frozen=True)
class ToolError:
    """by: errors if all is as stated, and if one statement is wrong, by its name."""

    by: Mapping[str, DrawnErrors]

    @property
    def interval(self) -> tuple[float, float, float]:
        """(median, lower, upper end of the 95 % interval) of the calibrated arm's [m], if all is as stated.

        What each image has of its own is joints that do not repeat, no error of the model, or what no parameter
        describes, which is one: the interval holds either way.
        """
        middle, low, high = np.quantile(self.by[AS_STATED].calibrated, _ENDS)
        return float(middle), float(min(low, np.quantile(self.by[AS_STATED].model, _ENDS[1]))), float(high)

    @property
    def nominal_interval(self) -> tuple[float, float, float]:
        """The same of the nominal arm."""
        middle, low, high = np.quantile(self.by[AS_STATED].nominal, _ENDS)
        return float(middle), float(low), float(high)

    @property
    def chance_worse(self) -> float:
        """Chance that the calibrated arm is no better than the nominal one, every statement wrong by its chance."""
        return float(sum(one.chance * np.mean(one.calibrated >= one.nominal) for one in self.by.values()))

    @property
    def as_stated(self) -> ToolError:
        """The same if all that was stated is right."""
        return ToolError({AS_STATED: replace(self.by[AS_STATED], chance=1.0)})


ArmDraws = dict[str, tuple[Array, float]]


def arm_draws(fit: CameraFit, rng: np.random.Generator, doubted: Sequence[DoubtedStatement] = ()) -> ArmDraws:
    """What the P parameters of the true arm are off by in D draws (D, P), and the chance of what they are drawn from:
    the fit, and each of the statements being wrong.
    """
    stated = 1.0 - sum(d.chance for d in doubted)
    out = {AS_STATED: (_drawn(fit, fit.equations.solve(fit.sizes), rng), stated)}
    return out | {d.what: (_drawn(fit, d.solved, rng), d.chance) for d in doubted}


def _drawn(fit: CameraFit, solved: SolvedEquations, rng: np.random.Generator) -> Array:
    """Draws (D, P) by these equations of the fit.

    Faults of the arm are drawn for all of its links and brought to the parameters that the fit has; where nobody states
    their size, it is drawn about that of the fit.
    """
    equations, sizes, faults = solved.equations, solved.sizes, fit.poses.faults
    of_arm = np.isin(solved.use, equations.arm)
    order = np.r_[np.flatnonzero(of_arm), np.flatnonzero(~of_arm)]
    data, known = (part[np.ix_(order, order)] for part in (solved.H - solved.P, solved.P))
    pull = (equations.prior(sizes) @ equations.offset)[solved.use][order]
    moves = np.zeros((0, 0)) if faults is None else faults.moves
    A, E = len(moves), moves.shape[1]
    to_fit = block_diag(moves, np.eye(len(order) - A))
    H = to_fit.T @ data @ to_fit
    stated = block_diag(np.zeros((E, E)), known[A:, A:]), np.r_[np.zeros(E), -pull[A:]]
    std = _OPEN / np.sqrt(np.diag(H + stated[0]))
    sort, group, shipped = np.full(len(std), FREE), np.zeros(len(std), int), np.zeros(len(std))
    if faults is not None:
        std[:E] = sizes.arm * np.where(faults.turns, 1.0, sizes.lengths)
        shipped[:E] = std[:E] * np.linalg.lstsq(moves * std[:E], equations.offset[equations.arm], rcond=None)[0]
        group[:E] = faults.place
        if faults.stated is None:
            sort[:E] = np.where(faults.turns, ANGLE, LENGTH)
    rows = float(sum(POSE * len(one.stop) for one in equations.cameras))
    shown = float(np.trace(np.linalg.solve(solved.H, solved.H - solved.P)))
    about = ArmEvidence(
        shipped=shipped,
        H=H[None],
        g=(to_fit.T @ (solved.b[order] + pull))[None],
        square=np.array([max(rows - shown, 1.0)]),
        rows=np.array([rows]),
        stated=stated,
        usual=np.ones(1),
        std=std,
        sort=sort,
        group=group,
        main=0,
        pull=np.zeros(len(std)),
    )
    out = np.zeros((_DRAWS, len(equations.offset)))
    out[:, solved.use[order]] = draw(about, _DRAWS, rng).values[:_DRAWS] @ to_fit.T
    return out[:, : fit.poses.count]


def tool_error(fit: CameraFit, nominal: CameraFit, q: Array, draws: ArmDraws, arm_alone: bool = False) -> ToolError:
    """The errors over postures q (M, n).

    nominal: of the same images, the arm held nominal. draws: of the fit. arm_alone: what is left once the frame of the
    other half is put where it suits best, which is the lens's matter and no arm's.
    """
    at = fit.poses.at_postures(q)
    T, motions = at.tool_motions(fit.state.values)
    placed = se3.apply(T, fit.flange)
    # the mean square over postures is a form of second order in the parameters, however many postures there are
    apart = (se3.apply(nominal.tool_at(q), fit.flange) - placed).reshape(-1)
    rows = fit.at_flange(T, motions).reshape(len(apart), -1)
    if arm_alone:
        basis = frame_basis(placed)
        rows, apart = rows - basis @ (basis.T @ rows), apart - basis @ (basis.T @ apart)
    gram, cross, square = rows.T @ rows, rows.T @ apart, float(apart @ apart)
    throw = fit.at_flange(T, at.own_motions(fit.state.values, T))[:, :, :-3]
    scatter = fit.sizes.joint**2 * float((throw**2).sum() / len(q)) + 3.0 * fit.sizes.shift**2

    def errors(values: Array, chance: float) -> DrawnErrors:
        own = np.maximum(((values @ gram) * values).sum(axis=1), 0.0)
        other = np.maximum(own - 2.0 * values @ cross + square, 0.0)
        calibrated, nominal = (np.sqrt(x / len(q) + scatter) for x in (own, other))
        return DrawnErrors(calibrated, np.sqrt(own / len(q)), nominal, chance)

    return ToolError({what: errors(*drawn) for what, drawn in draws.items()})


def frame_basis(at_frame: Array) -> Array:
    """Orthonormal columns (3 M, 6): how points (M, 3) move with a rigid motion of their frame."""
    M = len(at_frame)
    placed = np.concatenate([np.broadcast_to(np.eye(3), (M, 3, 3)), -so3.hat(at_frame)], axis=2)
    return np.asarray(np.linalg.qr(placed.reshape(3 * M, -1))[0])


@dataclass(frozen=True)
class RestsOn:
    """What the sheet's stated size is worth. images_std: to what the images by themselves show it, relative.
    per_unit_m: RMS by which the tool is off per unit that it is wrong. if_wrong_m: upper end of the 95 % interval of
    the calibrated arm's error, were it wrong by what the images allow.
    """

    images_std: float
    per_unit_m: float
    if_wrong_m: float

    def sentence(self, nominal_m: float, body: bool = False) -> str:
        """The findings as sentences. nominal_m: error of the nominal arm. body: whether the target is a body."""
        what, again = ("body", "across it") if body else ("sheet", "a square")
        return (
            f"All of this rests on the {what}'s stated size, which these images by themselves show to "
            f"{100.0 * self.images_std:.1f} % only: each per cent that it is off puts the tool "
            f"{10.0 * self.per_unit_m:.1f} mm off. Were it wrong, the calibrated arm could be up to "
            f"{1e3 * self.if_wrong_m:.1f} mm off (95 %), the nominal arm is {1e3 * nominal_m:.1f} mm: measure {again} "
            "once more."
        )


def rests_on(fit: CameraFit, doubted: Sequence[DoubtedStatement], q: Array, error: ToolError) -> RestsOn | None:
    """The sheet's stated size, where the images by themselves hardly show it, and what it is worth at the tool over
    postures q (M, n); None where they show it as well. error: over these postures.
    """
    P = fit.poses.count
    size = slice(P + 1 + SCALE.start, P + 1 + SCALE.stop)
    C = next(d for d in doubted if d.what == SIZE).solved.covariance()
    free, held = (float(np.sqrt(known[size, size].mean())) for known in (C, fit.covariance))
    if free < _RESTS * held:
        return None
    per_unit = C[:P, size].mean(axis=1) / free**2
    moved, if_wrong = fit.flange_motions(q) @ per_unit, float(np.quantile(error.by[SIZE].calibrated, _ENDS[2]))
    return RestsOn(free, float(np.sqrt((moved**2).sum() / len(q))), if_wrong)


def shares(fit: CameraFit, q: Array) -> dict[str, tuple[float, float]]:
    """For lens, print scale, flatness, clock and places of markers, and for all of these at once: (mean square error at
    the tool that is known [m²], the same if that thing were known exactly), over postures q (M, n).
    """
    J, C = fit.flange_motions(q), fit.covariance
    P = J.shape[2]
    common = fit.common
    groups = {"lens": common[:LENS], "print scale": common[SCALE], "flatness": common[BENT], "clock": np.array([P])}
    groups |= {"readout": common[[READOUT]], "places of markers": common[COMMON:], ALL_BUT_IMAGES: np.r_[P, common]}
    whole = mean_square(J, C[:P, :P])
    out = {}
    for name, rows in groups.items():
        rows = rows[np.diag(C)[rows] > 0.0]
        if len(rows):
            known = C[:P, :P] - C[:P][:, rows] @ np.linalg.pinv(C[np.ix_(rows, rows)], hermitian=True) @ C[rows][:, :P]
            out[name] = (whole, max(mean_square(J, known), 0.0))
    return out


def mean_square(J: Array, C: Array) -> float:
    """Mean square of motions J (M, 3, P) of parameters with covariance C (P, P)."""
    return float(np.einsum("mip,pq,miq->", J, C, J) / len(J))


APPLY, DO_NOT_APPLY, CANNOT_TELL = "apply", "do not apply", "cannot tell"
# Chance of an arm made worse that may be taken. Few calibrations come near it: with 1 %, the chances of a hundred of
# them add up to 0.05 arms that are made worse (38 simulated cells), with 2 % to 0.1, with 5 % to 0.4.
_WORSE = 0.01
_WHAT_TELLS = (
    "measure the two rulers on the sheet (modcal target --measured), state the arm's accuracy (--arm-mm), "
    "or add a second target at another distance, two scale marks, a ball in a socket or a few tracker points"
)

_BODY_TELLS = (
    "state how well the body's size is known (size_tolerance in the target file: a calliper across it tells), state "
    "the arm's accuracy (--arm-mm), or add a few tracker points"
)


@dataclass(frozen=True)
class Decision:
    """word: one of apply, do not apply, cannot tell. because: sentences. chance_worse: of an arm worse than drawn.
    problems: those sentences that say what contradicts the fit. doubtful: statements that images leave in doubt.
    """

    word: str
    because: tuple[str, ...]
    chance_worse: float
    problems: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()


def decide(
    error: ToolError,
    stated_m: float | None = None,
    problems: tuple[str, ...] = (),
    doubtful: tuple[str, ...] = (),
    size: str = "",
    body: bool = False,
) -> Decision:
    """The decision over the postures that were asked for, a length of which is known.

    stated_m: RMS error of the nominal arm, as the user states it [m]. problems: what contradicts the fit. doubtful:
    statements in doubt, in sentences. size: what to do about the sheet's size, where that keeps the arm from being
    clearly better. body: whether the target is a body with markers, and the error that of the arm by itself.
    """
    worse = error.chance_worse
    middle, _, high = error.interval
    drawn, drawn_low, _ = error.nominal_interval
    if problems:
        return Decision(DO_NOT_APPLY, problems, worse, problems)
    compared = (
        f"{'By itself, wherever camera and body stand, the' if body else 'The'} calibrated arm is off by "
        f"{1e3 * middle:.2f} mm RMS at the tool (95 %: up to {1e3 * high:.2f} mm), the nominal arm by "
        f"{1e3 * drawn:.2f} mm (95 %: at least {1e3 * drawn_low:.2f} mm)"
    )
    if worse > _WORSE or (stated_m is not None and high >= stated_m):
        if size:
            return Decision(CANNOT_TELL, (f"{compared}. {size}", *doubtful), worse)
        stated = "" if stated_m is None else f", and {1e3 * stated_m:.2f} mm is stated of it"
        return Decision(DO_NOT_APPLY, (f"{compared}{stated}: that is not clearly better.", *doubtful), worse)
    alike = ""
    if high >= drawn:
        alike = (
            " What is open of lens, sheet and places moves both alike; the chance that the calibrated arm is no better "
            f"is {max(100.0 * worse, 0.1):.1f} %."
        )
    return Decision(APPLY, (f"{compared}.{alike}", *doubtful), worse)


def no_length(error: ToolError, body: bool) -> Decision:
    """The decision where nothing has a length beyond the arm's own drawing."""
    said = f"Nothing in these images has a length that somebody measured: {_BODY_TELLS if body else _WHAT_TELLS}."
    return Decision(CANNOT_TELL, (said,), error.chance_worse)
