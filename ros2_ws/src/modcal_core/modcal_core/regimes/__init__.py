"""Stretches of a recording in which base or tool stood elsewhere."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.regimes.find import find_regimes, moves_of
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["find_regimes", "moves_of"]
