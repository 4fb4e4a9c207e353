"""What has changed since a calibration, told from a few stations."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.checking.accounted import require_accounted
    from modcal_core.checking.advice import advise, alike_everywhere, noticed
    from modcal_core.checking.beyond import UNTRIED, BeyondRanges, beyond_ranges
    from modcal_core.checking.contradicting import require_one_setting, require_own_rows
    from modcal_core.checking.history import Series, Values, series_of, values_of
    from modcal_core.checking.known import PATTERN, FrozenCalibration, frozen, pattern_of
    from modcal_core.checking.looked_at import spread_out
    from modcal_core.checking.naming import named
    from modcal_core.checking.outcome import NamedChange, Noticed, Recommendation, SizeFound, Status
    from modcal_core.checking.placed import new_frames, placed_anew, with_new_frames
    from modcal_core.checking.repair import repaired
    from modcal_core.checking.searching import FoundChanges, search
    from modcal_core.checking.state import CheckState
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["PATTERN", "UNTRIED", "BeyondRanges", "CheckState", "FoundChanges", "FrozenCalibration", "NamedChange"]
__all__ += ["Noticed", "Recommendation", "Series", "SizeFound", "Status", "Values", "advise", "alike_everywhere"]
__all__ += ["beyond_ranges", "frozen", "named", "new_frames", "noticed", "pattern_of", "placed_anew", "repaired"]
__all__ += ["require_accounted", "require_one_setting", "require_own_rows", "search", "series_of", "spread_out"]
__all__ += ["values_of", "with_new_frames"]
