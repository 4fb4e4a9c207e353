"""Quantities that no arm has: bodies whose mass lies beyond its reach, a tool that is longer than the arm."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import Model
from modcal_core.robots import Inertias, Mechanism

_MAX_KG = 5000.0  # the heaviest serial arms weigh three tonnes in all


def sane_inertias(inertias: Inertias | None, chain: Mechanism) -> tuple[Inertias | None, tuple[str, ...]]:
    """The bodies of the arm, None where some are absurd, and a sentence that names each of these."""
    if inertias is None or not inertias.known:
        return inertias, ()
    reach = chain.reach()
    said = []
    for name, mass, com in zip(chain.names, inertias.mass, inertias.com, strict=True):
        away = float(np.linalg.norm(com))
        if not np.isfinite(mass) or not np.isfinite(away) or not 0.0 <= mass <= _MAX_KG:
            said.append(f"behind {name} a mass of {mass:.3g} kg")
        elif mass > 0.0 and away > reach:
            said.append(f"behind {name} a centre of mass {away:.3g} m away, where the arm reaches {reach:.2f} m")
    if not said:
        return inertias, ()
    return None, (
        f"The robot description states {'; '.join(said)}. Its masses were not used, so loads are per kg at the tip: "
        "correct <inertial> in the URDF (metres and kilograms).",
    )


def long_tool(model: Model) -> tuple[str, ...]:
    """A sentence where the tool was found farther from the flange than the arm is long."""
    length, reach = float(np.linalg.norm(model.T_tip_tool[:3, 3])), model.chain.reach()
    if length <= reach:
        return ()
    return (
        f"The tool was found {length:.2f} m from {_tip(model)}, and the arm reaches {reach:.2f} m: check that the "
        "URDF, --base and --tip are those of this robot, and turn the wrist more while recording.",
    )


def _tip(model: Model) -> str:
    return str(getattr(model.chain, "tip", "") or "the flange")
