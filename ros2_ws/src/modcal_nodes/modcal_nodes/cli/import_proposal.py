"""``modcal import`` of tables that have no mapping: one is found out, said, and written to be edited."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from modcal_core.errors import BadTable
from modcal_core.files import write_file
from modcal_core.robot import Robot
from modcal_msgs_py.tables.proposal import Proposal, proposal
from modcal_msgs_py.tables.propose import find
from modcal_nodes.cli.console import Output, tell

_HEAD = 4096  # bytes in which a kinematic table says that it is one


def is_kinematic(path: Path) -> bool:
    """Whether a file looks like a kinematic table: it states a convention, or has the columns of one."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD).decode("utf-8", errors="replace").lstrip("\ufeff")
    if any(line.lstrip("# ").startswith("convention") for line in head.splitlines()):
        return True
    first = next((line for line in head.splitlines() if line.strip() and not line.startswith("#")), "")
    labels = {label.strip() for label in first.replace(";", ",").split(",")}
    return {"a", "d", "alpha"} <= labels or ("name" in labels and bool({"theta", "bx", "alpha"} & labels))


def proposed(
    tables: Sequence[Path],
    urdf: Path,
    base: str | None,
    tip: str | None,
    mapping: Path | None,
    out: Path | None,
    output: Output,
) -> tuple[Proposal, Path]:
    """The mapping of tables, and where it was written. Raises BadTable where none is found, or a file is in the way.

    out: the bag that is made of them at once, where nothing is left to ask.
    """
    path = mapping or Path(f"{tables[0].stem}.yaml")
    if path.exists():
        raise BadTable(str(path), "exists already", "give --mapping another name, import it, or remove it")
    folders = {table.resolve().parent for table in tables}
    if len(folders) > 1:
        raise BadTable(str(tables[1]), "is in another folder than the first table", "put them into one folder")
    robot = Robot.from_urdf(urdf, base, tip)
    with output.working() as watch:
        found = find(tables, robot.chain, watch, robot.inertias)
        made = proposal(found, os.path.relpath(urdf.resolve(), path.resolve().parent))
    write_file(path, made.text(", ".join(table.name for table in tables)))
    data = "" if folders == {path.resolve().parent} else f" --data {tables[0].parent}"
    again = f"modcal import {path}{data}" + (f" --out {out}" if out else "")
    following = f"answer, then: {again}" if made.open else f"after an edit: {again}" if out else f"next: {again}"
    lines = [
        *(f"proved: {said}" for said in made.proved),
        *(f"assumed: {said}" for said in made.assumed),
        *(f"asked: {said}" for said in made.open),
        f"{path}: the mapping; {following}",
    ]
    result = {
        "mapping": str(path), "proved": list(made.proved), "assumed": list(made.assumed), "undecided": list(made.open),
    }  # fmt: skip
    output.result(result, partial(tell, lines))
    return made, path
