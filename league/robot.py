"""The arm of a task in three dimensions, with what each method misses by at some of the scored rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from league import geometry
from league.tasks import Problem

BASE = "nominal"  # the method that the others are drawn beside
NOTE = (
    "An arrow begins where the tool was read, or truly is, and shows what the prediction is off by. Rows are some of "
    "those that no method was given. Beside the maker's arm stand the methods, the best first."
)


def drawn(problem: Problem, order: list[dict[str, Any]]) -> str:
    """A page of its own, made of modcal's parts for pages. order: results of the task, the best first."""
    from modcal_core.report import Page, Scene3D, Section

    task, arm, name = problem.task, problem.task.arm, problem.task.name
    rows = [r for r in order if len(r.get("shown_mm", ())) > 0]
    rows.sort(key=lambda r: r["method"] != BASE)
    q = task.q[problem.scored][np.linspace(0, len(problem.scored) - 1, len(rows[0]["shown_mm"])).astype(int)]
    placed = geometry.fit(task, geometry=False).steps
    back = (placed[0] @ np.linalg.inv(arm.steps[0]))[:3, :3]  # from the arm's base to the instrument's frame
    places = arm.frames(q, np.concatenate([arm.steps[:-1], placed[-1:]]))[..., :3, 3]
    paths = np.concatenate([np.zeros((len(q), 1, 3)), places], axis=1)
    stages = [(r["method"], np.array(r["shown_mm"]) @ back) for r in rows]
    scene = Scene3D(
        points=paths[:, -1],
        arms=[[path] for path in paths],
        shown=np.arange(len(q)),
        said=(),
        base="the base",
        alt=f"The arm of {name} and an arrow for the error of every method at {len(q)} rows",
        stages=stages,
        names=[f"row {k + 1} of {len(q)}" for k in range(len(q))],
    )
    best = min(rows, key=lambda r: r["rms_mm"])
    answer = f"{problem.about}: the first is {best['method']} with {best['rms_mm']:.3f} mm RMS."
    return Page(name, answer, [Section("robot", "Arm", [scene])], problem.track, lines=[NOTE]).html()
