"""Calibration that goes on while the arm works: samples as they come, a running estimate, and what has changed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.online.estimator import Estimator, RandomWalk
    from modcal_core.online.stream import SampleStream
    from modcal_core.online.supervisor import ASKED, BETTER, SUSPECTED, ChangeHypothesis, Policy, Supervisor
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
