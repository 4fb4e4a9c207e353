"""A Delta robot whose arms are not as long as they were drawn: measured points in, its constants out."""

import numpy as np
from scipy.optimize import fsolve

import modcal

rng = np.random.default_rng(8)
DRAWN = {"offset": 0.12, "proximal": 0.20, "distal": 0.46}  # m
AZIMUTH = np.array([0.0, 2.0, -2.0]) * np.pi / 3.0
offset, proximal, distal = (DRAWN[name] + 5e-4 * rng.normal(size=3) for name in DRAWN)
zero = 2e-3 * rng.normal(size=3)
T = np.array([0.3, -0.2, 1.5])  # of the base in the tracker's frame, which is parallel to it


def measured(q):
    """Where the platform is, (3,): as far from each elbow as its rod is long; with 0.02 mm of noise."""
    out, down = offset + proximal * np.cos(q + zero), -proximal * np.sin(q + zero)
    elbows = np.stack([out * np.cos(AZIMUTH), out * np.sin(AZIMUTH), down], axis=1)
    p = fsolve(lambda p: np.linalg.norm(p - elbows, axis=1) - distal, [0.0, 0.0, -0.5], xtol=1e-12)
    return p + T + 2e-5 * rng.normal(size=3)


robot = modcal.Robot.delta(["arm_1", "arm_2", "arm_3"], **DRAWN)
q = rng.uniform(0.0, 0.9, (100, 3))
p = np.array([measured(row) for row in q])
result = modcal.calibrate(robot, modcal.Samples.from_arrays(q, points=p), geometry_only=True)

print(result.report.verdict)
for name, found, drawn in zip(("offset", "proximal", "distal"), result.calibration.calibrated.chain.constants[3:],
                              DRAWN.values(), strict=True):  # fmt: skip
    print(f"{name}: {np.round(1e3 * (found - drawn), 2)} mm longer than drawn")
