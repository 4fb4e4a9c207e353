"""Statements about sheet, lens, clock and arm, and what the images say against each: one catalogue, one price.

A stated value that is wrong does not show in the residuals where the arm can take it up: a sheet 2 % larger than stated
looks like an arm whose links are all 2 % shorter. What gives it away is the likelihood of the images with the statement
relaxed against held, all parameters integrated out and the sizes of all errors found again.

* A stated value is held with its tolerance in the fit, and is relaxed to one that says next to nothing. Far likelier:
  it is contradicted, or the arm is built to another scale. Where images say neither, it is in doubt, which is said, and
  counts in the chance of an arm made worse.
* A default, as no delay or a flat sheet, is fitted, and is held at its value. Far less likely: the value is named.

Either is another prior of a few values in the equations of the fit, solved from there.

Every relaxed statement has a price in nats, and they share one probability with each other and with none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import PrintScale, alike
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import FREE, READOUT, SCALE, SHAPE, common_prior
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import LIKELIER, CameraFit, CameraImages, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.effects import ReportEntry
from modcal_core.geometry import Array

# Nats for each thing that backs a statement: that it is made, a value of one's own, and a tolerance stated with it. The
# first two are odds of 20 : 1.
_BACKED = 0.5 * float(np.log(20.0))
# Tolerances of a size that is not as stated, relative: of a length, and against the width.
_ANY_SIZE = PrintScale(known=alike(0.05, 0.01))
_ANY_BOW_M = 0.01  # of a sheet that lies on something uneven
_EXACT = 1e8  # times the information of its prior; a value that is held
_NEVER_LESS = 0.05  # chance that rulers of which nobody says how well they were read are of another sheet
IN_DOUBT = 0.025  # chance beyond which it reaches into a 95 % interval
SIZE, BOW, LENS_VALUES = "size", "bow", "lens"
TARGET, CLOCK = "target", "clock"  # families of the report


@dataclass(frozen=True)
class DoubtedStatement:
    """A relaxed statement. what: size, bow or lens. solved: the equations with it relaxed at the state of the fit, and
    the sizes of errors. gain: of −2 log likelihood. chance: that the statement is wrong, given the images.
    """

    what: str
    solved: SolvedEquations
    gain: float
    chance: float

    def values(self, fit: CameraFit) -> tuple[Array, Array]:
        """(lens, shape, readout and places of markers; their standard deviations) with it relaxed, (15 + Z,) each."""
        there = fit.state.common + self.solved.step()[fit.common]
        return there, np.sqrt(np.diag(self.solved.covariance()))[fit.common]


def doubts(fit: CameraFit, stated: CameraImages) -> tuple[DoubtedStatement, ...]:
    """Each of the statements relaxed, and the chance that it is wrong."""
    scale, relaxed = stated.target.scale, []
    for what, at, information, mean in _relaxed(fit, stated):
        there = fit.equations.with_block(fit.common[at], information, fit.state.common[at] - mean)
        relaxed.append((what, *fit.weighed(there)))
    # of a length nobody may have read more than the sheet; who says how well has measured it
    backed = 2.0 + scale.measured - 2.0 * scale.unsaid
    price = _BACKED * np.array([backed if what == SIZE else 2.0 for what, *_ in relaxed])
    gain = np.array([fit.misfit - misfit for *_, misfit in relaxed])
    odds = np.exp(0.5 * np.minimum(gain, 100.0) - price)
    # what images say against a wrong size hangs on how far off wrong sizes are supposed to be
    least = np.array([_NEVER_LESS * (scale.unsaid and what == SIZE) for what, *_ in relaxed])
    chances = np.maximum(odds / (1.0 + odds.sum()), least)
    every = zip(relaxed, gain, chances, strict=True)
    return tuple(DoubtedStatement(what, solved, float(more), float(p)) for (what, solved, _), more, p in every)


def _relaxed(fit: CameraFit, stated: CameraImages) -> Iterator[tuple[str, slice, Array, Array]]:
    """(what a statement is about, its values among lens and shape, their information and mean with it relaxed)."""
    prior = fit.prior
    cov = _ANY_SIZE.covariance
    if prior.places is not None:  # the print of its markers is another statement, and stands
        cov = np.asarray(np.linalg.inv(prior.information[SCALE, SCALE]) + np.diag([cov[0, 0], 0.0]))
    yield SIZE, SCALE, np.asarray(np.linalg.inv(cov)), prior.mean[SCALE]
    if prior.places is None:  # a body has no bow
        yield BOW, BENT, np.eye(SHAPE - 2) / _ANY_BOW_M**2, prior.mean[BENT]
    if stated.lens is not None and stated.stated != FREE:
        unknown, values = common_prior(stated.lens, PrintScale(), None), slice(0, LENS)
        yield LENS_VALUES, values, unknown.information[values, values], unknown.mean[values]


def contradictions(fit: CameraFit, doubted: Sequence[DoubtedStatement], stated: CameraImages) -> tuple[str, ...]:
    """What the images contradict of what was stated, in sentences. doubted: of this fit."""
    wrong = [doubt for doubt in doubted if doubt.gain > LIKELIER]
    out = [f"The images show {_phrase(fit, doubt, stated)}{_WHAT_TO_DO[doubt.what]}" for doubt in wrong]
    if fit.poses.faults is not None and fit.poses.arm_stated is not None:
        solved, misfit = fit.weighed(replace(fit.equations, faults=replace(fit.poses.faults, stated=None)))
        times = solved.sizes.arm / fit.sizes.arm
        if times > 1.0 and misfit < fit.misfit - LIKELIER:
            out.append(
                f"The arm is some {times:.1f} times as far off as --arm-mm states: state what you know of it, or check "
                "the square's size."
            )
    return tuple(out)


def in_doubt(fit: CameraFit, doubted: Sequence[DoubtedStatement], stated: CameraImages) -> tuple[str, ...]:
    """What the images leave in doubt of what was stated, in sentences."""
    return tuple(
        f"An arm with these faults and {_phrase(fit, doubt, stated)} look much alike (chance of the latter "
        f"{100.0 * doubt.chance:.0f} %): check that statement, or add a length of another kind, such as a few tracker "
        "points."
        for doubt in doubted
        if doubt.chance > IN_DOUBT
    )


_WHAT_TO_DO = {
    SIZE: ", or an arm that is built to another scale than its URDF: measure it again, and check the target file.",
    BOW: ": glue it to something flat.",
    LENS_VALUES: ": give the camera_info of this camera, focus and resolution, or leave it away.",
}


def _phrase(fit: CameraFit, doubt: DoubtedStatement, stated: CameraImages) -> str:
    """What the images have where the statement is wrong."""
    common, std = doubt.values(fit)
    if doubt.what == SIZE:
        what = "body" if fit.table.places else "sheet"
        return f"a {what} {_percent(fit, common, stated.target.scale)} off its stated size, ± {100.0 * std[LENS]:.1f} %"
    if doubt.what == BOW:
        worst = float(np.abs(fit.table.bow @ common[BENT]).max())
        return f"a sheet that is bent by {1e3 * worst:.1f} mm towards its edge"
    assert stated.lens is not None
    found, values, names = common[:LENS], stated.lens.values, stated.lens.names
    i = int(np.argmax(np.abs(found - values) / np.maximum(std[:LENS], 1e-9)))
    return f"a lens whose {_PLAIN.get(names[i], names[i])} is {found[i]:.4g} ± {std[i]:.2g} and not {values[i]:.4g}"


_PLAIN = {"fx": "focal length", "fy": "focal length", "cx": "centre", "cy": "centre"}


def _percent(fit: CameraFit, common: Array, scale: PrintScale) -> str:
    """By how much a sheet is off along x and y, or a body as a whole."""
    x, y = common[SCALE] + 1.0
    along_x = f"{100.0 * (x / scale.x - 1.0):+.1f} %"
    return along_x if fit.table.places else f"{along_x} (x) and {100.0 * (y / scale.y - 1.0):+.1f} % (y)"


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


def _printed(fit: CameraFit, value: Array, std: Array) -> str:
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
    _Default(TARGET, _SCALED, "size", "constant", ("size_x", "size_y"), "1", _printed),
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
        if held.solve(fit.sizes).misfit() + usual(fit.sizes) - plain <= LIKELIER:  # other sizes only help it
            continue
        gain = fit.weighed(held)[1] - plain
        if gain <= LIKELIER:
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
