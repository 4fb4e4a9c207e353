"""What target and camera are not as stated, by name: late images, a rolling shutter, the print's size, a bent sheet.

All of it is fitted in any case, with an expectation about what is stated. It is named where the images are likelier by
far with it than with the stated value, everything else integrated out and the sizes of all errors found again for
both. At given sizes the ratio of the two is that of the density at the stated value after and before the images
(Dickey 1971), which needs no second fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import beyond_chi2
from modcal_core.camera.causes import flange_motions
from modcal_core.camera.corners import BOW, READOUT, SCALE
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import CameraFit, likeliest, usual
from modcal_core.camera.target import PrintScale
from modcal_core.geometry import Array

TARGET, CLOCK = "target", "clock"  # families of the report
_GAIN = 6.0  # of −2 log likelihood: odds of 20 : 1, as of effects and statements


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
        "bow": common + np.arange(BOW.start, BOW.stop),
    }
    if scale.measured:  # somebody's ruler against the images: see contradicted
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
    rest = (p_value, gain, at_tool)
    cost = f"left out, it would put the tool {1e3 * at_tool:.2f} mm off"
    if what == "clock":
        late = "later" if value[0] < 0.0 else "earlier"
        size = f"{1e3 * abs(value[0]):.1f} ± {1e3 * std[0]:.1f} ms"
        said = f"Images are stamped {size} {late} than the joints of their moment"
        values = {"delay_s": (float(-value[0]), float(std[0]), "s")}
        return CameraFinding(CLOCK, "camera:camera", "all", "velocity", values, *rest, (), f"{said}; {cost}.")
    if what == "readout":
        height = fit.state.lens.size[1]
        line, spread = value[0] / height, std[0] / height
        said = (
            f"The camera reads an image line by line, {1e6 * line:.1f} ± {1e6 * spread:.1f} µs a line "
            f"({1e3 * value[0]:.1f} ms from top to bottom)"
        )
        values = {"line_s": (float(line), float(spread), "s")}
        return CameraFinding(CLOCK, "camera:camera", "all", "line", values, *rest, (), f"{said}; {cost}.")
    if what == "scale":
        x, y = 100.0 * value
        said = f"The sheet is {x:+.2f} % (x) and {y:+.2f} % (y) off its stated size, ± {100.0 * std[0]:.2f} %"
        if fit.table.places:
            said = f"The body is {x:+.2f} % and its markers {y:+.2f} % off their stated size, ± {100.0 * std[0]:.2f} %"
        values = {"size_x": (float(value[0]), float(std[0]), "1"), "size_y": (float(value[1]), float(std[1]), "1")}
        same: Sequence[str] = () if other_length else ("the arm, all lengths by one factor",)
        also = "" if other_length else ", or the arm is built to another scale than its URDF: nothing here tells which"
        said = f"{said}{also}; {cost}."
        return CameraFinding(TARGET, "target:target", "size", "constant", values, *rest, tuple(same), said)
    off = np.abs(fit.table.bow @ value)
    mode = fit.table.bow[int(off.argmax())]
    spread = float(np.sqrt((mode * std) @ (mode * std)))
    values = {
        f"bow_{name}": (float(v), float(s), "m") for name, v, s in zip(("xx", "xy", "yy"), value, std, strict=True)
    }
    said = f"The sheet is bent by {1e3 * float(off.max()):.2f} ± {1e3 * spread:.2f} mm towards its edge"
    return CameraFinding(TARGET, "target:target", "normal", "constant", values, *rest, (), f"{said}; {cost}.")
