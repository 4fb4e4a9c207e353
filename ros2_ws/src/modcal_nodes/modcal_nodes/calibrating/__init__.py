"""What the calibrator node is made of: what it remembers, solves, keeps and says."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.calibrating.corners import ByCamera, CornerIntake
    from modcal_nodes.calibrating.diagnostics import Standing, collected, model_status, sample_status, standing_of
    from modcal_nodes.calibrating.intake import Buffer, CommandSubscription, Intake, KnownArm, lacking, listen, policy
    from modcal_nodes.calibrating.state import StateFolder
    from modcal_nodes.calibrating.watching import SentinelWatch
    from modcal_nodes.calibrating.worker import Publishers, SolveWorker, Solved, condense, live_check, solve
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
