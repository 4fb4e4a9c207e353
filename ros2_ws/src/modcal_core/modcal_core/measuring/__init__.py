"""Measuring until a wanted accuracy is proven: which station comes next, and when there are enough."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.measuring.advice import BATCH, Advice, Advisor
    from modcal_core.measuring.choose import Pool, of_recording, of_robot
    from modcal_core.measuring.motion import TimedMotion, free_way, from_side, timed
    from modcal_core.measuring.proof import MAX_STATIONS, Goal
    from modcal_core.measuring.session import PROOF, SKIPPED, UNSEEN, Session, Station, from_data, to_data
    from modcal_core.measuring.table import FilledTable, require_likely, text_of, to_table, with_table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["BATCH", "MAX_STATIONS", "PROOF", "SKIPPED", "UNSEEN", "Advice", "Advisor", "FilledTable", "Goal", "Pool"]
__all__ += ["Session", "Station", "TimedMotion", "free_way", "from_data", "from_side", "of_recording", "of_robot"]
__all__ += ["require_likely", "text_of", "timed", "to_data", "to_table", "with_table"]
