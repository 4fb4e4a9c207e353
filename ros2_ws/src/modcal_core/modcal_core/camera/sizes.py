"""How large noise, what an image has of its own, and the arm's faults are: those sizes that the data make likeliest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from modcal_core.camera.downhill import downhill
from modcal_core.camera.equations import Equations, Sizes, SolvedEquations
from modcal_core.geometry.so3 import Array

START = Sizes(1.0, 1e-4, 1e-4, 0.1)  # to begin with: an arm that repeats to 0.1 mrad and is 1 mm off a parameter
# What is known of the sizes before: middle, and by what factor they usually differ from it. Wide, and there to keep a
# size that the data say nothing of where arms and cameras have it.
_USUAL = Sizes(1.0, 1e-4, 1e-4, 0.1)
_USUAL_LOGS = _USUAL.logs  # asked for with every step of the search
# Lengths and angles of an arm are as faulty as each other, in units of 10 mm and 20 mrad, to a factor of two: from
# industrial arms (0.3 mm, 0.5 mrad) to printed ones (1 mm, 5 mrad).
# Markers on a body are off by a tolerance that is mostly a guess, as the arm's is.
_FACTOR = np.log([10.0, 10.0, 10.0, 10.0, 10.0, 2.0, 10.0])
_MIN = np.log([0.02, 1e-7, 1e-7, 1e-3, 1e-7, 0.1, 1e-3])
_MAX = np.log([50.0, 0.03, 0.03, 5.0, 0.03, 10.0, 30.0])
_ARM, _OTHER, _LENGTHS, _PLACES = 3, 4, 5, 6
_EVALUATIONS = 400  # many times what a search takes
_MET = 0.005  # of −2 log likelihood, which moves by 1 at a standard deviation
_ROUGH, _ROUGHLY = 2.0, 0.3  # the same, and of logarithms, where the search from afar may end


def usual(sizes: Sizes) -> float:
    """−2 log of how usual these sizes are."""
    off = (sizes.logs - _USUAL_LOGS) / _FACTOR
    return float(off @ off)


def likeliest(
    equations: Equations,
    start: Sizes,
    arm: float | None = None,
    misfit_of: Callable[[SolvedEquations], float] = SolvedEquations.misfit,
    afar: bool = False,
) -> Sizes:
    """The sizes that make the data likeliest.

    arm: size of the arm's faults where it is stated. misfit_of: −2 log likelihood of the equations with their sizes.
    afar: start where nothing is known of them. A size that is far too small is nowhere seen to matter, so slopes alone
    may leave it there.
    """
    begin = start if arm is None else replace(start, arm=arm)
    unknown = [0, 1, 2]
    if arm is None and equations.arm.any():
        unknown += [_ARM, _LENGTHS]
    if equations.beside is not None:
        unknown.append(_OTHER)
    if equations.places is not None:
        unknown.append(_PLACES)

    known = begin.logs

    def inside(logs: Array) -> Array:
        full = known.copy()
        full[unknown] = np.clip(logs, _MIN[unknown], _MAX[unknown])
        return full

    def misfit(logs: Array) -> float:
        full = inside(logs)
        sizes = Sizes.of_logs(full)
        return misfit_of(equations.solve(sizes)) + usual(sizes) + float(np.abs(logs - full[unknown]).sum())

    first = known[unknown]
    around = np.vstack([first, first + np.eye(len(first))])
    if afar:
        options: Any = {"initial_simplex": around, "maxfev": _EVALUATIONS, "fatol": _ROUGH, "xatol": _ROUGHLY}
        first = minimize(misfit, first, method="Nelder-Mead", options=options).x
    else:
        first = min(around, key=misfit)
    bounds = _MIN[unknown], _MAX[unknown]
    # where the data say nothing of a size, what is usual still does
    found = downhill(misfit, first, *bounds, 2.0 / _FACTOR[unknown] ** 2, _MET, _EVALUATIONS)
    return Sizes.of_logs(inside(found))
