"""``modcal measure-object``: the box in a gripper by its calibrated range sensors, and where to put it down."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from modcal_core.calibration import Calibration
from modcal_core.correction import GripperRays, HeldBox, Placing, StackPlace, held_box, placing, rests
from modcal_core.errors import BadTable, NotEnoughData, about
from modcal_core.geometry import Array, se3
from modcal_core.report import Quantity, Summary, SummaryLine, quantity_tables
from modcal_msgs_py import read_recording
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.inputs import numbers_by_joint
from modcal_nodes.cli.options import EXISTING, given
from modcal_nodes.io import TopicOptions, option, repeated


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
