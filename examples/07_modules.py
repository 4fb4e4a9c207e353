"""An arm bolted together from modules: its kinematics from the list of modules, then calibrated as any other arm."""

import numpy as np
from scipy.spatial.transform import Rotation

import modcal

rng = np.random.default_rng(7)
# (size, turn) of the base, then of each joint and link: joint, turn of the link on it, link, size, turn of what follows
parts = [("JR", 1, "LR-I", 4, 0), ("JR", 0, "LP", 7, 2), ("JR", 0, "LP", 7, 2), ("JR", 2, "LR-II", 7, 2)]
assembly = modcal.Assembly.build((0, 1), [*parts, ("JR", 1, "LC", 6, 1)], name="five_joints")
robot = modcal.Robot.from_modules(assembly)
print(f"{robot.name}: {', '.join(robot.names)}; at zero its gripper is at {robot.forward(np.zeros(robot.n))[:3, 3]} m")

# Flanges do not meet exactly: where joints stand is off by milliradians. A tracker sees poses of the gripper.
ZEROS = 2e-3 * rng.normal(size=robot.n)
q = rng.uniform(-2.0, 2.0, (60, robot.n))
T = robot.forward(q + ZEROS)
T[:, :3, 3] += 3e-5 * rng.normal(size=(60, 3))
T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(3e-5 * rng.normal(size=(60, 3))).as_matrix()

result = modcal.calibrate(robot, modcal.Samples.from_arrays(q, poses=T, names=robot.names), geometry_only=True)
print(result.report.verdict)

q_new = rng.uniform(-2.0, 2.0, (20, robot.n))
missed = result.calibration.predict(q_new)[:, :3, 3] - robot.forward(q_new + ZEROS)[:, :3, 3]
print(f"new postures are predicted to {1e3 * np.sqrt(np.mean(np.sum(missed**2, axis=1))):.3f} mm RMS")
