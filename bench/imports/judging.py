"""Whether the recording that a proposed mapping makes is what was written: all of it, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from run import same_rigid
from scipy.spatial.transform import Rotation
from sheet import Written

from modcal_msgs_py.tables import read_tables

_KINDS = {"range": "range", "bearing": "bearing", "plane": "touch", "pose": "pose", "body": "pose", "point": "point"}


def judged(written: Written, mapping: dict, folder: Path) -> tuple[str, list[str]]:
    """("right", "less" or "wrong", reasons). less: columns that were not used; wrong: used, and not what they are."""
    tables = read_tables(mapping, folder, "bench")
    recording, truth = tables.recording, written.recorded
    (joints,) = recording.joints
    wrong: list[str] = []
    less: list[str] = []
    if set(joints.names) != set(truth.names):
        return "wrong", [f"joints {joints.names}"]
    order = [joints.names.index(n) for n in truth.names]
    rows = np.flatnonzero(written.whole)
    if len(joints.stamps) != len(truth.q) and len(joints.stamps) != len(rows):
        return "wrong", [f"{len(joints.stamps)} joint states of {len(truth.q)}"]
    every = np.arange(len(truth.q)) if len(joints.stamps) == len(truth.q) else rows
    if np.abs(joints.position[:, order] - truth.q[every]).max() > 1e-4:
        wrong.append("joints")
    if written.velocity is not None:
        v = joints.velocity[:, order]
        if np.isnan(v).all():  # nobody can tell the unit of a standing arm's speeds where no label does
            less += ["velocity"] if written.about["scenario"] == "moving" or written.about["velocity_told"] else []
        elif np.abs(v - written.velocity[every]).max() > max(1e-3, 1e-2 * np.abs(written.velocity).max()):
            wrong.append("velocity")
    elif not np.isnan(joints.velocity).all():
        wrong.append("velocity of nothing")
    if written.effort is not None:
        e = joints.effort[:, order]
        if np.isnan(e).all():
            less.append("effort")
        elif np.abs(e - written.effort[every]).max() > 2e-3:
            wrong.append("effort")
    elif not np.isnan(joints.effort).all():
        wrong.append("effort of nothing")
    if written.commanded is not None:
        found = tables.commanded
        if found is None:
            less.append("commanded")
        elif (
            np.abs(found.position[:, [found.names.index(n) for n in truth.names]] - written.commanded[every]).max()
            > 1e-4
        ):
            wrong.append("commanded")
    elif tables.commanded is not None:
        wrong.append("commanded of nothing")
    kinds = {kind: [r for r in recording.readings if r.kind == _KINDS[kind]] for kind in written.readings}
    if sum(map(len, kinds.values())) != len(recording.readings):
        wrong.append(f"readings {[r.kind for r in recording.readings]}")
    for kind, instruments in written.readings.items():
        if len(kinds[kind]) != len(instruments):
            (less if len(kinds[kind]) < len(instruments) else wrong).append(f"{len(kinds[kind])} of {kind}")
        for track, values in zip(kinds[kind], instruments, strict=False):
            if len(track.stamps) != len(rows):
                wrong.append(f"{kind}: {len(track.stamps)} readings of {len(rows)}")
            elif (said := _differs(kind, track.values, values[rows], truth.T[rows])) is not None:
                wrong.append(said)
    (first, *_) = recording.readings
    if written.std is not None:
        if first.stated is None or np.isnan(first.stated[:, 0]).all():
            less.append("std")
        elif np.abs(first.stated[:, 0] / written.std[rows] - 1.0).max() > 0.1:
            wrong.append("std")
    elif first.stated is not None and not np.isnan(first.stated[:, 0]).all():
        wrong.append("std of nothing")
    found = [s.values[:, 0] for s in recording.signals]
    for values in written.signals:
        near = [v for v in found if len(v) in (len(values), len(rows)) and np.abs(np.sort(v) - np.sort(
            values if len(v) == len(values) else values[rows])).max() < 2e-3]  # fmt: skip
        if not near:
            less.append("signal")
    return ("wrong", wrong + less) if wrong else ("less", less) if less else ("right", [])


def _differs(kind: str, got: np.ndarray, true: np.ndarray, T: np.ndarray) -> str | None:
    if kind in ("range", "plane"):
        gap = float(np.abs(got[:, 0] - true).max())
        return None if gap < 2e-6 else f"{kind} off by {gap:.3g} m"
    if kind == "bearing":  # but for a turn of the station
        U, _, Vt = np.linalg.svd(got.T @ true)
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        gap = float(np.linalg.norm(got - true @ R.T, axis=1).max())
        return None if gap < 1e-5 else f"bearing off by {gap:.3g} rad"
    made = np.tile(np.eye(4), (len(got), 1, 1))
    made[:, :3, 3] = got[:, :3]
    if kind == "point":
        a, b = true[:, :3, 3], got[:, :3]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        U, _, Vt = np.linalg.svd(b.T @ a)
        gap = float(
            np.median(np.linalg.norm(b - a @ (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T, axis=1))
        )
        return None if gap < 2e-6 else f"points off by {gap:.3g} m"
    made[:, :3, :3] = Rotation.from_quat(got[:, 3:]).as_matrix()
    gap, turn = same_rigid(T, made)
    near = (3e-4, 4e-3) if kind == "body" else (5e-6, 2e-5)  # of a body its targets' own noise is left
    return None if gap < near[0] and turn < near[1] else f"{kind} off by {gap:.3g} m, {turn:.3g} rad"
