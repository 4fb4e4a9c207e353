"""FIGAROH through its BaseCalibration, as its examples do: positions; all six parameters of a joint are candidates."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from league.arm import Array, align, pose
from league.task import Answer, Task

FEW = 100  # readings for the rough base and tool, and for the choice of parameters


def answer(task: Task) -> Answer:
    """FIGAROH's choice of parameters by the excitation of the readings."""
    import yaml
    from figaroh.calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm
    from figaroh.tools.load_robot import load_robot

    class PointCalibration(BaseCalibration):
        """What is measured is positions in metres, so the plain difference is the residual."""

        def cost_function(self, var: Array) -> Array:
            return self.PEE_measured - calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)

    arm = task.arm
    names, q, position = list(arm.names), task.q[task.train], task.position
    some = np.random.default_rng(0).permutation(len(q))[:FEW]
    with tempfile.TemporaryDirectory() as folder:
        urdf, readings, config = (Path(folder) / name for name in ("arm.urdf", "readings.csv", "config.yaml"))
        urdf.write_text(arm.urdf())
        head = ",".join(["x1", "y1", "z1", *names])
        np.savetxt(readings, np.hstack([position[some], q[some]]), delimiter=",", header=head, comments="", fmt="%.17g")
        asked = {
            "enabled": True,
            "parameters": {"calibration_level": "full_params", "estimation": {"method": "excitation"}},
            "kinematics": {"base_frame": "universe", "tool_frame": "tip"},
            "measurements": {
                "markers": [{"measurable_dof": [True, True, True, False, False, False]}],
                "poses": {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6},
            },
            "data": {"source_file": str(readings), "number_of_samples": len(some)},
        }
        robot = {"name": "arm", "properties": {"joints": {"active_joints": names}}}
        config.write_text(yaml.safe_dump({"robot": robot, "tasks": {"calibration": asked}}))
        work = PointCalibration(load_robot(str(urdf), load_by_urdf=True), str(config))
        work.calib_config.update(known_baseframe=False, known_tipframe=False)
        work.initialize()
    guess = work.initial_frame_guess()
    start = np.array([guess.get(name, 0.0) for name in work.calib_config["param_name"]])
    # positions go by component
    work.q_measured, work.PEE_measured = q, position.T.ravel()
    work.calib_config["NbSample"] = len(q)
    result, _ = work.solve_optimisation(var_init=start)
    all_rows = {**work.calib_config, "NbSample": len(task.q)}
    seen = calc_updated_fkm(work.model, work.data, result.x, task.q, all_rows).reshape(3, -1).T
    # orientations, which only a tool that is fitted again asks for: nominal ones, in the base that suits the positions
    T = arm.frames(task.q)[:, -1]
    base, _ = align(T, seen)
    return Answer(pose(base[:3, :3] @ T[:, :3, :3], seen), parameters=len(start), oriented=False)
