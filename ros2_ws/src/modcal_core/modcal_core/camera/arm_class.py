"""A stated error of the nominal arm, as a size of its parameters' prior."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.geometry.so3 import Array


def arm_size(poses: ArmPoses, error_m: float, q: Array) -> float:
    """The factor of the prior at which the nominal arm is off by this RMS [m] at the tool, over postures q (M, n).

    What base and tool can take of it is left out: camera and target are placed by the same images.
    """
    _, motions = poses.at_postures(q).tool_motions(poses.start)
    J = motions[:, :3].reshape(-1, motions.shape[2])
    arm = poses.of_arm
    if poses.faults is None:
        return 1.0
    basis, singular, _ = np.linalg.svd(J[:, ~arm], full_matrices=False)
    basis = basis[:, singular > 1e-9 * singular[0]]
    faults = J[:, arm] @ np.linalg.cholesky(poses.faults.covariance())
    rest = faults - basis @ (basis.T @ faults)
    rms = float(np.sqrt((rest**2).sum() / len(q)))
    return error_m / max(rms, 1e-12)
