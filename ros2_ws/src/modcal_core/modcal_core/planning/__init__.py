"""Which stations to measure: before anything is measured, one after the other until an accuracy is proven, and which
parameters matter at all.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.planning.advice import BATCH, Advice, Advisor
    from modcal_core.planning.closed_chain import ClosedChain, calibration_chain, dh_closed_chain, sizes_of
    from modcal_core.planning.criteria import ACCURACY, CRITERIA
    from modcal_core.planning.deciding import DecidingStations, propose, undecided_by_posture
    from modcal_core.planning.designs import DESIGNS, design, orthogonal_array
    from modcal_core.planning.motion import TimedMotion, free_way, from_side, timed
    from modcal_core.planning.planner import STARTS, Accuracy, Plan, PlanRequest, plan
    from modcal_core.planning.pool import CANDIDATES, Pool, allowed, of_recording, of_robot, with_limits
    from modcal_core.planning.proof import MAX_STATIONS, Goal
    from modcal_core.planning.route import RETURNS, with_returns
    from modcal_core.planning.sensitivity_study import ARMS, NAMED, Measured, Study, sensitivity, study
    from modcal_core.planning.session import PROOF, SKIPPED, UNSEEN, Session, Station, from_data, to_data
    from modcal_core.planning.site import Site, Spheres, clearance, site_from_data, spheres_of
    from modcal_core.planning.station_files import Trajectory, stations_from_data, stations_from_rows
    from modcal_core.planning.station_files import trajectory_from_data
    from modcal_core.planning.typed_table import FilledTable, require_likely, text_of, to_table, with_table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ACCURACY", "ARMS", "BATCH", "CANDIDATES", "CRITERIA", "DESIGNS", "MAX_STATIONS", "NAMED", "PROOF"]
__all__ += [
    "RETURNS",
    "SKIPPED",
    "STARTS",
    "UNSEEN",
    "Accuracy",
    "Advice",
    "Advisor",
    "ClosedChain",
    "DecidingStations",
]
__all__ += ["FilledTable", "Goal", "Measured", "Plan", "PlanRequest", "Pool", "Session", "Site", "Spheres", "Station"]
__all__ += ["Study", "TimedMotion", "Trajectory", "allowed", "calibration_chain", "clearance", "design"]
__all__ += ["dh_closed_chain", "free_way", "from_data", "from_side", "of_recording", "of_robot", "orthogonal_array"]
__all__ += ["plan", "propose", "require_likely", "sensitivity", "site_from_data", "sizes_of", "spheres_of"]
__all__ += ["stations_from_data", "stations_from_rows", "study", "text_of", "timed", "to_data", "to_table"]
__all__ += ["trajectory_from_data", "undecided_by_posture", "with_limits", "with_returns", "with_table"]
