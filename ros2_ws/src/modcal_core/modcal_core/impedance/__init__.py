"""Touching gently: the impedance law, the guard before every setpoint, and the course of pulling something open."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.impedance.joint_force import ArmEfforts, FreeMotion
    from modcal_core.impedance.operation import Operation
    from modcal_core.impedance.safety_monitor import ArmSetpoint, Limits
    from modcal_core.impedance.speed_governor import GovernorSettings
    from modcal_core.impedance.task import ImpedanceTask, JointPositions, Stop, Wait
    from modcal_core.impedance.wrench import Load, WrenchSensor
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
