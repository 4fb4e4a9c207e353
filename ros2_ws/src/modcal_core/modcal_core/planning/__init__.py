"""Which stations to measure: before anything is measured, one after the other until an accuracy is proven, and which
parameters matter at all.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.planning.advice import BATCH, Advice, Advisor, Method
    from modcal_core.planning.outlook import Refit
    from modcal_core.planning.planner import Plan, PlanRequest, plan
    from modcal_core.planning.pool import CANDIDATES, Pool, of_recording, survey, with_limits
    from modcal_core.planning.rivals import DecidingStations, pool_near, separations
    from modcal_core.planning.route import RETURNS, TimedMotion, free_way, from_side, timed, with_returns
    from modcal_core.planning.sensitivity_study import LEVELS, NAMED, ClosedChain, Measured, Study
    from modcal_core.planning.sensitivity_study import array_postures, calibration_chain, dh_closed_chain
    from modcal_core.planning.sensitivity_study import orthogonal_array, sensitivity, sizes_of, study
    from modcal_core.planning.session import MAX_STATIONS, PROOF, SKIPPED, UNSEEN, Goal, Session, Station, from_data
    from modcal_core.planning.session import to_data
    from modcal_core.planning.site import Site, Spheres, clearance, site_from_data, spheres_of
    from modcal_core.planning.station_files import Trajectory, stations_from_data
    from modcal_core.planning.typed_table import FilledTable, require_likely
    from modcal_core.planning.station_files import stations_from_rows, trajectory_from_data
    from modcal_core.planning.typed_table import text_of, to_table, with_table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
