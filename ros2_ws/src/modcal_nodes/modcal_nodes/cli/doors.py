"""``modcal articulate`` and ``modcal door``: which joint moved a handle, and a simulated door that is opened."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.articulation import Track, choose, require_convention
from modcal_core.errors import BadCommand, BadRecording, about
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POINT, POSE, ReadingTrack, Recording, cleaned, joints_by_time
from modcal_core.report import URDF, Articulation, articulation_report
from modcal_core.robots import chain_forward
from modcal_msgs_py import SUFFIXES, Topics, accepted, list_topics, read_recording, role_of
from modcal_msgs_py.tables import read_track
from modcal_nodes.cli.console import EXISTING, WRITTEN, Decimal, Output, Whole, given, saving, speaking, written
from modcal_nodes.cli.inputs import arm_line, chain_line, described, whole_rows
from modcal_nodes.io import ChainOptions, option, read_calibration, repeated

_MAX = 2000  # samples; of more, evenly chosen ones say the same


@dataclass(frozen=True)
class _Read:
    """Positions or poses (m, 3) or (m, 7), stamps (m,) or None, the frame they are in, and the arm that held it.

    left_out: rows of a table that hold no reading. unread: its columns of angles.
    """

    values: Array
    stamps: Array | None
    frame: str
    arm: str = ""
    left_out: int = 0
    unread: str = ""


@dataclass(frozen=True)
class ArticulateOptions(ChainOptions):
    """What is asked of a recording of a handle."""

    topic: tuple[str, ...] = repeated(
        "Poses or points of the handle, or joint_states; or ROLE=NAME, as for calibrate. Default: the first found.",
        "NAME",
    )
    ignore: tuple[str, ...] = repeated("Leave a topic out. Repeatable.", "TOPIC")
    tf: str | None = option("The handle is this pair of frames in /tf.", metavar="PARENT:CHILD")
    urdf: Path | None = option("Robot description, for joint states. Default: the bag's.")
    calibration: Path | None = option("For joint states: the arm as it was calibrated.")
    points: bool = option("Ignore rotations.", default=False)
    seed: int = option("Seed for choosing the samples of the first guesses.", default=0, low=0)


@click.command("articulate")
@click.argument("bag", type=EXISTING)
@given(ArticulateOptions)
@saving()
def articulate_command(bag: Path, output: Output, options: ArticulateOptions) -> None:
    """Identify how the handle in BAG moves: fixed, sliding, turning, a screw, or none of these; and write it as a URDF.

    Models of installed packages are compared too; they have no URDF.

    BAG is a bag with tracker poses or points, or joint states of the arm that holds the handle; or a text file with
    x y z, or x y z qx qy qz qw, in every line [m], a time before them or not; or a table with labels above its columns.
    """
    if bag.is_file() and not bag.name.endswith(SUFFIXES):
        text = read_track(bag)
        read = _Read(text.values, text.stamps, "", left_out=text.left_out, unread=text.unread)
    else:
        handle = next((name for name in options.topic if "=" not in name), None)
        topics = Topics.of([name for name in options.topic if "=" in name], options.ignore, options.tf)
        read = _of_bag(read_recording(bag, topics=_with_handle(bag, topics, handle)), handle, options)
    rows = np.unique(np.linspace(0, len(read.values) - 1, _MAX).round().astype(int))  # first and last pose too
    values = read.values[rows][:, : 3 if options.points else None]
    with about(str(bag)):
        track = Track.of_poses(values, None if read.stamps is None else read.stamps[rows])
    with output.working() as watch:
        watch("weighing the kinds of joint")
        rng = np.random.default_rng(options.seed)
        choice = choose(track, rng)
        if not read.arm:  # else the poses are the arm's by its joints, which nobody else wrote
            with about(str(bag)):
                require_convention(track, choice, rng)
    found = Articulation(bag.name, read.frame, track, choice)
    before = [read.arm] if read.arm else []
    if read.left_out:
        before.append(f"{read.left_out} of {len(read.values) + read.left_out} rows hold no reading and are left out.")
    if read.unread:
        before.append(f"Columns {read.unread} are not read, only positions: give quaternions for rotations.")
    report = articulation_report(found)
    out = output.out or Path(f"{bag.resolve().stem}_articulation")
    output.saved(report, out, *before)
    if URDF not in report.files:  # one of an earlier call would tell of another joint
        (out / URDF).unlink(missing_ok=True)


def _with_handle(bag: Path, topics: Topics, handle: str | None) -> Topics:
    """What is said of the topics, with one of poses or points that is no tracker's by its name taken for one."""
    name = None if handle is None else "/" + handle.strip("/")
    for one in () if name is None else list_topics(bag):
        if one.topic == name and role_of(one.topic, one.type_name) is None:
            for role in ("tracker/pose", "tracker/point"):
                if one.type_name in accepted(role):
                    return topics.over(Topics(((role, one.topic),)))
    return topics


