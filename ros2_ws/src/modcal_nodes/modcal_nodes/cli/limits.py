"""``modcal limits``, ``modcal payload`` and ``modcal measure-object``: what joints bear, and what the arm carries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.calibration import Calibration
from modcal_core.correction import GripperRays, HeldBox, Placing, StackPlace, held_box, placing, rests
from modcal_core.errors import BadRecording, BadTable, NotEnoughData, about
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Recording, efforts_at_rest, joints_by_time, spread_rows
from modcal_core.report import LimitsFound, Quantity, Summary, SummaryLine, limits_report, quantity_tables
from modcal_core.robot import Robot
from modcal_core.robots import Chain, JointPath, LoadedArm, Payload, Stands, Weighed, random_postures, weigh
from modcal_msgs_py import SUFFIXES, read_recording
from modcal_nodes.cli.console import EXISTING, Output, given, saving, speaking
from modcal_nodes.cli.inputs import arm_line, described, numbers_by_joint, read_stations, whole_rows
from modcal_nodes.io import ChainOptions, TopicOptions, option, repeated

_MAX = 2000  # postures of a bag; of more, evenly chosen ones say the same
_THOROUGH = 20_000  # for time, with --thorough


def _by_joint(text: str) -> Any:
    return option(f"{text} Repeat for more joints.", default=(), metavar="JOINT=VALUE")


def _numbers(text: str, *default: float) -> Any:
    return option(text, default=default, type=float, nargs=len(default), show_default=False)


@dataclass(frozen=True)
class LimitsOptions(ChainOptions, TopicOptions):
    """What is asked of bounds: the arm, what it carries, its postures, and its drives by joint, in SI."""

    urdf: Path | None = option("Robot description, for a bag. Default: the one in it.")
    payload: float = option("Mass that is carried [kg].", default=0.0, type=float)
    centre: tuple[float, ...] = _numbers("Centre of mass in the tip link [m].", 0.0, 0.0, 0.0)
    inertia: tuple[float, ...] = _numbers(
        "Inertia about the centre of mass: ixx iyy izz ixy ixz iyz [kg m²].", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )
    at: tuple[str, ...] = repeated("Position of a joint [rad; m]. Default: 0.", "JOINT=VALUE")
    velocity: tuple[str, ...] = repeated("Velocity of a joint [rad/s; m/s]. Default: 0.", "JOINT=VALUE")
    path: Path | None = option("Postures to pass in their order (CSV, or plan.yaml): the fastest motion through them.")
    workspace: int | None = option("Number of random postures within the limits.", low=1)
    seed: int = option("Seed of those postures.", default=0, low=0)
    thorough: bool = option("Of a bag up to 20 000 postures, not 2 000.", default=False)
    share: float = option("Share of the torque that may be used.", default=1.0, type=float)
    gravity: tuple[float, ...] = _numbers("Gravity in the base link [m/s²].", 0.0, 0.0, -9.80665)
    torque: tuple[str, ...] = _by_joint("Largest torque of a drive [N m; N], instead of the URDF's effort.")
    friction: tuple[str, ...] = _by_joint("Dry friction of a joint [N m; N], instead of the URDF's.")
    damping: tuple[str, ...] = _by_joint("Viscous friction of a joint [N m s/rad; N s/m], instead of the URDF's.")
    rotor: tuple[str, ...] = _by_joint("Inertia of motor and gear, seen from the joint [kg m²; kg].")

    def loaded(self, arm: LoadedArm) -> LoadedArm:
        """The arm with this payload, these drives and this gravity. Raises BadTable."""
        arm = arm.carrying(Payload.checked(self.payload, self.centre, self.inertia)).using(self.share, self.gravity)
        return arm.with_drives(
            torque=numbers_by_joint(self.torque, "--torque"),
            coulomb=numbers_by_joint(self.friction, "--friction"),
            viscous=numbers_by_joint(self.damping, "--damping"),
            rotor=numbers_by_joint(self.rotor, "--rotor"),
        )


@click.command("limits")
@click.argument("source", type=EXISTING)
@given(LimitsOptions)
@saving("Folder of limits.json, joint_limits.yaml and report.html.")
def limits_command(source: Path, output: Output, options: LimitsOptions) -> None:
    """Compute how fast each joint may accelerate within the torque of its drive.

    SOURCE is a URDF, for one posture (--at) or many (--workspace), or a bag, whose joint states are used.

    For each joint: the inertia it moves, the torque that gravity, friction and speed need, and bounds of its
    acceleration: by itself (equivalent), with all others within theirs (coupled), and one set for all postures
    (constant).
    """
    base, tip, topics = options.base, options.tip, options.topics
    recording = read_recording(source, topics=topics) if source.is_dir() or source.name.endswith(SUFFIXES) else None
    if recording is not None and (options.at or options.velocity or options.workspace or options.path):
        raise BadTable("--at, --velocity, --workspace, --path", f"and the postures of {source}", "give them a URDF")
    if recording is not None:
        robot = described(recording, None, options.urdf, base, tip)
    else:
        with about(str(source)):
            robot = Robot.from_urdf(source, base, tip)
    arm = options.loaded(LoadedArm.read(robot.description or "", robot.base, robot.tip))
    if recording is not None:
        q, v, notes = _recorded(arm, recording, _THOROUGH if options.thorough else _MAX)
    else:
        q, v = _motion(arm.chain, options)
        notes = ()
    found = LimitsFound(arm, q, v, source.name, None if options.path is None else JointPath.through(q))
    with output.working() as watch:
        watch(f"looking at {len(q)} posture{'s' * (len(q) > 1)}")
        report = limits_report(found, source.stem, notes)
    if output.out is None:
        output.result(report.data, [arm_line(robot), *report.said])
    else:
        output.saved(report, output.out, arm_line(robot))


def _motion(chain: Chain, options: LimitsOptions) -> tuple[Array, Array]:
    """Positions and velocities (N, n) that are asked for."""
    at, workspace = options.at, options.workspace
    if sum((options.path is not None, bool(at), workspace is not None)) > 1:
        raise BadTable("--path, --at, --workspace", "are three ways to choose postures", "give one of them")
    if options.path is not None:
        q = read_stations(options.path, chain)
        return q, np.zeros_like(q)
    speeds = _column(chain, options.velocity, "--velocity", np.zeros(chain.n))
    if workspace is not None:
        q = random_postures(chain, workspace, np.random.default_rng(options.seed))
        return q, np.tile(speeds, (len(q), 1))
    # a joint that cannot stand at zero stands at the limit next to it
    q = _column(chain, at, "--at", np.clip(0.0, chain.lower, chain.upper))
    outside = (q < chain.lower) | (q > chain.upper)
    if outside.any():
        j = int(np.argmax(outside))
        said = f"{q[j]:g} is outside its limits, {chain.lower[j]:g} to {chain.upper[j]:g}"
        raise BadTable(f"--at {chain.names[j]}", said, "give radians, or metres, within them")
    return q[None], speeds[None]


def _recorded(arm: LoadedArm, recording: Recording, most: int) -> tuple[Array, Array, tuple[str, ...]]:
    chain = arm.chain
    _, q, v = joints_by_time(recording, chain.names, "velocity")
    whole = whole_rows(recording, chain.names, q)
    notes = list(recording.warnings)
    if not whole.all():
        count = f"{int((~whole).sum())} of {len(q)}"
        notes.append(f"{count} joint states lack the position of a joint: they are left out.")
    q, v = q[whole], v[whole]
    if (~np.isfinite(v)).any():
        said = f"{int((~np.isfinite(v)).any(axis=1).sum())} of {len(q)} joint states report no velocity of some joint"
        notes.append(f"{said}: it counts as standing still, so that viscous friction is left out.")
    speed = np.abs(np.nan_to_num(v))
    # what an arm cannot do it did not: a simulation, or a description of another arm
    beyond = np.where(arm.drives.speed > 0.0, speed / arm.drives.speed, 0.0)
    fast = (beyond > 1.0).any(axis=1)
    if fast.any():
        j = int(np.argmax(beyond.max(axis=0)))
        unit = "rad/s" if chain.revolute[j] else "m/s"
        said = f"{chain.names[j]} reaches {speed[:, j].max():.3g} {unit}, {arm.drives.speed[j]:.3g} is its limit"
        if fast.all():
            remedy = "give the --urdf of this arm, or correct its velocity limits"
            limit = f"all move faster than the URDF allows: {said}"
            raise BadRecording(f"{recording.source}, joint_states", limit, remedy)
        count = f"{int(fast.sum())} of {len(q)}"
        notes.append(f"{count} joint states move faster than the URDF allows ({said}): they are left out.")
        q, v = q[~fast], v[~fast]
    rows = spread_rows(len(q), most)
    return q[rows], np.nan_to_num(v[rows]), tuple(notes)


def _column(chain: Chain, said: tuple[str, ...], option: str, otherwise: Array) -> Array:
    """A number of every joint (n,)."""
    out = np.array(otherwise)
    for name, value in numbers_by_joint(said, option).items():
        if name not in chain.names:
            raise BadTable(f"{option} {name}", "is not a joint of this arm", f"name one of {', '.join(chain.names)}")
        out[chain.names.index(name)] = value
    return out


_SURE = 3.0  # standard deviations by which a mass is told from nothing


@dataclass(frozen=True)
class PayloadOptions(ChainOptions, TopicOptions):
    """What is asked of a payload: the arm, a recording without it, and how far drives and description may be wrong."""

    without: Path | None = option("Bag of the same arm without the payload, in any postures.", metavar="BAG")
    urdf: Path | None = option("Robot description. Default: the one in the bag.")
    torque_constants: float = option("Standard deviation of torque constants [%].", default=5.0, type=float, above=0.0)
    masses: float = option("The same of the masses in the robot description [%].", default=10.0, type=float, above=0.0)
    gravity: tuple[float, ...] | None = option(
        "Which way gravity pulls in the base link, where its z does not point up.", type=float, nargs=3
    )


@click.command("payload")
@click.argument("bag", type=EXISTING)
@given(PayloadOptions)
@speaking
def payload_command(bag: Path, output: Output, options: PayloadOptions) -> None:
    """Weigh what the arm carries by the torques of its joints at rest: mass and centre, with their uncertainty.

    BAG has joint states with effort, of some ten postures that were held for a second. A second bag without the
    payload (--without) shows what the arm weighs by itself, and makes the answer several times sharper.
    """
    recording = read_recording(bag, topics=options.topics)
    robot = described(recording, None, options.urdf, options.base, options.tip)
    arm = LoadedArm.read(robot.description or "", robot.base, robot.tip)
    inertias = arm.inertias if options.gravity is None else arm.inertias.pulled(options.gravity)
    stands = [Stands(*efforts_at_rest(recording, arm.chain.names), True)]
    if options.without is not None:
        empty = read_recording(options.without, topics=options.topics)
        stands.append(Stands(*efforts_at_rest(empty, arm.chain.names), False))
    with about(str(bag)):
        found = weigh(arm.chain, inertias, stands, 1e-2 * options.torque_constants, 1e-2 * options.masses)
    said = [arm_line(robot), *_weighed(found, arm.chain, options.without is None)]
    output.result(weighed_data(found, arm.chain), said)


def weighed_data(found: Weighed, chain: Chain) -> dict[str, Any]:
    """A payload for JSON."""
    joints = zip(chain.names, found.scale.tolist(), found.scale_std.tolist(), found.scatter.tolist(), strict=True)
    return {
        "mass_kg": found.mass,
        "mass_std_kg": float(found.std[0]),
        "centre_m": found.centre.tolist(),
        "centre_std_m": found.std[1:].tolist(),
        "covariance": found.covariance.tolist(),
        "postures": found.postures,
        "joints": {name: {"factor": f, "factor_std": std, "scatter": scatter} for name, f, std, scatter in joints},
    }


def _weighed(found: Weighed, chain: Chain, alone: bool) -> list[Summary]:
    """The same for a terminal. alone: without a recording of the bare arm."""
    rows: list[Quantity] = [("mass", found.mass, float(found.std[0]), "kg")]
    centre = zip("xyz", found.centre.tolist(), found.std[1:].tolist(), strict=True)
    rows += [(f"centre, {axis} of {chain.tip}", at, std, "m") for axis, at, std in centre]
    out: list[Summary] = [*quantity_tables(rows, "payload")]
    if alone:
        remedy = "A bag without the payload (--without) shows the arm's own weight and sharpens this."
        out.append(SummaryLine(remedy, "legend"))
    if found.mass < _SURE * found.std[0]:
        out.append(SummaryLine("The mass cannot be told from nothing: its centre says little.", "doubt"))
    else:
        at = " ".join(f"{c:.4f}" for c in found.centre)
        out.append(SummaryLine(f"For limits and plans: --payload {found.mass:.3f} --centre {at}"))
    return out


@dataclass(frozen=True)
class HeldOptions(TopicOptions):
    """What is asked of a box in the gripper."""

    frame: str = option(
        "Frame of the result: the tip link, or tool, the tracked target that rays are calibrated in.",
        default="tip",
        choices=("tip", "tool"),
    )
    face: tuple[str, ...] = repeated(
        "Face of the box that a sensor looks at, as laser_1=-x. Default: the one that its ray runs against.",
        "SENSOR=FACE",
    )
    size: tuple[str, ...] = repeated("Known size of the box along its axis [m], as z=0.2. Repeatable.", "AXIS=NUMBER")
    stack: tuple[float, ...] | None = option(
        "Pose in the base link of the place on the stack: x y z qx qy qz qw, its z axis up.", type=float, nargs=7
    )
    stack_mm: float = option("Standard deviation of its position, per axis [mm].", default=0.0, low=0.0)
    stack_deg: float = option("The same of its orientation [deg].", default=0.0, low=0.0)
    down: str = option("Face that shall lie on the stack: +z is the one away from the gripper.", default="+z")
    corner: bool = option("Put the corner of least x and y there, not the middle of the face.", default=False)
    turn: float = option("Turn the box about the stack's z axis [deg].", default=0.0, type=float)

    @property
    def place(self) -> StackPlace | None:
        """Where the box shall stand, or None."""
        if self.stack is None:
            return None
        spread = np.diag(np.repeat([1e-3 * self.stack_mm, np.radians(self.stack_deg)], 3) ** 2)
        return StackPlace(self.stack, spread, self.down, self.corner, float(np.radians(self.turn)))

    @property
    def known(self) -> Array:
        """Known sizes [m], (3,), NaN for those that are not. Raises BadTable."""
        known = numbers_by_joint(self.size, "--size")
        if wrong := [text for text in known if text not in ("x", "y", "z") or known[text] <= 0.0]:
            raise BadTable(f"--size {wrong[0]}", "is not a size along x, y or z", "write it as z=0.2, in m")
        return np.array([known.get(axis, np.nan) for axis in "xyz"])


@click.command("measure-object")
@click.argument("calibration", type=EXISTING)
@click.argument("bag", type=EXISTING)
@given(HeldOptions)
@speaking
def measure_object_command(calibration: Path, bag: Path, output: Output, options: HeldOptions) -> int:
    """Measure the box in the gripper: pose in the tip link and size, with their uncertainty; with --stack, the pose
    of the tip that puts it down.

    CALIBRATION has the rays of the range sensors (gripper/range in its bag); BAG has their readings with a box at
    rest, one box after another. Rays are calibrated in the frame of the tracked target; they are brought into the tip.
    """
    rays = GripperRays.of(Calibration.load(calibration), "tool" if options.frame == "tool" else "tip")
    faces, size, place = rays.faces(options.face), options.known, options.place
    readings = read_recording(bag, topics=options.topics).readings
    data, blocks, untold = list[dict[str, object]](), list[Summary](), list[NotEnoughData]()
    with about(str(bag)):
        spans = rests(rays, readings)
        for span in spans:
            try:
                held = held_box(rays, readings, span, faces, size)
            except NotEnoughData as error:
                untold.append(error)
                data.append({"since_s": span[0], "until_s": span[1], "cannot_tell": str(error)})
                blocks.append(SummaryLine(f"From {span[0]:.3f} s on: {error}.", "bad"))
                continue
            put = None if place is None else placing(held, place)
            data.append({**held.data(), "placing": put and put.data()})
            blocks += held_summary(held, put)
        if len(untold) == len(spans):
            raise untold[0]
    output.result({"frame": rays.frame, "boxes": data}, blocks)
    return 3 if untold else 0


def held_summary(held: HeldBox, put: Placing | None) -> list[Summary]:
    """What is said of a box, and of where it goes."""
    std, position = np.sqrt(np.diag(held.pose_covariance)), held.box.T_frame_box[:3, 3]
    middle, size = zip("xyz", position, std, strict=False), zip("xyz", held.box.size, held.box.std[6:], strict=True)
    rows: list[Quantity] = [(f"{a} of its centre in {held.frame}", float(x), float(s), "m") for a, x, s in middle]
    rows += [(f"size along its {a}{'' if s else ', stated'}", float(x), float(s), "m") for a, x, s in size]
    out: list[Summary] = [*quantity_tables(rows, "box")]
    quaternion = " ".join(f"{x:.5f}" for x in se3.to_pose(held.box.T_frame_box)[3:])
    out.append(SummaryLine(f"Orientation in {held.frame}: {quaternion} (x y z w), ± {np.degrees(std[3:].max()):.2f}°."))
    if not held.box.spare:
        out.append(SummaryLine("No reading is spare: nothing checks that this is a box.", "doubt"))
    if held.silent:
        out.append(SummaryLine(f"{', '.join(held.silent)} read nothing.", "doubt"))
    if put is not None:
        pose = " ".join(f"{x:.5f}" for x in se3.to_pose(put.T_base_frame))
        off = 1e3 * np.sqrt(np.diag(put.covariance)[:3])
        out.append(SummaryLine(f"To put it down: {put.frame} at {pose} in the base link (x y z qx qy qz qw)."))
        within = ", ".join(f"{one:.2f}" for one in off)
        out.append(SummaryLine(f"It then stands within {within} mm (x y z, 1 σ), the arm's own error not counted."))
    return out
