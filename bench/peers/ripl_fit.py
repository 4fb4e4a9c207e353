"""Hinges fitted to poses by ripl_articulation, as its own test does. Usage: ripl_fit.py POSES.npz.

The file holds poses (K, N, 4, 4) of K handles, and the noise position [m] and rotation [rad] of every axis, which it is
told. Printed are a point on the axis and the axis of each, six numbers in a row.
"""

from __future__ import annotations

import json
import statistics
import sys
import time

import gtsam
import numpy as np
from ripl_articulation import solve_articulation_from_poses
from ripl_articulation.utils import compute_twist_center


def main() -> None:
    data = np.load(sys.argv[1])
    rotation, position = float(data["rotation"]), float(data["position"])
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [position] * 3))
    times, found = [], []
    for poses in data["poses"]:
        first = poses[0]
        # the twist is that between two poses which ought to coincide at rest: the handle's start, and the handle
        starts = np.repeat(first[None], len(poses), axis=0)
        farthest = poses[np.argmax(np.linalg.norm(poses[:, :3, 3] - first[:3, 3], axis=1))]
        moved = np.require(np.linalg.inv(first) @ farthest, requirements="F")
        guess = gtsam.Pose3.Logmap(gtsam.Pose3(moved))
        begun = time.process_time()
        twist, _ = solve_articulation_from_poses(starts, poses, prior_xi=guess, pose_noise_model=noise)
        times.append(1e3 * (time.process_time() - begun))
        axis = first[:3, :3] @ twist[:3]
        found += [*compute_twist_center(first, twist), *(axis / np.linalg.norm(axis))]
    print(json.dumps({"ms": statistics.median(times), "found": [float(x) for x in found]}))


if __name__ == "__main__":
    main()
