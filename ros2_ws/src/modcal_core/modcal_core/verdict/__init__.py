"""What may be said of a calibration: at the floor, open, or cannot tell; and the account that the words rest on."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.verdict.account import TOGETHER, Contribution, contributions_of, entries_of, resampled
    from modcal_core.verdict.case import Case, fitted_case, frozen_case, own_uncertainty
    from modcal_core.verdict.computed import COMPUTED, own_rows, too_small
    from modcal_core.verdict.contradicted import contradictions, doubtful, sane_inertias
    from modcal_core.verdict.floor import Floor, floors, reading_scatter_mm
    from modcal_core.verdict.grounds import Grounds, Rejected, regimes_of, rejection, too_many
    from modcal_core.verdict.iso9283 import PoseTest, pose_test
    from modcal_core.verdict.not_applied import Applied, applicable, carried_over, on_joints_clock
    from modcal_core.verdict.proof import Proofs
    from modcal_core.verdict.status import judge
    from modcal_core.verdict.tolerance import STATISTICS, Asked, AtTool, Tolerance, assess, interval_of_rms
    from modcal_core.verdict.verdict import NotAsked, Row, Share, Status, Verdict
    from modcal_core.verdict.where import with_places
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
