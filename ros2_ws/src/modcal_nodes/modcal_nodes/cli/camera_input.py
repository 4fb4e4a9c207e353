"""``modcal calibrate`` from images of a printed target: a folder with a table of joints, or those in a bag."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from modcal_core.errors import BadRobot, BadTable, about
from modcal_core.measurements import Recording
from modcal_core.robot import Robot
from modcal_core.robots import Tree, chain_forward, held_behind, parse, read_chain, rerooted
from modcal_msgs_py import Topics, read_recording
from modcal_nodes.cli.console import Output
from modcal_nodes.cli.inputs import arm_line
from modcal_nodes.cli.options import certified_hashes, exit_code
from modcal_nodes.io import Options, Watch, opened, option, repeated

if TYPE_CHECKING:
    from modcal_core.camera import CameraImages, CameraSolution, Lens, MarkerBundle, PrintedTarget, ReadingsBeside
    from modcal_core.report import Particulars
    from modcal_nodes.vision import ImageFolder


def described_arm(
    urdf: Path | None, base: str | None, tip: str | None, recorded: Collection[str], recording: Recording | None = None
) -> tuple[Robot, tuple[str, ...]]:
    """As :func:`arm_between`, of a file, or of the description in a recording where no file is given."""
    if urdf is not None:
        text, where = urdf.read_text(encoding="utf-8", errors="replace"), str(urdf)
    elif recording is None or recording.robot_description is None:
        source = "images" if recording is None else recording.source
        raise BadRobot(source, "holds no robot_description", "give --urdf, or record the topic")
    else:
        text, where = recording.robot_description, f"{recording.source}, robot_description"
    with about(where):
        return arm_between(text, base, tip, recorded)


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
class CameraOptions:
    """What is asked of a calibration by camera, by the names of the command's options. images: a folder, or a table of
    corners; None for those in a bag.
    """

    images: Path | None = option(
        "Images of a target, or a CSV of its corners by one camera or several; with --joints, --target, --urdf.",
        metavar="FOLDER",
    )
    joints: Path | None = option(
        "CSV: a column image (or stamp [s], images being named by theirs) and one a joint [rad, m].", metavar="FILE"
    )
    target: Path | None = option(
        "target.yaml of modcal target, Kalibr's, or a body's: calibrate from images in BAG, or --images.",
        metavar="FILE",
    )
    image_topic: str | None = option("Images of BAG. Default: the only ones there are.", metavar="TOPIC")
    also_camera: tuple[str, ...] = repeated(
        "Images of a further camera in BAG, and the target that it sees, where that is another file.", "TOPIC[=FILE]"
    )
    camera_info: tuple[str, ...] = repeated(
        "Intrinsics, of a camera of several by its name. Default: from the images.", "[CAMERA=]FILE"
    )
    intrinsics: str = option(
        "What becomes of those in --camera-info.",
        default="tolerance",
        choices=("free", "tolerance", "fixed"),
    )
    arm_mm: float | None = option(
        "Error of the nominal arm at its tool, RMS, as you know it.",
        above=0.0,
        metavar="MM",
    )
    mounting: str | None = option("Where the camera is. Default: found.", choices=("tip", "world"))
    fisheye: bool = option("The lens is a fisheye, where no camera_info says so.", default=False)
    flat_target: bool = option("The target is flat: on glass or aluminium.", default=False)

    @property
    def on_tip(self) -> bool | None:
        """Whether the arm carries the camera; None where it is not stated."""
        return None if self.mounting is None else self.mounting == "tip"


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


@dataclass(frozen=True)
class CameraSource:
    """Where images come from: options, the target that they show, and a bag, or None."""

    camera: CameraOptions
    options: Options
    target: PrintedTarget | MarkerBundle
    bag: Path | None
    watch: Watch

    @cached_property
    def recording(self) -> Recording | None:
        """What the bag holds beside images."""
        topics = Topics.of(self.options.topic, self.options.ignore)
        return None if self.bag is None else read_recording(self.bag, topics=topics)

    @cached_property
    def lenses(self) -> dict[str, tuple[Lens, str]]:
        """Lenses as :func:`stated_lenses` has them."""
        return stated_lenses(self.camera.camera_info)

    def read(self) -> CameraInput:
        """The robot, and what was seen of it. Raises ModcalError."""
        if self.camera.images is None:
            robot, notes, seen = self._in_bag()
        else:
            robot, notes, seen = self._in_files(self.camera.images)
        two_arms = bool(notes)
        (first, found), *others = seen.items()
        further = [self._further(name or "images", one, self.target, self.camera.on_tip) for name, one in others]
        for name, one in others:
            out = (f"left out: {image}: {why}." for image, why in one.left_out.items())
            notes += tuple(f"{name}: {said}" for said in (*one.notes, *out))
        if self.recording is not None:
            further += [self._also(said, robot) for said in self.camera.also_camera]
        lens = self._lens(found, [first, *(one.name for one in further)])
        readings = None
        told = [] if self.recording is None else [r for r in self.recording.readings if not r.by_type]
        if told and two_arms:
            notes += ("Readings of other instruments are left out: where they stand, the chain's first link moves.",)
        elif told:
            readings = self._beside(robot)
        return CameraInput(robot, found, readings, tuple(further), lens, notes)

    def _in_files(self, images: Path) -> tuple[Robot, tuple[str, ...], dict[str, ImageFolder]]:
        """(The robot, a note on two arms, images by camera) of a folder, or of tables of corners."""
        from modcal_nodes.vision import read_corner_tables, read_images

        joints, options = self.camera.joints, self.options
        assert joints is not None
        assert options.urdf is not None
        robot, notes = described_arm(camera_urdf(options.urdf), options.base, options.tip, _columns(joints))
        if images.is_dir():
            return robot, notes, {"": read_images(images, joints, robot.names, self.target, self.watch)}
        sizes = {name: lens.size for name, (lens, _) in self.lenses.items()}
        return robot, notes, read_corner_tables(images, joints, robot.names, self.target, sizes)

    def _in_bag(self) -> tuple[Robot, tuple[str, ...], dict[str, ImageFolder]]:
        """The same of the bag's images."""
        from modcal_nodes.vision import read_bag_images

        options = self.options
        assert self.bag is not None
        assert self.recording is not None
        urdf = None if options.urdf is None else camera_urdf(options.urdf)
        recorded = frozenset(name for track in self.recording.joints for name in track.names)
        robot, notes = described_arm(urdf, options.base, options.tip, recorded, self.recording)
        size = self.lenses[""][0].size if "" in self.lenses else None
        topic = self.camera.image_topic
        found = read_bag_images(self.bag, self.recording, robot.names, self.target, topic, self.watch, size)
        return robot, notes, {"": found}

    def _also(self, said: str, robot: Robot) -> CameraImages:
        """What a further camera of the bag saw. said: its topic, and after = the file of its target, where that is
        another.
        """
        from modcal_core.camera import read_any_target
        from modcal_nodes.vision import camera_key, read_bag_images

        assert self.bag is not None
        assert self.recording is not None
        topic, _, file = said.partition("=")
        if file and not Path(file).exists():
            raise BadTable(f"--also-camera {said}", f"names no file {file}", "give TOPIC, or TOPIC=target.yaml")
        target = read_any_target(Path(file)) if file else self.target
        lens = self.lenses.get(camera_key(topic))
        size = None if lens is None else lens[0].size
        found = read_bag_images(self.bag, self.recording, robot.names, target, topic, self.watch, size)
        return self._further(topic, found, target, None)

    def _further(
        self, name: str, found: ImageFolder, target: PrintedTarget | MarkerBundle, on_tip: bool | None
    ) -> CameraImages:
        """What a further camera saw. on_tip: whether the arm carries the camera."""
        from modcal_nodes.vision import camera_key, require_size

        lens, source = self.lenses.get(camera_key(name), (found.lens, found.lens_of))
        if lens is not None:
            require_size(lens, found.size, source)
        return replace(self.seen(found, target, lens, on_tip), name=name)

    def seen(
        self, found: ImageFolder, target: PrintedTarget | MarkerBundle, lens: Lens | None, on_tip: bool | None
    ) -> CameraImages:
        """What a camera saw. lens: where known. on_tip: whether the arm carries the camera, where stated."""
        from modcal_core.camera import CameraImages

        return CameraImages(
            *(found.q, found.views, target, found.size, found.velocity, lens, self.camera.intrinsics, on_tip),
            flat=self.camera.flat_target,
            moments=found.moments,
            fisheye=self.camera.fisheye,
        )

    def _lens(self, found: ImageFolder, cameras: list[str]) -> Lens | None:
        """The lens of the first camera, as far as it is stated. cameras: names of all, the first may be empty."""
        from modcal_nodes.vision import camera_key, require_size

        first, stated = cameras[0], self.lenses
        if strange := set(stated) - {"", *map(camera_key, cameras)}:
            known = f"they are of {', '.join(cameras)[:200]}" if first else "they have one camera, without a name"
            raise BadTable(
                f"--camera-info {min(strange)}=…", "names no camera of these images", f"name it as they do: {known}"
            )
        if "" in stated and first and len(cameras) > 1:
            said = f"does not say of which camera it is: {', '.join(cameras)[:200]}"
            raise BadTable(f"--camera-info {stated[''][1]}", said, f"give {first}=FILE, and so on")
        lens, source = stated.get(camera_key(first)) or stated.get("") or (found.lens, found.lens_of)
        if lens is not None:
            require_size(lens, found.size, source)
        return lens

    def _beside(self, robot: Robot) -> ReadingsBeside:
        """Readings of other instruments in the bag."""
        from modcal_core.camera import beside

        assert self.bag is not None
        assert self.recording is not None
        self.watch("reading other instruments")
        told = {r.topic for r in self.recording.readings if not r.by_type}
        # poses that nobody called a tracker's may be made from these very images
        guessed = [r.topic for r in self.recording.readings if r.by_type and r.topic not in told]
        topics = Topics.of(self.options.topic, [*self.options.ignore, *guessed])
        samples = opened(self.bag, self.watch, topics).samples(robot, self.options.clock_limit)
        return beside(robot.chain, samples, robot.inertias)


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


