"""Kinds that were written after a change to the code, with their words, and run once: the first and the second group.

What laboratories get wrong: exports, drivers, mountings, targets, statements; then what a metrology engineer, an
integrator of ROS drivers and a student in a hurry meet.
"""

from case import kinds
from transforms import *
from words import *

K, S = kinds("fresh")
TARGET = (r"\btool\b", r"\btarget\b", TRACKER)
# joint states
K("joint_folded_at_a_right_angle", "A driver computes a joint's angle by atan where atan2 is meant.", J)
S(130, pick(0, -1), col(lambda c: np.arctan(np.tan(c.x))))
K("joint_clipped", "A joint is reported up to one radian.", J)(140, pick(0, 5), col(lambda c: np.clip(c.x, -1.0, 1.0)))
K("joint_without_sign", "A joint is sent as an unsigned number.", J)(130, pick(1, -1), col(np.abs))
K("joint_in_gons", "A joint is in gons, 400 to a turn.", J)(120, pick(0, 5), col(lambda c: c.x * 200.0 / np.pi))
K("motor_angle_of_a_coupled_joint", "A motor is reported that turns with the joint before as well.", around(-1, 1))
S(130, pick(1, -1), col(lambda c: c.x + c.q[:, c.i - 1]))
K("column_of_currents", "A joint's column holds its motor's current.", J)(130, pick(0, 5), col(normal(0.7, 130)))
K("tracker_in_another_time_zone", "Readings' stamps are an hour later.", "clock", "stamp", "time", "overlap")
S(100, restamped(lambda stamps: stamps + 3600.0))

