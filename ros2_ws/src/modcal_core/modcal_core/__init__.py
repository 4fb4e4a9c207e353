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

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from modcal_core.version import __version__ as __version__

# Public name: the module of modcal_core that has it
_WHERE = {
    **dict.fromkeys(("calibrate", "check", "evaluate", "articulate", "plan"), "public"),
    "Robot": "robot",
    "Chain": "robots.chain",
    "Delta": "robots.delta",
    "Samples": "measurements.samples",
    "Result": "result",
    "Calibration": "calibration.store",
    "Report": "report.report",
    "Checked": "checkup",
    "Cell": "calibration.cell",
    "Distance": "calibration.distances",
    "Stated": "calibration.stated",
    "Track": "articulation.track",
    "Choice": "articulation.choice",
    "Assembly": "modules.assembly",
    "Module": "modules.assembly",
    "Library": "modules.library",
    "Site": "planning.site",
    "Plan": "planning.plan",
    **dict.fromkeys(
        (
            *("ModcalError", "BadRecording", "BadTable", "BadRobot", "BadCommand", "NotEnoughData"),
            *("NotRepresentable", "NotPlannable", "NotReachable", "MissingDriver", "Overloaded"),
        ),
        "errors",
    ),
}

if TYPE_CHECKING:
    from modcal_core.articulation.choice import Choice
    from modcal_core.articulation.track import Track
    from modcal_core.calibration.cell import Cell
    from modcal_core.calibration.distances import Distance
    from modcal_core.calibration.stated import Stated
    from modcal_core.calibration.store import Calibration
    from modcal_core.checkup import Checked
    from modcal_core.errors import (
        BadCommand,
        BadRecording,
        BadRobot,
        BadTable,
        MissingDriver,
        ModcalError,
        NotEnoughData,
        NotPlannable,
        NotReachable,
        NotRepresentable,
        Overloaded,
    )
    from modcal_core.measurements.samples import Samples
    from modcal_core.modules.assembly import Assembly, Module
    from modcal_core.modules.library import Library
    from modcal_core.planning.plan import Plan
    from modcal_core.planning.site import Site
    from modcal_core.public import articulate, calibrate, check, evaluate, plan
    from modcal_core.report.report import Report
    from modcal_core.result import Result
    from modcal_core.robot import Robot
    from modcal_core.robots.chain import Chain
    from modcal_core.robots.delta import Delta

__all__ = [
    "Assembly",
    "BadCommand",
    "BadRecording",
    "BadRobot",
    "BadTable",
    "Calibration",
    "Cell",
    "Chain",
    "Checked",
    "Choice",
    "Delta",
    "Distance",
    "Library",
    "MissingDriver",
    "ModcalError",
    "Module",
    "NotEnoughData",
    "NotPlannable",
    "NotReachable",
    "NotRepresentable",
    "Overloaded",
    "Plan",
    "Report",
    "Result",
    "Robot",
    "Samples",
    "Site",
    "Stated",
    "Track",
    "articulate",
    "calibrate",
    "check",
    "evaluate",
    "plan",
]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for (PEP 562)."""
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The public names, and those of a module."""
    return sorted({*globals(), *__all__})
