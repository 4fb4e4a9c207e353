"""A site as a factory floor has it, and what there is to choose from in it; made once for all tests."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from cells import ur10

from modcal_core.planning.planner import Planner, PlanRequest
from modcal_core.planning.pool import survey
from modcal_core.planning.site import Site, site_from_data

HALL: dict[str, Any] = yaml.safe_load((Path(__file__).resolve().parents[2] / "examples/planning/hall.yaml").read_text())


def hall() -> Site:
    return site_from_data(HALL, "hall")


@cache
def ground(reading: str = "point", candidates: int = 300) -> Planner:
    pool = survey(ur10(), hall(), np.random.default_rng(8), reading, candidates)
    return Planner(pool, PlanRequest(reading=reading), np.random.default_rng(1))
