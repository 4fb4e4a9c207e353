"""``modcal import`` and ``modcal export``: tables of measurements and of kinematics, to and from other programs."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import yaml

from modcal_core.calibration import Calibration, from_data
from modcal_core.errors import BadTable, ModcalError, about
from modcal_core.files import read_yaml, to_json, to_yaml, write_file
from modcal_core.geometry import se3
from modcal_core.measurements import IMPORTED, Recording, remedies_of
from modcal_core.report import kinematics_text
from modcal_core.robot import Robot
from modcal_core.robots import (
    CONVENTIONS,
    UNITS,
    Chain,
    chain_urdf,
    from_csv,
    from_table,
    from_ur_conf,
    joint_origins,
    loss,
    nearest_dh,
    parse,
    read_chain,
    read_path,
    ros2_control_offsets,
    to_csv,
    to_table,
    xacro_origins,
)
from modcal_msgs_py import write_recording
from modcal_msgs_py.tables import MeasuredArm, Proposal, find, import_tables, json_schema
from modcal_nodes.cli.console import EXISTING, WRITTEN, Output, given, speaking
from modcal_nodes.cli.inputs import described, read_robot, read_table
from modcal_nodes.io import ChainOptions, option, read_calibration

_MODELS = ("calibrated", "geometric", "nominal")
_OF_URDF = ("kinematics", "xacro")  # formats of a URDF's joints, each by itself
_OFFSETS = "ros2_control"
_MOUNT = "mount"
_FORMS = (*CONVENTIONS, "urdf", *_OF_URDF, _OFFSETS, _MOUNT)


_Told = tuple[dict[str, Any], list[str]]  # what to say of a written file, as data and as lines
_Source = tuple[Chain, tuple[str, ...]]  # an arm, and what of it no table can hold


@dataclass(frozen=True)
class _Export:
    """A text of an arm's kinematics. ending: of its file's name. left_out: what it cannot hold. off: how far poses are
    off when it is read back [m].
    """

    chain: Chain
    text: str
    ending: str
    left_out: Sequence[str] = ()
    off: float | None = None


@dataclass(frozen=True)
class ExportOptions(ChainOptions):
    """What is asked of an export. to: one of the formats. which: model of a calibration."""

    to: str = option("Format to write.", choices=_FORMS, required=True)
    which: str = option("Model of a calibration.", default="calibrated", choices=_MODELS)
    tool: bool = option("For a calibration: end at the measured tool, not at the tip link.", default=False)
    link: str | None = option("For mount: the camera's link, such as camera_color_optical_frame.", metavar="LINK")
    largest_offset: float = option("Largest offset in a DH row [m].", default=10.0, type=float)
    nearest: bool = option(
        "For dh and mdh: keep nearly parallel axes parallel, and say what that costs.", default=False
    )
    unit: str = option("Of a table that is written as CSV.", default="m rad", choices=tuple(UNITS))
    factory_kinematics: Path | None = option("For kinematics: the maker's own file of this arm.")


@click.command("export")
@click.argument("source", type=EXISTING)
@given(ExportOptions)
@click.option("--out", type=WRITTEN, help="File; .csv for CSV. Default: SOURCE_TO.yaml.")
@speaking
def export_command(source: Path, out: Path | None, output: Output, options: ExportOptions) -> None:
    """Write the kinematics of SOURCE as a table, as a URDF without bodies, or for a maker's description.

    SOURCE is a calibration (folder or calibration.yaml), a URDF, or a table (.yaml or .csv) of any convention. Tables
    are read back and must give the same poses. What a table cannot represent is reported, and noted in it.

    kinematics and xacro take the joints' origins of a URDF, or of the calibrated.urdf in the folder of a calibration:
    kinematics as the makers' descriptions (Universal Robots, Franka) or xacro.load_yaml read them, xacro as a property
    for a description of your own. ros2_control takes the joint offsets of a calibration: transmissions for the
    <ros2_control> block of an arm whose controller can take nothing else. mount writes, as xacro does, the origin of
    the joint by which a camera is mounted, so that its --link is where the calibration found the camera.
    """
    if not (0.0 < options.largest_offset < 1e9):
        said = f"{options.largest_offset:g} m is not a valid distance"
        raise BadTable("--largest-offset", said, "give metres, such as 10")
    if options.to in _OF_URDF:
        made = _origins(source, options)
    elif options.to == _OFFSETS:
        made = _offsets(source)
    elif options.to == _MOUNT:
        made = _mount(source, options.link)
    else:
        made = _table(source, options, out)
    out = out or Path(f"{source.resolve().stem}{made.ending}")
    write_file(out, made.text)
    output.result(*told(out, made.chain, made.off, made.left_out))


def _table(source: Path, options: ExportOptions, out: Path | None) -> _Export:
    """The arm as a table, or as a URDF without bodies. out: the file, where it is named."""
    form, unit = options.to, options.unit
    chain, left_out = _read(source, options)
    if form == "urdf":
        return _Export(chain, chain_urdf(chain), "_chain.urdf", left_out)
    near = options.nearest and form != "cpc"
    if near:
        found = nearest_dh(chain, form, options.largest_offset)
        pairs = "; ".join(f"{a} and {b}" for a, b in found.parallel) or "none"
        lost = (
            f"tilts of nearly parallel axes across their common normal ({pairs}): the tip is off by "
            f"{1e3 * found.rms:.3g} mm RMS, {1e3 * found.largest:.3g} mm and {math.degrees(found.angle):.2g}° at most"
        )
        table, left_out = found.table, (*left_out, lost)
    else:
        table = to_table(chain, form, options.largest_offset)
    ending = ".yaml" if unit == "m rad" else ".csv"
    notes = [f"left out: {note}" for note in left_out]
    if (ending if out is None else out.suffix.lower()) == ".csv":
        text = to_csv(table, notes, unit)
        again = from_csv(text, "the table")
    elif unit != "m rad":
        raise BadTable(f"--unit '{unit}'", "a YAML table is in m and rad", "give --out FILE.csv")
    else:
        text = "".join(f"# {note}\n" for note in notes) + to_yaml(table)
        again = yaml.safe_load(text)
    return _Export(chain, text, f"_{form}{ending}", left_out, float(loss(from_table(table) if near else chain, again)))


def told(out: Path, chain: Chain, off: float | None = None, left_out: Sequence[str] = ()) -> _Told:
    """What to say of the file with an arm's kinematics, as data and as lines.

    off: how far poses are off when it is read back [m]. left_out: what it cannot hold.
    """
    data = {
        "file": str(out),
        "base": chain.base,
        "tip": chain.tip,
        "joints": list(chain.names),
        "off_m": off,
        "left_out": list(left_out),
    }
    said = "" if off is None else f", read back it is off by {off:.1g} m at most"
    line = f"{out}: {chain.n} joints, {chain.base} → {chain.tip}{said}"
    return data, [*(f"left out: {note}" for note in left_out), line]


def _origins(source: Path, options: ExportOptions) -> _Export:
    """The origins of a URDF's joints between base and tip."""
    form, base, tip, factory = options.to, options.base, options.tip, options.factory_kinematics
    urdf, left_out = source, tuple[str, ...]()
    if source.is_dir():
        calibration = read_calibration(source)
        whole = calibration.calibrated.chain
        base, tip = base or whole.base, tip or whole.tip
        left_out = _of_calibration(calibration, "calibrated", False)[1][:-1]
        urdf = source / "calibrated.urdf"
    text = urdf.read_text(encoding="utf-8", errors="replace")
    if not text.lstrip("\ufeff \t\r\n").startswith("<"):
        raise BadTable(str(source), f"is not a URDF, which {form} is made from", "give calibrated.urdf or its folder")
    chain, origins = read_chain(text, base, tip), joint_origins(text)
    if form == "kinematics":
        written = kinematics_text(chain, origins, None if factory is None else read_yaml(factory))
        return _Export(chain, written, "_kinematics.yaml", left_out)
    way = [name for segment in read_path(text, chain.base, chain.tip) for name in segment]
    notes = [f"left out: {note}" for note in left_out]
    return _Export(chain, xacro_origins({name: origins[name] for name in way}, notes), ".xacro", left_out)


