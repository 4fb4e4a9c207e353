"""Where the arm truly is, and what to command so that it truly comes to be where it is wanted."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.correction.commander import CalibratedRobot, Commander, CommanderSettings, JointSetpoint
    from modcal_core.correction.commander import corrected_urdf, finite
    from modcal_core.correction.correction import ArmState, Correction
    from modcal_core.correction.held_object import GripperRays, HeldBox, Placing, StackPlace, held_box, placing, rests
    from modcal_core.correction.picture import Residuals, arm_state_of, ellipsoid, enlarged_axes, joint_axes, known_to
    from modcal_core.correction.picture import residuals, tool_ellipsoid
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
