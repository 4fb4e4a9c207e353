"""Joints that are at the same position at every station: they truly stood, or nobody recorded where they were."""

from __future__ import annotations

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.measurements import Samples


def standing(samples: Samples, said: str) -> BadRecording | None:
    """Refusal of samples whose joints do not move; None where all move. said: by how much an arm misses them."""
    spans = np.ptp(samples.q, axis=0)
    stand = [name for name, extent in zip(samples.names, spans, strict=True) if extent == 0.0]
    if not stand:
        return None
    return BadRecording(
        f"joint {' and '.join(stand)}",
        f"{'stands' if len(stand) == 1 else 'stand'} at the same position at all {len(samples)} stations; {said}",
        "see whether it truly did; else its position is not recorded: check how it gets into joint_states",
    )
