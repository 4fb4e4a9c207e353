"""``modcal import``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from modcal_core.errors import BadTable, ModcalError, about
from modcal_core.files import read_yaml, to_json, write_file
from modcal_core.measurements import IMPORTED, Recording, remedies_of
from modcal_core.robot import Robot
from modcal_core.robots import Chain, chain_urdf, from_table, from_ur_conf, parse
from modcal_msgs_py import write_recording
from modcal_msgs_py.tables import MeasuredArm, Proposal, find, import_tables, json_schema
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.export import told
from modcal_nodes.cli.inputs import described, read_table
from modcal_nodes.cli.options import EXISTING, WRITTEN, given
from modcal_nodes.io import ChainOptions, option

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


def proposed(tables: Sequence[Path], described: Path, options: ImportOptions, output: Output) -> tuple[Proposal, Path]:
    """The mapping of tables, and where it was written. Raises BadTable where none is found, or a file is in the way."""
    out, path = options.out, options.mapping or Path(f"{tables[0].stem}.yaml")
    folders = {table.resolve().parent for table in tables}
    if len(folders) > 1:
        raise BadTable(str(tables[1]), "is in another folder than the first table", "put them into one folder")
    data = "" if folders == {path.resolve().parent} else f" --data {tables[0].parent}"
    again = f"modcal import {path}{data}" + (f" --out {out}" if out else "")
    if path.exists():
        raise BadTable(str(path), "exists already", f"import it ({again}), give --mapping another name, or remove it")
    is_delta = described == options.delta
    robot = Robot.from_delta(described) if is_delta else Robot.from_urdf(described, options.base, options.tip)
    ends = {end: name for end, name in (("base", options.base), ("tip", options.tip)) if name is not None}
    with output.working() as watch:
        where = os.path.relpath(described.resolve(), path.resolve().parent)
        stated = {"delta" if is_delta else "urdf": where, **ends}
        made = find(tables, MeasuredArm(robot.mechanism, robot.inertias, _bystanders(robot), stated), watch)
    write_file(path, made.text(", ".join(table.name for table in tables)))
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
    output.result(result, lines)
    return made, path


def _bystanders(robot: Robot) -> dict[str, bool]:
    """Joints of the robot description that are not the arm's, each with whether it turns."""
    if robot.description is None:
        return {}
    kinds = {"revolute": True, "continuous": True, "prismatic": False}
    joints = parse(robot.description).joints
    own = robot.chain.own_names
    return {joint.name: kinds[joint.kind] for joint in joints if joint.kind in kinds and joint.name not in own}


_YAML = (".yaml", ".yml")


def _print_schema(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        click.echo(to_json(json_schema()), nl=False)
        context.exit()


@dataclass(frozen=True)
class ImportOptions(ChainOptions):
    """Where tables are, of which robot, and what is written."""

    data: Path | None = option("Folder of the tables. Default: the folder of MAPPING.")
    urdf: Path | None = option("Robot description to put into the bag, and to prove a mapping by.")
    delta: Path | None = option("Description of a Delta robot, to prove a mapping by instead.")
    mapping: Path | None = option(
        "For tables without a mapping: the mapping to write. Default: FILE.yaml.", type=click.Path(path_type=Path)
    )
    out: Path | None = option("The bag or URDF to write. Default: MAPPING's name; for mere tables none.", type=WRITTEN)


@click.command("import")
@click.argument("sources", type=EXISTING, nargs=-1, required=True, metavar="MAPPING | FILE.csv...")
@given(ImportOptions)
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON schema of MAPPING, for editors.",
)
@speaking
def import_command(sources: tuple[Path, ...], output: Output, options: ImportOptions) -> None:
    """Convert CSV tables into a bag, as described by MAPPING (a YAML file).

    Without a mapping, FILE.csv and the robot's --urdf or --delta are enough: separator, units, columns and conventions
    are found out, proved by the nominal arm that fits, and written as a mapping to edit. What the data cannot tell is
    asked, with exit code 3. Further files are joined by a column that they share.

    A kinematic table (.csv, or .yaml that states a convention: dh, mdh or cpc) becomes a URDF, which every other verb
    takes; so does UR's calibration.conf, beside the --urdf of its model.
    """  # fmt: skip
    first, urdf, out = sources[0], options.urdf, options.out
    if options.delta is not None and (urdf or options.base or options.tip):
        raise BadTable(f"--delta {options.delta}", "cannot be combined with --urdf, --base or --tip", "leave them out")
    robot = options.delta or urdf
    if first.suffix.lower() == ".conf":
        _write_arm(first, _of_conf(first, urdf), out, output)
        return
    if first.suffix.lower() not in _YAML and robot is not None and not is_kinematic(first):
        made, path = proposed(sources, robot, options, output)
        if made.open:
            raise SystemExit(3)
        if out is not None:
            _import(path, replace(options, data=options.data or first.parent), out, output)
        return
    if len(sources) > 1:
        raise BadTable(str(sources[1]), "stands beside a mapping", "name all files in the mapping, or give tables only")
    table = _kinematic_table(first)
    if table is not None:
        with about(str(first)):
            chain = from_table(table)
        _write_arm(first, chain, out, output)
        return
    _import(first, options, out or Path(first.stem), output)


