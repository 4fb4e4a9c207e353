"""What docs/sensitivity.md and docs/planning.md show works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from cells import ur10

from modcal_core.planning.exchange import CRITERIA
from modcal_core.planning.pool import with_limits
from modcal_core.planning.sensitivity_study import DESIGNS
from modcal_core.planning.site import site_from_data, spheres_of


def blocks(root: Path, page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (root / "docs" / page).read_text(), re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "count"), [("sensitivity.md", 2), ("planning.md", 1)])
def test_examples_run(page: str, count: int, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = blocks(root, page, "python")
    assert len(programs) == count
    monkeypatch.chdir(root)
    exec(compile("\n".join(programs), page, "exec"), {})


def test_the_site_is_read(root: Path) -> None:
    site = site_from_data(yaml.safe_load(blocks(root, "planning.md", "yaml")[0]), "docs")
    assert len(spheres_of(ur10(), site).link) > 20
    assert with_limits(ur10(), site).upper[5] == 2.0


@pytest.mark.parametrize(("page", "names"), [("sensitivity.md", DESIGNS), ("planning.md", CRITERIA)])
def test_every_choice_is_explained(page: str, names: tuple[str, ...], root: Path) -> None:
    text = (root / "docs" / page).read_text()
    assert all(f"| `{name}`" in text or f", `{name}` |" in text for name in names)
