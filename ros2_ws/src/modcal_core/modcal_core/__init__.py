"""modcal's mathematics: kinematics, identification and what is left over. NumPy and SciPy only, no ROS.

    robot = Robot.from_urdf("ur10.urdf", tip="tool0")
    samples = Samples.from_arrays(q, points=p)
    result = calibrate(robot, samples, seed=0)
    print(result.report)
    result.calibration.predict(q)

The names below are public; every other one may change. They are imported when they are first asked for.

Conventions, used everywhere and stated once: SI units (m, rad, s, N, kg); ``T_a_b`` is the pose of b in a, so
``p_a = T_a_b @ p_b``; twists are (v, ω), linear part first; quaternions are x y z w; arrays are float64 with the batch
axis first; joints are ordered by name, never by their place in a message.
"""

# ruff: noqa: I001

from __future__ import annotations

from typing import TYPE_CHECKING

from modcal_core.version import __version__ as __version__

if TYPE_CHECKING:
    from modcal_core.articulation.choice import Choice
    from modcal_core.articulation.track import Track
    from modcal_core.calibration.cell import Cell
    from modcal_core.calibration.distances import Distance
    from modcal_core.calibration.stated import Stated
    from modcal_core.calibration.store import Calibration
    from modcal_core.checkup import Checked
    from modcal_core.claim.claim import Claim
    from modcal_core.errors import BadCommand, BadRecording, BadRobot, BadTable, MissingDriver, ModcalError
    from modcal_core.errors import NotEnoughData, NotPlannable, NotReachable, NotRepresentable, Overloaded
    from modcal_core.measurements.samples import Samples
    from modcal_core.modules.library import Assembly, Library, Module
    from modcal_core.planning.planner import Plan
    from modcal_core.planning.site import Site
    from modcal_core.public import articulate, calibrate, check, evaluate, plan
    from modcal_core.report.report import Report
    from modcal_core.public import Result
    from modcal_core.robot import Robot
    from modcal_core.robots.chain import Chain
    from modcal_core.robots.delta import Delta
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["Assembly", "BadCommand", "BadRecording", "BadRobot", "BadTable", "Calibration", "Cell", "Chain", "Checked"]
__all__ += ["Choice", "Claim", "Delta", "Distance", "Library", "MissingDriver", "ModcalError", "Module"]
__all__ += ["NotEnoughData", "NotPlannable", "NotReachable", "NotRepresentable", "Overloaded", "Plan", "Report"]
__all__ += ["Result", "Robot", "Samples", "Site", "Stated", "Track", "articulate", "calibrate", "check", "evaluate"]
__all__ += ["plan"]