def _write_arm(source: Path, chain: Chain, out: Path | None, output: Output) -> None:
    out = out or Path(f"{source.stem}.urdf")
    write_file(out, chain_urdf(chain))
    output.result(*told(out, chain))


def _of_conf(path: Path, urdf: Path | None) -> Chain:
    """The arm of a UR controller's calibration.conf."""
    if urdf is None:
        raise BadTable(str(path), "holds only differences from the model's DH numbers", "give --urdf of this UR model")
    with about(str(path)):
        return from_ur_conf(path.read_text(encoding="utf-8", errors="replace"), Robot.from_urdf(urdf).chain)


def _kinematic_table(path: Path) -> Mapping[str, Any] | None:
    try:
        data = read_table(path)
    except BadTable as error:
        if path.suffix.lower() in _YAML or is_kinematic(path):
            raise
        remedy = "give --urdf ROBOT, and a mapping is found out for a table of measurements"
        raise BadTable(error.offender, error.limit, f"{remedy}; or {error.remedy}") from error
    return data if isinstance(data, Mapping) and {"convention", "kinematics"} & set(data) else None


def _import(mapping: Path, options: ImportOptions, out: Path, output: Output) -> None:
    stated, folder, urdf = read_yaml(mapping), options.data or mapping.parent, options.urdf
    with output.working() as watch:
        recording = import_tables(stated, folder, mapping.name, partial(watch, "reading the tables"))
        recording = replace(recording, warnings=(f"{IMPORTED}{mapping.name}.", *recording.warnings))
        delta = options.delta or _stated_robot("delta", stated, mapping, folder)
        urdf = urdf or _stated_robot("urdf", stated, mapping, folder)
        if urdf is not None:
            recording = replace(recording, robot_description=urdf.read_text(encoding="utf-8"))
            arm = options.base or stated.get("base"), options.tip or stated.get("tip")
            watch("comparing conventions")
            with remedies_of(recording.warnings):
                recording = _proved(recording, stated, arm)
        write_recording(recording, out, partial(watch, f"writing {out.name}"))
    frames = list(recording.frames)
    stations = sum(len(r.stamps) for r in recording.readings)
    left_out = [note for note in recording.warnings if "left out" in note]
    found = {"bag": str(out), "stations": stations, "frames": frames, "left_out": left_out}
    line = f"{out}: {stations} stations, {len(frames)} frame{'s' * (len(frames) != 1)}; next: modcal calibrate {out}"
    line += f" --delta {delta}" if delta is not None else ""
    if not recording.joints:
        line = f"{out}: {stations} readings of {len(frames)} sensors; next: modcal measure-object CALIBRATION {out}"
    elif not stations:
        line = f"{out}: {sum(len(t.stamps) for t in recording.joints)} joint states; next: modcal articulate {out}"
    output.result(found, [*left_out, line])


def _proved(recording: Recording, stated: Mapping[str, Any], arm: tuple[str | None, str | None]) -> Recording:
    """The recording with a note where its poses are inverse, and of the arm where its base or tip is stated.

    Raises BadRobot where these are no links of the robot, and BadRecording where another convention than the stated one
    fits the robot better beyond doubt.
    """
    from modcal_core.hypotheses import proved  # brings SciPy along, which kinematic tables do without
    from modcal_core.measurements import cleaned, cut_stations

    if any(arm):
        robot = described(recording, None, None, *arm)
        recording = recording.of_arm(robot.base, robot.tip)
    try:
        chain = described(recording, None, None, *arm).mechanism
        samples = cut_stations(cleaned(recording, chain.names, chain).recording, chain.names)
    except ModcalError:  # of another robot, or with nothing in common: `modcal calibrate` says so where it matters
        return recording
    poses = [pose for table in stated["tables"] for pose in _listed(table.get("pose"))]
    sequences = {str(pose.get("euler", {}).get("sequence", "")) for pose in poses}
    undone = proved(samples, chain, sequences.pop() or None if len(sequences) == 1 else None)[1]
    if undone is None:
        return recording
    note = "Poses look inverse (tracker in tool): `modcal calibrate` inverts them; state inverse: true on import."
    return replace(recording, warnings=(*recording.warnings, note))


def _listed(one: Any) -> list[Any]:
    return [one] if isinstance(one, Mapping) else one or []


def _stated_robot(key: str, stated: dict[str, object], mapping: Path, folder: Path) -> Path | None:
    name = stated.get(key)
    if name is None:
        return None
    for root in (mapping.parent, folder):
        if (root / str(name)).is_file():
            return root / str(name)
    raise BadTable(f"{mapping.name}: {key} {name}", "is neither beside the mapping nor in --data", "correct the path")
