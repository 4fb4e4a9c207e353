"""Whether the recording that a proposed mapping makes is what was written: all of it, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from exports import Export
from scipy.spatial.transform import Rotation
from sheet import Written

from modcal_msgs_py.tables import import_tables, read_tables

Array = np.ndarray
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


def judged(export: Export, mapping: dict[str, Any], folder: Path) -> str:
    """Of joints and a pose: "right", or what is wrong."""
    recording, truth = import_tables(mapping, folder, export.path.name), export.recorded
    (joints,), (reading,) = recording.joints, recording.readings
    if set(joints.names) != set(truth.names):
        return f"joints {joints.names}"
    rows = np.flatnonzero(export.whole)
    if len(reading.stamps) != len(rows):
        return f"{len(reading.stamps)} readings of {len(rows)}"
    here = np.searchsorted(joints.stamps, reading.stamps)
    q = joints.position[here][:, [joints.names.index(n) for n in truth.names]]
    if np.abs(q - truth.q[rows]).max() > 1e-4:
        return f"joints off by {np.abs(q - truth.q[rows]).max():.3g}"
    if recording.has_clock and export.about["clock"]:
        steps, true = np.diff(reading.stamps), np.diff(truth.stamps[rows])
        if np.abs(steps - true).max() > 1.1:
            return f"steps of time off by {np.abs(steps - true).max():.3g} s"
    wrong = differs("point" if reading.kind == "point" else "pose", reading.values, truth.T[rows], truth.T[rows])
    if wrong is None and reading.kind == "point" and not export.about["point"]:
        return "positions only"
    return wrong or "right"


def columns_judged(written: Written, mapping: dict[str, Any], folder: Path) -> tuple[str, list[str]]:
    """("right", "less" or "wrong", reasons). less: columns that were not used; wrong: used, and not what they are."""
    tables = read_tables(mapping, folder, "bench")
    recording, truth = tables.recording, written.recorded
    (joints,) = recording.joints
    wrong: list[str] = []
    less: list[str] = []
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

    def at(values: Array | None) -> Array | None:
        return None if values is None else values[every]

    compare("joints", used(joints, joints.position), truth.q[every], 1e-4)
    # nobody can tell the unit of a standing arm's speeds where no label does
    told = written.about["scenario"] == "moving" or bool(written.about.get("velocity_told"))
    v = written.velocity
    compare(
        "velocity", used(joints, joints.velocity), at(v), 0.0 if v is None else max(1e-3, 1e-2 * np.abs(v).max()), told
    )
    compare("effort", used(joints, joints.effort), at(written.effort), 2e-3)
    found = tables.commanded
    compare("commanded", None if found is None else used(found, found.position), at(written.commanded), 1e-4)
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
    stated = recording.readings[0].stated
    stated = None if stated is None or np.isnan(stated[:, 0]).all() else stated[:, 0]
    true = None if written.std is None else written.std[rows]
    compare(
        "std",
        stated if stated is None or true is None else stated / true,
        None if true is None else np.ones(len(true)),
        0.1,
    )
    signals = [s.values[:, 0] for s in recording.signals]
    for values in written.signals:
        alike = {len(rows): values[rows], len(values): values}
        near = [v for v in signals if len(v) in alike and np.abs(np.sort(v) - np.sort(alike[len(v)])).max() < 2e-3]
        if not near:
            less.append("signal")
    return ("wrong", wrong + less) if wrong else ("less", less) if less else ("right", [])
