"""``modcal calibrate`` from images of a printed target: a folder with a table of joints, or those in a bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from modcal_core.errors import BadTable
from modcal_core.files import write_folder
from modcal_core.robot import Robot
from modcal_msgs_py.choosing import Topics
from modcal_msgs_py.mcap_read import read_bag
from modcal_nodes.cli.certificate import UNMET, camera_certificate_files, certified_hashes
from modcal_nodes.cli.console import Output, tell, written
from modcal_nodes.cli.number import Decimal
from modcal_nodes.cli.robot import arm_line, described
from modcal_nodes.cli.two_arms import arm_between
from modcal_nodes.io.progress import Watch
from modcal_nodes.io.recorded import opened

if TYPE_CHECKING:
    from modcal_core.camera.beside import ReadingsBeside
    from modcal_core.camera.bundle import MarkerBundle
    from modcal_core.camera.lens import Lens
    from modcal_core.camera.prepared import CameraImages
    from modcal_core.camera.solve import CameraSolution
    from modcal_core.camera.target import PrintedTarget
    from modcal_core.measurements.recording import Recording
    from modcal_core.report.particulars import Particulars
    from modcal_nodes.vision.images import ImageFolder

_EXISTING = click.Path(exists=True, path_type=Path)
_OF_IMAGES = ("images", "joints", "target", "image_topic", "camera_info", "intrinsics", "arm_mm", "mounting")
_TOGETHER = (*_OF_IMAGES, "flat_target", "fisheye", "also_camera")
_OF_ALL = ("urdf", "base", "tip", "fixed", "seed", "geometry_only", "topic", "ignore", "clock_limit")
_CERTIFIED = ("tolerance_mm", "certificate", "serial", "cell_file")
_ALSO = (*_OF_ALL, *_CERTIFIED, "out", "as_json", "verbose", "bag")
OPTIONS = (
    click.option(
        "--images", type=_EXISTING, default=None, metavar="FOLDER",
        help="Images of a target, or a CSV of its corners by one camera or several; with --joints, --target, --urdf.",
    ),
    click.option(
        "--joints", type=_EXISTING, default=None, metavar="FILE",
        help="CSV: a column image (or stamp [s], images being named by theirs) and one a joint [rad, m].",
    ),
    click.option(
        "--target", type=_EXISTING, default=None, metavar="FILE",
        help="target.yaml of modcal target, Kalibr's, or a body's: calibrate from images in BAG, or --images.",
    ),
    click.option(
        "--image-topic", default=None, metavar="TOPIC", help="Images of BAG. Default: the only ones there are."
    ),
    click.option(
        "--also-camera", multiple=True, metavar="TOPIC[=FILE]",
        help="Images of a further camera in BAG, and the target that it sees, where that is another file.",
    ),
    click.option(
        "--camera-info", multiple=True, metavar="[CAMERA=]FILE",
        help="Intrinsics, of a camera of several by its name. Default: from the images.",
    ),
    click.option(
        "--intrinsics", type=click.Choice(["free", "tolerance", "fixed"]), default="tolerance", show_default=True,
        help="What becomes of those in --camera-info.",
    ),
    click.option(
        "--arm-mm", type=Decimal(min=0.0, min_open=True), default=None, metavar="MM",
        help="Error of the nominal arm at its tool, RMS, as you know it.",
    ),
    click.option(
        "--mounting", type=click.Choice(["tip", "world"]), default=None, help="Where the camera is. Default: found."
    ),
    click.option("--fisheye", is_flag=True, help="The lens is a fisheye, where no camera_info says so."),
    click.option("--flat-target", is_flag=True, help="The target is flat: on glass or aluminium."),
)  # fmt: skip


def camera_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with the options of a calibration by camera."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


def split_options(options: dict[str, Any]) -> dict[str, Any]:
    """The camera's options, taken out of all."""
    return {name: options.pop(name) for name in _TOGETHER}


