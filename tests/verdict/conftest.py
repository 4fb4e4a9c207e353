"""A recording that tests of the verdict spoil, each in its own way."""

from __future__ import annotations

import pytest
from cells import Recorded, record


@pytest.fixture(scope="session")
def made() -> Recorded:
    return record(33, 140)
