"""Whether a recording and a description can belong together: conventions, units, joints, single channels."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.plausibility.agreement import ANGLE, OF_REACH, Disagreement, Placed, limits
    from modcal_core.plausibility.channels import disagreeing_channel
    from modcal_core.plausibility.computed_part import computed_in_part
    from modcal_core.plausibility.consensus import CLEARLY, Consensus
    from modcal_core.plausibility.consistency import disagreement
    from modcal_core.plausibility.conventions import BEYOND_DOUBT, is_astray, points_left, points_match, proved
    from modcal_core.plausibility.coordinates import written_otherwise
    from modcal_core.plausibility.joint_columns import likely_orders
    from modcal_core.plausibility.joint_map import mixed_joints
    from modcal_core.plausibility.links import other_link
    from modcal_core.plausibility.meanings import LENGTHS, MIN_ROWS, Judged, Postures, judge, rivals, same_poses
    from modcal_core.plausibility.mistakes import inverse_pose, left_handed
    from modcal_core.plausibility.of_a_part import part_apart
    from modcal_core.plausibility.pairing import mispaired
    from modcal_core.plausibility.placements import several_placements
    from modcal_core.plausibility.recognise import MIN, MISREAD, ArmMiss, recognised
    from modcal_core.plausibility.require import LIMIT_OF_REACH, require_plausible
    from modcal_core.plausibility.screening import wrong_joints
    from modcal_core.plausibility.sights import SightMatch, Sighting, sights_match
    from modcal_core.plausibility.turning import EULER, MATRIX, QUATERNION, Turning, turnings
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ANGLE", "BEYOND_DOUBT", "CLEARLY", "EULER", "LENGTHS", "LIMIT_OF_REACH", "MATRIX", "MIN", "MIN_ROWS"]
__all__ += ["MISREAD", "OF_REACH", "QUATERNION", "ArmMiss", "Consensus", "Disagreement", "Judged", "Placed"]
__all__ += ["Postures", "SightMatch", "Sighting", "Turning", "computed_in_part", "disagreeing_channel", "disagreement"]
__all__ += ["inverse_pose", "is_astray", "judge", "left_handed", "likely_orders", "limits", "mispaired", "mixed_joints"]
__all__ += [
    "other_link",
    "part_apart",
    "points_left",
    "points_match",
    "proved",
    "recognised",
    "require_plausible",
    "rivals",
]
__all__ += ["same_poses", "several_placements", "sights_match", "turnings", "written_otherwise", "wrong_joints"]
