"""What was measured: the recording, the stations cut from it, and the samples a fit sees."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.measurements.alignment import BURST, LIMIT, LONGEST_PAUSE, SMALLEST_BURST, align, at_steady_rate
    from modcal_core.measurements.checks import joint_limits, moving_beside, other_joints, others_at, others_by_name
    from modcal_core.measurements.checks import remedies_of, require_usable, spoken_name
    from modcal_core.measurements.dropouts import BETWEEN, DAY, ELSEWHEN, GLITCHES, MAX_GLITCHES, UNUSABLE, Cleaned
    from modcal_core.measurements.dropouts import Dropped, Hung, cleaned, dropped, elsewhen, hung, together, unexpected
    from modcal_core.measurements.dwells import LATE_STEPS, LEFT, MIN_RETURNS, NOISE_FACTOR, SAME, SECOND_DIFFERENCE
    from modcal_core.measurements.dwells import SHORTEST, Approach, StationRules, dwells_of, find_dwells
    from modcal_core.measurements.dwells import fitted_rules, inliers, posture_numbers, returns, spread_rows
    from modcal_core.measurements.held_box import FACES, Box, Scan, measure_box
    from modcal_core.measurements.inspection import inspect, out_of_time
    from modcal_core.measurements.packages import added
    from modcal_core.measurements.pairing import averaged, efforts_at_rest
    from modcal_core.measurements.path import TRAVEL, UNKNOWN, WIDTHS, ahead, directions, went_on
    from modcal_core.measurements.recording import APART, BEARING, IMPORTED, ORDER_ONLY, PART, POINT, POSE, RANGE, RAY
    from modcal_core.measurements.recording import SOCKETS, TARGETS, TOUCH, UNREAD, JointTrack, Listed, ReadingTrack
    from modcal_core.measurements.recording import Recording, SignalTrack, Stretch, commanded_at, following, is_told
    from modcal_core.measurements.recording import joints_by_time
    from modcal_core.measurements.recording import staircase, told_at
    from modcal_core.measurements.samples import SHARED, Origin, Samples, after, as_recording, between, cut_stations
    from modcal_core.measurements.samples import explained_by_posture, joints_instead, marks_of
    from modcal_core.measurements.samples import require_new, share_of_known
    from modcal_core.schema import Schema, require, shown, told
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
