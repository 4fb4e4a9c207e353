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
from modcal_nodes.cli.certificate import certified_hashes, exit_code
from modcal_nodes.cli.console import Output
from modcal_nodes.cli.inputs import arm_line
from modcal_nodes.io import Options, Watch, opened, option, repeated

if TYPE_CHECKING:
    from modcal_core.camera import (
        CameraImages,
        CameraProblem,
        CameraSolution,
        Lens,
        MarkerBundle,
        PrintedTarget,
        ReadingsBeside,
    )
    from modcal_core.report import Particulars
    from modcal_nodes.vision import ImageFolder


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
    over = next(link for link in _above(tree, tree.link(tip)) if link in _above(tree, tree.link(base)))
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


def _above(tree: Tree, link: str) -> list[str]:
    """The link and what carries it, up to the root."""
    out = [link]
    while out[-1] in tree.above:
        out.append(tree.above[out[-1]].parent)
    return out


def stated_lenses(given: Sequence[str]) -> dict[str, tuple[Lens, str]]:
    """The lenses in camera_info files, each with its file, by camera_key of its camera, "" where none is said."""
    from modcal_nodes.vision import camera_key, read_camera_info

    out: dict[str, tuple[Lens, str]] = {}
    for said in given:
        name, _, file = ("", "", said) if Path(said).exists() else said.rpartition("=")
        if not Path(file).exists():
            raise BadTable(f"--camera-info {said}", f"names no file {file}", "give FILE, or CAMERA=FILE")
        if (key := camera_key(name)) in out:
            raise BadTable(f"--camera-info {said}", "is given twice", "give one file a camera")
        out[key] = read_camera_info(Path(file)), file
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
    intrinsics: str = option("What becomes of these.", default="tolerance", choices=("free", "tolerance", "fixed"))
    arm_mm: float | None = option("Error of the nominal arm at its tool, RMS, as known.", above=0.0, metavar="MM")
    mounting: str | None = option("Where the camera is. Default: found.", choices=("tip", "world"))
    fisheye: bool = option("The lens is a fisheye, where no camera_info says so.", default=False)
    flat_target: bool = option("The target is flat: on glass or aluminium.", default=False)

    @property
    def on_tip(self) -> bool | None:
        """Whether the arm carries the camera; None where it is not stated."""
        return None if self.mounting is None else self.mounting == "tip"


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

    def problem(self) -> tuple[CameraProblem, Robot, ImageFolder, tuple[str, ...]]:
        """(What is to be solved, the robot, the images of the first camera, notes). Raises ModcalError."""
        from modcal_core.camera import CameraProblem

        robot, notes = self._arm()
        two_arms, told = bool(notes), tuple[str, ...]()
        (first, found), *others = self._images(robot).items()
        seen = {name or "images": (one, self.target, self.camera.on_tip) for name, one in others}
        for name, one in others:
            out = (f"left out: {image}: {why}." for image, why in one.left_out.items())
            notes += tuple(f"{name}: {said}" for said in (*one.notes, *out))
        if self.recording is not None:
            seen |= dict(self._also(said, robot) for said in self.camera.also_camera)
            told = tuple(r.topic for r in self.recording.readings if not r.by_type)
        self._require_named([first, *seen])
        if told and two_arms:
            notes += ("Readings of other instruments are left out: where they stand, the chain's first link moves.",)
        problem = CameraProblem(
            robot.chain,
            (
                self._seen(first, found, self.target, self.camera.on_tip, self.lenses.get("")),
                *(self._seen(name, *one) for name, one in seen.items()),
            ),
            arm_m=None if self.camera.arm_mm is None else 1e-3 * self.camera.arm_mm,
            fixed=self.options.fixed,
            inertias=robot.inertias,
            beside=self._beside(robot, told) if told and not two_arms else None,
            look_for_effects=not self.options.geometry_only,
        )
        return problem, robot, found, (*found.notes, *notes)

    def _arm(self) -> tuple[Robot, tuple[str, ...]]:
        """The robot, and a note on two arms."""
        urdf, recording = self.options.urdf, self.recording
        tracks = () if recording is None else recording.joints
        columns = frozenset(name for track in tracks for name in track.names)
        recorded = columns if self.camera.joints is None else _columns(self.camera.joints)
        if urdf is not None:
            text, where = camera_urdf(urdf).read_text(encoding="utf-8", errors="replace"), str(urdf)
        elif recording is None or recording.robot_description is None:
            source = "images" if recording is None else recording.source
            raise BadRobot(source, "holds no robot_description", "give --urdf, or record the topic")
        else:
            text, where = recording.robot_description, f"{recording.source}, robot_description"
        with about(where):
            return arm_between(text, self.options.base, self.options.tip, recorded)

    def _images(self, robot: Robot) -> dict[str, ImageFolder]:
        """Images by camera: of a folder, of tables of corners, or of the bag."""
        from modcal_nodes.vision import read_corner_tables, read_images

        images, joints = self.camera.images, self.camera.joints
        if images is None or joints is None:
            return {"": self._of_topic(self.camera.image_topic, "", self.target, robot)}
        if images.is_dir():
            return {"": read_images(images, joints, robot.names, self.target, self.watch)}
        sizes = {name: lens.size for name, (lens, _) in self.lenses.items()}
        return read_corner_tables(images, joints, robot.names, self.target, sizes)

    def _of_topic(
        self, topic: str | None, camera: str, target: PrintedTarget | MarkerBundle, robot: Robot
    ) -> ImageFolder:
        """What the bag's images of a topic show; None: of the only one. camera: key of its lens."""
        from modcal_nodes.vision import read_bag_images

        assert self.bag is not None
        assert self.recording is not None
        size = self.lenses[camera][0].size if camera in self.lenses else None
        return read_bag_images(self.bag, self.recording, robot.names, target, topic, self.watch, size)

    def _also(
        self, said: str, robot: Robot
    ) -> tuple[str, tuple[ImageFolder, PrintedTarget | MarkerBundle, bool | None]]:
        """The topic of a further camera of the bag, what it saw, of which target, and that nobody says where it is.

        said: the topic, and after = the file of its target, where that is another.
        """
        from modcal_core.camera import read_any_target
        from modcal_nodes.vision import camera_key

        topic, _, file = said.partition("=")
        if file and not Path(file).exists():
            raise BadTable(f"--also-camera {said}", f"names no file {file}", "give TOPIC, or TOPIC=target.yaml")
        target = read_any_target(Path(file)) if file else self.target
        return topic, (self._of_topic(topic, camera_key(topic), target, robot), target, None)

    def _seen(
        self,
        name: str,
        found: ImageFolder,
        target: PrintedTarget | MarkerBundle,
        on_tip: bool | None,
        otherwise: tuple[Lens, str] | None = None,
    ) -> CameraImages:
        """What a camera saw. on_tip: whether the arm carries it, where stated. otherwise: a lens for any camera."""
        from modcal_core.camera import CameraImages
        from modcal_nodes.vision import camera_key, require_size

        lens, source = self.lenses.get(camera_key(name)) or otherwise or (found.lens, found.lens_of)
        if lens is not None:
            require_size(lens, found.size, source)
        return CameraImages(
            *(found.q, found.views, target, found.size, found.velocity, lens, self.camera.intrinsics, on_tip),
            flat=self.camera.flat_target,
            moments=found.moments,
            fisheye=self.camera.fisheye,
            name=name or "images",
        )

    def _require_named(self, cameras: list[str]) -> None:
        """Raises BadTable for a lens of which it is not clear whose it is. cameras: names, the first may be empty."""
        from modcal_nodes.vision import camera_key

        first, stated, known = cameras[0], self.lenses, ", ".join(cameras)[:200]
        if strange := set(stated) - {"", *map(camera_key, cameras)}:
            known = f"they are of {known}" if first else "they have one camera, without a name"
            said = f"--camera-info {min(strange)}=…"
            raise BadTable(said, "names no camera of these images", f"name it as they do: {known}")
        if "" in stated and first and len(cameras) > 1:
            said = f"does not say of which camera it is: {known}"
            raise BadTable(f"--camera-info {stated[''][1]}", said, f"give {first}=FILE, and so on")

    def _beside(self, robot: Robot, told: Collection[str]) -> ReadingsBeside:
        """Readings of other instruments in the bag. told: topics that are surely theirs."""
        from modcal_core.camera import beside

        assert self.bag is not None
        assert self.recording is not None
        self.watch("reading other instruments")
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
    is_folder, wrong = camera.images is not None, ""
    of_images = is_folder or camera.target is not None
    missing = [name for name in ("joints", "target", "urdf") if name not in given] if is_folder else []
    allowed = {*_TOGETHER, *_ALSO} - ({"image_topic", "also_camera"} if is_folder else {"joints"})
    if bag is None and not is_folder:
        wrong = "--target needs a bag with images, or --images." if of_images else "Missing argument 'BAG'."
    elif not of_images and (alone := given & set(_TOGETHER)):
        wrong = f"{_option(min(alone))} needs --images, or --target and a bag with images."
    elif missing:
        wrong = f"--images needs {_option(missing[0])}."
    elif of_images and "cell_file" in given and "certificate" not in given:
        wrong = "--cell states what is on a certificate where there are images: give --certificate."
    elif of_images and (other := given - allowed):
        wrong = f"{_option(min(other))} does not work with {'these ' if min(other) in _TOGETHER else ''}images."
    if wrong:
        raise click.UsageError(wrong, ctx)
    return of_images


