"""What may be said of a calibration: at the floor, open, or cannot tell; and the account that the words rest on."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.verdict.case import Case, fitted_case, frozen_case, own_uncertainty
    from modcal_core.verdict.computed import COMPUTED, own_rows, too_small
    from modcal_core.verdict.contradicted import contradictions
    from modcal_core.verdict.contributions import TOGETHER, contributions_of, left_without, resampled
    from modcal_core.verdict.floor import Floor, floors, reading_scatter_mm
    from modcal_core.verdict.grounds import Grounds
    from modcal_core.verdict.iso9283 import PoseTest, pose_test
    from modcal_core.verdict.not_applied import Applied, applicable, carried_over
    from modcal_core.verdict.readings import doubtful
    from modcal_core.verdict.regimes import regimes_of
    from modcal_core.verdict.rejected import Rejected, rejection, too_many
    from modcal_core.verdict.sanity import sane_inertias
    from modcal_core.verdict.status import judge
    from modcal_core.verdict.tolerance import STATISTICS, Asked, AtTool, Tolerance, assess, interval_of_rms
    from modcal_core.verdict.verdict import NotAsked, Row, Share, Status, Verdict
    from modcal_core.verdict.where import with_places
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["COMPUTED", "STATISTICS", "TOGETHER", "Applied", "Asked", "AtTool", "Case", "Floor", "Grounds", "NotAsked"]
__all__ += ["PoseTest", "Rejected", "Row", "Share", "Status", "Tolerance", "Verdict", "applicable", "assess"]
__all__ += ["carried_over", "contradictions", "contributions_of", "doubtful", "fitted_case", "floors", "frozen_case"]
__all__ += ["interval_of_rms", "judge", "left_without", "own_rows", "own_uncertainty", "pose_test"]
__all__ += ["reading_scatter_mm", "regimes_of", "rejection", "resampled", "sane_inertias", "too_many", "too_small"]
__all__ += ["with_places"]
