"""``modcal synthesize``."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import click

from modcal_core.files import read_yaml, to_json, to_yaml
from modcal_core.modules import (
    Generation,
    Library,
    Synthesis,
    assembly_to_data,
    described,
    picture,
    sentence,
    synthesize,
    task_from_data,
    to_data,
    to_markdown,
)
from modcal_core.report import Summary, VerbResult, explained
from modcal_nodes.cli.console import Output, saving
from modcal_nodes.cli.options import EXISTING, Whole
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
@saving()
def synthesize_command(
    task_file: Path,
    library_file: Path | None,
    seed: int,
    workers: int | None,
    thorough: bool,
    output: Output,
) -> None:
    """Find the assembly of modules with the fewest joints that reaches the poses of TASK and meets its requirements."""
    task = task_from_data(read_yaml(task_file), str(task_file))
    if thorough:
        task = replace(task, settings=task.settings.longer())
    library = read_library(library_file)
    with output.working() as watch:

        def heard(one: Generation) -> None:
            watch(f"{one.joints} joints", (one.number + 1) / task.settings.generations)

        result = synthesize(task, library, seed, workers or len(os.sched_getaffinity(0)), heard)
    files = synthesis_files(result, library, library_file)
    shown = [sentence(result), *_table(result, library)]
    output.saved(VerbResult(to_data(result, library), shown, files, "Best", "best.yaml"), f"{task.name}_synthesis")


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


def _table(result: Synthesis, library: Library) -> list[Summary]:
    rows = []
    for i, candidate in enumerate(result.ranking):
        way, angle = candidate.miss.max(axis=0)
        miss = f"{1e3 * way:.0e} mm, {angle:.0e} rad"
        rows.append((str(i + 1), " · ".join(described(candidate, library)), f"{candidate.cost:.3g}", miss))
    return explained(_COLUMNS, rows, words=2)