def calibrate_images(
    camera: CameraOptions, options: Options, bag: Path | None, output: Output, said: Particulars | None = None
) -> int:
    """Calibrate the arm from images, of a folder or in the bag, write the results, and say them.

    said: what is stated for a certificate, None if none is asked for. Returns the exit code.
    """
    # OpenCV, which other verbs can do without
    from modcal_core.report import camera_certificate, camera_report, camera_tolerance

    with output.working() as watch:
        robot, found, solution = _solved(camera, options, bag, watch)
        images = len(found.views) + len(found.left_out)
        source = camera.images or bag
        assert source is not None
        met = None if options.tolerance_mm is None else camera_tolerance(solution, options.tolerance_mm)
        report = camera_report(solution, robot, images, found.left_out, met)
        if said is not None and met is not None:
            watch("writing the certificate")
            calibration = report.files["calibration.yaml"]
            hashes = certified_hashes(options.urdf or robot.description, calibration, [source, camera.joints])
            page = camera_certificate(solution, report.data, met, said, hashes).html()
            report = replace(report, files={**report.files, "certificate.html": page})
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
    from modcal_core.camera import read_any_target, solve_camera

    assert camera.target is not None
    source = CameraSource(camera, options, read_any_target(camera.target), bag, watch)
    problem, robot, found, notes = source.problem()
    solution = solve_camera(problem, np.random.default_rng(options.seed), watch)
    return robot, found, replace(solution, notes=notes)


def _option(name: str) -> str:
    return {"fixed": "--fix", "cell_file": "--cell", "more": "--also"}.get(name, f"--{name.replace('_', '-')}")
