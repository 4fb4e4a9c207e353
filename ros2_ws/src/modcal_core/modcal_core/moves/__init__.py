"""What moved or changed, since when, and is it sure? One catalogue and one evidence for a check, a recording, a stream.

rows: the catalogue. noise: what readings scatter by while nothing has changed. evidence: how much more probable they
are with a row. state: a model beside readings, with rows taken up. searching: which rows it was. naming: what is said
of it. setups, regimes: stretches of one recording in which base or tool stood elsewhere.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.moves.evidence import SIZES
    from modcal_core.moves.naming import UNTRIED, Alike, NamedChange, SizeFound, named
    from modcal_core.moves.noise import FrozenKnowledge
    from modcal_core.moves.regimes import find_regimes, moves_of
    from modcal_core.moves.rows import BASE, COMPLIANCE, FRAME, GEAR, KINDS, LENGTH, LINK, LOAD, NOISE, PAYLOAD, PLAY
    from modcal_core.moves.rows import SCALE, STEP, TOOL, ZERO, CellChange, GeometryMotion, hypotheses, log_priors
    from modcal_core.moves.rows import put_in, towards
    from modcal_core.moves.searching import FALSE_ALARM, FittedChange, FoundChanges, MoveSearch, search
    from modcal_core.moves.state import CheckState
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["BASE", "COMPLIANCE", "FALSE_ALARM", "FRAME", "GEAR", "KINDS", "LENGTH", "LINK", "LOAD", "NOISE"]
__all__ += ["PAYLOAD", "PLAY", "SCALE", "SIZES", "STEP", "TOOL", "UNTRIED", "ZERO", "Alike", "CellChange"]
__all__ += ["CheckState", "FittedChange", "FoundChanges", "FrozenKnowledge", "GeometryMotion", "MoveSearch"]
__all__ += ["NamedChange", "SizeFound", "find_regimes", "hypotheses", "log_priors", "moves_of", "named", "put_in"]
__all__ += ["search", "towards"]
