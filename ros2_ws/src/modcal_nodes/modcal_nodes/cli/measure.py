"""``modcal simulate`` and ``modcal measure``: a cell recorded at once, or stations until an accuracy is proven."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from modcal_core.calibration import errors
from modcal_core.errors import BadTable, about
from modcal_core.files import read_yaml
from modcal_core.measurements import POINT, POSE
from modcal_core.outcome import counted, readmitted_note
from modcal_core.planning import (
    BATCH,
    MAX_STATIONS,
    RETURNS,
    Advice,
    Advisor,
    FilledTable,
    Goal,
    Method,
    Session,
    Site,
    of_recording,
    require_likely,
    site_from_data,
    survey,
    text_of,
    with_table,
)
from modcal_core.robot import Robot
from modcal_core.robots import other_tips
from modcal_msgs_py import write_recording
from modcal_nodes.cli.console import EXISTING, UNMET, WRITTEN, Decimal, Output, Whole, given, speaks, written
from modcal_nodes.cli.inputs import arm_line, chain_line, read_robot
from modcal_nodes.io import ChainOptions, Watch, opened, option, read_cell, repeated
from modcal_nodes.measuring import (
    NEXT,
    CellInProcess,
    Measurement,
    Replay,
    one_a_station,
    outcome_data,
)
from modcal_nodes.ros import SIMULATED_CELL
from modcal_nodes.simulation import Plant, recorded

_OF_THE_NODE = (
    "urdf",
    "delta",
    "obey_limits",
    "start_delay_s",
    "min_subscribers",
    "repeat",
    "publish_clock",
    "clock_rate_hz",
    "time_factor",
)
_STATIONS = 60


@click.command("simulate")
@click.argument("robot", type=EXISTING)
@click.option("--out", required=True, type=WRITTEN, help="Folder of the bag; must not exist.")
@click.option("-p", "given", multiple=True, metavar="NAME=VALUE", help="A parameter of simulated_cell. Repeatable.")
@click.option(
    "--at", "later", type=(Decimal(min=0.0), str), multiple=True, metavar="S NAME=VALUE",
    help="The same, from the given second on: payload_kg, tool_bump_m, tracker_move_m, warm_up_m … Repeatable.",
)  # fmt: skip
@click.option(
    "--returns", type=Whole(0, 1000), default=RETURNS,
    help="Number of these postures that are visited twice, so that the noise floor is known.",
)  # fmt: skip
@speaks()
def simulate_command(
    robot: Path, out: Path, given: tuple[str, ...], later: tuple[tuple[float, str], ...], returns: int, output: Output
) -> None:
    """Record an arm (URDF) or a Delta (YAML) that differs from its nominal model, in MuJoCo, with a tracker.

    The arm visits 60 random postures (-p stations=N), six of them twice, no faster than the URDF's velocity and effort
    allow. Unmodelled effects are switched on with
    -p: gear_joint, joint_compliance_rad_per_nm, payload_kg, warm_up_link, repeatability_rad and others
    of the node.
    """
    if out.exists():
        raise BadTable(str(out), "exists", "name another folder")
    chosen = {name: parameter.default for name, parameter in SIMULATED_CELL.items()}
    chosen["stations"], chosen["returns"], chosen["obey_limits"] = _STATIONS, returns, True
    chosen["delta" if robot.suffix in (".yaml", ".yml") else "urdf"] = str(robot)
    for text in given:
        name, value = parameter(text)
        chosen[name] = value
    changes = sorted(((when, *parameter(text)) for when, text in later), key=lambda change: change[0])
    with output.working() as watch:
        watch("building the cell")
        plant = Plant(chosen)
        recording = recorded(plant, chosen, changes, watch)
        write_recording(recording, out, partial(watch, f"writing {out.name}"))
    data = {
        "bag": str(out),
        "stations": plant.stops,
        "duration_s": plant.end,
        "joint_states": len(recording.joints[0].stamps),
        "readings": len(recording.readings[0].stamps),
        "overloads": list(plant.overloads),
    }
    counts = f"{data['joint_states']} joint states, {data['readings']} readings"
    chain = plant.chain
    others = () if chosen["delta"] or chosen["tip"] else other_tips(plant.text, chain.base)
    arm = chain_line(chain.base, chain.tip, chain.n, others)
    lines = [arm, *plant.overloads, f"Bag: {out}, {plant.stops} stations in {plant.end:.0f} s, {counts}"]
    output.result(data, lines)


def parameter(text: str) -> tuple[str, Any]:
    """Name and value of NAME=VALUE, of the type and within the bounds of the node's parameter."""
    name, equals, written = text.partition("=")
    if not equals or name not in SIMULATED_CELL or name in _OF_THE_NODE:
        names = ", ".join(n for n in SIMULATED_CELL if n not in _OF_THE_NODE)
        raise BadTable(f"-p {text}", "is not a NAME=VALUE of the simulated cell", f"names are {names}")
    return name, SIMULATED_CELL[name].parsed(f"-p {name}=", written)


