"""The eighth group, in cells of world.py: conventions, arms, stands, streams; two things wrong at once among them."""

from case import kinds
from streams import *
from transforms import *
from words import *
from world import UR5
from world import described as drawn

K, S = kinds("fresh_eighth")
BASE, TOOL = (r"\bbase\b", "tracker", "instrument"), (r"\btool\b", "target", "flange")
TURNED = ("quaternion", "orientation", "euler", "w x y z", "xyzw", "convention")
UNIT = ("millimet", r"\bmm\b", "unit", "scale", "metre")
MIRROR = ("handed", "mirror", "coordinate", r"\baxes\b", r"\baxis\b", "sign")
ROWS = (r"\brows?\b", "station", "posture", "order", "shift", "late", "belong")
STATED = ("stated", "repeatab", "instrument")
LOAD = ("load", "compliance", "gravity", "payload", "elastic", "spring")
CLOCK = ("clock", "stamp", "time", "late", "lag", "offset", "belong", "synchron")
STILL = ("same", "frozen", "repeat", "stand", "still", "identical", "stale", *ROWS)
GRID = ("digit", "decimal", "step", "round", "grid", "whole")
RANGE, TWICE = ("range", "distance", "scale", "reading"), ("joint states", "joint_states", "publish")
SMOOTH = ("filter", "settle", "smooth", "move", "direction")
OTHER = ("robot", "calibration", "pattern", "geometry", "fail")
FLIP, TODAY = np.diag([1.0, -1.0, 1.0]), {"begin": DAY}
WELL = asked("--repeatability-mm", "0.02", "--instrument-mm", "0.044", "--tolerance-mm", "0.3")
WORN = bend("x", np.s_[:, :3, 3], lambda c: 8e-4 * np.sin(c.q[:, :3] * [43.0, 57.0, 71.0] + 1.0))

# --- two things wrong at once ----------------------------------------------------------------------------------------

K("w_first_and_the_tool_bent", "Quaternions w x y z, and the tool was bent half way.", TURNED, TOOL)
S(tool(4e-3, 0.03, since(82)), 150, W_FIRST)
K("w_first_and_a_joint_negated", "Quaternions w x y z, and one joint counts the other way.", TURNED, J)
S(pick(1), 140, col(np.negative), W_FIRST)
K("millimetres_and_the_tripod_kicked", "Millimetres since the tripod was kicked by 3 mm.", UNIT, BASE)
S(base(3e-3, 2e-3, since(99)), 150, elsewhere(since(99), p=lambda c: 1e3 * c.p))
K("degrees_and_two_joints_swapped", "All joints in degrees, and two names exchanged.", r"\bdegrees?\b", JJ)
S(pick(1, -1), 140, put(q=lambda c: np.degrees(c.q)), cycle(1, 0))
K("left_handed_until_the_base_moved", "A left-handed frame at first; put right, its origin moved.", MIRROR, BASE, ROWS)
S(base(0.05, 0.02, since(75)), 150, let(flipped=lambda c: Rotation.from_matrix(FLIP @ c.R.as_matrix() @ FLIP)))
S(elsewhere(until(75), p=lambda c: c.p @ FLIP, R=lambda c: c.flipped))
K("sign_and_zero_of_a_joint", "A joint counts the other way than in the URDF, from a right angle on.", J)
S(pick(1), 140, col(lambda c: np.pi / 2 - c.x))
K("two_joints_swapped_and_both_negated", "Two joints under each other's name and of the other sign.", JJ)
S(pick(1, -1), 140, cycle(1, 0, sign=-1.0))
K("tool_bent_and_backlash", "One gear has play of a milliradian, and the tool was knocked by 0.6 mm.", J)
S(pick(1, 4), tool(6e-4, 5e-4, since(64)), joint(lambda c: 5e-4 * c.came[:, c.i]), 160)

# --- units and columns of some parts ---------------------------------------------------------------------------------

K("y_in_inches", "Points, of which y is in inches.", UNIT, "inch", r"\by\b", "coordinate")
S(points(150), times([1.0, 39.3701, 1.0]))
K("left_handed_points", "Points of a left-handed frame: x has the other sign.", MIRROR, "x")
S(points(150), times([-1.0, 1.0, 1.0]))
K("rail_in_millimetres", "The rail counts millimetres, all else is in metres and radians.", UNIT, "rail_joint")
S(built("rail"), 140, cols(0, lambda c, q: 1e3 * q))
K("rail_runs_the_other_way", "The rail counts from its other end.", "rail_joint")
S(built("rail"), 140, cols(0, lambda c, q: 1.5 - q))
K("scara_z_in_millimetres", "A SCARA's quill counts millimetres.", UNIT, "scara_z")
S(built("scara"), 120, cols(2, lambda c, q: 1e3 * q))
K("quill_screws_when_it_turns", "Turning a SCARA's last joint lifts its quill by 20 mm a turn.", "scara_z", "scara_4")
S(built("scara"), bend("x", np.s_[:, 2, 3], lambda c: 0.02 * c.q[:, 3] / (2 * np.pi)), 140)

