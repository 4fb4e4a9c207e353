"""How soft a joint may be before images show it: what a calibration by camera cannot tell of springs.

A spring under the arm's own weight bends the arm by little and smoothly, and much of that looks like a joint's zero or
a link's length. What is left of it, beside all that is fitted, has to stand out of the noise of the images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.camera.at_tool import at_flange, flange_in_tool
from modcal_core.camera.evidence import CameraScanner, WithModel
from modcal_core.camera.fit import CameraFit
from modcal_core.effects.effect import AXIS
from modcal_core.effects.registry import candidates

# Standard deviations at which one of some hundred candidates stands out: noise takes one so far once in 16 000.
_SEEN = 4.0


@dataclass(frozen=True)
class HiddenSpring:
    """place: of a joint. least: compliance that these images would show [rad/(N m), m/N]. at_tool_m: RMS by which a
    spring of it moves the flange over the images.
    """

    place: str
    least: float
    at_tool_m: float


def hidden_springs(fit: CameraFit) -> tuple[HiddenSpring, ...]:
    """For each joint that gravity loads and of which no spring was found, the softest that images do not show, those
    that move the tool most first; nothing where the arm's masses are unknown, or there are too few images to look.
    """
    drivers = fit.poses.drivers(fit.state.offset_s)
    chain = fit.poses.model.chain
    found = {e.driver for e in fit.poses.model.effects}
    effects = [
        e
        for e in candidates(drivers)
        if e.driver == f"load:{e.place}" and e.driver not in found and (e.direction, e.shape.kind) == (AXIS, "linear")
    ]
    if not effects:
        return ()
    scanner = CameraScanner(effects, drivers)
    asked = WithModel(fit, fit.poses.model_at(fit.state.values))
    if not scanner.enough(asked):  # type: ignore[arg-type]
        return ()
    T = fit.poses.tool_at(fit.state.values)
    joints = at_flange(T, flange_in_tool(fit), fit.poses.joint_motions(fit.state.values, T))
    out = []
    for effect in effects:
        information = scanner.information(asked, effect)
        if information > 0.0:
            least = _SEEN / np.sqrt(information)
            moved = joints[:, :, chain.names.index(effect.place)] * drivers.values(effect.driver)[:, None]
            out.append(HiddenSpring(effect.place, float(least), float(least * np.sqrt((moved**2).sum() / len(T)))))
    return tuple(sorted(out, key=lambda one: -one.at_tool_m))
