"""``modcal sensitivity`` and ``modcal plan``: which parameters matter, and where to measure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadTable, NotEnoughData, NotRepresentable
from modcal_core.files import read_yaml, to_yaml
from modcal_core.geometry import se3
from modcal_core.planning import (
    CANDIDATES,
    LEVELS,
    RETURNS,
    ClosedChain,
    DecidingStations,
    Measured,
    PlanRequest,
    Site,
    array_postures,
    calibration_chain,
    dh_closed_chain,
    plan,
    pool_near,
    separations,
    site_from_data,
    sizes_of,
    study,
)
from modcal_core.report import VerbResult, plan_report, sensitivity_report
from modcal_core.robots import Mechanism, is_serial_arm, vector
from modcal_nodes.cli.console import EXISTING, Output, given, saving
from modcal_nodes.cli.inputs import arm_line, read_robot, read_stations
from modcal_nodes.io import ChainOptions, Options, option, read_calibration, repeated


@dataclass(frozen=True)
class SensitivityOptions(ChainOptions):
    """What is asked of a study: lengths [mm], angles [mrad]."""

    tool: tuple[float, float, float] = option(
        "Position of the tracked target in the tip link [m].",
        default=(0.05, 0.0, 0.1),
        type=float,
        nargs=3,
        metavar="X Y Z",
    )
    parameters: str = option(
        "The 4 n + 9 of the closed chain, or those that modcal calibrate fits.",
        default="dh",
        choices=("dh", "calibration"),
    )
    levels: int = option(
        "Levels of each joint in the orthogonal array of postures; a prime.", default=LEVELS, low=2, high=31
    )
    length_mm: float = option("Errors of lengths.", default=0.5, low=0.0)
    angle_mrad: float = option("Errors of angles.", default=1.0, low=0.0)
    sizes: Path | None = option("YAML of other sizes, {NAME or PATTERN: SI}.")
    only: tuple[str, ...] = repeated(
        "Study only parameters of this name or pattern, e.g. '*/theta'; the others are known. Repeatable.", "NAME"
    )
    base_factor: str | None = option("Parameter that the others are compared with. Default: base/x.", metavar="NAME")
    stations: Path | None = option(
        "plan.yaml of modcal plan, or a CSV of joint positions: do they observe the important parameters? "
        "Default: the array's.",
        "--measured",
        metavar="STATIONS",
    )
    reading: str = option(default="point", choices=("point", "pose"))
    noise_mm: float = option("Noise of positions, per axis.", default=0.05, low=1e-6)
    noise_mrad: float = option("Noise of orientations, per axis.", default=0.05, low=1e-6)


@click.command("sensitivity")
@click.argument("robot", type=EXISTING)
@given(SensitivityOptions)
@saving()
def sensitivity_command(robot: Path, output: Output, options: SensitivityOptions) -> None:
    """Report which parameters of ROBOT (a URDF, or a YAML table such as examples/robots/irb1410.yaml) matter most."""
    arm = read_robot(robot, options.base, options.tip)
    closed = _closed_chain(arm.mechanism, options.parameters, options.tool, options.reading).only(options.only)
    sizes = sizes_of(closed, 1e-3 * options.length_mm, 1e-3 * options.angle_mrad, _tolerances(options.sizes))
    q = array_postures(closed.chain, options.levels)
    stations = read_stations(options.stations, closed.chain) if options.stations else q
    measured = Measured(stations, options.reading, 1e-3 * options.noise_mm, 1e-3 * options.noise_mrad)
    base = options.base_factor or next((f.name for f in closed.factors if f.is_length), closed.names[0])
    with output.working() as watch:
        watch("moving each parameter")
        result = study(closed, q, sizes, base, measured)
        watch("writing the report")
        report = sensitivity_report(result, robot.stem)
    output.saved(report, f"{robot.stem}_sensitivity", arm_line(arm))


def _closed_chain(chain: Mechanism, parameters: str, tool: tuple[float, float, float], reading: str) -> ClosedChain:
    if parameters == "dh" and is_serial_arm(chain):
        try:
            return dh_closed_chain(chain, point=tool)
        except NotRepresentable as error:
            raise NotRepresentable(error.offender, error.limit, "give --parameters calibration") from error
    return calibration_chain(chain, T_tip_tool=se3.transform(p=tool), kind=reading)


def _tolerances(path: Path | None) -> dict[str, float]:
    if path is None:
        return {}
    data: Any = read_yaml(path)
    if not isinstance(data, dict):
        raise BadTable(str(path), "is not a mapping", "give {NAME or PATTERN: metres or radians}")
    return {str(name): float(vector([size], 1, f"{path}, {name}")[0]) for name, size in data.items()}


def _decide(options: PlanOptions, report: Path, site: Site, output: Output) -> None:
    """Propose the stations that tell explanations apart, say what they are worth, and write plan.yaml."""
    folder = report if report.is_dir() else report.parent
    calibration = read_calibration(folder)
    ties = sum(map(len, calibration.rivals))
    if not ties:
        raise NotEnoughData(str(report), "no effect in it has a rival", "there is nothing to decide: use it as it is")
    rng = np.random.default_rng(options.seed)
    share = max(2, (options.stations or _DECIDING) // ties)
    said, decided = [], []
    for found, instead in separations(calibration, pool_near(calibration, site, rng), share, rng):
        effect, rival = found.effect, found.rival
        said.append(f"{effect.family}: {effect.label}, or {rival.family}: {rival.label}?")
        said.append(f"  postures cannot decide this: {instead}" if instead else f"  {_worth(found)}")
        if found.decides:
            ways = [{"approach": a.astype(int).tolist()} if a.any() else {} for a in found.approach]
            stations = [{"position": q.tolist(), **way} for q, way in zip(found.q, ways, strict=True)]
            between = [effect.label, rival.label]
            decided.append({"between": between, "separation": found.separation, "stations": stations})
    data = {"modcal_plan": 1, "joints": list(calibration.nominal.chain.names), "ties": decided}
    if decided:
        result = VerbResult(data, said, {"plan.yaml": to_yaml(data)}, "Stations", "plan.yaml")
        output.saved(result, folder.with_name(f"{folder.name}_plan"))
    else:
        output.result(data, said)


def _worth(proposal: DecidingStations) -> str:
    if proposal.decides:
        return f"{len(proposal.q)} stations tell them apart, by {proposal.separation:.0f} standard deviations"
    if proposal.same and proposal.by_effort:
        return (
            "postures cannot decide this: what the actuators exert beyond gravity is not known in advance: "
            "record stations with another payload, and come to them from both sides"
        )
    if proposal.same:
        return "no posture within the limits tells them apart: for this tool they are the same motion"
    return (
        f"{len(proposal.q)} stations tell them apart by {proposal.separation:.1f} standard deviations only: "
        f"about {proposal.needed} are needed (--stations)"
    )


_NEXT = 10  # images, where no number is asked for
_DECIDING = 16  # stations, where none are asked for


@dataclass(frozen=True)
class PlanOptions(ChainOptions):
    """What is asked of a plan, by the names of the command's options."""

    site: Path | None = option(
        "YAML: tracker, target, noise, spheres of the arm, floor, obstacles, limits. See docs/planning.md.",
        metavar="FILE",
    )
    stations: int | None = option("Stations. Default: twice what modcal calibrate needs; with --decide: 16.", low=2)
    accuracy_mm: float | None = option("Use as many stations as needed for this error of the calibrated arm.", low=1e-6)
    measure: str = option("Statistic of --accuracy-mm.", default="p95", choices=("p95", "rms"))
    reading: str = option(default="point", choices=("point", "pose"))
    fixed: tuple[str, ...] = repeated("Fixed parameter, as in modcal calibrate. Repeatable.", "NAME", "--fix")
    besides: Path | None = option("plan.yaml or CSV of stations measured already, which count too.", metavar="STATIONS")
    candidates: int = option("Postures to choose from.", default=CANDIDATES, low=10, high=20_000)
    speed: float = option("Joint speed of trajectory.yaml, rad/s.", default=0.5, low=1e-3)
    dwell: float = option("Standstill at each station, s.", default=2.0, low=0.6)
    report: Path | None = option(
        "Folder or report.json of a calibration whose effects have rivals (same_as): stations that tell them apart.",
        "--decide",
        metavar="REPORT",
    )
    returns: int = option(
        "Stations visited twice, so that the noise floor is known. None with fewer than three stations to each.",
        default=RETURNS,
        low=0,
        high=100,
    )
    camera: Path | None = option(
        "Bag with images, or folder of them with --joints: which images to take next; with --target.", metavar="IMAGES"
    )
    joints: Path | None = option("Joints of --camera's images, as in calibrate.", metavar="FILE")
    target: Path | None = option("Printed target of --camera's images.", metavar="FILE")
    seed: int = option("Seed of candidates.", default=0, low=0)

    def request(self, chain: Mechanism) -> PlanRequest:
        """The same for this arm, as the core has it."""
        return PlanRequest(
            stations=self.stations,
            accuracy=None if self.accuracy_mm is None else 1e-3 * self.accuracy_mm,
            measure=self.measure,
            reading=self.reading,
            fixed=self.fixed,
            candidates=self.candidates,
            besides=None if self.besides is None else read_stations(self.besides, chain),
            returns=self.returns,
        )


