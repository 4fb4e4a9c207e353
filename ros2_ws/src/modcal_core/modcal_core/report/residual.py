"""What small curves that no report names do together: a sentence, not a cause."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.removal import without
from modcal_core.calibration.score import errors
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.effects.registry import companionless
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.effect_sizes import at_tool

_MAX_SEEN = 500  # samples at which sizes at the tool are taken


def residual_notes(model: Model, known: Uncertainty, scored: Samples) -> tuple[str, ...]:
    """A sentence on the effects of the scored model that no entry contains, largest joint first; none without them.

    known: how well the model's values are known. scored: held-out samples.
    """
    numbers = companionless(model.effects)
    if not numbers or not len(scored):
        return ()
    few = scored.select(spread_rows(len(scored), _MAX_SEEN))
    of_joint: dict[str, list[int]] = {}
    for i in numbers:
        of_joint.setdefault(model.effects[i].place, []).append(i)
    size = {joint: 1e3 * at_tool(model, own, few) for joint, own in of_joint.items()}
    shares = ", ".join(f"{joint} {size[joint]:.3f} mm" for joint in sorted(size, key=lambda j: -size[j]))
    with_them, alone = (
        1e3 * float(np.sqrt(np.mean(errors(m, scored).position_norm ** 2)))
        for m in (model, without(model, known, numbers))
    )
    return (
        f"Beside what is named, small curves of joints, each held as small as these stations make likely, were learned "
        f"together (RMS at the tool: {shares}); without them the error would be {alone:.3f} instead of {with_them:.3f} "
        "mm. None of them is claimed as a cause.",
    )
