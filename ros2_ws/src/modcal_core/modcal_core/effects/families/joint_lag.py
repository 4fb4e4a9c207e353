"""One joint whose reported position is late: by a time, or by a share of what it still has to go to its command.

While the arm moves, a delay is the speed times a time. Where commands are recorded beside the measured positions, a
stale value is a share of commanded − measured, also at standstill: 1 where the joint was at its command already.
"""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry, complexity_of_joint
from modcal_core.effects.registry import followed, in_motion, moving_joints
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots import Mechanism

NAME = "joint_lag"
_BY_COMMAND = "following:"
# A joint is between what was logged and what was commanded, or a little beyond where it overshoots. A spring that
# deflects under the torque of a following error has the other sign: the joint is farther from its command than it says.
_MAX_SHARE = 1.5


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint whose command is known; and every joint that moved, where readings were taken in motion."""
    for j, name in enumerate(drivers.arm.chain.names):
        if followed(drivers, j):
            yield Effect(NAME, name, AXIS, f"{_BY_COMMAND}{name}", Shape("linear"))
    for _, name in moving_joints(drivers) if in_motion(drivers) else ():
        yield Effect(NAME, name, AXIS, "velocity", Shape("linear"))


def plausible(effect: Effect) -> bool:
    """Whether the joint is between what it reports and its command."""
    return not effect.driver.startswith(_BY_COMMAND) or 0.0 < float(effect.amplitudes[0]) <= _MAX_SHARE


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The share of commanded − measured; or the delay: against that of readings, of which the amplitude is one."""
    if effect.driver.startswith(_BY_COMMAND):
        return {"stale_share": value(effect)}
    return {"delay": value(effect, 0, -1.0, "s")}


def sentence(entry: ReportEntry) -> str:
    """The delay in milliseconds, or the share with its deviation."""
    if "stale_share" in entry.sizes:
        share, std, _ = entry.sizes["stale_share"]
        return (
            f"{entry.place} reports its position late: the logged value is stale by {share:.3f} ± {std:.3f} of "
            "commanded − measured"
        )
    return f"{entry.place} reports its position {1e3 * entry.sizes['delay'][0]:.2f} ms late"


FAMILY = Family(NAME, candidates, complexity=complexity_of_joint, plausible=plausible, sizes=sizes, sentence=sentence)
