"""``modcal synthesize``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import click
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from modcal_core.errors import plain
from modcal_core.files import read_yaml, to_json, to_yaml, write_folder
from modcal_core.modules import (
    Generation,
    Library,
    Synthesis,
    SynthesisTask,
    Watch,
    assembly_to_data,
    described,
    picture,
    sentence,
    synthesize,
    task_from_data,
    to_data,
    to_markdown,
)
from modcal_nodes.cli.console import console, explain, table, written
from modcal_nodes.cli.inputs import EXISTING, WRITTEN, Whole
from modcal_nodes.io import read_library

_COLUMNS = {
    "rank": "",
    "modules": "from base to tip, with length and turn",
    "cost": "what the requirements of TASK add up to; the lowest is the best",
    "worst miss": "what is left at the target that is missed most",
}
_PICTURES = 5  # of the ranking; the best gets one at each target


@click.command("synthesize")
@click.argument("task_file", type=EXISTING, metavar="TASK")
@click.option(
    "--library", "library_file", type=EXISTING, metavar="FILE",
    help="YAML of the available modules. Default: the published ones.",
)  # fmt: skip
@click.option("--seed", type=Whole(min=0), default=0, help="Seed of the search.")
@click.option("--workers", type=Whole(min=1, max=256), help="Processes. Default: one per processor.")
@click.option("--thorough", is_flag=True, help="Search longer for an assembly of lower cost.")
@click.option("--out", type=WRITTEN, help="Folder of the results.")
def synthesize_command(
    task_file: Path, library_file: Path | None, seed: int, workers: int | None, thorough: bool, out: Path | None
) -> None:
    """Find the assembly of modules with the fewest joints that reaches the poses of TASK and meets its requirements."""
    task = task_from_data(read_yaml(task_file), str(task_file))
    if thorough:
        task = replace(task, settings=task.settings.longer())
    library = read_library(library_file)
    page = console()
    with _progress(task) as watch:
        result = synthesize(task, library, seed, workers or len(os.sched_getaffinity(0)), watch)
    out = out or Path(f"{task.name}_synthesis")
    files = synthesis_files(result, library, library_file)
    write_folder(out, files)
    page.print(sentence(result))
    page.print(_table(result, library))
    explain(_COLUMNS, page)
    click.echo(plain(written(out, files, "Best", "best.yaml")))


def synthesis_files(result: Synthesis, library: Library, library_file: Path | None = None) -> dict[str, str]:
    """Names and texts of everything a synthesis leaves behind."""
    best = assembly_to_data(result.ranking[0].assembly, library)
    if library_file:
        best["library"] = "library.yaml"
    files = {
        "best.yaml": to_yaml(best),
        "ranking.json": to_json(to_data(result, library)),
        "ranking.md": to_markdown(result, library),
    }
    if library_file:  # a copy, so that the folder can be moved
        files["library.yaml"] = library_file.read_text(encoding="utf-8")
    for k, target in enumerate(result.task.targets):
        candidate = result.ranking[0]
        title = f"{candidate.assembly.name} at {target.name}"
        files[f"best_target_{k + 1}.svg"] = picture(candidate.assembly, library, candidate.postures[k], title)
    for i, candidate in enumerate(result.ranking[:_PICTURES]):
        title = f"{candidate.assembly.name} at zero, cost {candidate.cost:.3g}"
        files[f"rank_{i + 1}.svg"] = picture(candidate.assembly, library, title=title)
    return files


@contextmanager
def _progress(task: SynthesisTask) -> Iterator[Watch | None]:
    """Something to call after every generation; nothing is shown where nobody looks."""
    error = console(stderr=True)
    if not error.is_terminal:
        yield None
        return
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"), TimeElapsedColumn()
    with Progress(*columns, console=error, transient=True) as progress:
        bars: dict[int, object] = {}

        def watch(generation: Generation) -> None:
            n = generation.joints
            if n not in bars:
                bars[n] = progress.add_task(f"{n} joints", total=task.settings.generations, said="")
            said = f"{generation.judged} judged, {generation.met} meet all"
            said += f", cost {generation.cost:.3g}" if generation.met else f", nearest {generation.missing:.2g}"
            progress.update(bars[n], completed=generation.number + 1, said=said)  # type: ignore[arg-type]

        yield watch


def _table(result: Synthesis, library: Library) -> Table:
    shown = table(_COLUMNS, words=2)
    for i, candidate in enumerate(result.ranking):
        way, angle = candidate.miss.max(axis=0)
        miss = f"{1e3 * way:.0e} mm, {angle:.0e} rad"
        shown.add_row(str(i + 1), " · ".join(described(candidate, library)), f"{candidate.cost:.3g}", miss)
    return shown
