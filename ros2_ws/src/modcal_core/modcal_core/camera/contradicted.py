"""Statements about sheet, lens, clock and arm, each with its tolerance, and which of them the images contradict.

A stated value that is wrong does not show in the residuals where the arm can take it up: a sheet 2 % larger than stated
looks like an arm whose links are all 2 % shorter. What gives it away is the likelihood of the images, everything else
integrated out and the sizes of all errors found again. It is asked in two ways, by one price.

* A statement is held as an expectation in the fit. With its tolerance widened until it says next to nothing, are the
images likelier by far? Then the statement is wrong, or the arm is built to another scale, which is said too. Where the
images say neither, it is in doubt, and what it may do to the arm belongs into the interval of the error. * Of late
images, a rolling shutter, the size of a print that nobody measured and a bent sheet the stated value is "as it should
be", and the fit has a value. Are the images likelier by far with that value? Then it is named. At given sizes the ratio
is that of the density at the stated value after and before the images (Dickey 1971), without a second fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import beyond_chi2
from modcal_core.camera.bundle import PrintScale
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import READOUT, SCALE, SHAPE, CommonPrior, common_prior
from modcal_core.camera.equations import Equations, Sizes, SolvedEquations
from modcal_core.camera.fit import CameraFit, fit_camera, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.geometry import Array

# Of −2 log likelihood, the price of what is set free taken off: odds of 20 : 1. Where all is as stated it is −4 to −9
# (32 cells), for the price is that of a χ² of two with its chance below 0.2 %.
_GAIN = 6.0
_SCREEN = 2.0  # the same at the state of the fit, which is a unit or two off; below it no second fit is worth its time
# Tolerances of what is not as stated, relative: of a size, and of its length against its width. Prints that nobody
# measured are fitted to the page (94 to 97 %), all of it alike; who misreads two rulers does not misread them alike.
_ANY_PRINT = 0.03, PrintScale.std_apart
_ANY_READING = 0.05, 0.01
_ANY_BOW_M = 0.01  # of a sheet that lies on something uneven
# Prior chance that a statement is off by such a tolerance: what a 95 % interval leaves out, and the odds of _GAIN; of a
# size that was measured to a stated tolerance the square root of two such slips' chance; of rulers that are said to
# have their nominal lengths, to no stated tolerance, one in four.
_WRONG, _READ_WRONG, _NOMINAL_WRONG = 0.05, 0.01, 0.25
IN_DOUBT = 0.025  # chance beyond which it reaches into a 95 % interval
SIZE, BOW, LENS_VALUES = "size", "bow", "lens"
TARGET, CLOCK = "target", "clock"  # families of the report
_PLAIN = {"fx": "focal length", "fy": "focal length", "cx": "centre", "cy": "centre"}


@dataclass(frozen=True)
class StatedCamera:
    """What is stated of lens and print. became: what becomes of the lens's values, None if nobody stated any."""

    lens: Lens
    became: str | None
    scale: PrintScale


@dataclass(frozen=True)
class DoubtedStatement:
    """A statement with a wide tolerance. what: size, bow or lens. prior: with it. solved: the equations with that prior
    at the state of the fit, and the sizes of errors. misfit: −2 log likelihood there. chance: that the statement is
    wrong, given the images. counted: the same as it counts against an arm made worse: of a size without a stated
    tolerance the images do not lower it, for what they say hangs on how far off wrong sizes are supposed to be.
    """

    what: str
    prior: CommonPrior
    solved: SolvedEquations
    misfit: float
    chance: float
    counted: float

    @property
    def equations(self) -> Equations:
        """With the wide tolerance, at the state of the fit."""
        return self.solved.equations

    @property
    def sizes(self) -> Sizes:
        """Of errors, found again."""
        return self.solved.sizes


def doubts(fit: CameraFit, stated: StatedCamera) -> tuple[DoubtedStatement, ...]:
    """Each of the statements with a wide tolerance, and the chance that it is wrong."""
    of_size = _chance_of_size(stated.scale)
    weighed = [
        (what, prior, *fit.weighed(_with_prior(fit, prior))) for what, prior in _wider(fit.prior, stated).items()
    ]
    before = np.array([of_size if what == SIZE else _WRONG for what, *_ in weighed])
    odds = before * np.array([np.exp(0.5 * min(fit.misfit - misfit, 100.0)) for *_, misfit in weighed])
    chances = odds / (1.0 + odds.sum())
    least = of_size if stated.scale.unsaid and not stated.scale.nominal else 0.0
    return tuple(
        DoubtedStatement(*one, float(chance), max(float(chance), least if one[0] == SIZE else 0.0))
        for one, chance in zip(weighed, chances, strict=True)
    )


def _chance_of_size(scale: PrintScale) -> float:
    if scale.measured and not scale.unsaid:
        return _READ_WRONG
    return _NOMINAL_WRONG if scale.nominal else _WRONG


