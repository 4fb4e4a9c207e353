"""``modcal sensitivity``: which parameters of an arm its accuracy hangs on, and whether a plan would see them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.files import read_yaml
from modcal_core.geometry import se3
from modcal_core.planning import (
    ARMS,
    DESIGNS,
    ClosedChain,
    Measured,
    Studied,
    calibration_chain,
    design,
    dh_closed_chain,
    sizes_of,
    study,
)
from modcal_core.report import sensitivity_report
from modcal_core.robots import Mechanism, is_serial_arm, vector
from modcal_nodes.cli.console import Output, saving
from modcal_nodes.cli.inputs import arm_line, read_robot, read_stations
from modcal_nodes.cli.options import EXISTING, given
from modcal_nodes.io import ChainOptions, option, repeated


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
    design: str | None = option(
        "Design of postures for the indices. Default: l25, or sobol for more than six joints.",
        choices=DESIGNS,
    )
    levels: int = option("Levels of --design array; a prime.", default=5, low=2, high=31)
    postures: int | None = option("Postures of --design sobol. Default: 64, with --thorough 512.", low=4, high=4096)
    thorough: bool = option("Draw four times as many arms for the shares of the variance.", default=False)
    length_mm: float = option("Errors of lengths.", default=0.5, low=0.0)
    angle_mrad: float = option("Errors of angles.", default=1.0, low=0.0)
    sizes: Path | None = option("YAML of other sizes, {NAME or PATTERN: SI}.")
    only: tuple[str, ...] = repeated(
        "Study only parameters of this name or pattern, e.g. '*/theta'; the others are known. Repeatable.", "NAME"
    )
    base_factor: str | None = option("Parameter that the others are compared with. Default: base/x.", metavar="NAME")
    bins: int | None = option("Intervals of the multi-point weights.", low=1, high=1000)
    stations: Path | None = option(
        "plan.yaml of modcal plan, or a CSV of joint positions: do they observe the important parameters? "
        "Default: the design's.",
        "--measured",
        metavar="STATIONS",
    )
    reading: str = option(default="point", choices=("point", "pose"))
    noise_mm: float = option("Noise of positions, per axis.", default=0.05, low=1e-6)
    noise_mrad: float = option("Noise of orientations, per axis.", default=0.05, low=1e-6)
    seed: int = option(default=0, low=0)

    def studied(self, closed: ClosedChain, rng: np.random.Generator) -> Studied:
        """The study of this chain, as the core has it. Raises BadTable."""
        chain = closed.chain
        sizes = sizes_of(closed, 1e-3 * self.length_mm, 1e-3 * self.angle_mrad, _tolerances(self.sizes))
        kind = self.design or ("l25" if chain.n <= 6 else "sobol")
        q = design(chain, kind, rng, self.levels, self.postures or (512 if self.thorough else 64))
        stations = read_stations(self.stations, chain) if self.stations else q
        measured = Measured(stations, self.reading, 1e-3 * self.noise_mm, 1e-3 * self.noise_mrad)
        factor = self.base_factor or next((f.name for f in closed.factors if f.is_length), closed.names[0])
        return Studied(kind, q, sizes, factor, measured, self.bins, 4 * ARMS if self.thorough else ARMS)


@click.command("sensitivity")
@click.argument("robot", type=EXISTING)
@given(SensitivityOptions)
@saving()
def sensitivity_command(robot: Path, output: Output, options: SensitivityOptions) -> None:
    """Report which parameters of ROBOT (a URDF, or a YAML table such as examples/robots/irb1410.yaml) matter most."""
    arm = read_robot(robot, options.base, options.tip)
    closed = _closed_chain(arm.mechanism, options.parameters, options.tool, options.reading).only(options.only)
    rng = np.random.default_rng(options.seed)
    studied = options.studied(closed, rng)
    with output.working() as watch:
        watch("moving each parameter")
        result = study(closed, studied, rng)
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
