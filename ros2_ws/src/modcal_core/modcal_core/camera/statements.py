"""Statements about sheet, lens, clock and arm, and what the images say against each: one catalogue, one price.

A stated value that is wrong does not show in the residuals where the arm can take it up: a sheet 2 % larger than stated
looks like an arm whose links are all 2 % shorter. What gives it away is the likelihood of the images with the statement
relaxed against held, all parameters integrated out and the sizes of all errors found again.

* A stated value is held with its tolerance in the fit, and is relaxed to one that says next to nothing. Far likelier:
  it is contradicted, or the arm is built to another scale. Where images say neither, it is in doubt, and the interval
  of the error at the tool holds either way.
* A default, as no delay or a flat sheet, is fitted, and is held at its value. Far less likely: the value is named.

Every relaxed statement has a price in nats, and they share one probability with each other and with none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import PrintScale
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import READOUT, SCALE, SHAPE, CommonPrior, common_prior
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import CameraFit, fit_camera, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.effects import ReportEntry
from modcal_core.geometry import Array

# Nats for each thing that backs a statement: that it is made, a value of one's own, and a tolerance stated with it. The
# first two are odds of 20 : 1.
_BACKED = 0.5 * float(np.log(20.0))
# Of −2 log likelihood, the price of what is set free taken off: odds of 20 : 1. Where all is as stated it is −4 to −9
# (32 cells), for the price is that of a χ² of two with its chance below 0.2 %.
GAIN = 6.0
_SCREEN = 2.0  # the same at the state of the fit, which is a unit or two off; below it no second fit is worth its time
# Tolerances of what is not as stated, relative: of a size, and of its length against its width. Prints that nobody
# measured are fitted to the page (94 to 97 %), all of it alike; who misreads two rulers does not misread them alike.
_ANY_PRINT = 0.03, PrintScale.std_apart
_ANY_READING = 0.05, 0.01
_ANY_BOW_M = 0.01  # of a sheet that lies on something uneven
_EXACT = 1e8  # times the information of its prior; a value that is held
IN_DOUBT = 0.025  # chance beyond which it reaches into a 95 % interval
SIZE, BOW, LENS_VALUES = "size", "bow", "lens"
TARGET, CLOCK = "target", "clock"  # families of the report


@dataclass(frozen=True)
class StatedCamera:
    """What is stated of lens and print. became: what becomes of the lens's values, None if nobody stated any."""

    lens: Lens
    became: str | None
    scale: PrintScale


@dataclass(frozen=True)
class DoubtedStatement:
    """A relaxed statement. what: size, bow or lens. prior: with it. solved: the equations with that prior at the state
    of the fit, and the sizes of errors. misfit: −2 log likelihood there. chance: that the statement is wrong, given the
    images. counted: the same as it counts against an arm made worse: of a size without a stated tolerance the images do
    not lower it, for what they say hangs on how far off wrong sizes are supposed to be.
    """

    what: str
    prior: CommonPrior
    solved: SolvedEquations
    misfit: float
    chance: float
    counted: float


def doubts(fit: CameraFit, stated: StatedCamera) -> tuple[DoubtedStatement, ...]:
    """Each of the statements relaxed, and the chance that it is wrong."""
    scale = stated.scale
    common = fit.poses.count + 1 + np.arange(len(fit.prior.mean))
    relaxed = []
    for what, prior in _wider(fit.prior, stated).items():
        there = fit.equations.with_block(common, prior.information, fit.state.common - prior.mean, prior.free)
        relaxed.append((what, prior, *fit.weighed(there)))
    backed = 2.0 + (scale.measured and not scale.unsaid) - scale.nominal
    price = _BACKED * np.array([backed if what == SIZE else 2.0 for what, *_ in relaxed])
    gain = np.array([min(fit.misfit - misfit, 100.0) for *_, misfit in relaxed])
    odds = np.exp(0.5 * gain - price)
    chances = odds / (1.0 + odds.sum())
    least = np.exp(-2.0 * _BACKED) if scale.unsaid and not scale.nominal else 0.0
    return tuple(
        DoubtedStatement(*one, float(chance), max(float(chance), least if one[0] == SIZE else 0.0))
        for one, chance in zip(relaxed, chances, strict=True)
    )


