"""What the viewer node is made of: the stations it keeps and the pictures it draws."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.viewing.drawing import JudgedStations, Stations
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
