"""A tab of a headless browser, for the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from report.browser import Page, browser


@pytest.fixture(scope="session")
def tab() -> Iterator[Page]:
    with browser() as opened:
        yield opened