# --- encoders --------------------------------------------------------------------------------------------------------

K("turn_of_the_motor_lost", "From some station on a joint is off by one turn of its motor, 1 in 101.", J)
S(pick(1), 150, col(lambda c: c.x - (c.rows >= 90) * 2 * np.pi / 101))
K("odd_gear_and_a_folded_angle", "A gear errs twice and a half a turn, its angle is written within ±π.", JOINT(5))
S(turning(5), joint(lambda c: 2.5e-3 * np.sin(2.5 * c.x + 0.4)), 170, col(lambda c: folded(c.x)))
K("gear_ratio_and_a_folded_angle", "A motor counts 0.05 % too much, its angle is written within ±π.", JOINT(4))
S(turning(4), joint(lambda c: 5e-4 * c.x), 160, col(lambda c: folded(c.x)))
K("whole_turns_come_and_go", "Today the last joint is a turn larger, beyond its gear's curve.", J, shown="if left")
S(let(i=lambda c: c.n - 1), joint(lambda c: 2.5e-3 * np.sin(3 * c.x + 0.4)), clean(70, **TODAY))
S(col(lambda c: c.x + 2 * np.pi), same, before(150))

# --- descriptions, arms ----------------------------------------------------------------------------------------------

K("urdf_of_the_older_series", "A UR5e with the URDF of a UR5.", "urdf", "description", ALL, BASE, shown="if left")
S(built("ur5e"), 150, put(urdf=lambda c: drawn(UR5)))
K("another_arm_from_the_middle_on", "The second half is of the next arm of the series.", ROWS, ALL, "robot", BASE, TOOL)
S(80, part, lambda c: c.rebuild(), clean(80, begin=500.0), together)
K("user_frame_since_noon", "After a break readings are in a user's frame: 100 mm further along x.", BASE)
S(150, elsewhere(since(105), p=lambda c: c.p + [0.1, 0.0, 0.0]))
K(
    "middle_third_twice_the_tool_offset",
    "For a while an offset of the tool, 12 mm along its axis, was applied twice.",
    TOOL,
)
S(150, elsewhere(since(50, 100), p=lambda c: c.p + c.R.apply([0.0, 0.0, 0.012])))
K("whole_bag_written_twice", "A gear errs; each row stands twice, a millisecond later.", J, "twice", "repeat", "cop")
S(pick(1, 4), joint(lambda c: 8e-4 * np.sin(70 * c.x + 1.0)), 110)
S(let(session=lambda c: c.session.only(np.repeat(c.rows, 2))), put(t=lambda c: c.t + np.tile([0.0, 1e-3], 110)))

# --- joints, stands --------------------------------------------------------------------------------------------------

K("lost_motion_grows_with_load", "A gear's hysteresis is as wide as its load is large.", JOINT(1))
S(joint(lambda c: 9e-4 * (load := np.abs(c.torques(c.q)[:, 1])) / load.max() * c.came[:, 1], i=lambda c: 1), 170)
K("dress_pack_pulls_at_the_wrist", "A hose round the last joint twists the one before, with friction.", JOINT(-2, -1))
S(let(i=lambda c: c.n - 2), joint(lambda c: 9e-4 * np.sin(c.q[:, -1] - 0.7) + 2e-4 * c.came[:, -1]), 170)
K(
    "end_of_a_cantilever_table",
    "The arm's table sinks and tilts by the moment about its edge.",
    BASE,
    LOAD,
    JOINT(0),
    "link_0",
)
S(let(masses=lambda c: [9.81 * j.mass for j in c.joints]))
S(let(moment=lambda c: lambda q: sum(m * x for m, x in zip(c.masses, c.frames(q)[:, :, 0, 3].T, strict=True))))
S(bend("tracker", np.s_[:, [4, 2]], lambda c: np.outer(c.moment(c.q), [2e-5, -8e-6])), 160)
K(
    "encoder_ring_off_centre_and_payload",
    "An encoder's ring off centre; an elastic arm picks up 3 kg.",
    J,
    LOAD,
    JOINT(1),
)
S(pick(1, 4), let(load=3.0 * (np.arange(170) >= 90), one=lambda c: np.arange(c.n) == c.i))
S(let(ring=lambda c: lambda x: 1.5e-3 * np.sin(x + 0.6)[:, None] * c.one))
S(bend("x", np.s_[..., 3], lambda c: 1e-5 * c.torques(c.q, c.load) + c.ring(c.x)), 170)
K(
    "link_bends_by_the_part_it_holds",
    "A link bends by the weight behind it.",
    LOAD,
    JOINT(1, 2, 3, 4),
    "link_2",
    "link_3",
)
S(sagging(2, 3e-3), 160)
K("joint_of_two_values", "A cracked coupling sits in one of two places, by a neighbour's last move.", JJ)
S(let(i=2), joint(lambda c: 3.5e-4 * c.came[:, 3]), 160)