def by_camera(ctx: click.Context, bag: Path | None, camera: dict[str, Any]) -> bool:
    """Whether a call is about images, of a folder or in the bag.

    Raises click.UsageError unless there is a bag, or images with all that they need, and nothing that does not go
    with them.
    """
    given = {name for name in ctx.params if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE}
    if camera["images"] is None and camera["target"] is None:
        if bag is None:
            raise click.UsageError("Missing argument 'BAG'.", ctx)
        if alone := given & set(_TOGETHER):
            raise click.UsageError(f"{_option(min(alone))} needs --images, or --target and a bag with images.", ctx)
        return False
    if camera["images"] is None:
        if bag is None:
            raise click.UsageError("--target needs a bag with images, or --images.", ctx)
        if camera["joints"] is not None:
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
    camera: dict[str, Any],
    options: dict[str, Any],
    bag: Path | None,
    out: Path | None,
    output: Output,
    said: Particulars | None = None,
) -> int:
    """Calibrate the arm from images, of a folder or in the bag, write the results, and say them.

    said: what is stated for a certificate, None where none is asked for. Returns the exit code.
    """
    # OpenCV, which other verbs can do without
    from modcal_core.report.camera import camera_files, camera_report, lines
    from modcal_core.report.camera_certificate import camera_tolerance

    with output.working() as watch:
        robot, found, solution = _solved(camera, options, bag, watch)
        images = len(found.views) + len(found.left_out)
        source = camera["images"] or bag
        assert source is not None
        met = None if options["tolerance_mm"] is None else camera_tolerance(solution, options["tolerance_mm"])
        files: dict[str, str | bytes] = {**camera_files(solution, robot, images, found.left_out, met=met)}
        if said is not None:
            watch("writing the certificate")
            calibration = str(files["calibration.yaml"])
            hashes = certified_hashes(options["urdf"] or robot.description, calibration, [source, camera["joints"]])
            files |= camera_certificate_files(solution, robot.name or "", met, said, hashes, images)
    out = out or Path(f"{source.resolve().stem}_calibration")
    write_folder(out, files)
    data = camera_report(solution, robot, images, found.left_out, met)
    told = [arm_line(robot), *lines(solution, images, found.left_out)]
    told += [] if met is None else [f"{met.result}: {met.because}"]
    output.result(data, partial(tell, told), written(out, files))
    return 0 if met is None or met.result == "PASS" else UNMET


def plan_next_images(
    camera: dict[str, Any], options: dict[str, Any], count: int, out: Path | None, output: Output
) -> None:
    """Choose the images to take after those that there are, from a folder or a bag, write them, and say them."""
    from modcal_core.camera.plan import plan_images

    bag = None if camera["joints"] is not None else camera["images"]
    source: Path = camera["images"]
    if bag is not None:
        camera = {**camera, "images": None}
    with output.working() as watch:
        robot, _, solution = _solved(camera, options, bag, watch)
        watch("choosing images")
        found = plan_images(solution.fit, solution.target, count, np.random.default_rng(options["seed"]))
    rows = "".join(",".join(f"{v:.9f}" for v in q) + "\n" for q in found.q)
    files = {"stations.csv": ",".join(robot.names) + "\n" + rows}
    out = out or Path(f"{source.resolve().stem}_plan")
    write_folder(out, files)
    tilts, away = np.degrees(found.tilt), found.distance
    said = [
        arm_line(robot),
        f"{count} images more: the expected error at the tool, where the target is in view, falls from "
        f"{1e3 * found.expected_m[0]:.2f} to {1e3 * found.expected_m[-1]:.2f} mm RMS.",
        f"They show the whole target from {away.min():.2f} to {away.max():.2f} m, tilted by {tilts.min():.0f}° to "
        f"{tilts.max():.0f}°. Nothing was checked for collisions.",
    ]
    data = {
        "joints": list(robot.names),
        "stations": found.q.tolist(),
        "expected_mm": (1e3 * found.expected_m).tolist(),
        "tilt_deg": tilts.tolist(),
        "distance_m": away.tolist(),
    }
    output.result(data, partial(tell, said), written(out, files, "Images to take", "stations.csv"))