def _wider(prior: CommonPrior, stated: StatedCamera) -> dict[str, CommonPrior]:
    """The prior with each of the statements relaxed, by what it is about."""
    scale = stated.scale
    both, apart = _ANY_READING if scale.measured and not scale.nominal else _ANY_PRINT
    cov = PrintScale(std=both, std_apart=apart).covariance
    if prior.places is not None:  # the print of its markers is another statement, and stands
        cov = np.asarray(np.linalg.inv(prior.information[SCALE, SCALE]) + np.diag([both**2, 0.0]))
    out = {SIZE: prior.with_block(SCALE, np.asarray(np.linalg.inv(cov)))}
    if prior.places is None:  # a body has no bow
        out[BOW] = prior.with_block(BENT, np.eye(SHAPE - 2) / _ANY_BOW_M**2)
    if stated.became is not None:
        unknown = common_prior(stated.lens, PrintScale(), None)
        values = slice(0, LENS)
        wide = prior.with_block(values, unknown.information[values, values])
        out[LENS_VALUES] = replace(wide, mean=np.r_[unknown.mean[values], prior.mean[LENS:]])
    return out


def contradicted(fit: CameraFit, doubted: Sequence[DoubtedStatement]) -> dict[str, CameraFit]:
    """What the images contradict of what was stated, with the fit that has it relaxed. doubted: of this fit."""
    out = {}
    for doubt in doubted:
        if doubt.misfit < fit.misfit - _SCREEN:
            other = fit_camera(fit.table, fit.poses, doubt.prior, fit.state.lens, fit.sizes)
            if other.converged and other.misfit < fit.misfit - GAIN:
                out[doubt.what] = other
    return out


def arm_contradicted(fit: CameraFit) -> float | None:
    """How many times as far off as stated the arm is, None where the images do not say so, or nobody states it."""
    if fit.poses.faults is None or fit.poses.arm_stated is None:
        return None
    solved, misfit = fit.weighed(replace(fit.equations, faults=replace(fit.poses.faults, stated=None)))
    larger = solved.sizes.arm > fit.sizes.arm and misfit < fit.misfit - GAIN
    return solved.sizes.arm / fit.sizes.arm if larger else None


@dataclass(frozen=True)
class CameraFinding:
    """A default that does not hold. entry: as in the report. gain: of −2 log likelihood. at_tool_m: RMS by which the
    flange would be off were it left out. sentence: for a person.
    """

    family: str
    entry: ReportEntry
    gain: float
    at_tool_m: float
    sentence: str

    @property
    def p_value(self) -> float:
        """Bound on the chance that data of the default would look so bad: the likelihood ratio's (Markov)."""
        return float(np.exp(-0.5 * self.gain))


@dataclass(frozen=True)
class _Default:
    """A fitted value that has a default. at: where it stands behind clock, lens, shape, readout. driver, direction:
    of the report. names: of its values, in unit. say: what is found, by fit, value and standard deviation.
    """

    family: str
    at: slice
    direction: str
    driver: str
    names: tuple[str, ...]
    unit: str
    say: Callable[[CameraFit, Array, Array], str]


def _late(_: CameraFit, value: Array, std: Array) -> str:
    late = "later" if value[0] < 0.0 else "earlier"
    return (
        f"Images are stamped {1e3 * abs(value[0]):.1f} ± {1e3 * std[0]:.1f} ms {late} than the joints of their moment"
    )


def _by_line(fit: CameraFit, value: Array, std: Array) -> str:
    line, spread = 1e6 * np.array([value[0], std[0]]) / fit.state.lens.size[1]
    return (
        f"The camera reads an image line by line, {line:.1f} ± {spread:.1f} µs a line "
        f"({1e3 * value[0]:.1f} ms from top to bottom)"
    )


