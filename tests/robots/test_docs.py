"""The code in docs/robots.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest


def test_examples_run(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (root / "docs" / "robots.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    monkeypatch.chdir(root)
    exec("\n".join(blocks), {})
