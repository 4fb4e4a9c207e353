"""``modcal plan``: what to record next."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadTable
from modcal_core.files import read_yaml, to_yaml, write_folder
from modcal_core.planning.criteria import ACCURACY, CRITERIA
from modcal_core.planning.plan import STARTS, Plan, PlanRequest, plan
from modcal_core.planning.posture_pool import CANDIDATES
from modcal_core.planning.returns import RETURNS
from modcal_core.planning.site import Site, site_from_data
from modcal_core.report.planning import figure, sentences, to_csv, to_html, to_plan_data, to_trajectory_data
from modcal_nodes.cli.console import Output, say, speaking, written
from modcal_nodes.cli.number import Decimal, Whole
from modcal_nodes.cli.paths import EXISTING, WRITTEN
from modcal_nodes.cli.robot import BASE, TIP, file_line, read_robot
from modcal_nodes.cli.stations import read_stations

_NEXT = 10  # images, where no number is asked for
_DECIDING = 16  # stations, where none are asked for
_THOROUGH = 6000, 8  # candidates and starts


@click.command("plan")
@click.argument("robot", type=EXISTING, required=False)
@BASE
@TIP
@click.option(
    "--site", "site_file", type=EXISTING, metavar="FILE",
    help="YAML: tracker, target, noise, spheres of the arm, floor, obstacles, limits. See docs/planning.md.",
)  # fmt: skip
@click.option(
    "--stations", type=Whole(min=2),
    help="Number of stations. Default: half as many again as modcal calibrate needs; with --decide: 16.",
)  # fmt: skip
@click.option(
    "--accuracy-mm", type=Decimal(min=1e-6),
    help="Use as many stations as needed for this error of the calibrated arm.",
)  # fmt: skip
@click.option(
    "--measure", type=click.Choice(["p95", "rms"]), default="p95", show_default=True, help="Statistic of --accuracy-mm."
)
@click.option(
    "--criterion", type=click.Choice(CRITERIA), default=ACCURACY, show_default=True, help="Criterion to optimise."
)
@click.option("--reading", type=click.Choice(["point", "pose"]), default="point", show_default=True)
@click.option(
    "--fix", "fixed", multiple=True, metavar="NAME", help="Fixed parameter, as in modcal calibrate. Repeatable."
)
@click.option(
    "--besides", "measured", type=EXISTING, metavar="STATIONS",
    help="plan.yaml or CSV of stations that are already measured and count too.",
)  # fmt: skip
@click.option(
    "--candidates", type=Whole(10, 20_000),
    help=f"Postures to choose from. Default: {CANDIDATES}, with --thorough {_THOROUGH[0]}.",
)  # fmt: skip
@click.option(
    "--starts", type=Whole(1, 100),
    help=f"Random starts of the exchange. Default: {STARTS}, with --thorough {_THOROUGH[1]}.",
)  # fmt: skip
@click.option("--thorough", is_flag=True, help="Look longer for better stations.")
@click.option(
    "--speed", type=Decimal(1e-3), default=0.5, show_default=True, help="Joint speed of trajectory.yaml, rad/s."
)
@click.option("--dwell", type=Decimal(0.6), default=2.0, show_default=True, help="Standstill at each station, s.")
@click.option(
    "--decide", "report", type=EXISTING, metavar="REPORT",
    help="Folder or report.json of a calibration whose effects have rivals (same_as): stations that tell them apart.",
)  # fmt: skip
@click.option(
    "--returns", type=Whole(0, 100), default=RETURNS, show_default=True,
    help="Stations visited twice, so that the noise floor is known. None with fewer than three stations to each.",
)  # fmt: skip
@click.option(
    "--camera",
    type=EXISTING,
    metavar="IMAGES",
    help="Bag with images, or folder of them with --joints: which images to take next; with --target.",
)
@click.option("--joints", type=EXISTING, metavar="FILE", help="Joints of --camera's images, as in calibrate.")
@click.option("--target", type=EXISTING, metavar="FILE", help="Printed target of --camera's images.")
@click.option("--seed", type=Whole(min=0), default=0, show_default=True, help="Seed of candidates and starts.")
@click.option("--out", type=WRITTEN, help="Folder of plan.yaml.")
@speaking
def plan_command(
    robot: Path | None,
    base: str | None,
    tip: str | None,
    site_file: Path | None,
    stations: int | None,
    accuracy_mm: float | None,
    measure: str,
    criterion: str,
    reading: str,
    fixed: tuple[str, ...],
    measured: Path | None,
    candidates: int | None,
    starts: int | None,
    thorough: bool,
    speed: float,
    dwell: float,
    report: Path | None,
    returns: int,
    camera: Path | None,
    joints: Path | None,
    target: Path | None,
    seed: int,
    out: Path | None,
    output: Output,
) -> None:
    """Choose the best stations to calibrate ROBOT (a URDF, or a YAML table), or stations that separate explanations."""
    if camera is not None or joints is not None or target is not None:
        _by_camera(robot, base, tip, stations, fixed, camera, joints, target, seed, out, output)
        return
    site = None if site_file is None else site_from_data(read_yaml(site_file), str(site_file))
    if report is not None:
        from modcal_nodes.cli.deciding import decide

        if robot is not None or accuracy_mm is not None:
            raise BadTable(
                "--decide", "cannot be combined with ROBOT or --accuracy-mm", "give REPORT alone: it holds the robot"
            )
        decide(report, stations or _DECIDING, seed, out, site)
        return
    if robot is None:
        raise BadTable("modcal plan", "is given neither a ROBOT nor --decide REPORT", "give one of them")
    if stations is not None and accuracy_mm is not None:
        raise BadTable("--stations", "cannot be combined with --accuracy-mm", "give one of them")
    chain = read_robot(robot, base, tip)
    known = None if measured is None else read_stations(measured, chain)
    usual = _THOROUGH if thorough else (CANDIDATES, STARTS)
    request = PlanRequest(
        stations, None if accuracy_mm is None else 1e-3 * accuracy_mm, measure, criterion, reading, fixed,
        starts or usual[1], candidates or usual[0], known, returns,
    )  # fmt: skip
    with output.working() as watch:
        watch("choosing stations")
        found = plan(chain, site or Site(), request, np.random.default_rng(seed))
        out = out or Path(f"{robot.stem}_plan")
        watch("writing the plan")
        files = _files(found, speed, dwell, robot.stem)
        write_folder(out, files)
    said = [file_line(robot, chain, tip), *sentences(found)]
    output.result(to_plan_data(found), partial(say, said), written(out, files, "Stations", "plan.yaml"))


def _by_camera(
    robot: Path | None,
    base: str | None,
    tip: str | None,
    stations: int | None,
    fixed: tuple[str, ...],
    camera: Path | None,
    joints: Path | None,
    target: Path | None,
    seed: int,
    out: Path | None,
    output: Output,
) -> None:
    """The images to take after those that there are."""
    from modcal_nodes.cli.camera import plan_next_images

    if camera is None or target is None:
        given = "--joints" if target is None and camera is None else "--camera" if camera is not None else "--target"
        raise BadTable(given, "needs --camera and --target", "give the images so far, and the target that they show")
    if joints is not None and robot is None:
        raise BadTable("--joints", "needs ROBOT", "give the URDF: a folder of images has none")
    chosen = {
        "images": camera, "joints": joints, "target": target, "image_topic": None, "camera_info": None,
        "intrinsics": "tolerance", "arm_mm": None, "mounting": None, "flat_target": False, "fisheye": False,
    }  # fmt: skip
    options = {
        "urdf": robot, "base": base, "tip": tip, "fixed": fixed, "seed": seed, "geometry_only": True,
        "topic": (), "ignore": (), "clock_limit": 0.5,
    }  # fmt: skip
    plan_next_images(chosen, options, stations or _NEXT, out, output)


def _files(found: Plan, speed: float, dwell: float, title: str) -> dict[str, Any]:
    return {
        "plan.yaml": to_yaml(to_plan_data(found)),
        "stations.csv": to_csv(found),
        "trajectory.yaml": to_yaml(to_trajectory_data(found, speed, dwell)),
        "stations.svg": figure(found),
        "report.html": to_html(found, title),
    }