# --- instruments -----------------------------------------------------------------------------------------------------

K("prism_constant_and_a_kick", "Distances are 1.2 mm too long; the tripod was kicked.", BASE, RANGE)
S(base(5e-4, 2e-4, since(80)), points(160), times(lambda c: 1 + 1.2e-3 / far(c)))
K(
    "levels_itself_wrongly_after_a_nudge",
    "A tracker turns readings about its origin, to and fro.",
    BASE,
    r"\btime\b",
    JOINT(0),
)
S(160, let(on=lambda c: np.clip(c.t - 400.0, 0.0, None)))
S(let(by=lambda c: Rotation.from_rotvec(np.outer(1.5e-4 * np.sin(c.on / 55.0), [1.0, 0.3, 0.0]))))
S(put(p=lambda c: c.by.apply(c.p), R=lambda c: c.by * c.R))
K("camera_reads_depth_by_its_tilt", "A board's depth errs with its tilt to the sight.", BASE, "reading", "sight", TOOL)
S(170, let(tilt=lambda c: 1 - np.sum(c.R.apply([0.0, 0.0, 1.0]) * sight(c), axis=1) ** 2))
S(put(p=lambda c: c.p + 8e-4 * c.tilt[:, None] * sight(c)))
K("tenth_of_a_millimetre_typed", "Positions typed to a tenth of a millimetre.", GRID, shown="if left")
S(clean(140, noise_mm=0.005), put(p=lambda c: np.round(c.p, 4)))
K("distances_grow_with_air_pressure", "The scale drifts by 60 ppm.", BASE, "scale", r"\btime\b", shown="if left")
S(points(170, noise_mm=0.01), times(lambda c: (1 + 6e-5 * np.sin(c.t / 330.0 + 1.0))[:, None]))
K("press_next_door", "A press shakes the stand by 0.1 mm now and then, as scatter.", BASE, shown="if left")
S(let(hits=lambda c: 1e-4 * (c.rng.random(150) < 0.4)), bend("tracker", np.s_[:, 2], "hits"), 150)
S(put(floor_mm=lambda c: float(np.hypot(c.floor_mm, 1e3 * np.std(c.hits)))))

# --- later -----------------------------------------------------------------------------------------------------------

K("other_arm_base_and_tool_refitted", "The calibration is of another arm of the type, refitted.", ALL, OTHER)
S(130, frozen("--refit-base", "--refit-tool", "--tolerance-mm", "0.5"), lambda c: c.rebuild(), clean(60, **TODAY))
K("one_joint_in_degrees_today", "Today one joint is written in degrees; the calibration is from before.", J)
S(pick(1), clean(60, **TODAY), col(np.degrees), before(130, "--refit-base"))
K("tool_a_little_shorter_today", "Somebody ground the probe by 0.3 mm since, the base is found again.", TOOL)
S(tool(3e-4, 0.0), bare(130), frozen("--refit-base"), clean(70, **TODAY))
K("softer_since", "A joint's bearing wears: today it deflects twice as far.", JOINT(1), LOAD)
S(soft(1e-5), 140, frozen("--refit-base"), let(twice=lambda c: np.where(np.arange(c.n) == 1, 2.0, 1.0)))
S(bend("x", np.s_[..., 3], lambda c: 1e-5 * c.torques(c.q) * c.twice), clean(70, **TODAY))
K("handful_of_stations_today", "Nine stations; the third joint was mastered 1 mrad off since.", JOINT(2), "fail")
S(clean(9, returns=0, **TODAY), cols(2, lambda c, q: q + 1e-3), before(130, "--tolerance-mm", "0.2"))