FILTER = ("filter", "last move", "arrived", "previous")
# readings
K("height_in_millimetres", "z is in millimetres, x and y in metres.", UNIT, r"\bz\b", "scale")(
    120, times([1.0, 1.0, 1e3])
)
K("flat_camera", "z is written as zero.", r"\bz\b", "plane", "flat", r"\bax[ei]s\b")(120, times([1.0, 1.0, 0.0]))
K("only_yaw_is_measured", "Roll and pitch are written as zero.", ORIENTATION)
S(120, put(R=lambda c: Rotation.from_euler("z", c.R.as_euler("ZYX")[:, 0][:, None])))
K("vector_part_as_rotation_vector", "A quaternion's vector was taken for a rotation vector.", ORIENTATION, "quaternion")
S(120, put(R=lambda c: Rotation.from_rotvec(c.R.as_quat(canonical=True)[:, :3])))
K("quaternions_of_two_decimals", "Quaternions have two decimals, positions all.", QUATERNION, "digit", "round")
S(130, put(values=lambda c: np.column_stack([c.raw()[:, :3], np.round(c.raw()[:, 3:], 2)])))
K("positions_of_whole_millimetres", "Positions are in whole millimetres.", "digit", "round", "resolution", TRACKER)
S(130, put(p=lambda c: np.round(c.p, 3)))
LOST = (LEFT_OUT, "zero", "origin", "same reading", "lost")
K("lost_beam_is_zero", "Where the beam is lost, at every ninth station, the reading is the origin.", LOST)
S(140, let(lost=lambda c: (c.rng.random(140) < 0.11)[:, None]))
S(put(R=lambda c: Rotation.from_quat(np.where(c.lost, [0.0, 0.0, 0.0, 1.0], c.R.as_quat()))))
S(put(p=lambda c: np.where(c.lost, 0.0, c.p)))
PASTED = ("identical", "cop(y|ied)", "twice", "same reading", "returns show")
K("rows_pasted_twice", "Forty rows are pasted again with new stamps: no returns.", PASTED, JOINT(2))
S(joint(lambda c: 8e-4 * ((2.0 * c.q[:, 2]) % 1.0 - 0.5), 2), clean(120, returns=0), only(np.r_[:120, :40]))
S(put(t=lambda c: 4.0 * np.arange(160.0)))
K("tracker_filters", "The tracker is read early: some per mille of the last move are missing.", TRACKER, FILTER)
S(150, put(p=lambda c: c.p + 8e-4 * (np.concatenate([c.p[:1], c.p[:-1]]) - c.p)))
K("orientation_alone_drifts", "A gyroscope's heading drifts, positions do not.", ORIENTATION, "time", "order", "drift")
S(150, turned(lambda c: Rotation.from_rotvec(np.outer(c.t / c.t[-1], [0.0, 0.0, np.radians(0.4)]))))
K(
    "orientation_of_another_body",
    "Orientations are of the link before the last joint.",
    ORIENTATION,
    JOINT(-1),
    r"\btool\b",
)
S(130, let(axis=lambda c: c.R.apply(c.cell.tool[1].inv().apply([0.0, 0.0, 1.0]))))
S(turned(lambda c: Rotation.from_rotvec(-c.q[:, [c.n - 1]] * c.axis)))
K("magnetic_tracker_near_iron", "Readings are bent around one place.", TRACKER, LEFT_OUT)
S(170, let(gap=lambda c: c.p - c.p[int(c.rng.integers(170))]))
S(let(bump=lambda c: np.exp(-np.sum(c.gap**2, axis=1) / (2.0 * 0.25**2))[:, None]))
S(put(p=lambda c: c.p + 3e-3 * c.bump * c.way(1.0)))
K("seen_in_a_mirror", "On one side of the cell the target is seen in a mirror.", "mirror", "handed", LEFT_OUT, TRACKER)
S(150, let(v=way(1.0), height=lambda c: c.p @ c.v, wall=lambda c: np.quantile(c.height, 0.75)))
S(put(p=lambda c: c.p - 2.0 * np.maximum(c.height - c.wall, 0.0)[:, None] * c.v))
# targets, tools, arms
K("corner_cube_off_centre", "A glass reflector's path is longer the more obliquely the beam comes in.", TARGET)
S(150, put(p=lambda c: c.p + 9e-4 * (1.0 - np.abs(c.seen[:, 2:])) * c.sight))
K("marker_hidden_from_one_side", "From one side one of four balls is hidden, and the body sits elsewhere.", TARGET)
S(150, let(hidden=lambda c: (c.seen @ c.way(1.0) > 0.3)[:, None], shift=way(7e-4), v=way(3e-3)))
S(put(p=lambda c: c.p + np.where(c.hidden, c.R.apply(c.shift), 0.0)))
S(put(R=lambda c: c.R * Rotation.from_rotvec(np.where(c.hidden, c.v, 0.0))))
K("belt_slips_with_travel", "A belt slips as its joint goes forwards.", NEAR, lambda c: (r"\bbase\b",) * (c.i == 0))
S(pick(0, 4), joint(lambda c: -3e-5 * np.cumsum(np.maximum(moves(c.x), 0.0))), 160)
K("balancer_pulls", "A balancer above the cell pulls the flange of an elastic arm.", LOAD, ALL)
S(lambda c: waits(c, pulled, "compliance"), 160)
K("axis_of_the_description_wrong", "In the URDF a joint turns about y in place of z.", J)
S(130, pick(1, -1), in_block("joint", "name", lambda c, b: numbers(b, "axis xyz", lambda v: v[[2, 0, 1]])))
K("description_in_millimetres", "All lengths of the URDF's joints are in millimetres.", UNIT, "URDF", "metres")
S(120, each_joint(lambda joint: numbers(joint, "origin xyz", lambda v: 1e3 * v)))
K("remounted_on_a_wall_frozen", "Calibrated standing, used on a wall.", LOAD, ALL, "gravity", shown="if left")
S(elastic(8e-4), 140, frozen("--refit-base"), same, gravity(9.81, 0.0, 0.0), clean(80, begin=90_000.0))
# statements
JAGGED = joint(lambda c: 9e-4 * ((1.1 * c.x + 0.9 * c.q[:, c.i + 1]) % 1.0 - 0.5))
K("microns_stated_as_millimetres", "Micrometres are stated as millimetres.", "stated", "repeatab", JJ, floor=False)
S(pick(0, 4), JAGGED, clean(150, returns=0), asked("--repeatability-mm", "20", "--instrument-mm", "35"))
S(asked("--repeatability-deg", "2", "--instrument-deg", "2"))
K("recorded_twice_without_leaving", "Every posture is recorded twice: no returns.", JJ, floor=False)
S(pick(0, 4), visit(90, 0), let(q=lambda c: np.repeat(c.q, 2, axis=0), again=None), JAGGED, see())
# the second group: joint states and clocks
K, S = kinds("fresh_again")
K("three_joints_in_alphabetical_order", "The names of three joints are sorted, their values not.", JJJ)
S(130, pick(0, -2), cycle(1, 2, 0))
K("two_joints_of_other_sign", "A driver counts two joints the other way round.", lambda c: [c.names[k] for k in c.two])
S(130, let(two=lambda c: c.rng.choice(c.n, 2, replace=False)), cols(lambda c: c.two, lambda c, q: -q))
BOTH = ("publish", r"\bjumps?\b", "joint.states?", "two sources", "speed", "velocity")
K("two_publishers_of_joint_states", "A publisher writes zeros between the driver's joint states.", BOTH)
S(dwells(90), written(zeros_between))
K("encoder_bit_lost", "The twelfth bit of a joint's encoder is always zero.", J)
S(150, pick(0, 4), let(b=2.0 * np.pi / 4096.0), col(lambda c: c.x - c.b * (np.floor(c.x / c.b) % 2.0)))
K("joints_of_three_decimals", "Joints are to a milliradian.", r"\bdigit", "round", "decimal", "resolution")
S(150, put(q=lambda c: np.round(c.q, 3)))
K("efforts_of_the_station_before", "Efforts are those of the station before.", "effort", LOAD, ALL, shown="if left")
S(elastic(6e-4, payload=5.0), clean(150, effort=True))
S(put(effort=lambda c: np.concatenate([c.effort[:1], c.effort[:-1]])))
K("readings_stamped_on_arrival", "Readings are stamped a third of a second late.", CLOCK, shown="if left")
S(stream(90), streamed(lambda c: BEGIN + c.clock + 0.35, received=True))
K("stamps_of_whole_seconds", "Stamps are cut to whole seconds; the arm stands for two.", CLOCK, shown="if left")
S(dwells(90, begin=0.5), restamped(np.floor))
# instruments
K("beam_bends_while_the_air_warms", "The beam is bent upwards, ever more.", TRACKER, BASE, r"\btime\b", "drift")
S(150, put(p=lambda c: c.p + 8e-5 * (c.t / c.t[-1])[:, None] * np.sum(c.p**2, axis=1, keepdims=True) * c.up))
K("range_constant_wrong", "Every distance is 2 mm too long.", TRACKER, r"\bbase\b", "scale", shown="if left")
S(150, put(p=lambda c: c.p + 2e-3 * c.sight))
K("tracker_warms_up", "A tracker's scale settles by 150 ppm.", TRACKER, BASE, "scale", r"\btime\b", "drift")
S(150, times(lambda c: 1.0 + 1.5e-4 * np.exp(-c.t[:, None] / 150.0)))
K("tracker_changes_face", "A tracker looks with either face.", TRACKER, LEFT_OUT, r"\breturns?\b", r"\bjump")
S(150, let(side=lambda c: c.rng.choice([-1.0, 1.0], 150)))
S(put(p=lambda c: Rotation.from_rotvec(np.outer(1.5e-4 * c.side, [0.0, 0.0, 1.0])).apply(c.p)))
K("lens_distorts", "Towards the rim points stand too far out.", TRACKER, BASE, r"\breading")
S(160, let(depth=lambda c: (c.p @ c.forward)[:, None], across=lambda c: c.p - c.depth * c.forward))
S(put(p=lambda c: c.p + 0.02 * (np.linalg.norm(c.across, axis=1, keepdims=True) / c.depth) ** 2 * c.across))
K("planar_marker_flips", "A fifth of a flat marker's orientations took the wrong tilt.", ORIENTATION, LEFT_OUT)
S(150, let(flip=flipped, some=lambda c: c.rng.random(150) < 0.2))
S(turned(lambda c: Rotation.from_rotvec(np.where(c.some, c.flip[0], 0.0)[:, None] * c.flip[1])))
# arms and stands
K("brakes_let_the_arm_down", "Two joints drop by their free play to their load's side.", LOAD, JOINT(1, 2))
S(bend("x", np.s_[:, 1:3, 3], lambda c: -(3e-4 * np.sign(c.held[:, 1:3]))), 160)
K("gear_worn_in_one_half", "The second joint's gear errs in half of its range.", JOINT(1))
S(let(i=1), joint(lambda c: 7e-4 * np.sin(17.0 * c.x) * (c.x > c.middle[1])), 200)
K("gear_error_grows_with_load", "A gear's error is as large as the load on its teeth.", J)
S(pick(1, 4), let(cycles=between(5, 30)))
S(joint(lambda c: loaded(c, 5e-4) * np.sin(c.cycles * c.x)), 200)
K("pulley_of_an_odd_ratio", "A pulley out of centre turns 2.37 times as fast as its joint.", J)
S(pick(0, 4), joint(lambda c: 6e-4 * np.sin(2.37 * c.x + 0.5)), 160)
K("differential_wrist_with_backlash", "Backlash goes with the sum of two wrist joints' motions.", JOINT(-3, -2))
S(
    let(i=lambda c: c.n - 3),
    joint(lambda c: 5e-4 * np.sign(moves(c.q, c.middle)[:, c.i : c.i + 2].sum(axis=1)), -2),
    180,
)
