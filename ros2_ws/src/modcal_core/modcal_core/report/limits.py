"""Bounds of acceleration over some postures, as plain data for programs and planners."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.robots.acceleration import Window
from modcal_core.robots.fastest_motion import constant_bounds
from modcal_core.robots.loaded_arm import LoadedArm

_MAX = 200  # postures written one by one


@dataclass(frozen=True)
class LimitsFound:
    """The bounds of an arm at postures q (N, n) and velocities (N, n). Raises Overloaded where it cannot be held."""

    arm: LoadedArm
    q: Array
    velocity: Array
    source: str

    @cached_property
    def window(self) -> Window:
        """What the drives leave, checked to hold everywhere."""
        left = self.arm.window(self.q, self.velocity)
        left.require_held()
        return left

    @cached_property
    def coupled(self) -> tuple[Array, Array]:
        """Bounds that hold together, at every posture."""
        return self.window.box()

    @cached_property
    def constant(self) -> tuple[Array, Array]:
        """The same for all the postures at once, (n,)."""
        return constant_bounds(self.window)

    @property
    def inertia(self) -> Array:
        """Equivalent inertias (N, n), rotors included."""
        return np.diagonal(self.window.matrix, axis1=1, axis2=2)

    @property
    def load(self) -> Array:
        """Share of each drive's torque that gravity, friction and speed take, (N, n)."""
        half = 0.5 * (self.window.upper - self.window.lower)
        return np.abs(0.5 * (self.window.upper + self.window.lower)) / half


def to_json_data(found: LimitsFound) -> dict[str, Any]:
    """What limits.json holds: for each joint its range over the postures, and where they are few each of them."""
    arm, names = found.arm, found.arm.chain.names
    equivalent = found.window.equivalent()
    data: dict[str, Any] = {
        "modcal_limits": 1,
        "source": found.source,
        "base": arm.chain.base,
        "tip": arm.chain.tip,
        "postures": len(found.q),
        "payload": {"mass_kg": arm.payload.mass, "centre_m": arm.payload.centre.tolist()},
        "torque_share": arm.share,
        "joints": [_joint(found, equivalent, j) for j in range(len(names))],
    }
    if len(found.q) <= _MAX:
        data["at"] = [
            {
                "position": dict(zip(names, found.q[k].tolist(), strict=True)),
                "velocity": dict(zip(names, found.velocity[k].tolist(), strict=True)),
                "lower": dict(zip(names, found.coupled[0][k].tolist(), strict=True)),
                "upper": dict(zip(names, found.coupled[1][k].tolist(), strict=True)),
            }
            for k in range(len(found.q))
        ]
    return data


def _joint(found: LimitsFound, equivalent: tuple[Array, Array], j: int) -> dict[str, Any]:
    drives, revolute = found.arm.drives, bool(found.arm.chain.revolute[j])
    inertia = found.inertia[:, j]

    def tightest(bounds: tuple[Array, Array]) -> dict[str, float]:
        return {"lower": float(bounds[0][:, j].max()), "upper": float(bounds[1][:, j].min())}

    return {
        "name": found.arm.chain.names[j],
        "unit": "rad/s2" if revolute else "m/s2",
        "torque": float(drives.torque[j]),
        "inertia": {"least": float(inertia.min()), "most": float(inertia.max())},
        "load_share": float(found.load[:, j].max()),
        "equivalent": tightest(equivalent),
        "coupled": tightest(found.coupled),
        "constant": {"lower": float(found.constant[0][j]), "upper": float(found.constant[1][j])},
    }


def joint_limits(found: LimitsFound) -> dict[str, Any]:
    """Constant bounds in the form of MoveIt's joint_limits.yaml, the smaller of up and down."""
    lower, upper = found.constant
    speed = found.arm.drives.speed
    out: dict[str, Any] = {}
    for j, name in enumerate(found.arm.chain.names):
        limited = bool(np.isfinite(speed[j]))
        out[name] = {
            "has_velocity_limits": limited,
            **({"max_velocity": float(speed[j])} if limited else {}),
            "has_acceleration_limits": True,
            "max_acceleration": float(min(-lower[j], upper[j])),
        }
    return {"joint_limits": out}