def _sized(fit: CameraFit, value: Array, std: Array) -> str:
    (x, y), spread = 100.0 * value, f"off its stated size, ± {100.0 * std[0]:.2f} %"
    if fit.table.places:
        return f"The body is {x:+.2f} % and its markers {y:+.2f} % {spread}"
    return f"The sheet is {x:+.2f} % (x) and {y:+.2f} % (y) {spread}"


def _bent(fit: CameraFit, value: Array, std: Array) -> str:
    off = np.abs(fit.table.bow @ value)
    spread = float(np.linalg.norm(fit.table.bow[int(off.argmax())] * std))
    return f"The sheet is bent by {1e3 * float(off.max()):.2f} ± {1e3 * spread:.2f} mm towards its edge"


_SCALED = slice(1 + SCALE.start, 1 + SCALE.stop)  # of the defaults' values, behind the delay
_DEFAULTS = (
    _Default(CLOCK, slice(0, 1), "all", "velocity", ("delay_s",), "s", _late),
    _Default(CLOCK, slice(1 + READOUT, 2 + READOUT), "all", "line", ("line_s",), "s", _by_line),
    _Default(TARGET, _SCALED, "size", "constant", ("size_x", "size_y"), "1", _sized),
    _Default(
        TARGET,
        slice(1 + BENT.start, 1 + BENT.stop),
        "normal",
        "constant",
        ("bow_xx", "bow_xy", "bow_yy"),
        "m",
        _bent,
    ),
)


def findings(fit: CameraFit, scale: PrintScale, other_length: bool, q: Array) -> tuple[CameraFinding, ...]:
    """Defaults that do not hold.

    scale: as stated of the print. other_length: whether anything but the sheet states a length. q: postures (M, n) over
    which the size at the flange is.
    """
    P, C = fit.poses.count, fit.covariance
    values = np.r_[fit.state.offset_s, fit.state.common]
    default = np.zeros_like(values)
    default[_SCALED] = scale.x - 1.0, scale.y - 1.0
    J, plain, out = fit.flange_motions(q), fit.misfit, []
    for row in _DEFAULTS:
        rows = P + np.arange(row.at.start, row.at.stop)
        stated = row.at == _SCALED and scale.measured  # somebody's ruler against the images: that is no default
        if stated or not fit.equations.free[rows].all():
            continue
        value, off, std = values[row.at], (values - default)[row.at], np.sqrt(np.diag(C)[rows])
        exact = np.diag(_EXACT * np.diag(fit.equations.information)[rows])
        held = fit.equations.with_block(rows, exact, off)
        if held.solve(fit.sizes).misfit() + usual(fit.sizes) - plain <= GAIN:  # other sizes only help it
            continue
        gain = fit.weighed(held)[1] - plain
        if gain <= GAIN:
            continue
        shift = C[:P, rows] @ np.linalg.solve(C[np.ix_(rows, rows)], off)
        at_tool = float(np.sqrt(((J @ shift) ** 2).sum() / len(q)))
        said, same = row.say(fit, value, std), tuple[str, ...]()
        if row.at == _SCALED and not other_length:
            same = ("the arm, all lengths by one factor",)
            said += ", or the arm is built to another scale than its URDF: nothing here tells which"
        unit = {"delay_s": -1.0, "line_s": 1.0 / fit.state.lens.size[1]}.get(row.names[0], 1.0)
        every = zip(row.names, unit * value, abs(unit) * std, strict=True)
        sizes = {name: (float(v), float(s), row.unit) for name, v, s in every}
        place = "camera:camera" if row.family == CLOCK else "target:target"
        entry = ReportEntry(place, row.direction, row.driver, sizes, same)
        said += f"; left out, it would put the tool {1e3 * at_tool:.2f} mm off."
        out.append(CameraFinding(row.family, entry, gain, at_tool, said))
    return tuple(out)
