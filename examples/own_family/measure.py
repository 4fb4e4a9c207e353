"""An arm whose elbow winds up against its friction, measured at 120 stations: ``measure.py OUT.csv [RAD_PER_NM]``.

The arm is MuJoCo's reading of the URDF, with bodies that lie a little off; nothing of modcal takes part.
"""

import csv
import sys
from pathlib import Path

import mujoco
import numpy as np

URDF = Path(__file__).resolve().parents[1] / "robots" / "ur10.urdf"
KEEP = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'  # else the flange becomes a part of the wrist
TRACKER = np.array([3.0, 0.4, -0.6])  # m, seen from the base
REFLECTOR = np.array([0.05, 0.0, 0.12])  # m, seen from the flange
ELBOW, STATIONS = 2, 120

rng = np.random.default_rng(7)
model = mujoco.MjModel.from_xml_string(URDF.read_text().replace("</robot>", KEEP))
data = mujoco.MjData(model)
model.body_pos[2:] += 3e-4 * rng.normal(size=model.body_pos[2:].shape)
for quaternion in model.body_quat[2:]:
    mujoco.mju_quatIntegrate(quaternion, 5e-4 * rng.normal(size=3), 1.0)


def at(q):
    """MuJoCo's arm at these joint positions: the holding torques (6,) [N m], and the reflector (3,) [m]."""
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    flange = data.body("tool0")
    return data.qfrc_bias.copy(), flange.xpos + flange.xmat.reshape(3, 3) @ REFLECTOR


windup = float(sys.argv[2]) if len(sys.argv) > 2 else 6e-6  # rad per N m
with Path(sys.argv[1]).open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["Point", *(f"J{k} [deg]" for k in range(1, 7)), "X [mm]", "Y [mm]", "Z [mm]"])
    before = np.zeros(6)
    for i in range(STATIONS):
        q = rng.uniform(-2.5, 2.5, 6)
        stands = q + 1e-5 * rng.normal(size=6)
        stands[ELBOW] += windup * np.sign(q[ELBOW] - before[ELBOW]) * abs(at(q)[0][ELBOW])
        point = at(stands)[1] - TRACKER + 2e-5 * rng.normal(size=3)
        table.writerow([f"P{i + 1}", *(f"{x:.6f}" for x in np.degrees(q)), *(f"{1e3 * x:.4f}" for x in point)])
        before = q
