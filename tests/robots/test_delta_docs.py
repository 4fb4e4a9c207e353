"""The code in docs/delta.md runs as it stands, and its file is read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from modcal_core.robots.delta import delta_from_data
from modcal_core.robots.delta_kinematics import forward


def test_examples_run(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (root / "docs" / "delta.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    monkeypatch.chdir(root)
    exec("\n".join(blocks), {})
    (file,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert forward(delta_from_data(yaml.safe_load(file), "docs"), [0.1, 0.2, 0.3, 0.4])[2, 3] < -0.5
