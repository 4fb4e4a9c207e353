"""``modcal synthesize``, ``modcal assemble`` and ``modcal modules``: arms made of modules."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadRecording, BadTable
from modcal_core.files import read_yaml, to_json, to_yaml, write_folder
from modcal_core.modules import (
    JOINT,
    Assembly,
    Generation,
    Library,
    ModuleErrors,
    Synthesis,
    assembly_to_data,
    chain_of,
    described,
    learn,
    matrix_text,
    module_frames,
    picture,
    recording_evidence,
    sentence,
    store_from_data,
    store_to_data,
    surprise,
    synthesize,
    task_from_data,
    to_data,
    to_markdown,
    twists_from_data,
    urdf_of,
    with_recording,
)
from modcal_core.preprocess import prepare
from modcal_core.report import Summary, SummaryLine, TableBlock, VerbResult, explained
from modcal_msgs_py import read_recording
from modcal_nodes.cli.console import EXISTING, Output, Whole, given, saving, speaking
from modcal_nodes.io import TopicOptions, read_assembly, read_library

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
    shown: list[str | Summary] = [sentence(result), _ranking(result, library)]
    output.saved(VerbResult(to_data(result, library), shown, files, "Best", "best.yaml"), f"{task.name}_synthesis")


def synthesis_files(result: Synthesis, library: Library, library_file: Path | None = None) -> dict[str, str]:
    """Names and texts of everything a synthesis leaves behind."""
    best, first = result.ranking[0], assembly_to_data(result.ranking[0].assembly, library)
    files = {"ranking.json": to_json(to_data(result, library)), "ranking.md": to_markdown(result, library)}
    if library_file:  # a copy, so that the folder can be moved
        first["library"] = "library.yaml"
        files["library.yaml"] = library_file.read_text(encoding="utf-8")
    files["best.yaml"] = to_yaml(first)
    for k, target in enumerate(result.task.targets):
        title = f"{best.assembly.name} at {target.name}"
        files[f"best_target_{k + 1}.svg"] = picture(best.assembly, library, best.postures[k], title)
    for i, candidate in enumerate(result.ranking[:_PICTURES], 1):
        title = f"{candidate.assembly.name} at zero, cost {candidate.cost:.3g}"
        files[f"rank_{i}.svg"] = picture(candidate.assembly, library, title=title)
    return files


def _ranking(result: Synthesis, library: Library) -> TableBlock:
    rows = []
    for i, candidate in enumerate(result.ranking):
        way, angle = candidate.miss.max(axis=0)
        miss = f"{1e3 * way:.0e} mm, {angle:.0e} rad"
        rows.append((str(i + 1), " · ".join(described(candidate, library)), f"{candidate.cost:.3g}", miss))
    return explained(_COLUMNS, rows, words=2)


_LIBRARY = click.option(
    "--library", "library_file", type=EXISTING, metavar="FILE",
    help="YAML of the available modules. Default: the one that SPEC names, or the published ones.",
)  # fmt: skip
_UNLIKELY = 1e-4
_MODULES = {
    "module": "",
    "serial": "",
    "makes": "the joint that the module is, in the URDF",
    "length mm": "of a module that comes in several",
    "turn deg": "about the axis of the flange that it is mounted on",
    "x mm": "where the module begins, in the base link, all joints at zero; y and z as well",
    "y mm": "",
    "z mm": "",
}
_PARTS = {
    "serial": "",
    "kind": "",
    "part": "the flange or joint of the module that the error belongs to",
    "assemblies": "how many of them have shown it",
    "shift mm": "length of the displacement",
    "± mm": "its standard deviation",
    "turn mrad": "angle of the rotation",
    "± mrad": "its standard deviation",
}


@click.command("assemble")
@click.argument("spec", type=EXISTING)
@_LIBRARY
@click.option(
    "--modules", "store", type=EXISTING, metavar="STORE",
    help="File written by modcal modules learn: the URDF includes the known errors of these physical modules.",
)  # fmt: skip
@saving()
def assemble_command(spec: Path, library_file: Path | None, store: Path | None, output: Output) -> None:
    """Build a robot from SPEC, a YAML list of modules, an incidence matrix or a code: robot.urdf, matrix, picture."""
    assembly, library = read_assembly(spec, library_file)
    errors = twists_from_data(read_yaml(store), str(store)) if store else None
    named = [m.serial for m in assembly.modules if m.serial]
    known = {serial for serial, _ in errors or ()}
    strangers = [] if errors is None else [s for s in named if s not in known]
    out = output.out or Path(assembly.name)
    stated = assembly_to_data(assembly, library)
    files = {
        "robot.urdf": urdf_of(assembly, library, errors),
        "assembly.yaml": to_yaml(stated),
        "assembly.svg": picture(assembly, library),
    }
    data = {
        "robot": str(out / "robot.urdf"),
        "assembly": stated,
        "joints": list(assembly.joint_names),
        "known": [s for s in named if s in known],
        "strangers": strangers,
    }
    matrix, code = matrix_text(stated["aim"]), f"code: {stated['code']}"
    shown: list[str | Summary] = [_table(assembly, library), "assembly incidence matrix:", matrix, code]
    if errors is not None:
        shown.append(f"{len(data['known'])} of {len(assembly.modules)} modules are known from {store}")
    if strangers:
        shown.append(SummaryLine(f"not known: {', '.join(strangers)}", "doubt"))
    output.saved(VerbResult(data, shown, files, "Robot", "robot.urdf"), out)


@click.group("modules")
def modules_command() -> None:
    """Errors of physical modules, learned over the assemblies that contained them."""


@modules_command.command("learn")
@click.argument("spec", type=EXISTING)
@click.argument("bag", type=EXISTING)
@click.option(
    "--modules", "store", type=click.Path(path_type=Path), required=True, metavar="STORE",
    help="YAML of the known errors; created if it does not exist.",
)  # fmt: skip
@click.option("--accept", is_flag=True, help="Learn also from an assembly that is not as its modules were known.")
@_LIBRARY
@given(TopicOptions)
@speaking
def learn_command(
    spec: Path, bag: Path, store: Path, accept: bool, library_file: Path | None, output: Output, options: TopicOptions
) -> None:
    """Learn from BAG, a recording of the assembly SPEC, the errors of its modules (by serial number)."""
    assembly, library = read_assembly(spec, library_file)
    if not any(m.serial for m in assembly.modules):
        raise BadTable(str(spec), "no module has a serial number", "write serial: behind the modules to be known again")
    known = store_from_data(read_yaml(store), library, str(store)) if store.exists() else ModuleErrors()
    with output.working() as watch:
        watch(f"reading {bag.name}")
        prepared = prepare(read_recording(bag, topics=options.topics), chain_of(assembly, library))
        watch("fitting the modules")
        new = recording_evidence(assembly, library, prepared.samples)
        others = [w for w in known.recordings if w.assembly.name != assembly.name]
        p_value = surprise(learn(others, library), new, library).p_value
        as_known = bool(p_value >= _UNLIKELY)
        if not (as_known or accept):
            raise BadRecording(
                f"assembly {assembly.name}",
                f"is not as its modules were known (p = {p_value:.1g}, {_UNLIKELY:g} is the limit); nothing is learned",
                "check serial numbers, modules and flanges; where modules have changed, or the library's tolerances "
                "are too tight, --accept learns from it all the same",
            )
        known = with_recording(known, new, library)
        data = store_to_data(known, library)
    write_folder(store.resolve().parent, {store.name: to_yaml(data)})
    found = {
        "modules": str(store),
        "stations": new.stations,
        "residual_m": float(new.residual),
        "p_value": float(p_value),
        "as_known": as_known,
        "notes": list(prepared.notes),
        "parts": [
            {
                **{"serial": serial, "kind": error.kind, "part": part, "assemblies": int(error.seen)},
                **{"twist": np.asarray(error.twist).tolist(), "std": np.asarray(error.std).tolist()},  # [m, rad]
            }
            for (serial, part), error in known.parts.items()
        ],
    }
    output.result(found, _learned(found), f"Modules: {store}")


def _learned(found: dict[str, Any]) -> list[str | Summary]:
    left = f"{found['stations']} stations, {1e3 * found['residual_m']:.3f} mm RMS left by the fit"
    out: list[str | Summary] = [*(SummaryLine(note, "doubt") for note in found["notes"]), _known(found["parts"]), left]
    if not found["as_known"]:
        said = (
            f"Learned although this assembly is not as its modules were known (p = {found['p_value']:.1g}): a serial "
            "number is wrong, a module or a flange has changed, or the library's tolerances are too tight."
        )
        out.append(SummaryLine(said, "doubt"))
    return out


def _table(assembly: Assembly, library: Library) -> TableBlock:
    rows, joints = [], iter(assembly.joint_names)
    frames = module_frames(assembly, library)
    places = [[f"{1e3 * x + 0.0:.1f}" for x in T[:3, 3]] for T in frames]
    for i, (module, at) in enumerate(zip(assembly.modules, places, strict=False)):
        kind = library.types[module.kind]
        length = f"{1e3 * kind.length(module.size):g}" if kind.sizes > 1 else ""
        makes = next(joints) if kind.role == JOINT else ""
        rows.append((module.kind, module.serial, makes, length, str(90 * module.turn) if i else "", *at))
    return explained(_MODULES, [*rows, ("tip", "", "tool0", "", "", *places[-1])], words=3)


def _known(parts: list[dict[str, Any]]) -> TableBlock:
    rows = []
    for known in parts:
        twist, std = (1e3 * np.reshape(known[name], (2, 3)) for name in ("twist", "std"))
        sizes = zip(np.linalg.norm(twist, axis=1), np.sqrt(np.mean(std**2, axis=1)), strict=True)
        words = known["serial"], known["kind"], known["part"].replace("_", " "), str(known["assemblies"])
        rows.append((*words, *(f"{x:.3f}" for pair in sizes for x in pair)))
    return explained(_PARTS, rows, words=3)
