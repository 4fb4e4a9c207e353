"""Which of the values that somebody stated the images contradict: the sheet's size, its flatness, the lens, the arm.

A stated value that is wrong does not show in the residuals where the arm can take it up: a sheet 2 % larger than stated
looks like an arm whose links are all 2 % shorter. What gives it away is that no arm is faulty like that. So each
statement in turn is widened until it says next to nothing, all else stays, and the sizes of all errors are found again:
where the data are likelier by far, everything integrated out, the statement is what is wrong, or the arm is built to
another scale, which is said too.

Where the data say neither, because the arm is as faulty as a wrong statement would make it look, the statement is in
doubt: what it may do to the arm, weighed by its chance, belongs into the interval of the error at the tool.

What target and camera are not as stated, late images, a rolling shutter, the print's size and a bent sheet, is fitted
in any case, with an expectation about what is stated. It is named where the images are likelier by far with it than
with the stated value, everything else integrated out and the sizes of all errors found again for both. At given sizes
the ratio of the two is that of the density at the stated value after and before the images (Dickey 1971), which needs
no second fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import beyond_chi2
from modcal_core.camera.bundle import PrintScale
from modcal_core.camera.causes import flange_motions
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import READOUT, SCALE, SHAPE, CommonPrior, common_prior
from modcal_core.camera.equations import Equations, Sizes, SolvedEquations
from modcal_core.camera.fit import CameraFit, fit_camera, likeliest, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.geometry import Array

# Of −2 log likelihood, the price of what is set free taken off: odds of 20 : 1. Where all is as stated it is −4 to −9
# (32 cells), for the price is that of a χ² of two with its chance below 0.2 %.
_GAIN = 6.0
_SCREEN = 2.0  # the same at the state of the fit, which is a unit or two off; below it no second fit is worth its time
# Of a sheet whose size nobody has measured, and of its length against its width: A4 fitted to the page comes out at 94
# to 97 %, and all of it is scaled, so that its shape is that of any print (PrintScale).
_ANY_PRINT = 0.03, PrintScale.std_apart
_ANY_READING = 0.05, 0.01  # of a sheet that was measured wrong: who misreads two rulers does not misread them alike
_ANY_BOW_M = 0.01  # of a sheet that lies on something uneven
# Chance of a stated value that is grossly wrong (another printer's sheet, a slip of the pen), before the images are
# looked at: what a 95 % interval leaves out, and the odds of _GAIN.
_WRONG = 0.05
# The same of a size that two say: of a sheet whose two rulers were read, and who read them has said how well (that they
# agree, the images show); of a body that was measured and has the size that is drawn. It takes two slips that agree, as
# 0.05² has it, or one ruler, sheet or body that is another than was meant. Rulers of which only lengths are stated may
# be those of the sheet before, or of a rule held once: they count as any statement (_WRONG).
_READ_WRONG = 0.01
# The same of a sheet both of whose rulers read what they should, nobody having said how well they were read. One in ten
# does not measure and states that: half of them of a sheet that is grossly another (0.05), half of a right one (0.05).
# Of the others one in ten reads just that (0.09): prints are off by 0.5 %, and by 0.3 % along y against x, and half a
# millimetre is what a ruler shows. That makes 0.05 of 0.19.
_NOMINAL_WRONG = 0.25
IN_DOUBT = 0.025  # chance beyond which it reaches into a 95 % interval
SIZE, BOW, LENS_VALUES = "size", "bow", "lens"
_PLAIN = {"fx": "focal length", "fy": "focal length", "cx": "centre", "cy": "centre"}


@dataclass(frozen=True)
class DoubtedStatement:
    """A statement taken back. what: size, bow or lens. prior: without it. equations, sizes: with that prior, at the
    state of the fit. misfit: −2 log likelihood there. chance: that the statement is wrong, given the images. counted:
    the same as it counts against an arm made worse. What images say against a wrong size hangs on how far off wrong
    sizes are supposed to be (5 %, and one of 2 % shows far less); so of rulers that may have been read but once, it
    does not count.
    """

    what: str
    prior: CommonPrior
    equations: Equations
    sizes: Sizes
    misfit: float
    chance: float
    counted: float


def doubts(
    fit: CameraFit, lens: Lens, stated: str | None, scale: PrintScale, arm: float | None
) -> tuple[DoubtedStatement, ...]:
    """Each of the statements taken back, with the chance that it is wrong.

    lens, scale: as stated. stated: what became of the lens's values, None where nobody stated any. arm: as in the fit.
    """
    wider = _wider(fit.prior, lens, stated, scale)
    if fit.prior.places is not None:
        wider.pop(BOW)  # which a body has none of
    weighed = [(what, prior, *_without(fit, prior, arm)) for what, prior in wider.items()]
    of_size = _READ_WRONG if scale.measured else _WRONG
    if scale.measured and scale.unsaid:
        of_size = _NOMINAL_WRONG if scale.nominal else _WRONG
    before = np.array([of_size if what == SIZE else _WRONG for what in wider])
    odds = before * np.array([np.exp(0.5 * min(fit.misfit - misfit, 100.0)) for *_, misfit in weighed])
    chances = odds / (1.0 + odds.sum())
    least = of_size if scale.unsaid and not scale.nominal else 0.0
    return tuple(
        DoubtedStatement(*one, float(chance), max(float(chance), least if one[0] == SIZE else 0.0))
        for one, chance in zip(weighed, chances, strict=True)
    )


def contradictions(
    fit: CameraFit, doubted: Sequence[DoubtedStatement], lens: Lens, scale: PrintScale, arm: float | None
) -> tuple[str, ...]:
    """What the images contradict of what was stated, in sentences.

    doubted: of this fit. lens, scale: as stated. arm: as in the fit.
    """
    out = []
    plain = fit.misfit
    for doubt in doubted:
        if doubt.misfit < plain - _SCREEN:
            other = fit_camera(fit.table, fit.poses, fit.state.lens, doubt.prior, fit.sizes, arm)
            if other.converged and other.misfit < plain - _GAIN:
                out.append(_said(doubt.what, other, lens, scale))
    if arm is not None and fit.poses.of_arm.any():
        free = likeliest(fit.equations, fit.sizes)
        if free.arm > arm and fit.equations.solve(free).misfit() + usual(free) < plain - _GAIN:
            out.append(
                f"The arm is some {free.arm / arm:.1f} times as far off as --arm-mm states: state what you know of it, "
                "or check the square's size."
            )
    return tuple(out)


def in_doubt(fit: CameraFit, doubted: Sequence[DoubtedStatement], scale: PrintScale) -> tuple[str, ...]:
    """What the images leave in doubt of what was stated, in sentences."""
    out = []
    for doubt in doubted:
        if doubt.chance > IN_DOUBT:
            step = doubt.equations.solve(doubt.sizes).step()[fit.poses.count + 1 :]
            common = fit.state.common + step
            what = {
                SIZE: f"a {_of_what(fit)} {_percent(fit, common, scale)} off its stated size",
                BOW: f"a sheet bent by {1e3 * float(np.abs(common[BENT]).max()):.1f} mm",
                LENS_VALUES: "another lens than the stated one",
            }[doubt.what]
            out.append(
                f"An arm with these faults and {what} look much alike (chance of the latter "
                f"{100.0 * doubt.chance:.0f} %): check that statement, or add a length of another kind, such "
                "as a few tracker points."
            )
    return tuple(out)


def _wider(prior: CommonPrior, lens: Lens, stated: str | None, scale: PrintScale) -> dict[str, CommonPrior]:
    """The prior with each of the statements taken back, by what it is about."""
    size = prior.information.copy()
    of_both, of_shape = _ANY_READING if scale.measured and not scale.nominal else _ANY_PRINT
    both, apart = of_both**2, (0.5 * of_shape) ** 2
    cov = np.array([[both + apart, both - apart], [both - apart, both + apart]])
    if prior.places is not None:  # the print of its markers is another statement, and stands
        cov = np.linalg.inv(prior.information[SCALE, SCALE]) + np.diag([both, 0.0])
    size[SCALE, SCALE] = np.linalg.inv(cov)
    bow = prior.information.copy()
    bow[BENT, BENT] = np.eye(SHAPE - 2) / _ANY_BOW_M**2
    free = prior.free.copy()
    free[BENT] = True
    out = {SIZE: replace(prior, information=size), BOW: replace(prior, information=bow, free=free)}
    if stated is not None:
        unknown = common_prior(lens, PrintScale(), None)
        information, open_ = prior.information.copy(), prior.free.copy()
        information[:LENS, :LENS] = unknown.information[:LENS, :LENS]
        open_[:LENS] = True
        mean = np.r_[unknown.mean[:LENS], prior.mean[LENS:]]
        out[LENS_VALUES] = replace(prior, mean=mean, information=information, free=open_)
    return out


def _without(fit: CameraFit, prior: CommonPrior, arm: float | None) -> tuple[Equations, Sizes, float]:
    """(equations, sizes, −2 log likelihood) with another prior, at the state of the fit."""
    count = len(fit.equations.offset) - len(prior.mean)
    information = fit.equations.information.copy()
    information[count:, count:] = prior.information
    offset = np.r_[fit.equations.offset[:count], fit.state.common - prior.mean]
    free = np.r_[fit.equations.free[:count], prior.free]
    there: Equations = replace(fit.equations, information=information, offset=offset, free=free)
    sizes = likeliest(there, fit.sizes, arm)
    return there, sizes, there.solve(sizes).misfit() + usual(sizes)


def _said(what: str, other: CameraFit, lens: Lens, scale: PrintScale) -> str:
    P = other.poses.count
    std = np.sqrt(np.diag(other.covariance))[P + 1 :]
    shape = other.state.shape
    if what == SIZE:
        return (
            f"The {_of_what(other)} is {_percent(other, other.state.common, scale)} off its stated size, ± "
            f"{100.0 * float(std[LENS]):.1f} %, or the arm is built to another scale than its URDF: measure "
            f"{'across it' if other.table.places else 'a square'}, and check the target file."
        )
    if what == BOW:
        worst = float(np.abs(other.table.bow @ shape[2:]).max())
        return f"The sheet is bent by {1e3 * worst:.1f} mm towards its edge: glue it to something flat."
    off_by = np.abs(other.state.lens.values - lens.values) / np.maximum(std[:LENS], 1e-9)
    i = int(np.argmax(off_by))
    name = _PLAIN.get(lens.names[i], lens.names[i])
    return (
        f"The images contradict the stated lens: {name} {other.state.lens.values[i]:.4g} ± {std[i]:.2g} and not "
        f"{lens.values[i]:.4g}. Give the camera_info of this camera, focus and resolution, or leave it away."
    )


def _of_what(fit: CameraFit) -> str:
    """What has a size."""
    return "body" if fit.table.places else "sheet"


def _percent(fit: CameraFit, common: Array, scale: PrintScale) -> str:
    """By how much a sheet is off along x and y, or a body as a whole."""
    x, y = common[SCALE] + 1.0
    along_x = f"{100.0 * (x / scale.x - 1.0):+.1f} %"
    return along_x if fit.table.places else f"{along_x} (x) and {100.0 * (y / scale.y - 1.0):+.1f} % (y)"


TARGET, CLOCK = "target", "clock"  # families of the report


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


def findings(
    fit: CameraFit, scale: PrintScale, other_length: bool, q: Array, arm: float | None = None
) -> tuple[CameraFinding, ...]:
    """What is named.

    scale: as stated of the print. other_length: whether anything but the sheet states a length. q: postures (M, n) over
    which the size at the flange is. arm: as in the fit.
    """
    P = fit.poses.count
    common = P + 1
    groups = {
        "clock": np.array([P]),
        "readout": np.array([common + READOUT]),
        "scale": common + np.arange(SCALE.start, SCALE.stop),
        "bow": common + np.arange(BENT.start, BENT.stop),
    }
    if scale.measured:  # somebody's ruler against the images: see contradictions
        groups.pop("scale")
    J = flange_motions(fit, q)
    out = []
    for what, rows in groups.items():
        if not fit.equations.free[rows].all():
            continue
        stated = np.array([scale.x - 1.0, scale.y - 1.0]) if what == "scale" else np.zeros(len(rows))
        gain, p_value = _against(fit, rows, stated, arm)
        if gain > _GAIN:
            value = np.r_[fit.state.offset_s, fit.state.common][rows - P]
            C = fit.covariance
            shift = C[:P, rows] @ np.linalg.solve(C[np.ix_(rows, rows)], value - stated)
            at_tool = float(np.sqrt(((J @ shift) ** 2).sum() / len(q)))
            std = np.sqrt(np.diag(C)[rows])
            out.append(_finding(what, fit, value, std, p_value, gain, at_tool, other_length))
    return tuple(out)


def _against(fit: CameraFit, rows: np.ndarray, stated: Array, arm: float | None) -> tuple[float, float]:
    """(gain of −2 log likelihood over the stated values of these parameters, chance of the stated values)."""
    P = fit.poses.count
    here = np.r_[fit.state.values, fit.state.offset_s, fit.state.common][rows] - stated
    before_mean = here - fit.equations.offset[rows]
    before = np.linalg.inv(fit.equations.information[np.ix_(rows, rows)])
    assert rows.min() >= P
    log_before = _square(before_mean, before) + float(np.linalg.slogdet(before)[1])

    def after(solved: SolvedEquations) -> tuple[Array, Array]:
        return here + solved.step()[rows], solved.covariance()[np.ix_(rows, rows)]

    def at_stated(solved: SolvedEquations) -> float:
        mean, cov = after(solved)
        return solved.misfit() + _square(mean, cov) + float(np.linalg.slogdet(cov)[1]) - log_before

    free = fit.misfit
    if at_stated(fit.equations.solve(fit.sizes)) + usual(fit.sizes) - free <= _GAIN:  # other sizes only help it
        return 0.0, 1.0
    sizes = likeliest(fit.equations, fit.sizes, arm, at_stated)
    solved = fit.equations.solve(sizes)
    gain = at_stated(solved) + usual(sizes) - free
    return gain, beyond_chi2(_square(*after(solved)), len(rows))


def _square(mean: Array, cov: Array) -> float:
    return float(mean @ np.linalg.solve(cov, mean))


def _finding(
    what: str, fit: CameraFit, value: Array, std: Array, p_value: float, gain: float, at_tool: float, other_length: bool
) -> CameraFinding:
    cost = f"left out, it would put the tool {1e3 * at_tool:.2f} mm off"
    same: tuple[str, ...] = ()
    if what == "clock":
        where = (CLOCK, "camera:camera", "all", "velocity")
        late = "later" if value[0] < 0.0 else "earlier"
        size = f"{1e3 * abs(value[0]):.1f} ± {1e3 * std[0]:.1f} ms"
        said = f"Images are stamped {size} {late} than the joints of their moment"
        values = {"delay_s": (float(-value[0]), float(std[0]), "s")}
    elif what == "readout":
        where = (CLOCK, "camera:camera", "all", "line")
        line, spread = value[0] / fit.state.lens.size[1], std[0] / fit.state.lens.size[1]
        said = (
            f"The camera reads an image line by line, {1e6 * line:.1f} ± {1e6 * spread:.1f} µs a line "
            f"({1e3 * value[0]:.1f} ms from top to bottom)"
        )
        values = {"line_s": (float(line), float(spread), "s")}
    elif what == "scale":
        where = (TARGET, "target:target", "size", "constant")
        x, y = 100.0 * value
        said = f"The sheet is {x:+.2f} % (x) and {y:+.2f} % (y) off its stated size, ± {100.0 * std[0]:.2f} %"
        if fit.table.places:
            said = f"The body is {x:+.2f} % and its markers {y:+.2f} % off their stated size, ± {100.0 * std[0]:.2f} %"
        values = {f"size_{axis}": (float(v), float(s), "1") for axis, v, s in zip("xy", value, std, strict=True)}
        if not other_length:
            same = ("the arm, all lengths by one factor",)
            said += ", or the arm is built to another scale than its URDF: nothing here tells which"
    else:
        where = (TARGET, "target:target", "normal", "constant")
        off = np.abs(fit.table.bow @ value)
        mode = fit.table.bow[int(off.argmax())]
        spread = float(np.sqrt((mode * std) @ (mode * std)))
        modes = zip(("xx", "xy", "yy"), value, std, strict=True)
        values = {f"bow_{name}": (float(v), float(s), "m") for name, v, s in modes}
        said = f"The sheet is bent by {1e3 * float(off.max()):.2f} ± {1e3 * spread:.2f} mm towards its edge"
    return CameraFinding(*where, values, p_value, gain, at_tool, same, f"{said}; {cost}.")
