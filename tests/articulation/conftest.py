"""What tests of articulation share."""

from __future__ import annotations

from pathlib import Path

import pytest
from articulation.furniture_tracks import recorded

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.track import Track


@pytest.fixture(scope="session")
def furniture(shared_data: Path) -> dict[str, tuple[Kind, Track]]:
    """By name, the kind and the track of every recording of real furniture."""
    folder = shared_data / "articulation"
    if not folder.is_dir():
        pytest.skip("no tracks of real furniture: ../shared/data/articulation is not beside this checkout")
    return recorded(folder)
