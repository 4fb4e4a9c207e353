"""Where to measure: stations from which the arm is calibrated best, in an order that it can drive."""

from pathlib import Path

import numpy as np

import modcal

URDF = Path(__file__).resolve().parent / "robots" / "ur10.urdf"

robot = modcal.Robot.from_urdf(URDF, tip="tool0")
plan = modcal.plan(robot, stations=20, reading="pose", seed=0)

print(f"{plan.distinct} stations, {len(plan.q) - plan.distinct} of them visited twice")
print(
    f"to be claimed after calibration: at most {plan.expected.claim.mm['p95'].ci95[1]:.3f} mm (95 % of the workspace)"
)
left, at_random = plan.expected.left, plan.expected.at_random
print(f"the fit leaves {1e3 * left:.3f} mm RMS, of as many stations at random {1e3 * at_random:.3f} mm")
np.savetxt("stations.csv", plan.q, delimiter=",", header=",".join(robot.names))
