"""What does the nominal model lack? An unmodelled gear error in the elbow, read from the report with its verdict."""

from pathlib import Path

import numpy as np

import modcal

URDF = Path(__file__).resolve().parent / "robots" / "ur10.urdf"
TEETH, AMPLITUDE = 101, 2e-4  # of the gear: its error repeats so often a turn, with so many radians
rng = np.random.default_rng(3)
robot = modcal.Robot.from_urdf(URDF, tip="tool0")

# What the joints report is not where they are: the elbow is off by its gear, all of them by a zero.
q = rng.uniform(-2.5, 2.5, (160, 6))
stands = q + 1e-3 * rng.normal(size=6)
stands[:, 2] += AMPLITUDE * np.sin(TEETH * q[:, 2] + 0.4)
ball = np.array([0.05, 0.0, 0.12, 1.0])
p = (robot.forward(stands) @ ball)[:, :3] + 2e-5 * rng.normal(size=(160, 3))

report = modcal.calibrate(robot, modcal.Samples.from_arrays(q, points=p, frame="base_plate")).report
for effect in report.effects:
    sizes = ", ".join(f"{name} {x:.4g} ± {std:.1g} {unit}" for name, (x, std, unit) in effect.parameters.items())
    print(f"{effect.family} at {effect.place} by {effect.driver}: {sizes}; p = {effect.p_value:.1g}")
    print(f"  {1e3 * effect.before:.3f} mm RMS without it, {1e3 * effect.after:.3f} mm with it")
print(report.status, *report.open_because, sep="\n  ")  # at_floor, open or cannot_tell, and why
print(report.verdict)
print(report.to_data()["error_mm"]["final"])  # the data of report.json
