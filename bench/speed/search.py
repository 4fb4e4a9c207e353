"""Assemblies judged by the genetic search."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from timing import Row, spent_ms

from modcal_core.modules.coding import Coding
from modcal_core.modules.evaluation import Evaluator
from modcal_core.modules.genetic import SearchSettings, evolve
from modcal_core.modules.library_data import published
from modcal_core.modules.synthesis_data import task_from_data

ROOT = Path(__file__).resolve().parents[2]
BUDGET = 300


def rows() -> Iterator[Row]:
    """The published two-pose task; see bench/synthesis.py for how well the search does."""
    library = published()
    text = (ROOT / "examples/synthesis/two_poses.yaml").read_text()
    task = task_from_data(yaml.safe_load(text), "two_poses.yaml")
    evaluator = Evaluator(library, task.targets, task.uses, 0)
    judged: list[int] = []

    def search() -> None:
        archive = evolve(
            Coding(library),
            5,
            evaluator,
            np.random.default_rng([0, 5]),
            SearchSettings(generations=BUDGET, patience=BUDGET),
            enough=lambda archive: archive.judged >= BUDGET,
        )
        judged.append(archive.judged)

    ms = spent_ms(search)
    yield Row("synthesis", "one assembly judged", ms / judged[-1], remark=f"mean of {judged[-1]}, descents included")
