"""``modcal calibrate`` from images of a printed target: a folder with a table of joints, or those in a bag."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from modcal_core.robot import Robot
from modcal_nodes.cli.camera_input import CameraOptions, CameraSource
from modcal_nodes.cli.certificate import certified_hashes, exit_code
from modcal_nodes.cli.console import Output
from modcal_nodes.cli.inputs import arm_line
from modcal_nodes.io import Options, Watch

if TYPE_CHECKING:
    from modcal_core.camera import CameraSolution
    from modcal_core.report import Particulars
    from modcal_nodes.vision import ImageFolder

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
