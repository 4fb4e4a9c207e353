"""A JointTrajectory as legs of a program, or a refusal of the whole of it."""

from __future__ import annotations

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_core.robots.mechanism import Mechanism, passable
from modcal_msgs_py.stamps import seconds


def legs(chain: Mechanism, trajectory: JointTrajectory, start: Array | None = None) -> list[tuple[float, Array]]:
    """Seconds after the start, and postures (n,) in the chain's order; velocities and efforts are not read.

    start: where the arm is, (n,), where it matters. Raises BadCommand for joints that are not the chain's, positions
    that are none, times that do not rise, points outside the limits, and ways on which a Delta's platform fits no more.
    """
    names = tuple(trajectory.joint_names)
    if sorted(names) != sorted(chain.names):
        raise BadCommand(
            f"joint_trajectory names {', '.join(names)}", f"this arm has {', '.join(chain.names)}", "name these"
        )
    order = [names.index(name) for name in chain.names]
    out: list[tuple[float, Array]] = []
    last = 0.0
    for k, point in enumerate(trajectory.points):
        after = seconds(point.time_from_start)
        q = np.array(point.positions, dtype=float)
        offender = f"joint_trajectory: point {k}"
        if len(q) != len(order) or not np.isfinite(q).all():
            raise BadCommand(offender, "has wrong positions", f"give {len(order)} finite numbers")
        if after <= last:
            raise BadCommand(offender, "is not later than the one before", "make times increase from above zero")
        q = q[order]
        if (q < chain.lower).any() or (q > chain.upper).any():
            raise BadCommand(offender, "lies outside the joint limits", "stay within them")
        if start is not None and not passable(chain, start, q):
            raise BadCommand(
                offender, "the platform of the Delta does not fit along the whole path", "choose another path"
            )
        out.append((after, q))
        last, start = after, q
    return out
