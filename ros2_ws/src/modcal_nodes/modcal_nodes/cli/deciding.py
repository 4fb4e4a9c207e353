"""``modcal plan --decide``: the stations that tell two explanations of the same error apart."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from modcal_core.calibration.store import Calibration
from modcal_core.errors import NotEnoughData
from modcal_core.files import to_yaml, write_folder
from modcal_core.planning.deciding import DecidingStations, propose, undecided_by_posture
from modcal_core.planning.posture_pool import allowed
from modcal_core.planning.site import Site
from modcal_nodes.cli.console import console
from modcal_nodes.io.inputs import read_calibration


def decide(report: Path, stations: int, seed: int, out: Path | None, site: Site | None = None) -> None:
    """Propose the stations that tell explanations apart, print them, and write plan.yaml."""
    folder = report if report.is_dir() else report.parent
    calibration = read_calibration(folder)
    ties = [(i, j) for i, rivals in enumerate(calibration.rivals) for j in range(len(rivals))]
    if not ties:
        raise NotEnoughData(str(report), "no effect in it has a rival", "there is nothing to decide: use it as it is")
    rng = np.random.default_rng(seed)
    share = max(2, stations // len(ties))
    page = console()
    proposals = []
    for i, j in ties:
        page.print(_tie(calibration, i, j), highlight=False)
        if instead := undecided_by_posture(calibration, i, j):
            page.print(f"  postures cannot decide this: {instead}", highlight=False)
            continue
        proposal = propose(calibration, i, j, share, rng, None if site is None else allowed(calibration, site))
        page.print(f"  {_worth(proposal)}", highlight=False)
        proposals.append(proposal)
    deciding = [p for p in proposals if p.decides]
    if not deciding:
        return
    out = out or folder.with_name(f"{folder.name}_plan")
    write_folder(out, {"plan.yaml": to_yaml(_data(calibration, deciding))})
    click.echo(f"Stations: {out / 'plan.yaml'}")


def _tie(calibration: Calibration, i: int, j: int) -> str:
    effect, rival = calibration.calibrated.effects[i], calibration.rivals[i][j]
    return f"{effect.family}: {effect.label}, or {rival.family}: {rival.label}?"


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


def _data(calibration: Calibration, proposals: list[DecidingStations]) -> dict[str, object]:
    names = calibration.nominal.chain.names
    return {
        "modcal_plan": 1,
        "joints": list(names),
        "ties": [
            {
                "between": [p.effect.label, p.rival.label],
                "separation": float(p.separation),
                "stations": [
                    {"position": [float(x) for x in q], **({"approach": [int(x) for x in a]} if a.any() else {})}
                    for q, a in zip(p.q, p.approach, strict=True)
                ],
            }
            for p in proposals
        ],
    }
