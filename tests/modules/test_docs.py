"""What docs/modules.md shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import yaml
from modules.arms import LIBRARY

from modcal_core.modules.coding import assembly_from_data

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "modules.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_example_runs() -> None:
    programs = blocks("python")
    assert programs
    for program in programs:
        exec(compile(program, "docs/modules.md", "exec"), {})


def test_the_list_and_the_matrix_are_one_arm() -> None:
    listed, matrix = (assembly_from_data(yaml.safe_load(text), LIBRARY, "docs") for text in blocks("yaml"))
    assert matrix == listed.with_serials([""] * len(listed.modules))


def test_the_table_of_modules_is_the_library() -> None:
    rows = re.findall(r"^\| ([\w-]+) \| (base|joint|link|gripper)[^|]*\| ([^|]*)\|", TEXT, re.MULTILINE)
    assert {name: role for name, role, _ in rows} == {t.name: t.role for t in LIBRARY.types.values()}
    for name, _, said in rows:
        kind = LIBRARY.type(name)
        stated = [float(x) for x in re.findall(r"[\d.]+", said)]
        assert stated == ([1e3 * kind.first, 1e3 * kind.step] if kind.sizes > 1 else [])