def _of_bag(recording: Recording, topic: str | None, options: ArticulateOptions) -> _Read:
    """What a bag shows of the handle: the named topic, else poses, else points, else the arm's joints."""
    urdf, calibration = options.urdf, options.calibration
    wanted = None if topic is None else "/" + topic.strip("/")
    shown = [r for kind in (POSE, POINT) for r in recording.readings if r.kind == kind and len(r.stamps)]
    of_arm = wanted is not None and any(track.topic == wanted for track in recording.joints)
    named = [r for r in shown if r.topic == wanted]
    if wanted is not None and not (of_arm or named):
        had = ", ".join(sorted({r.topic for r in shown} | {t.topic for t in recording.joints}))
        raise BadRecording(f"topic {wanted}", "shows no poses, points or joint states", f"use {had}")
    if not of_arm and (named or (shown and urdf is None and calibration is None)):
        return _reading((named or shown)[0])
    if not recording.joints:
        raise BadRecording(recording.source, "shows no handle: no poses, points or joint states", "record one of them")
    if calibration is not None:
        chain = read_calibration(calibration).calibrated.serial
        arm = chain_line(chain.base, chain.tip, chain.n)
    else:
        robot = described(recording, None, urdf, options.base, options.tip)
        chain, arm = robot.chain, arm_line(robot)
    stamps, q = joints_by_time(recording, chain.names)
    good = whole_rows(recording, chain.names, q)
    return _Read(se3.to_pose(chain_forward(chain, q[good])), stamps[good], chain.base, arm)


def _reading(reading: ReadingTrack) -> _Read:
    (reading,) = cleaned(Recording(readings=(reading,)), ()).recording.readings
    order = np.argsort(reading.stamps, kind="stable")
    return _Read(reading.values[order], reading.stamps[order], reading.frame)


_NODE, _LOG, _RESULT = "door_demo", "nodes.log", "pull.json"
_DOMAINS = 100  # of them every system has ports for; 0 is the one that robots usually speak in


@click.command("door")
@click.option("--kind", type=click.Choice(["door", "drawer"]), default="door", help="What to open.")
@click.option("--seed", type=Whole(0, 2**31 - 1), default=0, help="Seed of the object, its place and the noise.")
@click.option(
    "--patience", type=Decimal(5.0, 3600.0), default=90.0, metavar="S", help="Time after which it is given up."
)
@click.option("--domain", type=Whole(0, 232), help="ROS_DOMAIN_ID of the nodes. Default: one of its own.")
@click.option("--out", type=WRITTEN, help="Folder of the results. Default: KIND_demo.")
@speaking
def door_command(kind: str, seed: int, patience: float, domain: int | None, out: Path | None, output: Output) -> None:
    """Open a simulated door or drawer from start to end, and report what was learned of it.

    Starts an arm and an object in MuJoCo, articulation_estimator and impedance_setpoint, in a ROS domain of their own,
    and pulls. The nodes are told the direction of the first pull only. Takes about half a minute. Exit code 0: it is
    open; 2: it is not, and one line says why.
    """
    out = out or Path(f"{kind}_demo")
    chosen = 1 + os.getpid() % _DOMAINS if domain is None else domain
    program = _program()
    parameters = {"kind": kind, "seed": seed, "patience_s": patience, "out": str(out.resolve())}
    out.mkdir(parents=True, exist_ok=True)
    (out / _RESULT).unlink(missing_ok=True)
    with output.working() as watch:
        watch(f"opening a {kind}; ROS_DOMAIN_ID={chosen} modcal watch shows the nodes")
        code = _opened(program, parameters, chosen, out / _LOG)
    if code or not (out / _RESULT).is_file():
        raise BadCommand(f"{kind} {seed}", _last_word(out / _LOG), f"see {out / _LOG}, or give another --seed")
    data = json.loads((out / _RESULT).read_text(encoding="utf-8"))
    names = [_LOG, _RESULT, *data["files"]]
    output.result(data, data["sentences"], written(out, names))


def _program() -> Path:
    """The executable of the demonstration. Raises ModcalError where it, or what it speaks, is not installed."""
    from ament_index_python.packages import get_package_prefix  # only where ROS is

    from modcal_nodes.ros import interface

    interface("Pull")
    try:
        return Path(get_package_prefix("modcal_nodes"), "lib", "modcal_nodes", _NODE)
    except (LookupError, OSError) as error:
        raise BadCommand("package modcal_nodes", "is not installed for ROS", "source install/setup.bash") from error


def _opened(program: Path, parameters: dict[str, Any], domain: int, log: Path) -> int:
    """The exit code of the demonstration, whose nodes write to a log."""
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    # whatever robot listens in this network must not be told to move
    alone = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(domain)}
    with log.open("wb") as stream:
        child = subprocess.Popen(
            [program, "--ros-args", *given], env={**os.environ, **alone}, stdout=stream, stderr=stream,
            start_new_session=True,
        )  # fmt: skip
        try:
            return child.wait()
        except BaseException:
            child.send_signal(signal.SIGINT)
            child.wait()
            raise


def _last_word(log: Path) -> str:
    """What the demonstration said in the end, in its one line for a refusal."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    refused = [line.removeprefix("modcal: ") for line in lines if line.startswith("modcal: ")]
    return refused[-1] if refused else "did not end as it should"
