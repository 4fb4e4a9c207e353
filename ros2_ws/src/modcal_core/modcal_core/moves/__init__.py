"""What moved or changed, since when, and is it sure? One catalogue and one evidence for a check, a recording, a stream.

rows: the catalogue. noise: what readings scatter by while nothing has changed. evidence: how much more probable they
are with a row. state: a model beside readings, with rows taken up. searching: which rows it was. setups, regimes:
stretches of one recording in which base or tool stood elsewhere.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.moves.evidence import SIZES
    from modcal_core.moves.noise import FrozenKnowledge
    from modcal_core.moves.regimes import find_regimes, moves_of
    from modcal_core.moves.rows import (
        BASE,
        COMPLIANCE,
        FRAME,
        GEAR,
        KINDS,
        LENGTH,
        LINK,
        LOAD,
        NOISE,
        PAYLOAD,
        PLAY,
        SCALE,
        STEP,
        TOOL,
        ZERO,
        CellChange,
        GeometryMotion,
        hypotheses,
        log_priors,
        put_in,
        towards,
    )
    from modcal_core.moves.searching import FALSE_ALARM, FittedChange, FoundChanges, MoveSearch, search
    from modcal_core.moves.state import CheckState
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["BASE", "COMPLIANCE", "FALSE_ALARM", "FRAME", "GEAR", "KINDS", "LENGTH", "LINK", "LOAD", "NOISE", "PAYLOAD"]
__all__ += [
    "PLAY",
    "SCALE",
    "SIZES",
    "STEP",
    "TOOL",
    "ZERO",
    "CellChange",
    "CheckState",
    "FittedChange",
    "FoundChanges",
]
__all__ += ["FrozenKnowledge", "GeometryMotion", "MoveSearch", "find_regimes", "hypotheses", "log_priors", "moves_of"]
__all__ += ["put_in", "search", "towards"]
