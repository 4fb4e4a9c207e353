"""The code in docs/robots.md and docs/acceleration_limits.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest


@pytest.mark.parametrize(("page", "blocks"), [("robots", 3), ("acceleration_limits", 2)])
def test_examples_run(page: str, blocks: int, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.findall(r"```python\n(.*?)```", (root / "docs" / f"{page}.md").read_text(), re.DOTALL)
    assert len(found) == blocks
    monkeypatch.chdir(root)
    exec("\n".join(found), {})
