"""Many recordings: calibrated or watched on all cores or on a cluster, and put in one table."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.fleet.recordings import DONE, Row, calibrate_all, find_bags, names_of, watch_all, write_table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