def contradictions(fit: CameraFit, doubted: Sequence[DoubtedStatement], stated: StatedCamera) -> tuple[str, ...]:
    """What the images contradict of what was stated, in sentences. doubted: of this fit."""
    out = []
    plain = fit.misfit
    for doubt in doubted:
        if doubt.misfit < plain - _SCREEN:
            other = fit_camera(fit.table, fit.poses, doubt.prior, fit.state.lens, fit.sizes)
            if other.converged and other.misfit < plain - _GAIN:
                out.append(_contradiction(doubt.what, other, stated))
    if fit.arm_stated and fit.poses.faults is not None:
        free = replace(fit.poses.faults, stated=None)
        solved, misfit = fit.weighed(replace(fit.equations, faults=free))
        if solved.sizes.arm > fit.sizes.arm and misfit < plain - _GAIN:
            out.append(
                f"The arm is some {solved.sizes.arm / fit.sizes.arm:.1f} times as far off as --arm-mm states: state "
                "what you know of it, or check the square's size."
            )
    return tuple(out)


def in_doubt(fit: CameraFit, doubted: Sequence[DoubtedStatement], scale: PrintScale) -> tuple[str, ...]:
    """What the images leave in doubt of what was stated, in sentences."""
    out = []
    for doubt in doubted:
        if doubt.chance > IN_DOUBT:
            common = fit.state.common + doubt.solved.step()[fit.poses.count + 1 :]
            what = {
                SIZE: f"a {_sized(fit)} {_percent(fit, common, scale)} off its stated size",
                BOW: f"a sheet bent by {1e3 * float(np.abs(common[BENT]).max()):.1f} mm",
                LENS_VALUES: "another lens than the stated one",
            }[doubt.what]
            out.append(
                f"An arm with these faults and {what} look much alike (chance of the latter "
                f"{100.0 * doubt.chance:.0f} %): check that statement, or add a length of another kind, such "
                "as a few tracker points."
            )
    return tuple(out)


def _wider(prior: CommonPrior, stated: StatedCamera) -> dict[str, CommonPrior]:
    """The prior with each of the statements' tolerances widened, by what it is about."""
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


def _with_prior(fit: CameraFit, prior: CommonPrior) -> Equations:
    """The equations with another prior, at the state of the fit."""
    count = fit.poses.count + 1
    information = fit.equations.information.copy()
    information[count:, count:] = prior.information
    offset = np.r_[fit.equations.offset[:count], fit.state.common - prior.mean]
    free = np.r_[fit.equations.free[:count], prior.free]
    return replace(fit.equations, information=information, offset=offset, free=free)


def _contradiction(what: str, other: CameraFit, stated: StatedCamera) -> str:
    """The sentence for a wrong statement. other: the fit with its tolerance widened."""
    std = np.sqrt(np.diag(other.covariance))[other.poses.count + 1 :]
    if what == SIZE:
        return (
            f"The {_sized(other)} is {_percent(other, other.state.common, stated.scale)} off its stated size, ± "
            f"{100.0 * float(std[LENS]):.1f} %, or the arm is built to another scale than its URDF: measure "
            f"{'across it' if other.table.places else 'a square'}, and check the target file."
        )
    if what == BOW:
        worst = float(np.abs(other.table.bow @ other.state.shape[2:]).max())
        return f"The sheet is bent by {1e3 * worst:.1f} mm towards its edge: glue it to something flat."
    found, values, names = other.state.lens.values, stated.lens.values, stated.lens.names
    i = int(np.argmax(np.abs(found - values) / np.maximum(std[:LENS], 1e-9)))
    return (
        f"The images contradict the stated lens: {_PLAIN.get(names[i], names[i])} {found[i]:.4g} ± {std[i]:.2g} "
        f"and not {values[i]:.4g}. Give the camera_info of this camera, focus and resolution, or leave it away."
    )


def _sized(fit: CameraFit) -> str:
    """What has a size."""
    return "body" if fit.table.places else "sheet"


def _percent(fit: CameraFit, common: Array, scale: PrintScale) -> str:
    """By how much a sheet is off along x and y, or a body as a whole."""
    x, y = common[SCALE] + 1.0
    along_x = f"{100.0 * (x / scale.x - 1.0):+.1f} %"
    return along_x if fit.table.places else f"{along_x} (x) and {100.0 * (y / scale.y - 1.0):+.1f} % (y)"


@dataclass(frozen=True)
class CameraFinding:
    """family, place, direction, driver: as in the report. values: (value, standard deviation, unit) by name. p_value:
    that the stated value would look as bad. gain: of −2 log likelihood. at_tool_m: RMS by which the flange would be off
    were it left out. same_as: what explains it as well. sentence: for a person.
    """

    family: str
    place: str
    direction: str
    driver: str
    values: dict[str, tuple[float, float, str]]
    p_value: float
    gain: float
    at_tool_m: float
    same_as: tuple[str, ...]
    sentence: str