_TOGETHER = tuple(one.name for one in fields(CameraOptions))
_OF_ALL = ("urdf", "base", "tip", "fixed", "seed", "geometry_only", "topic", "ignore", "clock_limit")
_CERTIFIED = ("tolerance_mm", "certificate", "serial", "cell_file")
_ALSO = (*_OF_ALL, *_CERTIFIED, "out", "as_json", "verbose", "bag")


def by_camera(ctx: click.Context, bag: Path | None, camera: CameraOptions) -> bool:
    """Whether a call is about images, of a folder or in the bag.

    Raises click.UsageError unless there is a bag, or images with all that they need, and nothing that does not go
    with them.
    """
    given = {name for name in ctx.params if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE}
    if camera.images is None and camera.target is None:
        if bag is None:
            raise click.UsageError("Missing argument 'BAG'.", ctx)
        if alone := given & set(_TOGETHER):
            raise click.UsageError(f"{_option(min(alone))} needs --images, or --target and a bag with images.", ctx)
        return False
    if camera.images is None:
        if bag is None:
            raise click.UsageError("--target needs a bag with images, or --images.", ctx)
        if camera.joints is not None:
            raise click.UsageError("--joints needs --images: a bag has joint states.", ctx)
    else:
        if missing := [name for name in ("joints", "target", "urdf") if name not in given]:
            raise click.UsageError(f"--images needs {_option(missing[0])}.", ctx)
        if of_bag := given & {"image_topic", "also_camera"}:
            raise click.UsageError(f"{_option(min(of_bag))} is of a bag: leave out --images.", ctx)
    if "cell_file" in given and "certificate" not in given:
        raise click.UsageError(
            "--cell states what is on a certificate where there are images: give --certificate.", ctx
        )
    if other := given - set(_TOGETHER) - set(_ALSO):
        raise click.UsageError(f"{_option(min(other))} does not work with images.", ctx)
    return True


