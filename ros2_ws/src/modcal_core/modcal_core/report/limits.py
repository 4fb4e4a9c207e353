"""Bounds of acceleration over some postures, as plain data for programs and planners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from modcal_core.files import to_json, to_yaml
from modcal_core.geometry import Array
from modcal_core.outcome import counted
from modcal_core.report.blocks import Page, Section, SummaryLine, TableBlock, VerbResult
from modcal_core.report.figures import ShownPostures
from modcal_core.report.tables import csv_text, percent
from modcal_core.robots import JointPath, LoadedArm, Window, constant_bounds, motion, within_torque

_MAX = 200  # postures written one by one
_STEP = 0.008  # s between rows of a trajectory, as controllers take them


@dataclass(frozen=True)
class LimitsFound:
    """The bounds of an arm at postures q (N, n) and velocities (N, n), and a path through these, where it is to go one.

    Raises Overloaded where it cannot be held.
    """

    arm: LoadedArm
    q: Array
    velocity: Array
    source: str
    path: JointPath | None = None

    @cached_property
    def trajectory(self) -> tuple[Array, Array, Array] | None:
        """Times (m,) [s], positions and velocities (m, n) of the fastest motion along the path; None without one."""
        if self.path is None:
            return None
        timing = within_torque(self.arm, self.path)
        t = np.r_[np.arange(0.0, timing.duration, _STEP), timing.duration]
        return t, *motion(self.path, timing, t)[:2]

    @cached_property
    def window(self) -> Window:
        """What the drives leave, checked to hold everywhere."""
        left = self.arm.window(self.q, self.velocity)
        left.require_held()
        return left

    @property
    def inertia(self) -> Array:
        """Equivalent inertias (N, n), rotors included."""
        return np.diagonal(self.window.matrix, axis1=1, axis2=2)

    @property
    def load(self) -> Array:
        """Share of each drive's torque that gravity, friction and speed take, (N, n)."""
        half = 0.5 * (self.window.upper - self.window.lower)
        return np.abs(0.5 * (self.window.upper + self.window.lower)) / half


def limits_data(found: LimitsFound) -> dict[str, Any]:
    """What limits.json holds: for each joint its range over the postures, and where they are few each of them."""
    arm, names, (least, most) = found.arm, found.arm.chain.names, constant_bounds(found.window)
    lower, upper = coupled = found.window.box()
    over = {"equivalent": found.window.equivalent(), "coupled": coupled}
    data: dict[str, Any] = {
        "modcal_limits": 1,
        "source": found.source,
        "base": arm.chain.base,
        "tip": arm.chain.tip,
        "postures": len(found.q),
        "payload": {"mass_kg": arm.payload.mass, "centre_m": arm.payload.centre.tolist()},
        "torque_share": arm.share,
        "joints": [
            {
                "name": name,
                "unit": "rad/s2" if arm.chain.revolute[j] else "m/s2",
                "torque": float(arm.drives.torque[j]),
                "inertia": {"least": float(found.inertia[:, j].min()), "most": float(found.inertia[:, j].max())},
                "load_share": float(found.load[:, j].max()),
                **{of: {"lower": float(a[:, j].max()), "upper": float(b[:, j].min())} for of, (a, b) in over.items()},
                "constant": {"lower": float(least[j]), "upper": float(most[j])},
            }
            for j, name in enumerate(names)
        ],
    }
    if len(found.q) <= _MAX:
        each = {"position": found.q, "velocity": found.velocity, "lower": lower, "upper": upper}
        data["at"] = [
            {what: dict(zip(names, rows[k].tolist(), strict=True)) for what, rows in each.items()}
            for k in range(len(found.q))
        ]
    return data


def joint_limits(joints: Sequence[Mapping[str, Any]], speed: Array) -> dict[str, Any]:
    """Constant bounds in the form of MoveIt's joint_limits.yaml, the smaller of up and down. speed: limits (n,)."""
    out: dict[str, Any] = {}
    for joint, fastest in zip(joints, speed.tolist(), strict=True):
        limited = bool(np.isfinite(fastest))
        out[joint["name"]] = {
            "has_velocity_limits": limited,
            **({"max_velocity": fastest} if limited else {}),
            "has_acceleration_limits": True,
            "max_acceleration": _least(joint),
        }
    return {"joint_limits": out}


def _least(joint: Mapping[str, Any]) -> float:
    """How fast a joint may accelerate either way, at every posture."""
    return float(min(-joint["constant"]["lower"], joint["constant"]["upper"]))


