"""Draws exports, lets modcal propose a mapping for each, and counts: right, asked, wrong in silence.

    python bench/imports/run.py --first 0 --count 120

A proposal is right when the recording that its mapping makes has the joints that were written, and poses that differ from
the true ones by fixed transforms only. It is asked when the mapping says that it cannot tell, or none is proposed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from arms import ROBOTS
from exports import Export, draw

from modcal_core.errors import ModcalError
from modcal_core.robot import Robot
from modcal_msgs_py.tables import import_tables
from modcal_msgs_py.tables.proposal import proposal
from modcal_msgs_py.tables.propose import find

TARGET = 0.95


def same_rigid(A: np.ndarray, B: np.ndarray) -> tuple[float, float]:
    """How far poses B (N, 4, 4) are from Y A X with the best rotations, (m, rad), medians; X from the first pose on."""
    # rotations of the relative motions are conjugate by Y: their axes turn alike
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    from scipy.spatial.transform import Rotation

    rel_a = Rotation.from_matrix(Ra[1:] @ Ra[0].T).as_rotvec()
    rel_b = Rotation.from_matrix(Rb[1:] @ Rb[0].T).as_rotvec()
    Y = Rotation.align_vectors(rel_b, rel_a)[0].as_matrix()
    X = Rotation.from_matrix(np.swapaxes(Y @ Ra, 1, 2) @ Rb).mean().as_matrix()
    turn = Rotation.from_matrix(np.swapaxes(Y @ Ra @ X, 1, 2) @ Rb).magnitude()
    G = np.concatenate([Y @ Ra, np.tile(np.eye(3), (len(A), 1, 1))], axis=2).reshape(-1, 6)
    h = (B[:, :3, 3] - A[:, :3, 3] @ Y.T).reshape(-1)
    gap = (h - G @ np.linalg.lstsq(G, h, rcond=None)[0]).reshape(-1, 3)
    return float(np.median(np.linalg.norm(gap, axis=1))), float(np.median(turn))


def judged(export: Export, mapping: dict, folder: Path) -> str:
    """ "right", or what is wrong."""
    recording = import_tables(mapping, folder, export.path.name)
    (joints,) = recording.joints
    (reading,) = recording.readings
    truth = export.recorded
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
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, 3] = reading.values[:, :3]
    if reading.kind == "point":
        a, b = truth.T[rows][:, :3, 3], T[:, :3, 3]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        U, _, Vt = np.linalg.svd(b.T @ a)
        Y = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        gap = float(np.median(np.linalg.norm(b - a @ Y.T, axis=1)))
        if gap > 2e-6:
            return f"points off by {1e3 * gap:.3g} mm"
        return "right" if export.about["point"] else "positions only"
    from scipy.spatial.transform import Rotation

    T[:, :3, :3] = Rotation.from_quat(reading.values[:, 3:]).as_matrix()
    gap, turn = same_rigid(truth.T[rows], T)
    return "right" if gap < 5e-6 and turn < 2e-5 else f"poses off by {1e3 * gap:.3g} mm, {np.degrees(turn):.3g}°"


def one(seed: int, folder: Path) -> dict[str, object]:
    """What came of one export."""
    export = draw(seed, folder)
    chain = Robot.from_urdf(str((ROBOTS / f"{export.recorded.robot}.urdf").read_text())).chain
    since = time.monotonic()
    try:
        made = proposal(find([export.path], chain), None)
    except ModcalError as error:
        outcome, said = "asked", f"refused: {error}"
    else:
        if made.open:
            outcome, said = "asked", "; ".join(made.open)[:300]
        else:
            try:
                said = judged(export, dict(made.mapping), folder)
            except ModcalError as error:
                said = f"the mapping is refused: {error}"
            outcome = "right" if said == "right" else "asked" if said.startswith("the mapping is refused") else "wrong"
    return {"seed": seed, "outcome": outcome, "said": said, "s": round(time.monotonic() - since, 2), **export.about}


def more(seed: int, folder: Path) -> dict[str, object]:
    """What came of one export with more columns: "less" where some are not used, and nothing is wrong."""
    from columns import draw as draw_columns
    from judging import judged as judged_columns

    written = draw_columns(seed, folder)
    robot = Robot.from_urdf(str((ROBOTS / f"{written.recorded.robot}.urdf").read_text()))
    since = time.monotonic()
    said: object
    try:
        made = proposal(find(written.paths, robot.chain, inertias=robot.inertias), None)
        if made.open:
            outcome, said = "asked", "; ".join(made.open)[:300]
        else:
            outcome, said = judged_columns(written, dict(made.mapping), folder)
    except ModcalError as error:
        outcome, said = "asked", f"refused: {error}"
    return {"seed": seed, "outcome": outcome, "said": said, "s": round(time.monotonic() - since, 2), **written.about}


def main() -> int:
    """Exit code: 0 where the target is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=120)
    parser.add_argument("--keep", type=Path, default=None, help="folder for the files")
    parser.add_argument("--out", type=Path, default=None, help="results as JSON lines")
    parser.add_argument("--columns", action="store_true", help="exports with more columns than joints and a pose")
    chosen = parser.parse_args()
    counted: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as made:
        folder = chosen.keep or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(chosen.first, chosen.first + chosen.count):
            found = (more if chosen.columns else one)(seed, folder)
            counted[str(found["outcome"])] += 1
            if found["outcome"] != "right":
                print(json.dumps(found, default=str), flush=True)
            if chosen.out:
                with chosen.out.open("a") as stream:
                    stream.write(json.dumps(found, default=str) + "\n")
    share = counted["right"] / chosen.count
    counts = ", ".join(
        f"{counted[name]} {name}" for name in ("asked", "less", "wrong") if counted[name] or name != "less"
    )
    print(f"{chosen.count} exports: {counted['right']} right ({share:.1%}), {counts}")
    return 0 if share >= TARGET and not counted["wrong"] else 1


if __name__ == "__main__":
    sys.exit(main())
