"""Which explanation fits readings that do not agree with the arm, and is it sure?

hand_eye, hypothesis: readings beside tip poses and the evidence of a fit; what may be wrong, undone, with its price.
conventions, channels, rows, joints, description: the catalogues. search: rank, refit, repeat; *nothing* and *none*.
meant: conventions proved before a fit, and of a robot that is known. refusal: what no fit may come to terms with.
meanings, sights, joint_columns: what columns of a table mean. socket_places, stated_distances,
computed_part: plain checks of statements.
"""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.hypotheses.hand_eye import ANGLE, OF_REACH, HandEye, HandEyeFit, limits, placed
    from modcal_core.hypotheses.computed_part import computed_in_part, last_step
    from modcal_core.hypotheses.conventions import INVERSE, inverse_pose, left_handed, of_recording
    from modcal_core.hypotheses.hypothesis import COMMON, Disagreement, Hypothesis, family
    from modcal_core.hypotheses.joint_columns import likely_orders
    from modcal_core.hypotheses.meanings import LENGTHS, MIN_ROWS, Judged, judge, same_poses
    from modcal_core.hypotheses.meant import BEYOND_DOUBT, MIN, MISREAD, ArmMiss, proved, recognised
    from modcal_core.hypotheses.refusal import LIMIT_OF_REACH, disagreement, require_plausible
    from modcal_core.hypotheses.rows import orders, unrelated
    from modcal_core.hypotheses.search import Answer, explain
    from modcal_core.hypotheses.sights import SightMatch, Sighting, sights_match
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