def _offsets(source: Path) -> _Export:
    """The joint offsets of a calibration for ros2_control."""
    from modcal_core.outcome import offsets_of  # the fit's parameters, which tables do without

    calibration = read_calibration(source)
    found = offsets_of(calibration)
    if found is None or not found.found:
        raise BadTable(str(source), "determines no joint offset", "give the calibration of a serial arm")
    chain, offsets = calibration.nominal.serial, {one.joint: one.value for one in found.found}
    notes = [f"all but joint offsets, which leave {found.left_mm:.3g} mm RMS of {found.nominal_mm:.3g} mm corrected"]
    if open_ones := [name for name in chain.names if name not in offsets]:
        notes.append(f"offsets that base or tool take up: {', '.join(open_ones)}")
    said = ["Add these to offsets that are there already.", *(f"left out: {note}" for note in notes)]
    return _Export(chain, ros2_control_offsets(offsets, said), f"_{_OFFSETS}.xml", notes)


def _mount(source: Path, link: str | None) -> _Export:
    """The origin of the joint by which a camera is mounted on the tip, or beside the arm."""
    if link is None or not source.is_dir():
        raise BadTable(f"--to {_MOUNT}", "needs the folder of a calibration and the camera's link", "give --link LINK")
    model = read_calibration(source).calibrated
    chain, tree = model.serial, parse((source / "calibrated.urdf").read_text(encoding="utf-8"))
    above, held = tree.link(link), list[str]()
    while above in tree.above and above not in (chain.tip, chain.base) and not tree.above[above].moves:
        held.append(tree.above[above].name)
        above = tree.above[above].parent
    if not held or above not in (chain.tip, chain.base):
        said = f"hangs by fixed joints on neither {chain.tip} nor {chain.base}"
        raise BadTable(f"--link {link}", said, "give the camera's link, or calibrate with the --tip that carries it")
    mount, *behind = tree.path(above, link)
    T = model.T_tip_tool if above == chain.tip else se3.inverse(model.T_frame_base[0])
    for joint in reversed(behind):
        T = T @ se3.inverse(joint.T_parent_joint)
    return _Export(chain, xacro_origins({mount.name: T}), f"_{_MOUNT}.xacro")


def _read(source: Path, options: ExportOptions) -> _Source:
    which, tool = options.which, options.tool
    if source.is_dir():
        return _of_calibration(read_calibration(source), which, tool)
    if source.suffix in (".yaml", ".yml"):
        data = read_yaml(source)
        if isinstance(data, Mapping) and "modcal_calibration" in data:
            return _of_calibration(from_data(data, str(source)), which, tool)
    return read_robot(source, options.base, options.tip).chain, ()


def _of_calibration(calibration: Calibration, which: str, tool: bool) -> _Source:
    model = getattr(calibration, which)
    chain = model.chain
    if tool:
        origins = chain.origins.copy()
        origins[-1] = origins[-1] @ model.T_tip_tool
        chain = replace(chain.with_origins(origins), tip="tool")
    left = [f"{effect.family} of {effect.label}" for effect in model.effects]
    if left:
        left.append("geometry alone does best with --which geometric")
    return chain, tuple(left)


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