def _solved(
    camera: dict[str, Any], options: dict[str, Any], bag: Path | None, watch: Watch
) -> tuple[Robot, ImageFolder, CameraSolution]:
    """The robot, its images, and what they lead to."""
    from modcal_core.camera.solve import solve_camera
    from modcal_core.camera.target_file import read_any_target, read_target

    if camera["images"] is not None and camera["images"].is_file():
        target = read_any_target(camera["target"])
    else:
        target = read_target(camera["target"])
    stated = _stated_lenses(camera["camera_info"] or ())
    read = _read(camera, options, target, bag, watch, stated)
    robot, found = read.robot, read.found
    solution = solve_camera(
        robot.chain,
        found.q,
        found.views,
        target,
        found.size,
        np.random.default_rng(options["seed"]),
        velocity=found.velocity,
        lens=read.lens,
        stated=camera["intrinsics"],
        arm_m=None if camera["arm_mm"] is None else 1e-3 * camera["arm_mm"],
        camera_on_tip=None if camera["mounting"] is None else camera["mounting"] == "tip",
        flat=camera["flat_target"],
        fixed=options["fixed"],
        progress=watch,
        moments=found.moments,
        inertias=robot.inertias,
        beside=read.others,
        look_for_effects=not options["geometry_only"] and not read.two_arms,
        fisheye=camera["fisheye"],
        further=read.further,
    )
    return robot, found, replace(solution, notes=(*found.notes, *read.notes))


def _stated_lenses(given: Sequence[str]) -> dict[str, tuple[Lens, str]]:
    """The lenses in camera_info files, each with its file, by the name of the camera, "" where none is said."""
    from modcal_nodes.vision.images import read_camera_info

    out = {}
    for said in given:
        name, file = ("", said) if Path(said).exists() else (said.rpartition("=")[0], said.rpartition("=")[2])
        if not Path(file).exists():
            raise BadTable(f"--camera-info {said}", f"names no file {file}", "give FILE, or CAMERA=FILE")
        if name in out:
            raise BadTable(f"--camera-info {said}", "is given twice", "give one file a camera")
        out[name] = read_camera_info(Path(file)), file
    return out


@dataclass(frozen=True)
class _Read:
    """robot: it. found: the images of the first camera. others: readings of other instruments in the bag, None where it
    has none. further: what further cameras saw. lens: stated of the first camera. notes: on the further ones. two_arms:
    whether the chain goes from one arm's tip to another's.
    """

    robot: Robot
    found: ImageFolder
    others: ReadingsBeside | None = None
    further: tuple[CameraImages, ...] = ()
    lens: Lens | None = None
    notes: tuple[str, ...] = ()
    two_arms: bool = False


def _read(
    camera: dict[str, Any],
    options: dict[str, Any],
    target: PrintedTarget | MarkerBundle,
    bag: Path | None,
    watch: Watch,
    stated: dict[str, tuple[Lens, str]],
) -> _Read:
    """The robot, and what was seen of it."""
    from modcal_core.camera.beside import beside
    from modcal_core.camera.target import PrintedTarget
    from modcal_nodes.vision.bag import read_bag_images
    from modcal_nodes.vision.corner_table import read_corner_tables
    from modcal_nodes.vision.images import read_images, require_size

    recording, first, notes, two_arms = None, "", tuple[str, ...](), tuple[str, ...]()
    further: tuple[CameraImages, ...] = ()
    if bag is not None:
        recording = read_bag(bag, topics=Topics.of(options["topic"], options["ignore"]))
    if camera["images"] is not None:
        columns = _columns(camera["joints"])
        robot, two_arms = arm_between(camera_urdf(options["urdf"]), options["base"], options["tip"], columns)
        if camera["images"].is_file():
            sizes = {name: lens.size for name, (lens, _) in stated.items()}
            by_name = read_corner_tables(camera["images"], camera["joints"], robot.names, target, sizes)
            (first, found), *others = by_name.items()
            further = tuple(_of_table(name, one, target, camera, stated) for name, one in others)
            notes += tuple(f"{name}: {said}" for name, one in others for said in (*one.notes, *_out(one)))
        else:
            assert isinstance(target, PrintedTarget)
            found = read_images(camera["images"], camera["joints"], robot.names, target, watch)
    else:
        assert bag is not None
        assert recording is not None
        assert isinstance(target, PrintedTarget)
        urdf = None if options["urdf"] is None else camera_urdf(options["urdf"])
        robot = described(recording, None, urdf, options["base"], options["tip"])
        size = stated[""][0].size if "" in stated else None
        found = read_bag_images(bag, recording, robot.names, target, camera["image_topic"], watch, size)
    if bag is not None and recording is not None and isinstance(target, PrintedTarget):
        further += tuple(
            _further(one, bag, recording, robot, target, camera["flat_target"], watch)
            for one in camera.get("also_camera", ())
        )
    if strange := set(stated) - {"", first, *(one.name for one in further)}:
        raise BadTable(f"--camera-info {min(strange)}=…", "names no camera of these images", "name it as they do")
    lens, source = stated.get(first) or stated.get("") or (found.lens, found.lens_of)
    if lens is not None:
        require_size(lens, found.size, source)
    if bag is None or recording is None or not (told := [r for r in recording.readings if not r.by_type]):
        return _Read(robot, found, None, further, lens, (*two_arms, *notes), bool(two_arms))
    watch("reading other instruments")
    # poses that nobody called a tracker's may be made from these very images
    guessed = [r.topic for r in recording.readings if r.by_type and r.topic not in {t.topic for t in told}]
    topics = Topics.of(options["topic"], [*options["ignore"], *guessed])
    samples = opened(bag, watch, topics).samples(robot, options["clock_limit"])
    readings = beside(robot.chain, samples, robot.inertias)
    return _Read(robot, found, readings, further, lens, (*two_arms, *notes), bool(two_arms))


