"""Is a calibration still good? It is saved, loaded, and scored on data that came later, after the tool was changed."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import modcal

URDF = Path(__file__).resolve().parent / "robots" / "ur10.urdf"
rng = np.random.default_rng(2)
robot = modcal.Robot.from_urdf(URDF, tip="tool0")


def pose(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), position
    return T


# The real arm's encoders are off by a milliradian each, and its flange sits askew; the tracker stands two metres away.
ZEROS = 1e-3 * rng.normal(size=6)
BENT = pose([2e-3, -1e-3, 0.0], [1e-3, 0.0, -5e-4])
T_TRACKER_BASE = pose([0.1, 0.0, -0.7], [2.0, 1.0, 0.0])


def recorded(count, tool):
    """Postures (count, 6) and what the tracker says of the tool, (count, 4, 4), with noise."""
    q = rng.uniform(-2.5, 2.5, (count, 6))
    noise = np.array([pose(5e-5 * rng.normal(size=3), 5e-5 * rng.normal(size=3)) for _ in q])
    return q, T_TRACKER_BASE @ robot.forward(q + ZEROS) @ BENT @ tool @ noise


q, T = recorded(60, pose([0.3, 0.0, 0.0], [0.0, 0.02, 0.10]))
result = modcal.calibrate(robot, modcal.Samples.from_arrays(q, poses=T), geometry_only=True)
path = result.calibration.save("calibration.yaml")

frozen = modcal.Calibration.load(path)
q, T = recorded(40, pose([0.3, 0.1, 0.0], [0.0, 0.02, 0.15]))  # another tool
samples = modcal.Samples.from_arrays(q, poses=T)
as_it_was = modcal.evaluate(frozen, samples)
refitted = modcal.evaluate(frozen, samples, refit_tool=True)
print(f"with the old tool: {as_it_was.size_mm('final').rms:.2f} mm RMS")
print(f"with the tool found again: {refitted.size_mm('final').rms:.3f} mm RMS")
print(refitted.verdict)
