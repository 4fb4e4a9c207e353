"""Recordings of real arms, spoiled; and as they are, where what is left is known to be more than noise."""

from tables import *
from transforms import *

K, S = kinds("real")
K("cubes_other_sequence", "The tracker's angles are read as extrinsic.", ORIENTATION)(cubes, euler("XYZ", "xyz"))
K("cubes_reversed_sequence", "The tracker's angles are read as ZYX.", ORIENTATION)(cubes, euler("XYZ", "ZYX"))
K("cubes_w_first", "Quaternions are written w x y z.", QUATERNION)(cubes, W_FIRST)
K("cubes_tool_turned", "The tool is turned after 80 stations.", TOOL)(cubes, knocked("tool", 0.03, 0.1, since(80)))
K("cubes_first_with_another_tool", "Twelve stations have it.", TOOL)(cubes, knocked("tool", 0.02, 0.2, since(0, 12)))
K("cubes_base_moved", "The tracker stands some centimetres aside from the middle on.", BASE)
S(cubes, let(by=lambda c: Rotation.from_rotvec(c.way(0.02)), v=way(0.03)))
S(elsewhere(since(300), lambda c: c.by.apply(c.p) + c.v, lambda c: c.by * c.R, "quat"))
K("cubes_in_millimetres_at_the_end", "The last hundred positions are in millimetres.", UNIT)
S(cubes, times(lambda c: np.where(c.rows >= 532, 1e3, 1.0)[:, None]))
K("cubes_half_shifted_frozen", "A calibration on 400 stations is used where 45 % is shifted by 5 mm.", LEFT_OUT)
S(cubes, only(np.arange(400)), frozen(), cubes, only(np.arange(400, 632)), shifted(0.45, 5e-3))
K("goals_for_readings", "The controller's own goal poses stand in place of readings.")
S(cubes, put(p=lambda c: c.goal[:, :3], R=lambda c: Rotation.from_euler("xyz", c.goal[:, 3:])))
K("cubes_geometry_only", "Gears err.", "shoulder_pan", "shoulder_lift", "elbow", "wrist", BOLTED)
S(cubes, asked("--geometry-only"))
K("cubes_readings_shuffled", "Readings belong to other rows.")(cubes, rows(lambda c: c.rng.permutation(632)))
K("sockets_two_millimetres_wrong", "The distance is.", "distance", "apart")(on_plates("panda_3", "0.052"))
K("sockets_half_a_millimetre_wrong", "The distance is.", "distance", "apart")(on_plates("panda_4", "0.0505"))
K("sockets_with_their_distance", "Sockets as they are.", "distance", "apart", shown="if missed")(on_plates("panda_3"))

if not DATA.is_dir():
    KINDS.pop("real")
