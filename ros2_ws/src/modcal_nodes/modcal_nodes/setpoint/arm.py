"""The arm and the task that the parameters of ``impedance_setpoint`` describe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.impedance.speed_governor import GovernorSettings
from modcal_core.impedance.task import ImpedanceTask
from modcal_core.impedance.wrench import Load, WrenchSensor
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf import read_chain

_SLOWS, _STANDS = 0.6, 0.95  # of the most force: what needs less than that is opened
_LEAD, _LEAD_SHARE = 0.08, 1.3  # m by which the expected pose may lead; of what the most force takes of the impedance


@dataclass(frozen=True)
class SensedArm:
    """The chain to the tool, and its force sensor. farthest: no tool lies farther off [m]."""

    urdf: str
    chain: Chain
    sensor: WrenchSensor
    farthest: float

    @classmethod
    def of(cls, urdf: str, chosen: dict[str, Any]) -> SensedArm:
        """The arm of a URDF. Raises BadRobot."""
        chain = read_chain(urdf, chosen["base"] or None, chosen["tip"] or None)
        frames = [(chain.tip, np.eye(4))]
        if chosen["wrench_frame"]:
            frames.append((chosen["wrench_frame"], _fixed(urdf, chain, chosen["wrench_frame"])))
        load = Load(chosen["tool_mass"], _vector("tool_centre", chosen))
        sensor = WrenchSensor(frames, load, chosen["cutoff_hz"], -1.0 if chosen["wrench_by_tool"] else 1.0)
        farthest = 1.05 * (chain.reach() + float(np.linalg.norm(chain.origins[0, :3, 3])))
        return cls(urdf, chain, sensor, farthest)


def limits(chain: Chain, chosen: dict[str, Any]) -> Limits:
    """What the arm may be told, by these parameters."""
    turning = chain.revolute
    return Limits(
        joint_speed=np.where(turning, chosen["joint_speed_rad_s"], chosen["joint_speed_m_s"]),
        joint_acceleration=np.where(turning, chosen["joint_acceleration_rad_s2"], chosen["joint_acceleration_m_s2"]),
        speed=chosen["max_speed_m_s"],
        acceleration=chosen["max_acceleration_m_s2"],
        angular_speed=chosen["max_angular_speed_rad_s"],
        angular_acceleration=chosen["max_angular_acceleration_rad_s2"],
        force=chosen["max_force_n"],
        moment=chosen["max_moment_nm"],
        displacement=chosen["max_displacement_m"],
        rotation=chosen["max_rotation_rad"],
        timeout=chosen["timeout_s"],
        period=1.0 / chosen["rate_hz"],
        gain=chosen["min_gain"],
    )


def task(chosen: dict[str, Any]) -> ImpedanceTask:
    """The task that parameters ask for. Raises ModcalError for values that make no sense together."""
    if chosen["mode"] not in ("expected", "admittance"):
        raise BadTable(f"mode '{chosen['mode']}'", "is neither expected nor admittance", "set one of them")
    chosen = {**chosen, **_forces(chosen)}
    for what in ("force_n", "moment_nm"):
        names = [f"{name}_{what}" for name in ("slowdown", "stop", "max")]
        slow, stop, most = (chosen[name] for name in names)
        if not slow < stop <= most:
            raise BadTable(
                ", ".join(f"{name} {chosen[name]:g}" for name in names),
                "must rise from the first to the last",
                "change them",
            )
    goal = chosen["goal"]
    out = ImpedanceTask(
        direction=_vector("direction", chosen),
        goal_rad=goal or chosen["goal_rad"],
        goal_m=goal or chosen["goal_m"],
        mode=chosen["mode"],
        exploration_speed=chosen["exploration_speed_m_s"],
        speed=chosen["speed_m_s"],
        max_exploration=chosen["max_exploration_m"],
        mass=_three("mass", chosen),
        damping=_three("damping", chosen),
        stiffness=_three("stiffness", chosen),
        stack=(float(_numbers("stack_stiffness", chosen, 2)[0]), float(_numbers("stack_stiffness", chosen, 2)[1])),
        blend=chosen["blend_s"],
        tare_s=chosen["tare_s"],
        servo_lag=chosen["servo_lag_s"],
        gravity=_vector("gravity", chosen),
        governor=GovernorSettings(
            slowdown=(chosen["slowdown_force_n"], chosen["slowdown_moment_nm"]),
            stop=(chosen["stop_force_n"], chosen["stop_moment_nm"]),
            max_force=chosen["max_force_n"],
            contact_stiffness=chosen["contact_stiffness_n_m"],
            max_lead=max(_LEAD, _LEAD_SHARE * chosen["max_force_n"] / _three("stiffness", chosen)[0]),
        ),
        input_timeout_s=chosen["patience_s"],
        arm_stiffness=chosen["arm_stiffness_n_m"],
    )
    out.gains(out.direction)  # refuses what is no gain, and no direction
    if out.mode == "admittance":
        _require_damping(out)
    return out


def _forces(chosen: dict[str, Any]) -> dict[str, float]:
    """From which force on the pull slows down, and at which it stands [N]: as asked, or shares of the most."""
    shares = {"slowdown_force_n": _SLOWS, "stop_force_n": _STANDS}
    return {name: chosen[name] or share * chosen["max_force_n"] for name, share in shares.items()}


def _require_damping(asked: ImpedanceTask) -> None:
    """Raises BadTable for a damping with which contact would swing: below the servo's stiffness times its lag."""
    along, across, turning = asked.damping
    for what, value, stiff in (
        ("damping along the pull", along, asked.stack[0]),
        ("damping across the pull", across, asked.stack[0]),
        ("damping of turning", turning, asked.stack[1]),
    ):
        if value < (least := stiff * asked.servo_lag):
            said = f"is below {least:g}, stack_stiffness times servo_lag_s, so that contact would oscillate"
            raise BadTable(f"{what} {value:g}", said, "raise damping, or correct the other two")


def _fixed(urdf: str, chain: Chain, frame: str) -> Array:
    """T_tip_frame (4, 4) of a link that moves with the tip."""
    other = read_chain(urdf, chain.base, frame)
    if other.names != chain.names:
        said = f"does not move with {chain.tip}: joints lie between them"
        raise BadTable(f"wrench_frame '{frame}'", said, "name a link that is fixed to the tool")
    q = np.zeros(chain.n)
    return se3.inverse(forward(chain, q)) @ forward(other, q)


def _numbers(name: str, chosen: dict[str, Any], count: int) -> Array:
    out = np.array(chosen[name], dtype=float)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise BadTable(f"{name} {list(chosen[name])}", f"is not {count} finite numbers", "give that many")
    return out


def _vector(name: str, chosen: dict[str, Any]) -> Array:
    return _numbers(name, chosen, 3)


def _three(name: str, chosen: dict[str, Any]) -> tuple[float, float, float]:
    a, b, c = _numbers(name, chosen, 3).tolist()
    return a, b, c
