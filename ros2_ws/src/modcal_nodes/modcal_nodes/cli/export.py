"""``modcal export``: an arm's kinematics as a CPC, DH or modified DH table, a URDF, a maker's file or a xacro file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import yaml

from modcal_core.calibration import Calibration, from_data
from modcal_core.errors import BadTable
from modcal_core.files import read_yaml, to_yaml, write_file
from modcal_core.geometry import se3
from modcal_core.report import kinematics_text
from modcal_core.robots import (
    CONVENTIONS,
    UNITS,
    Chain,
    chain_urdf,
    from_csv,
    from_table,
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
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.inputs import read_robot
from modcal_nodes.cli.options import EXISTING, WRITTEN, given
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
