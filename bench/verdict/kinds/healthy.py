"""Healthy cells: builds that the other good recordings lack, and the cells of world.py with streams and frames."""

from arms import described as drawn
from streams import *
from transforms import *

K, S = kinds("good_fifth", fault=False)
K("healthy_on_a_rail", "A UR10 on a rail of two metres whose carriage is one of the joints.")(built("rail"), 140)
K("healthy_scara", "Four joints, all axes upright.")(built("scara"), 110)
K("healthy_gantry", "Three slides and a wrist of two joints.")(built("gantry"), 120)
K("healthy_seven_axes", "An iiwa, measured by points alone.")(built("iiwa14"), points(170))
K("healthy_at_few_stations", "Twenty-six poses, six of them second visits.")(26)

K, S = kinds("good_eighth", fault=False)
BESIDE = ("finger_joint", "wheel_left", "wheel_right")
K("tracker_clock_drifts_while_it_waits", "The clock is off by 80 ppm and 0.2 s.", planted=("latency", "clock"))
S(flowing(70, lambda c, t, v: (t * (1 + 8e-5) + 0.2, v)))
K("gripper_and_mobile_base_beside_it", "Another publisher sends a gripper and wheels.")
S(let(open=lambda c: lambda t: 0.02 + 0.02 * np.sign(np.sin(t / 17.0))))
S(flowing(70, more=lambda c, t, q: (BESIDE, t, np.c_[c.open(t), 0.0 * t, 0.0 * t])))
K("every_packet_twice", "The network delivers every reading twice, with the same stamp.")
S(flowing(70, lambda c, t, v: (np.repeat(t, 2), np.repeat(v, 2, axis=0))))
K("angles_within_half_a_turn", "Joints turn by more.")
S(turning(0, 3, 4, 5), 130, put(q=lambda c: (c.q + np.pi) % (2 * np.pi) - np.pi))
K("whole_turn_more_since", "The last joint counts one turn more than when the arm was calibrated, as its limits allow.")
S(let(wide=lambda c: tuple(replace(j, low=j.low - 3.0, high=j.high + 3.0) for j in c.joints)))
S(lambda c: setattr(c.w, "urdf", drawn(c.wide)), clean(70, begin=DAY), cols(-1, lambda c, q: q + 2 * np.pi))
S(before(130))
K("readings_in_the_base_by_a_hand_eye", "They are, to a millimetre.")(let(at_=normal(1e-3, 3)))
S(let(by=lambda c: Rotation.from_rotvec(c.rng.normal(0, 1e-3, 3))), lambda c: setattr(c.w, "eye", (c.at_, c.by)), 130)
K("survey_coordinates", "The tracker's frame has its origin 40 m away.")
S(lambda c: setattr(c.w, "eye", (np.array([31.0, -24.0, 4.0]), Rotation.random(rng=c.rng))), 130)
K("elastic_arm", "Joints deflect by 20 µrad/Nm.")(soft(2e-5), 150)
K("on_a_rail", "A UR5e on a rail of one metre and a half.")(built("rail"), 140)
K("scara", "Four joints with upright axes.")(built("scara"), 110)
K("smoothed_a_little", "A filter of 60 ms has settled.", planted=("latency",))(flowing(70, smoothed(0.06)))
K("points_of_a_coarse_camera", "Points with 0.3 mm of noise.")(points(200, noise_mm=0.3))