_BY_HAND = 4  # stations at once, since whoever fills in a table gives the command again for each lot


@dataclass(frozen=True)
class MeasureOptions(ChainOptions):
    """What is asked of a measurement, by the names of the command's options."""

    goal_mm: float | None = option(
        "Error at the tool to be proven. Default: the least possible.", above=0.0, metavar="MM"
    )
    statistic: str = option("Statistic of --goal-mm.", "--of", default="rms", choices=("rms", "p95"))
    stations: int = option("Most stations.", default=MAX_STATIONS, low=1)
    minutes: float | None = option("Most time, from the first call on.", above=0.0)
    by_hand: Path | None = option(
        "Ask for stations in DIR/next.csv, and read there what was measured.",
        type=click.Path(path_type=Path),
        metavar="DIR",
    )
    simulated: bool = option("Measure in the simulated cell (MuJoCo).", default=False)
    given: tuple[str, ...] = repeated("A parameter of simulated_cell. Repeatable.", "NAME=VALUE", "-p")
    replay: Path | None = option("Choose among the stations of a recording.", metavar="BAG")
    site: Path | None = option(
        "YAML: tracker, target, spheres of the arm, floor, obstacles, limits, workspace. See docs/planning.md.",
        metavar="FILE",
    )
    reading: str = option("What is read by hand.", default=POINT, choices=(POINT, POSE))
    instrument_mm: float | None = option(
        "Error of the instrument, RMS over space: it is no error of the tool.", above=0.0, metavar="MM"
    )
    cell_file: Path | None = option("YAML of fixed parameters, and what is stated of arm and instrument.", "--cell")
    fixed: tuple[str, ...] = repeated("Fixed parameter, as in modcal calibrate. Repeatable.", "NAME", "--fix")
    ties: bool = option("Separate explanations that stay open, by up to 12 more stations.", default=False)
    geometry_only: bool = option("Fit only the geometry; do not look for other effects.", default=False)
    batch: int | None = option(f"Stations between two fits. Default: {BATCH}, by hand {_BY_HAND}.", low=1, high=100)
    seed: int = option("Seed of what is drawn at random.", default=0, low=0)
    out: Path | None = option("Folder of session and results; of --by-hand it is DIR.", type=WRITTEN)

    @property
    def goal(self) -> Goal:
        """What is to be proven. Raises BadTable for what cannot be asked."""
        return Goal(
            accuracy=None if self.goal_mm is None else 1e-3 * self.goal_mm,
            statistic="p95" if self.statistic == "p95" else "rms",
            stations=self.stations,
            seconds=None if self.minutes is None else 60.0 * self.minutes,
            instrument=1e-3 * (self.instrument_mm or 0.0),
            ties=self.ties,
        )

    def measurer(self, robot: Path, arm: Robot, watch: Watch) -> CellInProcess | Replay | None:
        """What measures; None: a person."""
        if self.replay is not None:
            return Replay(one_a_station(opened(self.replay, watch).samples(arm, 0.5)))
        if not self.simulated:
            return None
        chosen = {name: p.default for name, p in SIMULATED_CELL.items()}
        chosen["delta" if robot.suffix in (".yaml", ".yml") else "urdf"] = str(robot)
        chosen |= {"base": self.base or "", "tip": self.tip or ""} | dict(map(parameter, self.given))
        return CellInProcess(chosen)


@click.command("measure")
@click.argument("robot", type=EXISTING)
@given(MeasureOptions)
@speaks()
def measure_command(robot: Path, output: Output, options: MeasureOptions) -> int:
    """Measure ROBOT (a URDF), station after station, until an accuracy is proven or cannot be reached.

    After every few stations the model is fitted again and the next ones are chosen for what they are worth. The
    claim at the tool proves the result, from random stations too that no fit sees. A session is kept in its folder and
    goes on where it stopped. Exit code 3: ended, and the goal is not proven.
    """
    folder = options.by_hand
    if sum((folder is not None, options.simulated, options.replay is not None)) != 1:
        raise BadTable("modcal measure", "needs one of --by-hand, --simulated and --replay", "say who measures")
    goal = options.goal
    arm = read_robot(robot, options.base, options.tip)
    site = Site() if options.site is None else site_from_data(read_yaml(options.site), str(options.site))
    if site.carried and folder is None:
        raise BadTable(str(options.site), "has a camera on the tool", "measure by hand, or with station_runner")
    cell = read_cell(options.cell_file, options.fixed)
    lot = options.batch or (_BY_HAND if folder is not None else BATCH)
    method = Method(options.seed, lot, not options.geometry_only)
    with output.working() as watch:
        rng, measurer = np.random.default_rng(options.seed), options.measurer(robot, arm, watch)
        reading = options.reading if measurer is None else measurer.kind
        watch("looking at what the arm can reach")
        if isinstance(measurer, Replay):
            pool = of_recording(measurer.samples.q, rng)
        else:
            pool = survey(arm.mechanism, site, rng, reading, drawn=True)
        advisor = Advisor(arm.mechanism, pool, goal, method, cell, arm.inertias)
        session = Session(arm.names, reading, carried=site.carried)
        began = time.time() if measurer is None else None
        path = folder or options.out or Path(f"{robot.stem}_measured")
        measurement = Measurement(path, arm, advisor, session, options.seed, began)
        filled = FilledTable(session)
        if measurer is None:
            filled = _filled_in(measurement)
            measurement.take(filled.session)
        watch("fitting and choosing")
        advice = measurement.advise(None if measurer is None else measurer.elapsed)
        while measurer is not None and advice.outcome is None:
            for number in measurement.session.pending:
                watch(f"station {number + 1}")
                measurement.note(number, measurer.measure(measurement.session.stations[number]))
            watch("fitting and choosing")
            advice = measurement.advise(measurer.elapsed)
        if advice.outcome is not None:
            files = measurement.finish(advice)
        else:
            measurement.write_tables()
    data = outcome_data(advice, goal)
    if advice.outcome is None:
        output.result(data, _asking(measurement, advice, filled))
        return 0
    where = written(measurement.path, files, "Result", "measure.json")
    output.result(data, [arm_line(arm), *_ended(advice)], where)
    return 0 if advice.outcome.ending == "proven" or goal.accuracy is None else UNMET


