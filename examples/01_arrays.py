"""Arrays in, a calibrated arm out: joint positions and what a laser tracker saw of a ball on the flange.

The real arm is played by a UR5 whose links are displaced by 1 mm and 1 mrad; a script of yours reads its own files.
"""

import numpy as np
from scipy.spatial.transform import Rotation

import modcal

TABLE = [  # theta, d, a, alpha of the nominal model [rad, m]
    (0, 0.089159, 0, np.pi / 2), (0, 0, -0.425, 0), (0, 0, -0.39225, 0),
    (0, 0.10915, 0, np.pi / 2), (0, 0.09465, 0, -np.pi / 2), (0, 0.0823, 0, 0),
]  # fmt: skip
NAMES = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
rng = np.random.default_rng(1)


def pose(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), position
    return T


BENT = [pose(1e-3 * rng.normal(size=3), 1e-3 * rng.normal(size=3)) for _ in TABLE]
T_TRACKER_BASE = pose([0.1, -0.2, 1.2], [2.0, 0.5, 0.3])


def measured(q):
    """Where the tracker sees the ball, (3,), with 0.03 mm of noise."""
    T = T_TRACKER_BASE
    for angle, (theta, d, a, alpha), bent in zip(q, TABLE, BENT, strict=True):
        T = T @ pose([0, 0, theta + angle], [0, 0, d]) @ pose([alpha, 0, 0], [a, 0, 0]) @ bent
    return (T @ [0.03, 0.0, 0.08, 1.0])[:3] + 3e-5 * rng.normal(size=3)


q = rng.uniform(-2.5, 2.5, (120, 6))
p = np.array([measured(row) for row in q])

rows = [
    dict(zip(("name", "theta", "d", "a", "alpha"), (n, *r), strict=True)) for n, r in zip(NAMES, TABLE, strict=True)
]
robot = modcal.Robot.from_dh({"joints": rows})
samples = modcal.Samples.from_arrays(q, points=p)
result = modcal.calibrate(robot, samples, seed=0)

print(result.report)
print(result.message)

# where the ball is in postures that nobody measured
q_new = rng.uniform(-2.5, 2.5, (20, 6))
predicted = result.calibration.predict(q_new)[:, :3, 3]
missed = np.linalg.norm(predicted - [measured(row) for row in q_new], axis=1)
print(f"20 new postures are predicted to {1e3 * np.sqrt(np.mean(missed**2)):.3f} mm RMS")
result.save("out", page=False)  # page: report.html as well
