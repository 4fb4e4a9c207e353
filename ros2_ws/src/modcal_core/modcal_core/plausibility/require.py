"""When even the fitted model misses by far, the input is wrong, and is refused (:mod:`refusal`).

So are sockets that moved (:mod:`socket_places`), which a fit would half follow and half reject.
"""

from __future__ import annotations

from collections.abc import Sequence

from modcal_core.calibration import AnyDistance, Fit, usual_miss
from modcal_core.measurements import Samples
from modcal_core.plausibility.socket_places import require_one_place

LIMIT_OF_REACH = 0.01  # a fitted arm that misses by more than this share of its reach is not an arm with small errors


def require_plausible(
    nominal: Fit,
    fitted: Fit,
    samples: Samples,
    whole: Samples | None = None,
    distances: Sequence[AnyDistance] = (),
    placed: bool = False,
) -> None:
    """Raises BadRecording, naming the likely mistake, when the fitted model misses by more than an arm's errors can.

    samples: that were fitted. whole: of the recording, in which rows stand beside their neighbours; None for these.
    distances: that were stated and fitted beside the readings. placed: whether places of frames were stated as well.
    """
    whole = samples if whole is None else whole
    require_one_place(whole, nominal.model.chain)
    limit = LIMIT_OF_REACH * nominal.model.chain.reach()
    missed = usual_miss(fitted.model, samples)
    if missed > limit:
        from modcal_core.plausibility.refusal import refuse  # two dozen files, which most recordings do not need

        refuse(nominal, samples, whole, distances, placed, missed, limit)