# --- stated, and contradicted by the data ----------------------------------------------------------------------------

K("repeatability_stated_far_too_large", "2 mm are stated of an arm that repeats to 0.02; a gear errs.", STATED, J)
S(pick(1, 4), joint(lambda c: 4e-4 * np.sin(70 * c.x + 1.0)), 170)
S(asked("--repeatability-mm", "2.0", "--instrument-mm", "0.04", "--geometry-only"))
K("repeatability_stated_far_too_small", "5 µm and 1 µm are stated of an arm that scatters by 0.05 mm.", STATED)
S(140, asked("--repeatability-mm", "0.005", "--instrument-mm", "0.001"))
K("points_returns_and_a_large_stated_instrument", "1 mm is stated; a joint has backlash.", STATED, J)
S(pick(1, 4), joint(lambda c: 6e-4 * c.came[:, c.i]), 160, put(kind=lambda c: "point"))
S(asked("--instrument-mm", "1.0", "--tolerance-mm", "2"))
K("masses_a_tenth", "The URDF's masses of an elastic arm are a tenth.", LOAD, "mass", shown="if left")
S(soft(2e-5), 150, sub(r'mass value="([^"]*)"', lambda found: f'mass value="{0.1 * float(found[1]):.4f}"'))
K("known_distance_is_another_ones", "A scale of 3 ‰ beside a known tool.", UNIT, BASE, TOOL, "stated", shown="if left")
S(let(at_=lambda c: ", ".join(f"{v:.5f}" for v in c.target[0])), points(160), times(1.003))
S(truth(files=lambda c: {"cell.yaml": f"tool: {{position_m: [{c.at_}], std_m: 0.0001}}\n"}))
S(asked("--cell", "{cell.yaml}"))

# --- read again and again --------------------------------------------------------------------------------------------

K("sixteen_points_read_five_times", "Sixteen points, however often read, are too few.", r"\bpostures\b", JOINT(0, 1, 2))
S(visit(16, 0), let(q=lambda c: np.repeat(c.q, 5, axis=0), again=None), WORN, see(kind="point", repeat=0.0), WELL)
K("thirty_points_read_four_times", "Thirty are enough for geometry, and not for gears.", shown="if left")
S(visit(30, 0), let(q=lambda c: np.repeat(c.q, 4, axis=0), again=None), WORN, see(kind="point", repeat=0.0), WELL)
K("five_rounds_of_twenty_poses", "Twenty poses are gone to five times, one after the other.", shown="if left")
S(visit(100, 0), see(repeat=0.0), let(q=lambda c: np.tile(c.q[:20], (5, 1)), again=None), WORN, see())
S(asked("--tolerance-mm", "0.3"))

# --- streams ---------------------------------------------------------------------------------------------------------

K("atomic_time_for_universal", "The tracker keeps atomic time: its stamps are 37 s ahead of the joints'.", CLOCK)
S(streamed(80, lambda c, t, v: (t + 37.0, v)))
K("stamps_since_switched_on", "The tracker counts seconds since it was switched on.", CLOCK, "joint states")
S(streamed(60, lambda c, t, v: (t + 812.0 - EPOCH, v)))
K("tracker_filters_heavily", "The tracker's filter settles within 1.5 s.", CLOCK, SMOOTH)
S(streamed(80, smoothed(1.5)))
K("tracker_hangs_now_and_then", "Ten times the last reading is repeated for nine seconds, with new stamps.", STILL)
S(streamed(90, hung))
K("computed_pose_forty_milliseconds_late", "A driver computes the pose of the joints.", COMPUTED, "nominal")
S(streamed(70, computed))
K("goals_published_beside_the_joints", "Goals are published under the joints' names.", TWICE, ALL)
S(let(off=lambda c: c.rng.normal(0, 6e-4, c.n)), streamed(80, more=goals))
K(
    "old_simulation_left_running",
    "A simulation publishes joint states of another way, under the same names.",
    TWICE,
    ROWS,
)
S(let(other=lambda c: c.postures(80)[0]), streamed(80, more=simulated))
K("clock_jumps_by_half_a_second", "The network sets the tracker's clock back by 4.5 s in the middle.", CLOCK)
S(streamed(90, lambda c, t, v: (t - 4.5 * (t > 260.0), v)))
K("every_reading_four_seconds_old", "A buffer that was never emptied: readings are 4 s old when stamped.", CLOCK)
S(streamed(80, lambda c, t, v: (t + 4.0, v)))
