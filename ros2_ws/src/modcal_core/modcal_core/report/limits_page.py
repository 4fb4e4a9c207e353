"""Bounds of acceleration as a page: the answer, a table for each unit, and the robot."""

from __future__ import annotations

import numpy as np

from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.counted import counted, percent
from modcal_core.report.limits import LimitsFound
from modcal_core.report.page import PageTable, plain_page
from modcal_core.report.robot_scene import MAX_POSTURES, RobotScene, arm_paths, joints_in_words

_FILES = [
    ("limits.json", "all numbers, for programs"),
    ("joint_limits.yaml", "constant bounds in the form of MoveIt's file"),
]


def answer(found: LimitsFound) -> str:
    """What a person asks first: how fast the weakest joint may accelerate, and which drive is nearest to its limit."""
    lower, upper = found.constant
    least = np.minimum(-lower, upper)
    chain, most = found.arm.chain, found.load.max(axis=0)
    loaded = int(np.argmax(most))
    carried = f"With {found.arm.payload.mass:g} kg" if found.arm.payload.mass else "Without a payload"
    said = f"{carried} at {counted(len(found.q), 'posture')}, "
    parts = []
    for turning, unit in ((True, "rad/s²"), (False, "m/s²")):
        rows = np.flatnonzero(chain.revolute == turning)
        if len(rows):
            j = int(rows[np.argmin(least[rows])])
            parts.append(f"{chain.names[j]} may accelerate by {least[j]:.3g} {unit}")
    said += " and ".join(parts) + ", the least of all joints, whatever the others do within their bounds."
    return f"{said} {chain.names[loaded]} needs up to {percent(most[loaded])} of its torque to hold and move at all."


def to_html(found: LimitsFound, title: str, notes: tuple[str, ...] = ()) -> str:
    """The page. notes: sentences beside it."""
    lines = [
        *notes,
        f"{percent(found.arm.share)} of the torque of each drive may be used.",
        "Alone: the bound of a joint while all others stand or move evenly. Together: every joint within its own "
        "bounds at once, at the tightest posture. For all postures: one set of bounds that holds at each of them, as "
        "joint_limits.yaml has it.",
    ]
    return plain_page(
        f"{title}: limits of acceleration", answer(found), lines, [], _FILES, _tables(found), _robot(found)
    )


def _tables(found: LimitsFound) -> tuple[PageTable, ...]:
    """Table of accelerations and holding torques, separate for revolute and prismatic joints."""
    chain, drives = found.arm.chain, found.arm.drives
    alone, together = found.window.equivalent(), found.coupled
    out = []
    for turning, kind, unit, torque, inertia in (
        (True, "turning", "rad/s²", "N m", "kg m²"),
        (False, "sliding", "m/s²", "N", "kg"),
    ):
        rows = [int(j) for j in np.flatnonzero(chain.revolute == turning)]
        if not rows:
            continue
        bounds = tuple(
            (
                chain.names[j],
                _span(alone[0][:, j].max(), alone[1][:, j].min()),
                _span(together[0][:, j].max(), together[1][:, j].min()),
                _span(found.constant[0][j], found.constant[1][j]),
            )
            for j in rows
        )
        header = ("joint", "alone", "together", "for all postures")
        out.append(PageTable(f"Acceleration of {kind} joints, {unit}", header, bounds))
        loads = tuple(
            (
                chain.names[j],
                f"{drives.torque[j]:.3g}",
                percent(found.load[:, j].max()),
                _span(found.inertia[:, j].min(), found.inertia[:, j].max()),
            )
            for j in rows
        )
        header = ("joint", f"torque of the drive, {torque}", "of it needed to hold", f"inertia, {inertia}")
        out.append(PageTable(f"Load of {kind} joints", header, loads))
    return tuple(out)


def _span(low: float, high: float) -> str:
    """Both ends with three digits, large ones in full; one where they are the same."""
    if abs(high - low) < 1e-3 * abs(high):
        low = high
    ends = (f"{x:.0f}" if abs(x) >= 1000.0 else f"{x:.3g}" for x in ((low,) if low == high else (low, high)))
    return " … ".join(ends).replace("-", "−")


def _robot(found: LimitsFound) -> RobotScene:
    """The arm in its postures, every joint as large as the share of its torque that is needed at most."""
    chain = found.arm.chain
    rows = spread_rows(len(found.q), MAX_POSTURES)
    paths = arm_paths(chain, found.q[rows])
    said = []
    for row in rows:
        j = int(np.argmax(found.load[row]))
        said.append(
            f"Posture {row + 1} of {len(found.q)}: {joints_in_words(chain, found.q[row])}. {chain.names[j]} needs "
            f"{percent(found.load[row, j])} of its torque here. Discs: the share that each joint needs at most."
        )
    most = found.load.max(axis=0)
    alt = "The arm; a disc at each joint shows the share of its torque that is needed: " + ", ".join(
        f"{name} {percent(value)}" for name, value in zip(chain.names, most, strict=True)
    )
    weights = tuple(float(min(value, 1.0)) for value in most)
    return RobotScene(tuple(paths), tuple(said), paths[:, -1], np.arange(len(rows)), chain.base, alt, weights=weights)
