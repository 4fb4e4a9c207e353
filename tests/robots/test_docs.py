"""The code in the pages of robots, planning and instruments runs as it stands, and their files are read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from cells import ur10

from modcal_core.measurements.kinds import kinds
from modcal_core.planning import CRITERIA, DESIGNS, site_from_data, with_limits
from modcal_core.robots import delta_from_data, forward
from modcal_nodes.io.inputs import read_cell

PROGRAMS = {"robots": 3, "acceleration_limits": 2, "delta": 2, "instruments": 1, "sensitivity": 2, "planning": 1}


def page(name: str) -> str:
    return (Path(__file__).resolve().parents[2] / "docs" / f"{name}.md").read_text()


def blocks(name: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page(name), re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_examples_run(name: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = blocks(name, "python")
    assert len(programs) == PROGRAMS[name]
    monkeypatch.chdir(root)
    exec(compile("\n".join(programs), name, "exec"), {})


def test_files_are_read(tmp_path: Path) -> None:
    (text,) = blocks("delta", "yaml")
    assert forward(delta_from_data(yaml.safe_load(text), "docs"), [0.1, 0.2, 0.3, 0.4])[2, 3] < -0.5
    assert with_limits(ur10(), site_from_data(yaml.safe_load(blocks("planning", "yaml")[0]), "docs")).upper[5] == 2.0
    (text,) = blocks("instruments", "yaml")
    (tmp_path / "cell.yaml").write_text(text)
    cell = read_cell(tmp_path / "cell.yaml")
    assert [k.frame for k in cell.known] == [k["frame"] for k in yaml.safe_load(text)["known"]]
    assert len(cell.distances) == 2


@pytest.mark.parametrize(("name", "names"), [("sensitivity", DESIGNS), ("planning", CRITERIA)])
def test_every_choice_is_explained(name: str, names: tuple[str, ...]) -> None:
    assert all(f"| `{choice}`" in page(name) or f", `{choice}` |" in page(name) for choice in names)


def test_the_table_of_kinds_is_the_registry() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([\w/]+)` (\w+) \| .* \| (\d) \|$", page("instruments"), re.MULTILINE)
    assert {(name, topic, message, int(seen)) for name, topic, message, seen in rows} == {
        (k.name, k.topic, k.message.rpartition("/")[2], k.dimensions) for k in kinds().values()
    }
