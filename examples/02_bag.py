"""A bag in, a calibrated arm out: what ``modcal calibrate bags/ur10_cell`` does, in Python."""

from pathlib import Path

import modcal

BAG = Path(__file__).resolve().parent.parent / "bags" / "ur10_cell"

bag = modcal.read_bag(BAG)  # topics=["tracker/pose=/vrpn/tool/pose"] where they have other names
robot = bag.robot(tip="tool0")  # or modcal.Robot.from_urdf("ur10.urdf", tip="tool0")
samples = bag.samples(robot)
print(f"{len(samples)} samples at {samples.stations} stations, by {samples.origin.instrument}")

result = modcal.calibrate(robot, samples, seed=0, tolerance_mm=0.2)
print(result.report)

for stage in ("nominal", "geometric", "final"):
    print(f"{stage}: {result.report.size_mm(stage).rms:.3f} mm RMS on stations that no fit has seen")
result.save("out", page=False)
print(sorted(path.name for path in Path("out").iterdir()))
