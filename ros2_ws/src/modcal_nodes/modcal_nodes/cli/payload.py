"""``modcal payload``: weigh what an arm carries by the efforts of its joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from modcal_core.errors import about
from modcal_core.measurements import Recording, efforts_at_rest
from modcal_core.report import SummaryLine, TableBlock
from modcal_core.robots import Chain, LoadedArm, Stands, Weighed, weigh
from modcal_msgs_py import read_recording
from modcal_nodes.cli.console import Output, speaking
from modcal_nodes.cli.inputs import arm_line, described
from modcal_nodes.cli.options import EXISTING, given
from modcal_nodes.io import ChainOptions, TopicOptions, option

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
    stands = [_stands(recording, arm.chain, True)]
    if options.without is not None:
        stands.append(_stands(read_recording(options.without, topics=options.topics), arm.chain, False))
    with about(str(bag)):
        found = weigh(arm.chain, inertias, stands, 1e-2 * options.torque_constants, 1e-2 * options.masses)
    output.result(_data(found, arm.chain), [arm_line(robot), *_summary(found, arm.chain, options.without is None)])


def _stands(recording: Recording, chain: Chain, loaded: bool) -> Stands:
    return Stands(*efforts_at_rest(recording, chain.names), loaded)


def _data(found: Weighed, chain: Chain) -> dict[str, object]:
    std = found.std
    return {
        "mass_kg": found.mass,
        "mass_std_kg": float(std[0]),
        "centre_m": found.centre.tolist(),
        "centre_std_m": std[1:].tolist(),
        "covariance": found.covariance.tolist(),
        "postures": found.postures,
        "joints": {
            name: {"factor": factor, "factor_std": factor_std, "scatter": scatter}
            for name, factor, factor_std, scatter in zip(
                chain.names, found.scale.tolist(), found.scale_std.tolist(), found.scatter.tolist(), strict=True
            )
        },
    }


def _summary(found: Weighed, chain: Chain, alone: bool) -> list[SummaryLine | TableBlock]:
    std = found.std
    rows = [("mass", f"{found.mass:.3f} kg", f"{std[0]:.3f} kg")]
    rows += [
        (f"centre, {axis} of {chain.tip}", f"{1e3 * c:.1f} mm", f"{1e3 * s:.1f} mm")
        for axis, c, s in zip("xyz", found.centre, std[1:], strict=True)
    ]
    out: list[SummaryLine | TableBlock] = [TableBlock("", ("payload", "value", "standard deviation"), tuple(rows))]
    if found.mass < _SURE * std[0]:
        out.append(SummaryLine("The mass cannot be told from nothing: its centre says little.", "doubt"))
    if alone:
        remedy = "A bag without the payload (--without) shows the arm's own weight and sharpens this."
        out.append(SummaryLine(remedy, "legend"))
    if found.mass >= _SURE * std[0]:
        centre = " ".join(f"{c:.4f}" for c in found.centre)
        out.append(SummaryLine(f"For limits and plans: --payload {found.mass:.3f} --centre {centre}"))
    return out
