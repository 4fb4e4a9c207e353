"""A physical stand-in for a cell: MuJoCo computes where things are, not modcal's kinematics."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.simulation.furniture import draw
    from modcal_nodes.simulation.mjcf import Servo, World
    from modcal_nodes.simulation.plant import SWITCHES, TRACKER, TRACKER_PHASE, Grid, Plant, recorded
    from modcal_nodes.simulation.program import legs
    from modcal_nodes.simulation.pulling import PullRecord, Pulling, effort_limits
    from modcal_nodes.simulation.speaking import SpeakingNode
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
