"""What docs/instruments.md shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from modcal_core.measurements.kinds.registry import kinds
from modcal_nodes.io.inputs import read_cell

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "instruments.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_examples_run() -> None:
    programs = blocks("python")
    assert len(programs) == 2
    exec(compile("\n".join(programs), "docs/instruments.md", "exec"), {})


def test_the_cell_file_is_one(tmp_path: Path) -> None:
    (text,) = blocks("yaml")
    (tmp_path / "cell.yaml").write_text(text)
    cell = read_cell(tmp_path / "cell.yaml")
    stated = yaml.safe_load(text)
    assert [k.frame for k in cell.known] == [k["frame"] for k in stated["known"]]
    assert len(cell.distances) == 2


def test_the_table_of_kinds_is_the_registry() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([\w/]+)` (\w+) \| .* \| (\d) \|$", TEXT, re.MULTILINE)
    assert {(name, topic, message, int(seen)) for name, topic, message, seen in rows} == {
        (k.name, k.topic, k.message.rpartition("/")[2], k.dimensions) for k in kinds().values()
    }
