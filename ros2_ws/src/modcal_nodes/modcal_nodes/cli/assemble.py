"""``modcal assemble`` and ``modcal modules``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from modcal_core.calibration.module_errors import ModuleErrors, learn, surprise
from modcal_core.calibration.module_store import store_from_data, store_to_data, twists_from_data, with_witness
from modcal_core.calibration.witness import witness
from modcal_core.errors import BadTable
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.incidence import incidence_of
from modcal_core.modules.library import JOINT, Library
from modcal_core.modules.picture import picture
from modcal_core.modules.poe import chain_of, module_frames
from modcal_core.modules.spec import assembly_to_data
from modcal_core.modules.urdf import urdf_of
from modcal_core.prepare import prepare
from modcal_msgs_py.mcap_read import read_bag
from modcal_nodes.assemblies import read_assembly
from modcal_nodes.cli.calibrate import EXISTING
from modcal_nodes.files import read_yaml, to_yaml, write_folder

_LIBRARY = click.option(
    "--library", "library_file", type=EXISTING, default=None, metavar="FILE",
    help="YAML of the modules there are. Default: the one that SPEC names, or the published ones.",
)  # fmt: skip
_UNLIKELY = 1e-4


@click.command("assemble")
@click.argument("spec", type=EXISTING)
@_LIBRARY
@click.option(
    "--modules", "store", type=EXISTING, default=None, metavar="STORE",
    help="What modcal modules learn wrote: the URDF gets what is known of these physical modules.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Folder of the results.")
def assemble_command(spec: Path, library_file: Path | None, store: Path | None, out: Path | None) -> None:
    """Make a robot of SPEC, a YAML list of modules or an assembly incidence matrix: robot.urdf, matrix, picture."""
    assembly, library = read_assembly(spec, library_file)
    errors = twists_from_data(read_yaml(store), str(store)) if store else None
    console = Console(emoji=False)
    console.print(_table(assembly, library))
    console.print(str(incidence_of(assembly, library)), highlight=False)
    if errors is not None:
        known = {serial for serial, _ in errors}
        named = [m.serial for m in assembly.modules if m.serial]
        strangers = [s for s in named if s not in known]
        console.print(f"{len(named) - len(strangers)} of {len(assembly.modules)} modules are known from {store}")
        if strangers:
            console.print(f"not known: {', '.join(strangers)}", style="yellow", highlight=False)
    out = out or Path(assembly.name)
    files = {
        "robot.urdf": urdf_of(assembly, library, errors),
        "assembly.yaml": to_yaml(assembly_to_data(assembly, library)),
        "assembly.svg": picture(assembly, library),
    }
    write_folder(out, files)
    click.echo(f"Robot: {out / 'robot.urdf'}")


@click.group("modules")
def modules_command() -> None:
    """What physical modules are off by, learned over the assemblies they were in."""


@modules_command.command("learn")
@click.argument("spec", type=EXISTING)
@click.argument("bag", type=EXISTING)
@click.option(
    "--modules", "store", type=click.Path(path_type=Path), required=True, metavar="STORE",
    help="YAML of what is known; made if it is not there.",
)  # fmt: skip
@_LIBRARY
def learn_command(spec: Path, bag: Path, store: Path, library_file: Path | None) -> None:
    """Learn from BAG, a recording of the assembly SPEC, what its modules (by serial number) are off by."""
    assembly, library = read_assembly(spec, library_file)
    if not any(m.serial for m in assembly.modules):
        raise BadTable(str(spec), "no module has a serial number", "write serial: behind the modules to be known again")
    known = store_from_data(read_yaml(store), library, str(store)) if store.exists() else ModuleErrors()
    prepared = prepare(read_bag(bag), chain_of(assembly, library))
    new = witness(assembly, library, prepared.samples)
    console = Console(emoji=False)
    for note in prepared.notes:
        console.print(note, style="yellow", highlight=False)
    others = [w for w in known.witnesses if w.assembly.name != assembly.name]
    expected = surprise(learn(others, library), new, library)
    known = with_witness(known, new, library)
    console.print(_known(known))
    console.print(f"{new.stations} stations, {1e3 * new.residual:.3f} mm RMS left by the fit", highlight=False)
    if expected.p_value < _UNLIKELY:
        said = (
            f"This assembly is not as its modules were known (p = {expected.p_value:.1g}): "
            "a serial number is wrong, a module or a flange has suffered, or the library's tolerances are too tight."
        )
        console.print(said, style="yellow", highlight=False)
    write_folder(store.resolve().parent, {store.name: to_yaml(store_to_data(known, library))})
    click.echo(f"Modules: {store}")


def _table(assembly: Assembly, library: Library) -> Table:
    """Every module in its place, joints at zero."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("module", "serial"):
        table.add_column(name)
    for name in ("length mm", "turn deg", "x mm", "y mm", "z mm"):
        table.add_column(name, justify="right")
    table.add_column("makes")
    joints = iter(assembly.joint_names)
    frames = module_frames(assembly, library)
    for i, (module, T) in enumerate(zip(assembly.modules, frames, strict=False)):
        kind = library.types[module.kind]
        length = f"{1e3 * kind.length(module.size):g}" if kind.sizes > 1 else ""
        at = [f"{1e3 * x + 0.0:.1f}" for x in T[:3, 3]]
        table.add_row(
            module.kind,
            module.serial,
            length,
            str(90 * module.turn) if i else "",
            *at,
            next(joints) if kind.role == JOINT else "",
        )
    tip = [f"{1e3 * x + 0.0:.1f}" for x in frames[-1][:3, 3]]
    table.add_row("tip", "", "", "", *tip, "tool0")
    return table


def _known(known: ModuleErrors) -> Table:
    """What is known of every part: sizes of its errors, and how surely."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("serial", "kind", "part"):
        table.add_column(name)
    for name in ("assemblies", "shift mm", "± mm", "turn mrad", "± mrad"):
        table.add_column(name, justify="right")
    for (serial, part), error in known.parts.items():
        shift, turn = (float(np.linalg.norm(error.twist[at])) for at in (slice(0, 3), slice(3, 6)))
        sure = (float(np.sqrt(np.mean(error.std[at] ** 2))) for at in (slice(0, 3), slice(3, 6)))
        numbers = [f"{1e3 * x:.3f}" for pair in zip((shift, turn), sure, strict=True) for x in pair]
        table.add_row(serial, error.kind, part.replace("_", " "), str(error.seen), *numbers)
    return table
