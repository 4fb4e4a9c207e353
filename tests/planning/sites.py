"""A site as a factory floor has it, and what there is to choose from in it; made once for all tests."""

from __future__ import annotations

from functools import cache

import numpy as np
from cells import ur10

from modcal_core.planning.ground import Ground, survey
from modcal_core.planning.site import Site, site_from_data

HALL = {
    "tracker": {"position_m": [2.5, 0.3, 0.6], "range_m": [0.5, 8.0], "axis": [-1, 0, 0], "half_angle_deg": 40},
    "target": {"position_m": [0.05, 0.0, 0.1], "axis": [0, 0, 1], "half_angle_deg": 80},
    "noise": {"position_m": 3e-5, "position_m_per_m": 5e-6, "rotation_rad": 5e-5, "joint_rad": 2e-5},
    "surroundings": {"floor_m": 0.0},
}


def hall() -> Site:
    return site_from_data(HALL, "hall")


@cache
def ground(reading: str = "point", candidates: int = 300) -> Ground:
    return survey(ur10(), hall(), np.random.default_rng(8), reading, (), candidates)
