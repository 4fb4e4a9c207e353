"""Statements about sheet, lens, clock and arm, and what the images say against each: one catalogue, one price.

A stated value that is wrong does not show in the residuals where the arm can take it up: a sheet 2 % larger than stated
looks like an arm whose links are all 2 % shorter. What gives it away is the likelihood of the images with the statement
relaxed against held, all parameters integrated out and the sizes of all errors found again.

* A stated value is held with its tolerance in the fit, and is relaxed. Far likelier: it is contradicted, or the arm is
  built to another scale. Where images say neither, it is in doubt, and counts in the chance of an arm made worse.
* A default, as no delay or a flat sheet, is fitted, and is held at its value. Far less likely: the value is named.

Either is another prior of a few values in the equations of the fit. Every relaxed statement has a price in nats, and
they share one probability with each other and with none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import PrintScale, alike
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import FREE, READOUT, SCALE, SHAPE, common_prior
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import LIKELIER, CameraFit
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
TARGET, CLOCK = "target", "clock"  # families of the report


def _late(_: CameraFit, value: Array, std: Array) -> str:
    late = "later" if value[0] < 0.0 else "earlier"
    return f"stamps {1e3 * abs(value[0]):.1f} ± {1e3 * std[0]:.1f} ms {late} than the joints of their moment"


def _by_line(fit: CameraFit, value: Array, std: Array) -> str:
    line, spread = 1e6 * np.array([value[0], std[0]]) / fit.state.lens.size[1]
    whole = f"{1e3 * value[0]:.1f} ms from top to bottom"
    return f"a camera that reads an image line by line, {line:.1f} ± {spread:.1f} µs a line ({whole})"


def _size(fit: CameraFit, value: Array, std: Array) -> str:
    scale = fit.table.target.scale
    x, y = 100.0 * ((1.0 + value) / [scale.x, scale.y] - 1.0)
    if fit.table.places:
        return f"a body {x:+.2f} % and markers {y:+.2f} % off their stated size, ± {100.0 * std[0]:.2f} %"
    return f"a sheet {x:+.2f} % (x) and {y:+.2f} % (y) off its stated size, ± {100.0 * std[0]:.2f} %"


def _bent(fit: CameraFit, value: Array, std: Array) -> str:
    bow = fit.table.modes[:, 2, 2:]  # how far each corner leaves the plane per unit of its three modes
    off = np.abs(bow @ value)
    spread = float(np.linalg.norm(bow[int(off.argmax())] * std))
    return f"a sheet that is bent by {1e3 * float(off.max()):.2f} ± {1e3 * spread:.2f} mm towards its edge"


def _other_lens(fit: CameraFit, value: Array, std: Array) -> str:
    lens = fit.cameras.first.given.lens
    assert lens is not None
    i = int(np.argmax(np.abs(value - lens.values) / np.maximum(std, 1e-9)))
    plain = {"fx": "focal length", "fy": "focal length", "cx": "centre", "cy": "centre"}
    name = plain.get(lens.names[i], lens.names[i])
    return f"a lens whose {name} is {value[i]:.4g} ± {std[i]:.2g} and not {lens.values[i]:.4g}"


@dataclass(frozen=True)
class Statement:
    """at: its values, where they stand behind the clock's delay: lens, shape, readout. words: what images have in its
    place, by fit, values and standard deviations. remedy: of a stated value. family, direction, driver, names, unit: of
    a default in the report; without a family it is none.
    """

    at: slice
    words: Callable[[CameraFit, Array, Array], str]
    remedy: str = ""
    family: str = ""
    direction: str = "all"
    driver: str = "constant"
    names: tuple[str, ...] = ()
    unit: str = "s"

    def rows(self, fit: CameraFit) -> np.ndarray:
        """Where its values stand among all of a fit."""
        return fit.poses.count + np.arange(self.at.start, self.at.stop)


def _behind_clock(at: slice) -> slice:
    return slice(1 + at.start, 1 + at.stop)


SIZE, BOW, LENS_VALUES = "size", "bow", "lens"
_STATEMENTS = {
    "delay": Statement(slice(0, 1), _late, family=CLOCK, driver="velocity", names=("delay_s",)),
    "line": Statement(slice(1 + READOUT, 2 + READOUT), _by_line, family=CLOCK, driver="line", names=("line_s",)),
    SIZE: Statement(
        _behind_clock(SCALE),
        _size,
        ", or an arm that is built to another scale than its URDF: measure it again, and check the target file.",
        family=TARGET,
        direction="size",
        names=("size_x", "size_y"),
        unit="1",
    ),
    BOW: Statement(
        _behind_clock(BENT),
        _bent,
        ": glue it to something flat.",
        family=TARGET,
        direction="normal",
        names=("bow_xx", "bow_xy", "bow_yy"),
        unit="m",
    ),
    LENS_VALUES: Statement(
        _behind_clock(slice(0, LENS)),
        _other_lens,
        ": give the camera_info of this camera, focus and resolution, or leave it away.",
    ),
}


@dataclass(frozen=True)
class DoubtedStatement:
    """A statement relaxed. what: size, bow or lens. words: what the images have in its place. solved: the equations
    with it relaxed at the state of the fit, and the sizes of errors. gain: of −2 log likelihood. chance: that it is
    wrong, given the images.
    """

    what: str
    words: str
    solved: SolvedEquations
    gain: float
    chance: float


def doubts(fit: CameraFit) -> tuple[DoubtedStatement, ...]:
    """Each of the statements relaxed, and the chance that it is wrong."""
    scale, relaxed = fit.table.target.scale, []
    for what, information, mean in _relaxed(fit):
        rows = _STATEMENTS[what].rows(fit)
        solved, misfit = fit.weighed(fit.equations.with_block(rows, information, fit.x[rows] - mean))
        there, std = fit.x + solved.step(), np.sqrt(np.diag(solved.covariance()))
        relaxed.append((what, _STATEMENTS[what].words(fit, there[rows], std[rows]), solved, fit.misfit - misfit))
    # of a length nobody may have read more than the sheet; who says how well has measured it
    backed = 2.0 + scale.measured - 2.0 * scale.unsaid
    price = _BACKED * np.array([backed if what == SIZE else 2.0 for what, *_ in relaxed])
    odds = np.exp(0.5 * np.minimum([gain for *_, gain in relaxed], 100.0) - price)
    # what images say against a wrong size hangs on how far off wrong sizes are supposed to be
    least = np.array([_NEVER_LESS * (scale.unsaid and what == SIZE) for what, *_ in relaxed])
    chances = np.maximum(odds / (1.0 + odds.sum()), least).tolist()
    return tuple(DoubtedStatement(*one, p) for one, p in zip(relaxed, chances, strict=True))


def _relaxed(fit: CameraFit) -> Iterator[tuple[str, Array, Array]]:
    """(what a statement is about, information and mean of its values with it relaxed)."""
    prior, given = fit.cameras.first.prior, fit.cameras.first.given
    cov = _ANY_SIZE.covariance
    if prior.places is not None:  # the print of its markers is another statement, and stands
        cov = np.asarray(np.linalg.inv(prior.information[SCALE, SCALE]) + np.diag([cov[0, 0], 0.0]))
    yield SIZE, np.asarray(np.linalg.inv(cov)), prior.mean[SCALE]
    if prior.places is None:  # a body has no bow
        yield BOW, np.eye(SHAPE - 2) / _ANY_BOW_M**2, prior.mean[BENT]
    if given.lens is not None and given.stated != FREE:
        unknown = common_prior(given.lens, given.target, None)
        yield LENS_VALUES, unknown.information[:LENS, :LENS], unknown.mean[:LENS]


def contradictions(fit: CameraFit, doubted: Sequence[DoubtedStatement]) -> tuple[str, ...]:
    """What the images contradict of what was stated, in sentences. doubted: of this fit."""
    wrong = [one for one in doubted if one.gain > LIKELIER]
    out = [f"The images show {one.words}{_STATEMENTS[one.what].remedy}" for one in wrong]
    if fit.poses.faults is not None and fit.poses.arm_stated is not None:
        solved, misfit = fit.weighed(replace(fit.equations, faults=replace(fit.poses.faults, stated=None)))
        times = solved.sizes.arm / fit.sizes.arm
        if times > 1.0 and misfit < fit.misfit - LIKELIER:
            out.append(
                f"The arm is some {times:.1f} times as far off as --arm-mm states: state what you know of it, or check "
                "the square's size."
            )
    return tuple(out)


def in_doubt(doubted: Sequence[DoubtedStatement]) -> tuple[str, ...]:
    """What the images leave in doubt of what was stated, in sentences."""
    return tuple(
        f"An arm with these faults and {one.words} look much alike (chance of the latter {100.0 * one.chance:.0f} %): "
        "check that statement, or add a length of another kind, such as a few tracker points."
        for one in doubted
        if one.chance > IN_DOUBT
    )


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


def findings(fit: CameraFit, other_length: bool, q: Array) -> tuple[CameraFinding, ...]:
    """Defaults that do not hold. other_length: not of the sheet. q (M, n): postures for the size at the flange."""
    P, C, scale = fit.poses.count, fit.covariance, fit.table.target.scale
    J, plain, out = fit.flange_motions(q), fit.misfit, []
    for what, row in _STATEMENTS.items():
        rows, of_size = row.rows(fit), what == SIZE
        # somebody's ruler against the images is no default
        if not row.family or (of_size and scale.measured) or not fit.equations.free[rows].all():
            continue
        value, std = fit.x[rows], np.sqrt(np.diag(C)[rows])
        off = value - [scale.x - 1.0, scale.y - 1.0] if of_size else value
        held = fit.equations.with_block(rows, np.diag(_EXACT * np.diag(fit.equations.information)[rows]), off)
        gain = fit.weighed(held)[1] - plain
        if gain <= LIKELIER:
            continue
        shift = C[:P, rows] @ np.linalg.solve(C[np.ix_(rows, rows)], off)
        at_tool = float(np.sqrt(((J @ shift) ** 2).sum() / len(q)))
        either = of_size and not other_length
        unit = {"delay": -1.0, "line": 1.0 / fit.state.lens.size[1]}.get(what, 1.0)
        every = zip(row.names, unit * value, abs(unit) * std, strict=True)
        sizes = {name: (float(v), float(s), row.unit) for name, v, s in every}
        place = "camera:camera" if row.family == CLOCK else "target:target"
        same = ("the arm, all lengths by one factor",) if either else ()
        said = (
            f"The images show {row.words(fit, value, std)}"
            f"{', or an arm that is built to another scale than its URDF: nothing here tells which' if either else ''}"
            f"; left out, it would put the tool {1e3 * at_tool:.2f} mm off."
        )
        entry = ReportEntry(place, row.direction, row.driver, sizes, same)
        out.append(CameraFinding(row.family, entry, gain, at_tool, said))
    return tuple(out)
