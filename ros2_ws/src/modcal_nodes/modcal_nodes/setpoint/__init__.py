"""What the setpoint node is made of."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.setpoint.arm import JointEfforts, JointSoftness, limits, task
    from modcal_nodes.setpoint.arm_inputs import ArmInputs, SetpointPublishers, require_changeable
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ArmInputs", "JointEfforts", "JointSoftness", "SetpointPublishers", "limits", "require_changeable", "task"]
