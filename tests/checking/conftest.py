"""The arm that is checked: calibrated once for all tests of a process, since it is only looked at."""

from __future__ import annotations

import pytest
from cells import Recorded, record, ur10

from modcal_core.calibration.store import Calibration
from modcal_core.public import calibrate
from modcal_core.robot import Robot


@pytest.fixture(scope="session")
def cell() -> tuple[Recorded, Calibration]:
    """A world, and what was calibrated from eighty stations of it."""
    recorded = record(3, 80)
    return recorded, calibrate(Robot(ur10()), recorded.samples, geometry_only=True).calibration
