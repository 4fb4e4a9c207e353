"""One fit of arm, camera, target and lens, as several tests ask for it."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
from camera.boards import BOARD
from camera.scenes import CameraScene, scene

from modcal_core.calibration import Model
from modcal_core.camera.arm_poses import ArmPoses, with_parameters
from modcal_core.camera.corners import CameraState, CommonPrior, CornerTable
from modcal_core.camera.fit import Camera, CameraFit, CameraImages, Cameras
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting, board_poses, find_mounting
from modcal_core.camera.solve import CameraProblem, CameraSolution, solve_camera
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots import Chain, chain_forward

FLAT = np.zeros(5)
MEASURED = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2, 0.12), "rulers", RULER_STD_M))
AS_DRAWN = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2, 0.12), "rulers"))  # which anybody states


@cache
def images(on_tip: bool) -> CameraScene:
    return scene(1, on_tip, count=20, board=MEASURED)


def arm_poses(chain: Chain, q: Array, velocity: Array, found: Mounting) -> ArmPoses:
    """The nominal arm at N images, base and tool as found."""
    frame = "target" if found.camera_on_tip else "camera"
    model = Model(chain, (frame,), found.T_frame_base[None], found.T_tip_tool)
    return with_parameters(ArmPoses(model, (), q, velocity, found.camera_on_tip))


def start(s: CameraScene, velocity: float = 0.0) -> tuple[CornerTable, ArmPoses]:
    table = CornerTable.of(s.views, s.board)
    found = find_mounting(chain_forward(s.chain, s.q), board_poses(table, s.lens, FLAT))
    moving = np.full_like(s.q, velocity)
    return table, arm_poses(s.chain, s.q, moving, found)


def alone(table: CornerTable, poses: ArmPoses, prior: CommonPrior, lens: Lens) -> Cameras:
    """One camera, and nothing beside it."""
    images = CameraImages(poses.q, (), table.target, lens.size)
    base, tool = poses.model.T_frame_base[0], poses.model.T_tip_tool
    mounting = Mounting(poses.camera_on_tip, base, tool, tool[None], 0.0, np.inf, np.zeros(3), np.empty(0))
    begin = CameraState(poses.values.start, 0.0, np.r_[lens.values, prior.mean[len(lens.values) :]], lens)
    return Cameras((Camera(images, mounting, table, poses, prior, begin, {}),))


def problem(s: CameraScene, *further: CameraImages, **options: object) -> CameraProblem:
    """options: of the images, or of the problem."""
    own = {one.name for one in fields(CameraImages)} & set(options)
    images = {name: options.pop(name) for name in own}
    first = CameraImages(s.q, s.views, s.board, s.lens.size, **images)  # type: ignore[arg-type]
    return CameraProblem(s.chain, (first, *further), **options)  # type: ignore[arg-type]


def solved(s: CameraScene, *further: CameraImages, **options: object) -> CameraSolution:
    return solve_camera(problem(s, *further, **options), np.random.default_rng(3))


def true_error(s: CameraScene, fit: CameraFit, q: Array) -> float:
    """RMS distance of the flange, as the model has it on the tool, from the truth [m]."""
    tip = se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3]
    model = fit.poses.model_at(fit.state.values).predict(q)
    return float(np.sqrt(((se3.apply(model, tip) - se3.apply(s.truth(q), tip)) ** 2).sum(1).mean()))