def calibrate_images(
    camera: CameraOptions,
    options: Options,
    bag: Path | None,
    output: Output,
    said: Particulars | None = None,
) -> int:
    """Calibrate the arm from images, of a folder or in the bag, write the results, and say them.

    said: what is stated for a certificate, None if none is asked for. Returns the exit code.
    """
    # OpenCV, which other verbs can do without
    from modcal_core.report import (
        camera_certificate,
        camera_report,
        camera_tolerance,
        certificate_html,
    )

    with output.working() as watch:
        robot, found, solution = _solved(camera, options, bag, watch)
        images = len(found.views) + len(found.left_out)
        source = camera.images or bag
        assert source is not None
        met = None if options.tolerance_mm is None else camera_tolerance(solution, options.tolerance_mm)
        report = camera_report(solution, robot, images, found.left_out, met)
        if said is not None:
            watch("writing the certificate")
            calibration = report.files["calibration.yaml"]
            hashes = certified_hashes(options.urdf or robot.description, calibration, [source, camera.joints])
            page = camera_certificate(solution, robot.name or "", met, said, hashes, images)
            report = replace(report, files={**report.files, "certificate.html": certificate_html(page)})
    output.saved(report, f"{source.resolve().stem}_calibration", arm_line(robot))
    return exit_code(met)


