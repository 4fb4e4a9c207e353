"""The files that tell how a handle moves, as ``modcal articulate`` and ``modcal door`` write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from modcal_core.articulation import JointModel, describe
from modcal_core.files import to_json, write_folder
from modcal_core.report import Articulation, articulation_data, articulation_html

_URDF = "object.urdf"


def write_articulation(found: Articulation, out: Path) -> tuple[dict[str, Any], tuple[str, ...], list[str]]:
    """Write them into a folder; returns what articulation.json holds, the names, and what a person should hear."""
    data = articulation_data(found)
    choice = found.choice
    files = {"articulation.json": to_json(data), "report.html": articulation_html(found)}
    said = [data["verdict"]]
    if not choice.follows:
        said.append(
            "By positions alone: the measured rotations do not follow it (the handle turned in the grasp, or they are "
            "wrong)."
        )
    if choice.misfit.fails:
        said.append(
            f"No {_URDF}: a URDF has no joint that moves so; articulation.json has the best one and its phases."
        )
    elif isinstance(model := choice.fit.model, JointModel):
        reach = data["configuration"]
        limits = None if not model.moves else (reach["lower"], max(reach["upper"], reach["lower"] + 1e-6))
        files[_URDF] = describe(model, found.frame or "world", "object_handle", limits)
    else:
        said.append(
            f"No {_URDF}: a URDF has no joint that moves like a {choice.kind}; articulation.json says how it moves."
        )
    write_folder(out, files)
    if _URDF not in files:  # one of an earlier call would tell of another joint
        (out / _URDF).unlink(missing_ok=True)
    return data, tuple(files), said
