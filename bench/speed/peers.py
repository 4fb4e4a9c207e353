"""Others doing the same work, each in an environment of its own under .venv-bench, and what is asked of them there.

    python peers.py mcap FILE.mcap | pybotics SAMPLES.npz | figaroh SAMPLES.npz ARM.urdf METHOD | ripl POSES.npz

prints {"ms": …, "remark": …, "found": […]}. Requirements go neither with ours nor with one another's (NumPy 1 here,
NumPy 2 there). One that cannot be installed is said in the table, and is no error. Pinocchio and rosbags stand among
the requirements of the tests.
"""

from __future__ import annotations

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ENVIRONMENTS = Path(__file__).resolve().parents[2] / ".venv-bench"
# a peer, and what it is pinned together with
PINNED = {
    "mcap": "mcap-ros2-support==0.6.0",
    "pybotics": "pybotics==3.1.2 numpy==1.26.4 scipy==1.17.1",
    "figaroh": "figaroh==1.0.2 pin==4.1.0 ndcurves==2.3.0 numpy==2.4.6 scipy==1.17.1",
    "ripl": "ripl_articulation==2025.10.20 gtsam==4.3.0 numpy==1.26.4",
}
FEW = 100


@dataclass(frozen=True)
class Answer:
    """What a peer took [ms], None where it could not be asked, and what is to be said of it. found: its solution."""

    ms: float | None
    remark: str = ""
    found: tuple[float, ...] = ()


def install() -> None:
    """Bring the environments up to the pins; quick and silent where nothing has changed."""
    stamp = ENVIRONMENTS / "pinned.json"
    if stamp.exists() and json.loads(stamp.read_text()) == PINNED:
        return
    shutil.rmtree(ENVIRONMENTS, ignore_errors=True)
    for peer, wanted in PINNED.items():
        venv = ENVIRONMENTS / peer
        print(f"modcal bench: installing {peer}", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
        pip = [sys.executable, "-m", "pip", "--python", str(venv / "bin" / "python"), "install", "-q", "--no-input"]
        try:  # what is not there after five minutes is not waited for
            subprocess.run([*pip, "--no-compile", *wanted.split()], check=True, timeout=300.0, capture_output=True)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            print(f"modcal bench: {peer} cannot be installed here, and is left out", file=sys.stderr, flush=True)
            shutil.rmtree(venv, ignore_errors=True)
    stamp.write_text(json.dumps(PINNED))


def ask(peer: str, *arguments: str, seconds: float = 300.0, arrays: dict[str, Any] | None = None) -> Answer:
    """What this file prints in the environment of a peer. arrays: of the file that is its first argument."""
    python = ENVIRONMENTS / peer / "bin" / "python"
    if not python.exists():
        return Answer(None, "not installed")
    with tempfile.TemporaryDirectory() as folder:
        if arrays is not None:
            import numpy as np

            arguments = f"{folder}/told.npz", *arguments
            np.savez(arguments[0], **arrays)
        try:
            command = [str(python), __file__, peer, *arguments]
            done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
        except subprocess.TimeoutExpired:
            return Answer(None, f"not done after {seconds:.0f} s")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["failed"])[-1]
        return Answer(None, "not installed" if "ModuleNotFoundError" in last else last[:60])
    said = json.loads(done.stdout.strip().splitlines()[-1])
    return Answer(said["ms"], said.get("remark", ""), tuple(said.get("found", ())))


def took(work: Callable[[], Any], runs: int = 1) -> tuple[float, Any]:
    """Median of the processor's times [ms], and the last result."""
    times = []
    for _ in range(runs):
        begun = time.process_time()
        result = work()
        times.append(1e3 * (time.process_time() - begun))
    return statistics.median(times), result


def mcap(file: str) -> dict[str, Any]:
    """Every message of an MCAP file decoded."""
    from mcap_ros2.reader import read_ros2_messages

    ms, count = took(lambda: sum(1 for _ in read_ros2_messages(file)), 3)
    return {"ms": ms, "remark": f"{count / ms:.0f} k messages/s"}


def pybotics(file: str) -> dict[str, Any]:
    """A UR10 fitted to positions, as the documentation of pybotics does; found: the RMS of what is left.

    Fitted are those of the DH parameters, the base and the tool's point that the readings tell apart at the start, by a
    QR of the derivative: with all of them it does not end, for two parallel axes lead to offsets of metres.
    """
    import numpy as np
    from pybotics.robot import Robot
    from scipy.linalg import qr
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    right = np.pi / 2
    # pybotics counts in millimetres; its rows are alpha, a, theta, d before the joint (modified DH)
    turned, level = (right, 0.0, 0.0), (0.0, 0.0, 0.0)
    rows = [(*level, 127.3), (*turned, 0.0), (0.0, -612.0, 0.0, 0.0), (0.0, -572.3, 0.0, 163.941), (*turned, 115.7)]
    table = np.array([*rows, (-right, 0.0, 0.0, 92.2)]).ravel()
    data = np.load(file)
    q, seen, frame, tool = data["q"], 1e3 * data["position"], data["frame"], 1e3 * data["tool"][:3, 3]

    def residual(x: np.ndarray) -> np.ndarray:
        robot = Robot.from_parameters((table + x[:24] * np.tile([1e-3, 1.0, 1e-3, 1.0], 6)).reshape(6, 4))
        R = Rotation.from_rotvec(1e-3 * x[24:27]).as_matrix() @ frame[:3, :3]
        T = np.array([robot.fk(row) for row in q])
        point = T[:, :3, :3] @ (tool + x[30:33]) + T[:, :3, 3]
        return (point @ R.T + 1e3 * frame[:3, 3] + x[27:30] - seen).ravel()

    def work() -> Any:
        still = residual(np.zeros(33))
        J = np.stack([(residual(1e-3 * row) - still) / 1e-3 for row in np.eye(33)], axis=1)
        _, R, order = qr(J, mode="economic", pivoting=True)
        size = np.abs(np.diag(R))
        chosen = np.sort(order[size > 1e-3 * size[0]])
        return least_squares(lambda v: residual(np.eye(33)[:, chosen] @ v), np.zeros(len(chosen)))

    ms, found = took(work)
    rms = float(np.sqrt(np.mean(found.fun**2)))
    return {"ms": ms, "found": [rms], "remark": f"{len(found.x)} parameters, {1e3 * rms:.1f} um left"}


