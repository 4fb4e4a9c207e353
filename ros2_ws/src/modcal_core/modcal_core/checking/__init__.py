"""What has changed since a calibration, told from a few stations."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.checking.advice import Noticed, Recommendation, advise, alike_everywhere, noticed
    from modcal_core.checking.history import Series, Values, series_of, values_of
    from modcal_core.checking.known import PATTERN, BeyondRanges, beyond_ranges, frozen
    from modcal_core.checking.known import in_known_frames, new_frames, pattern_of, placed_anew, spread_out
    from modcal_core.checking.known import with_new_frames
    from modcal_core.checking.own_rows import require_accounted
    from modcal_core.checking.repair import repaired
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["PATTERN", "BeyondRanges", "Noticed", "Recommendation", "Series", "Values", "advise", "alike_everywhere"]
__all__ += ["beyond_ranges", "frozen", "in_known_frames", "new_frames", "noticed", "pattern_of", "placed_anew"]
__all__ += ["repaired", "require_accounted", "series_of", "spread_out"]
__all__ += ["values_of", "with_new_frames"]
