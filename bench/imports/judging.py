"""Whether the recording that a proposed mapping makes is what was written: all of it, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from sheet import Array, Written

from modcal_msgs_py.tables import import_tables

KINDS = {"range": "range", "bearing": "bearing", "plane": "touch", "pose": "pose", "body": "pose", "point": "point"}


def turned(a: Array, b: Array) -> Array:
    """Distances (N,) of vectors b from a, turned as one where that is least."""
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.linalg.norm(b - a @ R.T, axis=1)


def same_rigid(A: Array, B: Array) -> tuple[float, float]:
    """How far poses B (N, 4, 4) are from Y A X with the best rotations, (m, rad), medians; X from the first pose on."""
    # rotations of the relative motions are conjugate by Y: their axes turn alike
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    rel_a, rel_b = (Rotation.from_matrix(R[1:] @ R[0].T).as_rotvec() for R in (Ra, Rb))
    Y = Rotation.align_vectors(rel_b, rel_a)[0].as_matrix()
    X = Rotation.from_matrix(np.swapaxes(Y @ Ra, 1, 2) @ Rb).mean().as_matrix()
    turn = Rotation.from_matrix(np.swapaxes(Y @ Ra @ X, 1, 2) @ Rb).magnitude()
    G = np.concatenate([Y @ Ra, np.tile(np.eye(3), (len(A), 1, 1))], axis=2).reshape(-1, 6)
    h = (B[:, :3, 3] - A[:, :3, 3] @ Y.T).reshape(-1)
    gap = (h - G @ np.linalg.lstsq(G, h, rcond=None)[0]).reshape(-1, 3)
    return float(np.median(np.linalg.norm(gap, axis=1))), float(np.median(turn))


def differs(kind: str, got: Array, true: Array, T: Array) -> str | None:
    """What is wrong with readings of a kind (N, …), but for fixed transforms at base and tool; None: nothing."""
    if kind in ("range", "plane"):
        gap = float(np.abs(got[:, 0] - true).max())
        return None if gap < 2e-6 else f"{kind} off by {gap:.3g} m"
    if kind == "bearing":  # but for a turn of the station
        gap = float(turned(true, got).max())
        return None if gap < 1e-5 else f"bearing off by {gap:.3g} rad"
    if kind == "point":
        a, b = true[:, :3, 3], got[:, :3]
        gap = float(np.median(turned(a - a.mean(axis=0), b - b.mean(axis=0))))
        return None if gap < 2e-6 else f"points off by {gap:.3g} m"
    made = np.tile(np.eye(4), (len(got), 1, 1))
    made[:, :3, 3], made[:, :3, :3] = got[:, :3], Rotation.from_quat(got[:, 3:]).as_matrix()
    gap, turn = same_rigid(T, made)
    near = (3e-4, 4e-3) if kind == "body" else (5e-6, 2e-5)  # of a body its targets' own noise is left
    return None if gap < near[0] and turn < near[1] else f"{kind} off by {gap:.3g} m, {turn:.3g} rad"


def judged(written: Written, mapping: dict[str, Any], folder: Path) -> str:
    """Of joints and a pose, whatever else is used: "right", or what is wrong."""
    recording, truth, rows = import_tables(mapping, folder, "bench"), written.recorded, np.flatnonzero(written.whole)
    (joints,), (reading,), (kind,) = recording.joints, recording.readings, written.readings
    if set(joints.names) != set(truth.names):
        return f"joints {joints.names}"
    if len(reading.stamps) != len(rows):
        return f"{len(reading.stamps)} readings of {len(rows)}"
    here = np.searchsorted(joints.stamps, reading.stamps)
    off = np.abs(joints.position[here][:, [joints.names.index(n) for n in truth.names]] - truth.q[rows]).max()
    if off > 1e-4:
        return f"joints off by {off:.3g}"
    if recording.has_clock and written.about["clock"]:
        apart = np.abs(np.diff(reading.stamps) - np.diff(truth.stamps[rows])).max()
        if apart > 1.1:
            return f"steps of time off by {apart:.3g} s"
    wrong = differs(reading.kind, reading.values, truth.T[rows], truth.T[rows])
    return wrong or ("right" if reading.kind == kind else f"{reading.kind} of a {kind}")


def columns_judged(written: Written, mapping: dict[str, Any], folder: Path) -> tuple[str, list[str]]:
    """("right", "less" or "wrong", reasons). less: columns that were not used; wrong: used, and not what they are."""
    recording, truth = import_tables(mapping, folder, "bench"), written.recorded
    (joints,) = recording.joints
    wrong, less = list[str](), list[str]()
    if set(joints.names) != set(truth.names):
        return "wrong", [f"joints {joints.names}"]
    rows = np.flatnonzero(written.whole)
    if len(joints.stamps) not in (len(truth.q), len(rows)):
        return "wrong", [f"{len(joints.stamps)} joint states of {len(truth.q)}"]
    every = np.arange(len(truth.q)) if len(joints.stamps) == len(truth.q) else rows

    def compare(what: str, got: Array | None, true: Array | None, near: float, needed: bool = True) -> None:
        """Values as they were written (N, …); got: None where they are not used."""
        if true is None:
            wrong.extend([] if got is None else [f"{what} of nothing"])
        elif got is None:
            less.extend([what] if needed else [])
        elif np.abs(got - true).max() > near:
            wrong.append(what)

    def used(track: Any, values: Array) -> Array | None:
        """In the order of the truth; None where nothing is known."""
        return None if np.isnan(values).all() else values[:, [track.names.index(n) for n in truth.names]]

    v, effort, commands = (
        None if x is None else x[every] for x in (written.velocity, written.effort, written.commanded)
    )
    # nobody can tell the unit of a standing arm's speeds where no label does
    told = written.about["scenario"] == "moving" or bool(written.about.get("velocity_told"))
    near = 0.0 if v is None else max(1e-3, 1e-2 * np.abs(written.velocity).max())
    compare("joints", used(joints, joints.position), truth.q[every], 1e-4)
    compare("velocity", used(joints, joints.velocity), v, near, told)
    compare("effort", used(joints, joints.effort), effort, 2e-3)
    found = next(iter(recording.commands), None)
    compare("commanded", None if found is None else used(found, found.position), commands, 1e-4)
    kinds = {kind: [r for r in recording.readings if r.kind == KINDS[kind]] for kind in written.readings}
    if sum(map(len, kinds.values())) != len(recording.readings):
        wrong.append(f"readings {[r.kind for r in recording.readings]}")
    for kind, instruments in written.readings.items():
        if len(kinds[kind]) != len(instruments):
            (less if len(kinds[kind]) < len(instruments) else wrong).append(f"{len(kinds[kind])} of {kind}")
        for track, values in zip(kinds[kind], instruments, strict=False):
            if len(track.stamps) != len(rows):
                wrong.append(f"{kind}: {len(track.stamps)} readings of {len(rows)}")
            elif (said := differs(kind, track.values, values[rows], truth.T[rows])) is not None:
                wrong.append(said)
    stated, std = recording.readings[0].stated, None if written.std is None else written.std[rows]
    stated = None if stated is None or np.isnan(stated[:, 0]).all() else stated[:, 0]
    ratio = stated if stated is None or std is None else stated / std
    compare("std", ratio, None if std is None else np.ones(len(std)), 0.1)
    signals = [np.sort(s.values[:, 0]) for s in recording.signals]
    for values in written.signals:
        alike = {len(v): np.sort(v) for v in (values[rows], values)}
        if not any(len(v) in alike and np.abs(v - alike[len(v)]).max() < 2e-3 for v in signals):
            less.append("signal")
    return ("wrong", wrong + less) if wrong else ("less", less) if less else ("right", [])
