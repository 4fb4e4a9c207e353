"""Tables with what people make of them: a bad row, a zero far off, joints counted otherwise, several targets.

Arms, motions and noise are those of ``sheet``; a fault is a change of the joints or of the readings that are written.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from judging import same_rigid
from scipy.spatial.transform import Rotation
from sheet import ARMS, DIGITS, LENGTH, Array, Sheet, Written, nominal, record

FAULTS = ("bad row", "zero", "coupled", "reversed", "quarter turn", "targets", "by row", "ten rows", "two faults")


def draw(seed: int, folder: Path) -> Written:
    """One table, of joints and points or poses; joints that the description means are the truth."""
    rng = np.random.default_rng([seed, 5])
    fault, robot = FAULTS[seed % len(FAULTS)], str(rng.choice(list(ARMS)))
    recorded = record(robot, rng, 10 if fault == "ten rows" else int(rng.integers(40, 90)))
    T, told, N, n = recorded.T.copy(), recorded.q.copy(), *recorded.q.shape
    about: dict[str, Any] = {"robot": robot, "fault": fault, "scenario": "apart"}
    j = int(rng.integers(1, n - 1))
    if fault in ("bad row", "two faults"):
        for row in rng.choice(np.arange(1, N), int(rng.integers(1, 4)), replace=False):
            T[row] = T[row - 1] if rng.random() < 0.5 else T[int(rng.integers(N))]
    if fault in ("zero", "two faults"):
        told[:, j] += np.radians(rng.uniform(1.5, 5.0)) * rng.choice([-1.0, 1.0])
        recorded = replace(recorded, q=told.copy())  # the table is right; the arm differs from its drawing
    if fault == "coupled":
        told[:, j + 1 if j + 1 < n else 1] -= rng.choice([-1.0, 1.0]) * told[:, j]
    if fault == "reversed":
        told[:, j] *= -1.0
    if fault == "quarter turn":
        told[:, j] += rng.choice([-0.5, 0.5, 1.0]) * np.pi
    extra = Sheet(".")
    if fault == "targets":
        which = rng.integers(0, 3, N)
        places = np.r_[np.zeros((1, 3)), rng.uniform(0.06, 0.2, (2, 3))]
        T[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], places[which])
        extra.add("target", which + 1.0, 0)
        order = np.argsort([list(dict.fromkeys(which)).index(k) for k in which], kind="stable")
        recorded = replace(recorded, q=recorded.q[order], T=recorded.T[order])
        about["order"] = True
        T_true = T[order]
    else:
        T_true = T
    posed = fault != "targets" and rng.random() < 0.4
    unit, degrees = str(rng.choice(["mm", "m"])), bool(rng.random() < 0.7)
    tracker, robot_sheet = Sheet("."), Sheet(".")
    tracker.add_all(["X", "Y", "Z"], LENGTH[unit] * T[:, :3, 3], DIGITS[unit])
    if posed:
        tracker.add_all(["qx", "qy", "qz", "qw"], Rotation.from_matrix(T[:, :3, :3]).as_quat(), 7)
    q = np.degrees(told) if degrees else told
    robot_sheet.add_all([f"J{k + 1}" for k in range(n)], q, 5 if degrees else 7)
    sheets = [robot_sheet, tracker] if fault == "by row" else [robot_sheet]
    if fault != "by row":
        for other in (extra, tracker):
            robot_sheet.labels += other.labels
            robot_sheet.cells += other.cells
    paths = []
    for k, sheet in enumerate(sheets):
        paths.append(folder / f"others_{seed:04d}_{k}.csv")
        paths[-1].write_text(sheet.text(rng, np.arange(N)), encoding="utf-8")
    kind = "pose" if posed else "point"
    return Written(paths, replace(recorded, T=T_true), {kind: [T_true]}, np.ones(N, bool), about=about)


def judged(written: Written, recording: Any) -> str:
    """Of joints and their points: "right", or what is wrong."""
    (joints,), (reading,), truth = recording.joints, recording.readings, written.recorded
    q: Array = joints.position[:, [joints.names.index(name) for name in truth.names]]
    arm = nominal(truth.robot)
    A, B = (np.tile(np.eye(4), (len(q), 1, 1)) for _ in range(2))
    for T, values in ((A, q), (B, truth.q)):
        T[:, :3, 3], T[:, :3, :3] = arm.tool(values, np.zeros(3))
    gap, turn = same_rigid(A, B)  # a joint that turns the other way may be half a turn of its neighbours
    if gap > 1e-4 or turn > 1e-3:
        return f"the arm is off by {gap:.3g} m, {turn:.3g} rad"
    (kind,) = written.readings
    if reading.kind != kind:
        return f"{reading.kind} of a {kind}"
    a, b = (x - x.mean(axis=0) for x in (truth.T[:, :3, 3], reading.values[:, :3]))
    gap = abs(float(np.linalg.norm(b) / np.linalg.norm(a)) - 1.0)
    return "right" if gap < 1e-3 else f"positions scaled by {1.0 + gap:.3g}"