def findings(fit: CameraFit, scale: PrintScale, other_length: bool, q: Array) -> tuple[CameraFinding, ...]:
    """What is named.

    scale: as stated of the print. other_length: whether anything but the sheet states a length. q: postures (M, n) over
    which the size at the flange is.
    """
    P = fit.poses.count
    common = P + 1
    groups = {
        "clock": (np.array([P]), np.zeros(1)),
        "readout": (np.array([common + READOUT]), np.zeros(1)),
        "scale": (common + np.arange(SCALE.start, SCALE.stop), np.array([scale.x, scale.y]) - 1.0),
        "bow": (common + np.arange(BENT.start, BENT.stop), np.zeros(SHAPE - 2)),
    }
    if scale.measured:  # somebody's ruler against the images: see contradictions
        groups.pop("scale")
    J = fit.flange_motions(q)
    out = []
    for what, (rows, stated) in groups.items():
        if not fit.equations.free[rows].all():
            continue
        gain, p_value = _against(fit, rows, stated)
        if gain > _GAIN:
            value = np.r_[fit.state.offset_s, fit.state.common][rows - P]
            C = fit.covariance
            shift = C[:P, rows] @ np.linalg.solve(C[np.ix_(rows, rows)], value - stated)
            at_tool = float(np.sqrt(((J @ shift) ** 2).sum() / len(q)))
            where, values, said = _finding(what, fit, value, np.sqrt(np.diag(C)[rows]))
            same: tuple[str, ...] = ()
            if what == "scale" and not other_length:
                same = ("the arm, all lengths by one factor",)
                said += ", or the arm is built to another scale than its URDF: nothing here tells which"
            said += f"; left out, it would put the tool {1e3 * at_tool:.2f} mm off."
            out.append(CameraFinding(*where, values, p_value, gain, at_tool, same, said))
    return tuple(out)


def _against(fit: CameraFit, rows: np.ndarray, stated: Array) -> tuple[float, float]:
    """(gain of −2 log likelihood over the stated values of these parameters, chance of the stated values)."""
    here = np.r_[fit.state.values, fit.state.offset_s, fit.state.common][rows] - stated
    before = np.linalg.inv(fit.equations.information[np.ix_(rows, rows)])
    log_before = _log_density(here - fit.equations.offset[rows], before)

    def after(solved: SolvedEquations) -> tuple[Array, Array]:
        return here + solved.step()[rows], solved.covariance()[np.ix_(rows, rows)]

    def at_stated(solved: SolvedEquations) -> float:
        return solved.misfit() + _log_density(*after(solved)) - log_before

    free = fit.misfit
    if at_stated(fit.equations.solve(fit.sizes)) + usual(fit.sizes) - free <= _GAIN:  # other sizes only help it
        return 0.0, 1.0
    solved, misfit = fit.weighed(misfit_of=at_stated)
    mean, cov = after(solved)
    return misfit - free, beyond_chi2(float(mean @ np.linalg.solve(cov, mean)), len(rows))


def _log_density(mean: Array, cov: Array) -> float:
    """−2 log of the normal density at zero, up to a constant."""
    return float(mean @ np.linalg.solve(cov, mean)) + float(np.linalg.slogdet(cov)[1])


_Named = tuple[tuple[str, str, str, str], dict[str, tuple[float, float, str]], str]


def _finding(what: str, fit: CameraFit, value: Array, std: Array) -> _Named:
    """(family, place, direction and driver of the report, values, sentence) of what is named."""
    if what == "clock":
        late = "later" if value[0] < 0.0 else "earlier"
        size = f"{1e3 * abs(value[0]):.1f} ± {1e3 * std[0]:.1f} ms"
        said = f"Images are stamped {size} {late} than the joints of their moment"
        return (CLOCK, "camera:camera", "all", "velocity"), {"delay_s": (float(-value[0]), float(std[0]), "s")}, said
    if what == "readout":
        line, spread = value[0] / fit.state.lens.size[1], std[0] / fit.state.lens.size[1]
        said = (
            f"The camera reads an image line by line, {1e6 * line:.1f} ± {1e6 * spread:.1f} µs a line "
            f"({1e3 * value[0]:.1f} ms from top to bottom)"
        )
        return (CLOCK, "camera:camera", "all", "line"), {"line_s": (float(line), float(spread), "s")}, said
    if what == "scale":
        x, y = 100.0 * value
        said = f"The sheet is {x:+.2f} % (x) and {y:+.2f} % (y) off its stated size, ± {100.0 * std[0]:.2f} %"
        if fit.table.places:
            said = f"The body is {x:+.2f} % and its markers {y:+.2f} % off their stated size, ± {100.0 * std[0]:.2f} %"
        values = {f"size_{axis}": (float(v), float(s), "1") for axis, v, s in zip("xy", value, std, strict=True)}
        return (TARGET, "target:target", "size", "constant"), values, said
    off = np.abs(fit.table.bow @ value)
    mode = fit.table.bow[int(off.argmax())]
    spread = float(np.sqrt((mode * std) @ (mode * std)))
    modes = zip(("xx", "xy", "yy"), value, std, strict=True)
    values = {f"bow_{name}": (float(v), float(s), "m") for name, v, s in modes}
    said = f"The sheet is bent by {1e3 * float(off.max()):.2f} ± {1e3 * spread:.2f} mm towards its edge"
    return (TARGET, "target:target", "normal", "constant"), values, said