def plan_next_images(camera: CameraOptions, options: Options, count: int, output: Output) -> None:
    """Choose the images to take after those that there are, from a folder or a bag, write them, and say them."""
    from modcal_core.camera import plan_images
    from modcal_core.report import VerbResult, csv_text

    source = camera.images
    assert source is not None
    bag = None if camera.joints is not None else source
    if bag is not None:
        camera = replace(camera, images=None)
    with output.working() as watch:
        robot, _, solution = _solved(camera, options, bag, watch)
        watch("choosing images")
        found = plan_images(solution.fit, solution.camera.given.target, count, np.random.default_rng(options.seed))
    tilts, away = np.degrees(found.tilt), found.distance
    reach = f"from {away.min():.2f} to {away.max():.2f} m"
    shown = f"the target {reach}, tilted by {tilts.min():.0f}° to {tilts.max():.0f}°"
    over = "where the target is in view"
    if solution.fit.table.places:
        over, shown = "of the arm by itself wherever the camera stands", f"the body {reach}"
    said = [
        f"{count} images more: the expected error at the tool, {over}, falls from "
        f"{1e3 * found.expected_m[0]:.2f} to {1e3 * found.expected_m[-1]:.2f} mm RMS.",
        f"They show {shown}. Nothing was checked for collisions.",
    ]
    data = {
        "joints": list(robot.names),
        "stations": found.q.tolist(),
        "expected_mm": (1e3 * found.expected_m).tolist(),
        "tilt_deg": tilts.tolist(),
        "distance_m": away.tolist(),
    }
    files = {"stations.csv": csv_text(robot.names, found.q)}
    result = VerbResult(data, said, files, "Images to take", "stations.csv")
    output.saved(result, f"{source.resolve().stem}_plan", arm_line(robot))


def _solved(
    camera: CameraOptions, options: Options, bag: Path | None, watch: Watch
) -> tuple[Robot, ImageFolder, CameraSolution]:
    from modcal_core.camera import CameraProblem, read_any_target, solve_camera

    assert camera.target is not None
    target = read_any_target(camera.target)
    source = CameraSource(camera, options, target, bag, watch)
    read = source.read()
    robot, found = read.robot, read.found
    problem = CameraProblem(
        robot.chain,
        (source.seen(found, target, read.lens, camera.on_tip), *read.further),
        arm_m=None if camera.arm_mm is None else 1e-3 * camera.arm_mm,
        fixed=options.fixed,
        inertias=robot.inertias,
        beside=read.others,
        look_for_effects=not options.geometry_only,
    )
    solution = solve_camera(problem, np.random.default_rng(options.seed), watch)
    return robot, found, replace(solution, notes=(*found.notes, *read.notes))


def _option(name: str) -> str:
    return {"fixed": "--fix", "cell_file": "--cell", "more": "--also"}.get(name, f"--{name.replace('_', '-')}")