def _filled_in(measurement: Measurement) -> FilledTable:
    """The session with what was written into the table of the stations that were asked for."""
    table, mechanism = measurement.path / NEXT, measurement.robot.mechanism
    if not table.exists():
        return FilledTable(measurement.session)
    with about(str(table)):
        text = text_of(table.read_bytes(), str(table))
        filled = with_table(measurement.session, text, np.asarray(mechanism.revolute), str(table))
    new = [i for i in filled.read if i not in filled.checked]
    require_likely(filled.session, mechanism, new, str(table))
    return filled


def _asking(measurement: Measurement, advice: Advice, filled: FilledTable) -> list[str]:
    session, turns, table = advice.session, measurement.robot.mechanism.revolute, measurement.path / NEXT
    lines = [*_nothing_new(table, filled), *left_out(advice)]
    lines.append(f"{counted(len(session.rows()), 'station')} measured; {_standing(advice)}".rstrip("; "))
    lines.append(f"Next: {counted(len(session.pending), 'station')} ({advice.why}), in {table}")
    for number in session.pending:
        station = session.stations[number]
        q = zip(station.asked, turns, strict=True)
        shown = " ".join(f"{np.degrees(v):9.3f}°" if turn else f"{1e3 * v:9.3f} mm" for v, turn in q)
        lines.append(f"  {number + 1:3d} {station.role:7s}{shown}")
    return [
        *lines,
        "Write each reading into its row (leave a row empty for later; note 'unseen' or 'skipped' where there is",
        "none), and give the same command again.",
    ]


def left_out(advice: Advice) -> list[str]:
    """A sentence for each station whose reading the fit leaves out, for whoever can look at it again."""
    found = advice.refitted
    if found is None or not found.wrong.any():
        return []
    away = 1e3 * errors(found.calibration.calibrated, found.samples).position_norm
    number = found.samples.station + 1
    return [
        f"Station {number[k]} is left out of the fit: its reading lies {away[k]:.1f} mm from the model of the others."
        for k in np.flatnonzero(found.wrong)
    ]


def _nothing_new(table: Path, filled: FilledTable) -> list[str]:
    """What to say where a table was asked for before and nothing new is in it."""
    if filled.read or not filled.session.stations or filled.session.pending == ():
        return []
    beside = [p.name for p in table.parent.glob(f"{table.stem}.*") if p.name != NEXT]
    saved = f"; {beside[0]} is beside it: save as CSV, under the same name" if beside else ""
    return [f"{NEXT} has no new reading{saved}."]


def _standing(advice: Advice) -> str:
    status = advice.status
    if status.expected is None:
        return ""
    sizes = {
        "{:.3f} mm RMS expected": status.expected,
        "at most {:.3f} mm claimed": status.bound,
        f"{{:.3f}} mm seen at {status.proving} random stations": status.seen,
    }
    parts = [said.format(1e3 * size) for said, size in sizes.items() if size is not None]
    parts += [] if status.needed is None else [f"about {counted(status.needed, 'more station')}"]
    return ", ".join(parts)


def _ended(advice: Advice) -> list[str]:
    assert advice.outcome is not None
    out = [advice.outcome.sentence]
    if advice.status.effects:
        out.append(f"Effects beyond geometry: {'; '.join(advice.status.effects)}")
    if advice.status.ties:
        out.append(f"Not decided: {'; '.join(advice.status.ties)} (--ties measures on)")
    if advice.refitted is not None:
        out += readmitted_note(advice.refitted.taken_in)
    return out
