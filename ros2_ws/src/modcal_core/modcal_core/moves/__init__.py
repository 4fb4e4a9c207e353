"""What moved or changed, since when, and is it sure? One catalogue and one evidence for a check, a recording, a stream.

rows: the catalogue. likelihood: what readings scatter by while nothing has changed, and how much more probable they
are with a row. state: a model beside readings, with rows taken up. searching: which rows it was. naming: what is said
of it, and what to do. setups, regimes: stretches of one recording in which base or tool stood elsewhere. known: a
calibration that is checked, and its repair. history: what grows over months.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.moves.history import Series, Values, series_of, values_of
    from modcal_core.moves.known import PATTERN, BeyondRanges, beyond_ranges, frozen, in_known_frames, new_frames
    from modcal_core.moves.known import pattern_of, newly_placed, repaired, require_accounted, spread_out
    from modcal_core.moves.known import with_new_frames
    from modcal_core.moves.naming import UNTRIED, NamedChange, Noticed, Recommendation, SizeFound, advise
    from modcal_core.moves.naming import alike_everywhere, named, noticed
    from modcal_core.moves.likelihood import SIZES, FrozenKnowledge, JudgedChange, by_name, e_value
    from modcal_core.moves.regimes import find_regimes, moves_of
    from modcal_core.moves.rows import BASE, CAMERA, EFFORT, FRAME, FRICTION, GEAR, KINDS, LATENCY, LENGTH, LOAD, MASS
    from modcal_core.moves.rows import (
        OFFSET,
        PAYLOAD,
        SERVO,
        SLACK,
        TAG,
        TOOL,
        ZERO,
        CellChange,
        hypotheses,
        log_priors,
    )
    from modcal_core.moves.searching import AS_PROBABLE, FoundChanges, MoveSearch, search
    from modcal_core.moves.state import CheckState
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
