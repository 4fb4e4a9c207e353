"""Tracks of real doors and drawers, with what they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.track import Track


def recorded(folder: Path) -> dict[str, tuple[Kind, Track]]:
    """By name, the kind and the track of every recording in this folder."""
    out: dict[str, tuple[Kind, Track]] = {}
    for file in sorted(folder.glob("position/*/*.log")) + sorted(folder.glob("pose/*.log")):
        slides = "drawer" in file.parent.name or file.stem in ("M2U00394", "M2U00395")
        kind: Kind = "prismatic" if slides else "revolute"
        out[f"{file.parent.name}/{file.stem}"] = kind, Track.of_poses(np.loadtxt(file))
    return out
