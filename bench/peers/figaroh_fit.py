"""A UR10 fitted to positions by FIGAROH, as its examples do. Usage: figaroh_fit.py SAMPLES.npz ARM.urdf METHOD.

The file holds names (6,), q (N, 6), position (N, 3), held (M, 6). METHOD is how FIGAROH chooses its parameters:
"structural", which it does unless told otherwise, or "excitation". Printed are the positions it predicts for the
postures held out, in a row. As on our side, finding base and tool roughly and choosing the parameters is not timed; a
hundred readings do for it.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from figaroh.calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot

FEW = 100


class PointCalibration(BaseCalibration):
    """What is measured is positions in metres, so the plain difference is the residual, and the quickest one."""

    def cost_function(self, var: np.ndarray) -> np.ndarray:
        return self.PEE_measured - calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)


def settings(names: list[str], readings: Path, count: int, method: str) -> dict[str, Any]:
    """All six parameters of every joint are candidates; the tracker sees one point of the tool."""
    task = {
        "enabled": True,
        "parameters": {"calibration_level": "full_params", "estimation": {"method": method}},
        "kinematics": {"base_frame": "universe", "tool_frame": "tool0"},
        "measurements": {
            "markers": [{"measurable_dof": [True, True, True, False, False, False]}],
            "poses": {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6},
        },
        "data": {"source_file": str(readings), "number_of_samples": count},
    }
    robot = {"name": "ur10", "properties": {"joints": {"active_joints": names}}}
    return {"robot": robot, "tasks": {"calibration": task}}


def prepared(data: Any, urdf: str, method: str) -> PointCalibration:
    """A calibration whose parameters are chosen, from the first readings."""
    names = [str(name) for name in data["names"]]
    q, position = data["q"][:FEW], data["position"][:FEW]
    with tempfile.TemporaryDirectory() as folder:
        readings, config = Path(folder) / "readings.csv", Path(folder) / "config.yaml"
        head = ",".join(["x1", "y1", "z1", *names])
        np.savetxt(readings, np.hstack([position, q]), delimiter=",", header=head, comments="", fmt="%.17g")
        config.write_text(yaml.safe_dump(settings(names, readings, len(q), method)))
        work = PointCalibration(load_robot(urdf, load_by_urdf=True), str(config))
        work.calib_config.update(known_baseframe=False, known_tipframe=False)
        work.initialize()
    return work


def main() -> None:
    data = np.load(sys.argv[1])
    work = prepared(data, sys.argv[2], sys.argv[3])
    guess = work.initial_frame_guess()
    start = np.array([guess.get(name, 0.0) for name in work.calib_config["param_name"]])
    # the joints stand in the URDF's order, which is that of the samples; positions go by component
    work.q_measured, work.PEE_measured = data["q"], data["position"].T.ravel()
    work.calib_config["NbSample"] = len(data["q"])
    times = []
    for _ in range(3 if len(data["q"]) <= 1_000 else 1):
        begun = time.process_time()
        result, _ = work.solve_optimisation(var_init=start)
        times.append(1e3 * (time.process_time() - begun))
    config = {**work.calib_config, "NbSample": len(data["held"])}
    seen = calc_updated_fkm(work.model, work.data, result.x, data["held"], config).reshape(3, -1).T
    said = {"ms": statistics.median(times), "found": seen.ravel().tolist(), "remark": f"{len(start)} parameters"}
    print(json.dumps(said))


if __name__ == "__main__":
    main()
