"""What a report says of what pulls on the arm, where the data showed it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from modcal_core.calibration.distributions import beyond_normal
from modcal_core.calibration.model import Model
from modcal_core.calibration.score import errors
from modcal_core.diagnosis.load_step import by_weight
from modcal_core.diagnosis.loads import Loads
from modcal_core.effects.drivers import NominalArm
from modcal_core.effects.effect import ALL
from modcal_core.effects.families import payload
from modcal_core.effects.sizes import Quantity
from modcal_core.measurements.samples import Samples
from modcal_core.report.findings import Finding
from modcal_core.verdict.contributions import resampled

_NORMAL = 1.96  # deviations of a 95 % interval


def load_notes(loads: Loads | None) -> tuple[str, ...]:
    """Sentences on gravity and payloads, with 95 % intervals."""
    if loads is None:
        return ()
    out = []
    if loads.unknown:
        out.append(
            "The stations cannot tell gravity: joints seem to deflect under a weight that pulls another way than the "
            "robot description says, but not which way. State gravity: in the cell file."
        )
    if loads.down is not None:
        way = ", ".join(f"{x:+.3f}" for x in loads.down)
        out.append(
            f"Weight pulls along [{way}] in the base link (± {np.degrees(_NORMAL * loads.down_std):.2g}°), "
            f"{np.degrees(loads.turned):.1f}° from where the robot description says: state gravity: in the cell file, "
            "or tilt the base in the URDF."
        )
    if loads.relative and loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g}" for p in loads.payloads[:-1])
        out.append(
            f"The recordings were loaded differently: {said} of what the tip carries in the last one. No mass is "
            "known, so compliances are per kg of that."
        )
    elif loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g} kg" for p in loads.payloads)
        where = "" if len(loads.payloads) == 1 else " in the recordings, one after the other"
        out.append(f"The tip carries {said}{where} beyond what the robot description states.")
    if loads.centre is not None and loads.centre_std is not None:
        each = zip("xyz", 1e3 * loads.centre, 1e3 * _NORMAL * loads.centre_std, strict=True)
        said = ", ".join(f"{axis} {at:+.0f} ± {wide:.2g} mm" for axis, at, wide in each)
        out.append(f"The payload that the recording states has its centre at {said} in the tip link.")
    return tuple(out)


def load_findings(loads: Loads | None, model: Model, scored: Samples) -> tuple[Finding, ...]:
    """The payload as an entry of the report; none where none was found.

    What it is worth is what its removal costs, compliances and all else being kept.
    """
    if loads is None or not loads.payloads or loads.relative or not len(scored):
        return ()
    sizes: dict[str, Quantity] = {}
    many = len(loads.payloads) > 1
    for k, found in enumerate(loads.payloads, 1):
        number = f"_{k}" if many else ""
        sizes[f"mass{number}"] = (found.mass, found.mass_std, "kg")
        if found.place is not None and found.place_std is not None:
            for axis, at, std in zip("xyz", found.place, found.place_std, strict=True):
                sizes[f"centre_{axis}{number}"] = (float(at), float(std), "m")
    bare = replace(model, arm=_unloaded(loads))
    with_it, without_it = (errors(m, scored).position_norm ** 2 for m in (model, bare))
    cost, interval = resampled(1e6 * (without_it - with_it), scored.station)
    sure = max(abs(p.mass) / p.mass_std for p in loads.payloads if p.mass_std > 0.0)
    driver = next((e.public_driver for e in model.effects if by_weight(e)), "constant")
    moved = model.predict_samples(scored)[:, :3, 3] - bare.predict_samples(scored)[:, :3, 3]
    return (
        Finding(
            *(payload.NAME, "tool", ALL, driver),
            parameters=sizes,
            p_value=max(2.0 * beyond_normal(sure), 1e-300),
            before=float(np.sqrt(without_it.mean())),
            after=float(np.sqrt(with_it.mean())),
            gain_mm2=cost,
            ci95=interval,
            tool=float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
        ),
    )


def _unloaded(loads: Loads) -> NominalArm:
    """The arm without what was found to be carried."""
    if loads.down is None or loads.before.inertias is None:
        return loads.before
    return replace(loads.before, inertias=loads.before.inertias.pulled(loads.down))


def loads_to_json(loads: Loads | None) -> dict[str, Any] | None:
    """For ``report.json``."""
    if loads is None:
        return None
    return {
        "gravity": None
        if loads.down is None
        else {
            "direction": [float(x) for x in loads.down],
            "std_deg": float(np.degrees(loads.down_std)),
            "turned_deg": float(np.degrees(loads.turned)),
        },
        "gravity_unknown": loads.unknown,
        "relative": loads.relative,
        "stated_payload_centre_m": None if loads.centre is None else [float(x) for x in loads.centre],
        "stated_payload_centre_std_m": None if loads.centre_std is None else [float(x) for x in loads.centre_std],
        "payloads": [
            {
                "since": p.since,
                "mass": p.mass,
                "mass_std": p.mass_std,
                "centre_m": None if p.place is None else [float(x) for x in p.place],
                "centre_std_m": None if p.place_std is None else [float(x) for x in p.place_std],
            }
            for p in loads.payloads
        ],
    }