def figaroh(file: str, urdf: str, method: str) -> dict[str, Any]:
    """A UR10 fitted to positions, as the examples of FIGAROH do; found: what it predicts for the postures held out.

    method: how FIGAROH chooses its parameters: "structural", which it does unless told otherwise, or "excitation". As
    on our side, finding base and tool roughly and choosing the parameters is not timed; a hundred readings do for it.
    """
    import numpy as np
    import yaml
    from figaroh.calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm
    from figaroh.tools.load_robot import load_robot

    class PointCalibration(BaseCalibration):
        """What is measured is positions in metres, so the plain difference is the residual, and the quickest one."""

        def cost_function(self, var: np.ndarray) -> np.ndarray:
            return self.PEE_measured - calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)

    data = np.load(file)
    names, q, position = [str(name) for name in data["names"]], data["q"][:FEW], data["position"][:FEW]
    with tempfile.TemporaryDirectory() as folder:
        readings, config = Path(folder) / "readings.csv", Path(folder) / "config.yaml"
        head = ",".join(["x1", "y1", "z1", *names])
        np.savetxt(readings, np.hstack([position, q]), delimiter=",", header=head, comments="", fmt="%.17g")
        task = {  # all six parameters of every joint are candidates; the tracker sees one point of the tool
            "enabled": True,
            "parameters": {"calibration_level": "full_params", "estimation": {"method": method}},
            "kinematics": {"base_frame": "universe", "tool_frame": "tool0"},
            "measurements": {
                "markers": [{"measurable_dof": [True, True, True, False, False, False]}],
                "poses": {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6},
            },
            "data": {"source_file": str(readings), "number_of_samples": len(q)},
        }
        robot = {"name": "ur10", "properties": {"joints": {"active_joints": names}}}
        config.write_text(yaml.safe_dump({"robot": robot, "tasks": {"calibration": task}}))
        work = PointCalibration(load_robot(urdf, load_by_urdf=True), str(config))
        work.calib_config.update(known_baseframe=False, known_tipframe=False)
        work.initialize()
    guess = work.initial_frame_guess()
    start = np.array([guess.get(name, 0.0) for name in work.calib_config["param_name"]])
    # the joints stand in the URDF's order, which is that of the samples; positions go by component
    work.q_measured, work.PEE_measured = data["q"], data["position"].T.ravel()
    work.calib_config["NbSample"] = len(data["q"])
    ms, (result, _) = took(lambda: work.solve_optimisation(var_init=start), 3 if len(data["q"]) <= 1_000 else 1)
    config = {**work.calib_config, "NbSample": len(data["held"])}
    seen = calc_updated_fkm(work.model, work.data, result.x, data["held"], config).reshape(3, -1).T
    return {"ms": ms, "found": seen.ravel().tolist(), "remark": f"{len(start)} parameters"}


def ripl(file: str) -> dict[str, Any]:
    """Hinges fitted to poses, as the test of ripl_articulation does; found: a point on the axis and the axis of each.

    The twist is that between two poses which ought to coincide at rest: the handle's start, and the handle.
    """
    import gtsam
    import numpy as np
    from ripl_articulation import solve_articulation_from_poses
    from ripl_articulation.utils import compute_twist_center

    data = np.load(file)
    sigmas = np.array([float(data["rotation"])] * 3 + [float(data["position"])] * 3)
    noise, times, found = gtsam.noiseModel.Diagonal.Sigmas(sigmas), [], []
    for poses in data["poses"]:
        first = poses[0]
        starts = np.repeat(first[None], len(poses), axis=0)
        farthest = poses[np.argmax(np.linalg.norm(poses[:, :3, 3] - first[:3, 3], axis=1))]
        moved = np.require(np.linalg.inv(first) @ farthest, requirements="F")
        about = {"prior_xi": gtsam.Pose3.Logmap(gtsam.Pose3(moved)), "pose_noise_model": noise}
        ms, (twist, _) = took(lambda s=starts, p=poses, a=about: solve_articulation_from_poses(s, p, **a))
        times.append(ms)
        axis = first[:3, :3] @ twist[:3]
        found += [*compute_twist_center(first, twist), *(axis / np.linalg.norm(axis))]
    return {"ms": statistics.median(times), "found": [float(x) for x in found]}


if __name__ == "__main__":
    peer = {"mcap": mcap, "pybotics": pybotics, "figaroh": figaroh, "ripl": ripl}[sys.argv[1]]
    print(json.dumps(peer(*sys.argv[2:])))