_UNITS = {"rad/s2": ("turning", "rad/s²", "N m", "kg m²"), "m/s2": ("sliding", "m/s²", "N", "kg")}


def answer(data: Mapping[str, Any]) -> str:
    """What a person asks first: how fast the weakest joint may accelerate, and which drive is nearest to its limit."""
    mass, parts = data["payload"]["mass_kg"], []
    for si, (_, unit, *_) in _UNITS.items():
        if own := [joint for joint in data["joints"] if joint["unit"] == si]:
            weakest = min(own, key=_least)
            parts.append(f"{weakest['name']} may accelerate by {_least(weakest):.3g} {unit}")
    loaded = max(data["joints"], key=lambda joint: float(joint["load_share"]))
    return (
        f"{f'With {mass:g} kg' if mass else 'Without a payload'} at {counted(data['postures'], 'posture')}, "
        f"{' and '.join(parts)}, the least of all joints, whatever the others do within their bounds. {loaded['name']} "
        f"needs up to {percent(loaded['load_share'])} of its torque to hold and move at all."
    )


_MEANINGS = (
    "Alone (equivalent): the bound of a joint while all others stand or move evenly. Together (coupled): every joint "
    "within its own bounds at once, at the tightest posture. For all postures (constant): bounds that hold at each of "
    "them, as joint_limits.yaml has them."
)


def limits_report(found: LimitsFound, title: str, notes: Sequence[str] = ()) -> VerbResult:
    """The bounds as a verb leaves them. notes: sentences beside them."""
    data = {**limits_data(found), "notes": list(notes)}
    joints, said = data["joints"], answer(data)
    files = {"limits.json": to_json(data), "joint_limits.yaml": to_yaml(joint_limits(joints, found.arm.drives.speed))}
    tables = _tables(joints)
    if found.trajectory is not None:
        t, q, v = found.trajectory
        data["fastest_s"] = float(t[-1])
        said += f" The fastest motion along the path takes {t[-1]:.3f} s."
        names = found.arm.chain.names
        head = ("time_s", *names, *(f"{name}_velocity" for name in names))
        files["trajectory.csv"] = csv_text(head, np.column_stack([t, q, v]))
    may = f"{percent(found.arm.share)} of the torque of each drive may be used."
    blocks = [Section("bounds", "Bounds and loads", tables), _robot(found)]
    page = Page(f"{title}: limits of acceleration", said, blocks, lines=(*notes, may, SummaryLine(_MEANINGS, "legend")))
    return page.result(data, files, tables, "Limits", "limits.json")


def _tables(joints: Sequence[Mapping[str, Any]]) -> list[TableBlock]:
    """Accelerations and holding torques of joints, as limits.json has them, turning and sliding ones apart."""
    out = []
    for si, (kind, unit, torque, inertia) in _UNITS.items():
        own = [joint for joint in joints if joint["unit"] == si]
        bounds = ("equivalent", "coupled", "constant")
        allowed = tuple((j["name"], *(_span(j[of]["lower"], j[of]["upper"]) for of in bounds)) for j in own)
        loads = tuple(
            (*(j["name"], f"{j['torque']:.3g}", percent(j["load_share"])), _span(*j["inertia"].values())) for j in own
        )
        names = ("joint", "alone", "together", "for all postures")
        header = ("joint", f"torque of the drive, {torque}", "of it needed to hold", f"inertia, {inertia}")
        out.append(TableBlock(f"Acceleration of {kind} joints, {unit}", names, allowed, heading=True))
        out.append(TableBlock(f"Load of {kind} joints", header, loads, heading=True))
    return out


def _span(low: float, high: float) -> str:
    """Both ends with three digits, large ones in full; one where they are the same."""
    if abs(high - low) < 1e-3 * abs(high):
        low = high
    ends = (f"{x:.0f}" if abs(x) >= 1000.0 else f"{x:.3g}" for x in ((low,) if low == high else (low, high)))
    return " … ".join(ends).replace("-", "−")


def _robot(found: LimitsFound) -> Section:
    """The arm in its postures, every joint as large as the share of its torque that is needed at most."""
    names, shown = found.arm.chain.names, ShownPostures(found.arm.chain, found.q)
    said = "{} needs {} of its torque here. Discs: the share that each joint needs at most."
    loads = found.load[shown.rows]
    more = [said.format(names[j], percent(load[j])) for j, load in zip(loads.argmax(axis=1), loads, strict=True)]
    return Section("robot", "Robot", [shown.discs("its torque that is needed", found.load.max(axis=0), more)])
