"""Before anything is measured: which parameters matter, and which stations will show them."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.planning.closed_chain import ClosedChain, calibration_chain, dh_closed_chain, sizes_of
    from modcal_core.planning.criteria import ACCURACY, CRITERIA, criterion
    from modcal_core.planning.deciding import DecidingStations, propose, undecided_by_posture
    from modcal_core.planning.fedorov import exchange
    from modcal_core.planning.planner import STARTS, Plan, PlanRequest, plan
    from modcal_core.planning.posture_pool import CANDIDATES, allowed, survey, with_limits
    from modcal_core.planning.route import RETURNS, Trajectory, stations_from_data, stations_from_rows
    from modcal_core.planning.route import trajectory_from_data, with_returns
    from modcal_core.planning.sensitivity_study import ARMS, DESIGNS, NAMED, Measured, Study, design, orthogonal_array
    from modcal_core.planning.sensitivity_study import sensitivity, study
    from modcal_core.planning.site import Site, Spheres, clearance, site_from_data, spheres_of, visible
    from modcal_core.planning.worth import Accuracy
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ACCURACY", "ARMS", "CANDIDATES", "CRITERIA", "DESIGNS", "NAMED", "RETURNS", "STARTS", "Accuracy"]
__all__ += ["ClosedChain", "DecidingStations", "Measured", "Plan", "PlanRequest", "Site", "Spheres", "Study"]
__all__ += ["Trajectory", "allowed", "calibration_chain", "clearance", "criterion", "design", "dh_closed_chain"]
__all__ += ["exchange", "orthogonal_array", "plan", "propose", "sensitivity", "site_from_data", "sizes_of"]
__all__ += ["spheres_of", "stations_from_data", "stations_from_rows", "study", "survey", "trajectory_from_data"]
__all__ += ["undecided_by_posture", "visible", "with_limits", "with_returns"]
