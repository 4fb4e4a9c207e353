"""What has changed since a calibration, told from a few stations."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.checking.advice import advise, alike_everywhere, noticed
    from modcal_core.checking.history import Series, Values, series_of, values_of
    from modcal_core.checking.known import PATTERN, UNTRIED, BeyondRanges, beyond_ranges, frozen
    from modcal_core.checking.known import in_known_frames, new_frames, pattern_of, placed_anew, spread_out
    from modcal_core.checking.known import with_new_frames
    from modcal_core.checking.naming import NamedChange, Noticed, Recommendation, SizeFound, Status, named
    from modcal_core.checking.own_rows import require_accounted, require_one_setting, require_own_rows
    from modcal_core.checking.repair import repaired
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["PATTERN", "UNTRIED", "BeyondRanges", "NamedChange", "Noticed", "Recommendation"]
__all__ += ["Series", "SizeFound", "Status", "Values", "advise", "alike_everywhere", "beyond_ranges", "frozen"]
__all__ += ["in_known_frames", "named", "new_frames", "noticed", "pattern_of", "placed_anew", "repaired"]
__all__ += ["require_accounted", "require_one_setting", "require_own_rows", "series_of", "spread_out", "values_of"]
__all__ += ["with_new_frames"]