@click.command("plan")
@click.argument("robot", type=EXISTING, required=False)
@given(PlanOptions)
@saving("Folder of plan.yaml.")
def plan_command(robot: Path | None, output: Output, options: PlanOptions) -> None:
    """Choose the best stations to calibrate ROBOT (a URDF, or a YAML table), or stations that separate explanations."""
    if any(one is not None for one in (options.camera, options.joints, options.target)):
        _by_camera(robot, options, output)
        return
    site = Site() if options.site is None else site_from_data(read_yaml(options.site), str(options.site))
    if options.report is not None:
        if robot is not None or options.accuracy_mm is not None:
            raise BadTable("--decide", "cannot be combined with ROBOT or --accuracy-mm", "give REPORT alone")
        _decide(options, options.report, site, output)
        return
    if robot is None:
        raise BadTable("modcal plan", "is given neither a ROBOT nor --decide REPORT", "give one of them")
    if options.stations is not None and options.accuracy_mm is not None:
        raise BadTable("--stations", "cannot be combined with --accuracy-mm", "give one of them")
    arm = read_robot(robot, options.base, options.tip)
    request = options.request(arm.mechanism)
    with output.working() as watch:
        watch("choosing stations")
        found = plan(arm.mechanism, site, request, np.random.default_rng(options.seed))
        watch("writing the plan")
        report = plan_report(found, robot.stem, options.speed, options.dwell)
    output.saved(report, f"{robot.stem}_plan", arm_line(arm))


def _by_camera(robot: Path | None, asked: PlanOptions, output: Output) -> None:
    from modcal_nodes.cli.camera_input import CameraOptions, plan_next_images

    if asked.camera is None or asked.target is None:
        given = "--camera" if asked.camera is not None else "--target" if asked.target is not None else "--joints"
        raise BadTable(given, "needs --camera and --target", "give the images so far, and the target that they show")
    if asked.joints is not None and robot is None:
        raise BadTable("--joints", "needs ROBOT", "give the URDF: a folder of images has none")
    images = CameraOptions(asked.camera, asked.joints, asked.target)
    arm = Options(robot, base=asked.base, tip=asked.tip, fixed=asked.fixed, geometry_only=True, seed=asked.seed)
    plan_next_images(images, arm, asked.stations or _NEXT, output)
