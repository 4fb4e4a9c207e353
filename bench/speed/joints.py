"""A hinge fitted to poses of its handle, beside ripl_articulation's factor graph."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from articulation.objects import Seen, ideal, noisy
from peers import ask
from timing import Row, median_ms

from modcal_core.articulation.fit import fit
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

POSES = 100
DOORS = 5
OPENING = 1.2  # rad
POSITION, ROTATION = 5e-4, 2e-3  # noise of every axis [m, rad]
SAME = (5e-3, 0.01)  # m, rad that two hinges found in the same poses may lie apart


def doors() -> list[Seen]:
    """Doors with handles 0.5 m from the hinge, opened once."""
    opening = np.linspace(0.0, OPENING, POSES)
    out = []
    for seed in range(DOORS):
        rng = np.random.default_rng(seed)
        out.append(noisy(ideal("revolute", opening, rng, 0.5), rng, POSITION, ROTATION))
    return out


def apart(hinge: Array, other: Array) -> tuple[float, float]:
    """How far the first hinge's point is from the other's line [m], and the angle of the two lines [rad].

    A hinge is a point on its axis and the axis (6,).
    """
    away, axis = hinge[:3] - other[:3], other[3:]
    angle = float(np.arctan2(np.linalg.norm(np.cross(hinge[3:], axis)), abs(hinge[3:] @ axis)))
    return float(np.linalg.norm(away - axis * (axis @ away))), angle


def off(hinges: Array, truth: Array) -> str:
    """Mean errors of hinges, in words."""
    errors = np.mean([apart(a, b) for a, b in zip(hinges, truth, strict=True)], axis=0)
    return f"{1e3 * errors[0]:.2f} mm and {np.degrees(errors[1]):.2f} deg"


def rows() -> Iterator[Row]:
    """The fit of a known kind of joint, and the same by ripl_articulation."""
    seen = doors()
    tracks = [Track(s.positions, s.rotations) for s in seen]
    truth = np.array([np.r_[s.point, s.axis] for s in seen])
    models = [fit(track, "revolute").model for track in tracks]
    ours = np.array([np.r_[m.point, m.axis] for m in models])
    ms = float(np.median([median_ms(lambda t=track: fit(t, "revolute"), 3) for track in tracks]))
    poses = np.tile(np.eye(4), (DOORS, POSES, 1, 1))
    poses[..., :3, :3] = [s.rotations for s in seen]
    poses[..., :3, 3] = [s.positions for s in seen]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "poses.npz"
        np.savez(file, poses=poses, position=POSITION, rotation=ROTATION)
        answer = ask("ripl_articulation", "ripl_fit", str(file), seconds=120.0)
    remark = answer.remark
    if answer.found:
        theirs = np.reshape(answer.found, (DOORS, 6))
        for a, b in zip(theirs, ours, strict=True):
            if (np.array(apart(a, b)) > SAME).any():
                raise SystemExit(f"ripl_articulation: another hinge, {apart(a, b)} m and rad away")
        remark = f"off the true hinge by {off(theirs, truth)}, ours by {off(ours, truth)}"
    yield Row("articulation", f"hinge from {POSES} poses", ms, "ripl_articulation", answer.ms, remark, 0)
