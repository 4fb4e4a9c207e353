"""What a calibration by camera comes from: the robot, its images or corners of each camera, lenses, other readings."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.errors import BadRobot, BadTable, about
from modcal_core.measurements import Recording
from modcal_core.robot import Robot
from modcal_core.robots import Tree, chain_forward, held_behind, parse, read_chain, rerooted
from modcal_msgs_py import Topics, read_recording
from modcal_nodes.io import Watch, opened

if TYPE_CHECKING:
    from modcal_core.camera import CameraImages, Lens, MarkerBundle, PrintedTarget, ReadingsBeside
    from modcal_nodes.vision import ImageFolder


def arm_of_file(
    urdf: Path, base: str | None, tip: str | None, recorded: Collection[str]
) -> tuple[Robot, tuple[str, ...]]:
    """As arm_between, of a file."""
    with about(str(urdf)):
        return arm_between(urdf.read_text(encoding="utf-8", errors="replace"), base, tip, recorded)


def arm_recorded(
    recording: Recording, urdf: Path | None, base: str | None, tip: str | None
) -> tuple[Robot, tuple[str, ...]]:
    """As arm_between, of a recording, which holds the description where no file is given."""
    recorded = frozenset(name for track in recording.joints for name in track.names)
    if urdf is not None:
        return arm_of_file(urdf, base, tip, recorded)
    if recording.robot_description is None:
        raise BadRobot(recording.source, "holds no robot_description", "give --urdf, or record the topic")
    with about(f"{recording.source}, robot_description"):
        return arm_between(recording.robot_description, base, tip, recorded)


def arm_between(
    urdf: str, base: str | None, tip: str | None, recorded: Collection[str]
) -> tuple[Robot, tuple[str, ...]]:
    """(the arm, what is to be said of it, in sentences): where the tip is not carried by the base, both arms as one.

    urdf: text. recorded: names of the joints whose positions are known. The second is empty where the arm is one.
    Raises ModcalError.
    """
    if base is None or tip is None:
        return Robot.from_urdf(urdf, base, tip, recorded), ()
    tree = parse(urdf)
    over = _above_both(tree, tree.link(base), tree.link(tip))
    if over == base:
        return Robot.from_urdf(urdf, base, tip, recorded), ()
    turned = rerooted(urdf, base)
    robot = Robot.from_urdf(turned, base, tip)
    said = (
        f"{tip} is not carried by {base}: both arms are calibrated as one chain of {robot.n} joints from {base} over "
        f"{over} to {tip}, and calibrated.urdf has {base} as its root."
    )
    if over == tip or robot.inertias is None:
        return replace(robot, inertias=None), (said,)
    carrying = read_chain(urdf, tree.root(), base)
    down = -chain_forward(carrying, np.zeros((1, carrying.n)))[0, 2, :3]
    own = sum(joint.moves and joint.mimics is None for joint in tree.path(over, tree.link(base)))
    return replace(robot, inertias=held_behind(turned, robot.inertias, robot.chain, own, down)), (said,)


def _above_both(tree: Tree, base: str, tip: str) -> str:
    """The link that carries both, or is one of them."""
    above, link = {base}, base
    while link in tree.above:
        link = tree.above[link].parent
        above.add(link)
    link = tip
    while link not in above:
        link = tree.above[link].parent
    return link


def stated_lenses(given: Sequence[str]) -> dict[str, tuple[Lens, str]]:
    """The lenses in camera_info files, each with its file, by camera_key of its camera, "" where none is said."""
    from modcal_nodes.vision import camera_key, read_camera_info

    out = {}
    for said in given:
        name, file = ("", said) if Path(said).exists() else (said.rpartition("=")[0], said.rpartition("=")[2])
        if not Path(file).exists():
            raise BadTable(f"--camera-info {said}", f"names no file {file}", "give FILE, or CAMERA=FILE")
        if camera_key(name) in out:
            raise BadTable(f"--camera-info {said}", "is given twice", "give one file a camera")
        out[camera_key(name)] = read_camera_info(Path(file)), file
    return out


@dataclass(frozen=True)
class CameraInput:
    """robot: it. found: the images of the first camera. others: readings of other instruments in the bag, None where it
    has none. further: what further cameras saw. lens: stated of the first camera. notes: on the further ones, and
    on two arms.
    """

    robot: Robot
    found: ImageFolder
    others: ReadingsBeside | None = None
    further: tuple[CameraImages, ...] = ()
    lens: Lens | None = None
    notes: tuple[str, ...] = ()


def read_input(
    camera: dict[str, Any],
    options: dict[str, Any],
    target: PrintedTarget | MarkerBundle,
    bag: Path | None,
    watch: Watch,
    stated: dict[str, tuple[Lens, str]],
) -> CameraInput:
    """The robot, and what was seen of it."""
    from modcal_core.camera import beside
    from modcal_nodes.vision import camera_key, read_bag_images, read_corner_tables, read_images, require_size

    recording, first, notes, two_arms = None, "", tuple[str, ...](), tuple[str, ...]()
    further: tuple[CameraImages, ...] = ()
    if bag is not None:
        recording = read_recording(bag, topics=Topics.of(options["topic"], options["ignore"]))
    if camera["images"] is not None:
        columns = _columns(camera["joints"])
        robot, two_arms = arm_of_file(camera_urdf(options["urdf"]), options["base"], options["tip"], columns)
        if camera["images"].is_file():
            sizes = {name: lens.size for name, (lens, _) in stated.items()}
            by_name = read_corner_tables(camera["images"], camera["joints"], robot.names, target, sizes)
            (first, found), *others = by_name.items()
            on_tip = None if camera["mounting"] is None else camera["mounting"] == "tip"
            further = tuple(
                seen_by(name or "images", one, target, camera, stated.get(camera_key(name), (None, "")), on_tip)
                for name, one in others
            )
            for name, one in others:
                out = (f"left out: {image}: {why}." for image, why in one.left_out.items())
                notes += tuple(f"{name}: {said}" for said in (*one.notes, *out))
        else:
            found = read_images(camera["images"], camera["joints"], robot.names, target, watch)
    else:
        assert bag is not None
        assert recording is not None
        urdf = None if options["urdf"] is None else camera_urdf(options["urdf"])
        robot, two_arms = arm_recorded(recording, urdf, options["base"], options["tip"])
        size = stated[""][0].size if "" in stated else None
        found = read_bag_images(bag, recording, robot.names, target, camera["image_topic"], watch, size)
    if bag is not None and recording is not None:
        further += tuple(
            _further(one, bag, recording, robot, target, camera, stated, watch)
            for one in camera.get("also_camera") or ()
        )
    cameras = [first, *(one.name for one in further)]
    if strange := set(stated) - {"", *map(camera_key, cameras)}:
        known = f"they are of {', '.join(cameras)[:200]}" if first else "they have one camera, without a name"
        raise BadTable(
            f"--camera-info {min(strange)}=…", "names no camera of these images", f"name it as they do: {known}"
        )
    if "" in stated and first and further:
        said = f"does not say of which camera it is: {', '.join(cameras)[:200]}"
        raise BadTable(f"--camera-info {stated[''][1]}", said, f"give {first}=FILE, and so on")
    lens, source = stated.get(camera_key(first)) or stated.get("") or (found.lens, found.lens_of)
    if lens is not None:
        require_size(lens, found.size, source)
    told = [] if recording is None else [r for r in recording.readings if not r.by_type]
    if two_arms and told:
        notes += ("Readings of other instruments are left out: where they stand, the chain's first link moves.",)
    if bag is None or recording is None or not told or two_arms:
        return CameraInput(robot, found, None, further, lens, (*two_arms, *notes))
    watch("reading other instruments")
    # poses that nobody called a tracker's may be made from these very images
    guessed = [r.topic for r in recording.readings if r.by_type and r.topic not in {t.topic for t in told}]
    topics = Topics.of(options["topic"], [*options["ignore"], *guessed])
    samples = opened(bag, watch, topics).samples(robot, options["clock_limit"])
    readings = beside(robot.chain, samples, robot.inertias)
    return CameraInput(robot, found, readings, further, lens, notes)


def _further(
    said: str, bag: Path, recording: Recording, robot: Robot, target: PrintedTarget | MarkerBundle,
    camera: dict[str, Any], stated: dict[str, tuple[Lens, str]], watch: Watch,
) -> CameraImages:  # fmt: skip
    """What a further camera saw. said: its topic, and after = the file of its target, where that is another."""
    from modcal_core.camera import read_any_target
    from modcal_nodes.vision import camera_key, read_bag_images

    topic, _, file = said.partition("=")
    if file and not Path(file).exists():
        raise BadTable(f"--also-camera {said}", f"names no file {file}", "give TOPIC, or TOPIC=target.yaml")
    own = read_any_target(Path(file)) if file else target
    lens = stated.get(camera_key(topic))
    size = None if lens is None else lens[0].size
    found = read_bag_images(bag, recording, robot.names, own, topic, watch, size)
    return seen_by(topic, found, own, camera, lens or (found.lens, found.lens_of), None)


def seen_by(
    name: str,
    found: ImageFolder,
    target: PrintedTarget | MarkerBundle,
    camera: dict[str, Any],
    lens: tuple[Lens | None, str],
    on_tip: bool | None,
) -> CameraImages:
    """What a camera saw. lens: where known, and its source. on_tip: whether the arm carries it, where stated."""
    from modcal_core.camera import CameraImages
    from modcal_nodes.vision import require_size

    if lens[0] is not None:
        require_size(lens[0], found.size, lens[1])
    return CameraImages(
        *(found.q, found.views, target, found.size, found.velocity, lens[0], camera["intrinsics"], on_tip),
        flat=camera["flat_target"],
        moments=found.moments,
        fisheye=camera["fisheye"],
        name=name,
    )


def camera_urdf(path: Path) -> Path:
    """The path of a URDF; raises BadTable for a table, which has no origins to write back into."""
    if path.suffix in (".yaml", ".yml", ".csv"):
        raise BadTable(str(path), "is a table", "give a URDF: modcal import makes one of a table")
    return path


def _columns(path: Path) -> frozenset[str]:
    """The columns of a table of joints, so that the tip behind them is taken."""
    from modcal_nodes.vision import joint_column

    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline(1 << 16)
    return frozenset(joint_column(cell.strip())[0] for cell in first.replace(";", ",").split(","))
