"""Which stations to measure: before anything is measured, one after the other until an accuracy is proven, and which
parameters matter at all.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.planning.advice import BATCH, Advice, Advisor, Method
    from modcal_core.planning.pool import ClosedChain, calibration_chain, dh_closed_chain, sizes_of
    from modcal_core.planning.exchange import ACCURACY, CRITERIA
    from modcal_core.planning.next_stations import DecidingStations, propose, undecided_by_posture
    from modcal_core.planning.sensitivity_study import DESIGNS, design, orthogonal_array
    from modcal_core.planning.route import TimedMotion, free_way, from_side, timed
    from modcal_core.planning.planner import STARTS, Plan, PlanRequest, plan
    from modcal_core.planning.pool import CANDIDATES, Pool, allowed, of_recording, of_robot, with_limits
    from modcal_core.planning.session import MAX_STATIONS, Goal
    from modcal_core.planning.route import RETURNS, with_returns
    from modcal_core.planning.sensitivity_study import ARMS, NAMED, Measured, Studied, Study, sensitivity, study
    from modcal_core.planning.session import PROOF, SKIPPED, UNSEEN, Session, Station, from_data, to_data
    from modcal_core.planning.site import Site, Spheres, clearance, site_from_data, spheres_of
    from modcal_core.planning.typed_table import Trajectory, stations_from_data, stations_from_rows
    from modcal_core.planning.typed_table import trajectory_from_data
    from modcal_core.planning.typed_table import FilledTable, require_likely, text_of, to_table, with_table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
