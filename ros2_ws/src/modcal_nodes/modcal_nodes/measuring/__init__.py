"""Measuring on order: the folder that keeps a session, and those who measure for it."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.measuring.folder import NEXT, CellInProcess, Measurement, Replay, one_a_station
    from modcal_nodes.measuring.folder import outcome_data
    from modcal_nodes.measuring.sequence import StationSequence
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