def _out(found: ImageFolder) -> tuple[str, ...]:
    """What was left out of the images of a camera, in sentences."""
    return tuple(f"left out: {name}: {why}." for name, why in found.left_out.items())


def _of_table(
    name: str,
    found: ImageFolder,
    target: PrintedTarget | MarkerBundle,
    camera: dict[str, Any],
    stated: dict[str, tuple[Lens, str]],
) -> CameraImages:
    """What a further camera of a table of corners saw."""
    from modcal_core.camera.prepared import CameraImages
    from modcal_nodes.vision.images import require_size

    lens, source = stated.get(name) or (None, "")
    if lens is not None:
        require_size(lens, found.size, source)
    on_tip = None if camera["mounting"] is None else camera["mounting"] == "tip"
    return CameraImages(
        *(found.q, found.views, target, found.size, found.velocity, lens, camera["intrinsics"], on_tip),
        flat=camera["flat_target"],
        moments=found.moments,
        fisheye=camera["fisheye"],
        name=name or "images",
    )


def _further(
    said: str, bag: Path, recording: Recording, robot: Robot, target: PrintedTarget, flat: bool, watch: Watch
) -> CameraImages:
    """What a further camera saw. said: its topic, and after = the file of its target, where that is another."""
    from modcal_core.camera.prepared import CameraImages
    from modcal_core.camera.priors import TOLERANCE
    from modcal_core.camera.target_file import read_target
    from modcal_nodes.vision.bag import read_bag_images
    from modcal_nodes.vision.images import require_size

    topic, _, file = said.partition("=")
    if file and not Path(file).exists():
        raise BadTable(f"--also-camera {said}", f"names no file {file}", "give TOPIC, or TOPIC=target.yaml")
    own = read_target(Path(file)) if file else target
    found = read_bag_images(bag, recording, robot.names, own, topic, watch)
    if found.lens is not None:
        require_size(found.lens, found.size, found.lens_of)
    return CameraImages(
        *(found.q, found.views, own, found.size, found.velocity, found.lens, TOLERANCE, None, flat, found.moments),
        name=topic,
    )


def camera_urdf(path: Path) -> Path:
    """The path of a URDF; raises BadTable for a table, which has no origins to write back into."""
    if path.suffix in (".yaml", ".yml", ".csv"):
        raise BadTable(str(path), "is a table", "give a URDF: modcal import makes one of a table")
    return path


def _columns(path: Path) -> frozenset[str]:
    """The columns of a table of joints, so that the tip behind them is taken."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline(1 << 16)
    return frozenset(cell.strip() for cell in first.replace(";", ",").split(","))


def _option(name: str) -> str:
    return {"fixed": "--fix", "cell_file": "--cell", "more": "--also"}.get(name, f"--{name.replace('_', '-')}")
