"""The folder of a measurement: its session, kept after every station, and in the end what came of it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core import public
from modcal_core.calibration import fingerprint
from modcal_core.errors import BadTable
from modcal_core.files import read_yaml, to_json, to_yaml, write_file, write_folder
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import POINT, POSE, Origin, Samples
from modcal_core.outcome import readmitted_note
from modcal_core.planning import (
    PROOF,
    Advice,
    Advisor,
    Goal,
    Refit,
    Session,
    Station,
    from_data,
    from_side,
    to_data,
    to_table,
)
from modcal_core.report import calibration_files
from modcal_core.robot import Robot
from modcal_nodes.measuring.runner import averaged
from modcal_nodes.simulation import Plant

SESSION, NEXT, STATIONS, RESULT = "session.yaml", "next.csv", "stations.csv", "measure.json"
_FEWEST_SCORED = 2  # proof stations, from which a report is theirs


class Measurement:
    """One robot's measurement, kept in a folder after every step: the session that is there goes on."""

    def __init__(
        self, path: Path, robot: Robot, advisor: Advisor, session: Session, seed: int, began: float | None
    ) -> None:
        """session: an empty one. seed: of what is drawn. began: now [s]; None: no time is counted.

        Raises BadTable where the session there cannot be read, is another robot's, or was begun otherwise.
        """
        self.path, self.robot, self.advisor = path, robot, advisor
        self.session, self._seed, self._began = session, seed, began
        self._print, file = fingerprint(robot.mechanism), path / SESSION
        if not file.exists():
            path.mkdir(parents=True, exist_ok=True)
            self.take(session)
            return
        there, goal, its_seed, its_print, self._began = from_data(read_yaml(file), str(file))
        if its_print != self._print or there.names != robot.names:
            said = f"is of robot {its_print}, this is {self._print}"
            raise BadTable(str(file), said, "give the description that it was begun with, or another folder")
        other = [name for name, asked in vars(advisor.goal).items() if asked != vars(goal)[name]]
        other += ["reading"] if (session.kind, session.carried) != (there.kind, there.carried) else []
        other += ["seed"] if seed != its_seed else []
        if other:
            said = f"was begun with another {other[0]}"
            raise BadTable(str(file), said, "repeat its options, or give another folder")
        self.session = there

    def take(self, session: Session) -> None:
        """Go on from this session, which is written whole or not at all."""
        self.session = session
        data = to_data(session, self.advisor.goal, self._seed, self._print, self._began)
        write_file(self.path / SESSION, to_yaml(data))

    def advise(self, elapsed: float | None = None) -> Advice:
        """What is next. elapsed: since the beginning [s]; None: by the clock."""
        if elapsed is None:
            elapsed = 0.0 if self._began is None else time.time() - self._began
        advice = self.advisor.advise(self.session, elapsed)
        self.take(advice.session)
        return advice

    def note(self, number: int, station: Station) -> None:
        """Keep what became of a station."""
        self.take(self.session.with_station(number, station))

    def write_tables(self) -> None:
        """Write the stations that were done, and those to measure next, as tables."""
        session, turns = self.session, np.asarray(self.robot.mechanism.revolute)
        done = [i for i in range(len(session.stations)) if i not in session.pending]
        write_file(self.path / STATIONS, to_table(session, done, turns))
        write_file(self.path / NEXT, to_table(session, session.pending, turns))

    def finish(self, advice: Advice) -> dict[str, str]:
        """Write what came of it: the model, its report, and how it ended; returns names and texts."""
        self.write_tables()
        files = {RESULT: to_json(outcome_data(advice, self.advisor.goal))}
        if advice.refitted is not None:
            files |= self._model(advice.refitted, advice.session)
        write_folder(self.path, files)
        (self.path / NEXT).unlink(missing_ok=True)
        return files

    def _model(self, refitted: Refit, session: Session) -> dict[str, str]:
        """The files of the calibration, its report that of the stations of the proof; without any, of all stations."""
        rows = session.rows(PROOF)
        samples = session.samples(rows if len(rows) >= _FEWEST_SCORED else session.fitted)
        samples = replace(samples, origin=Origin(title=self.path.name))
        report = public.evaluate(refitted.calibration, samples, block=1)
        report = replace(report, notes=(*report.notes, *readmitted_note(refitted.taken_in)))
        made = refitted.calibration
        if report.claim is not None:
            made = replace(made, claim_mm=report.claim.mm["p95"].ci95[1])
        return calibration_files(made, report, self.robot.mechanism, self.robot.description)


def outcome_data(advice: Advice, goal: Goal) -> dict[str, Any]:
    """How a measurement ended or stands, for programs: numbers in mm, null where not known."""
    status, ended = advice.status, advice.outcome

    def mm(value: float | None) -> float | None:
        return None if value is None else 1e3 * value

    readmitted = 0 if advice.refitted is None else advice.refitted.taken_in.stations
    stations = {"measured": status.measured, "fit": status.fitted, "proof": status.proving, "readmitted": readmitted}
    return {
        "modcal_measure": 1,
        "goal_mm": mm(goal.accuracy),
        "statistic": goal.statistic,
        "ending": None if ended is None else ended.ending,
        "sentence": None if ended is None else ended.sentence,
        "stations": stations,
        "expected_rms_mm": mm(status.expected),
        "proof": {"rms_mm": mm(status.seen), "at_most_mm": mm(status.bound)},
        "floor_mm": mm(status.floor),
        "effects": list(status.effects),
        "undecided": list(status.ties),
        "next": {"stations": len(advice.session.pending), "why": advice.why} if ended is None else None,
    }


_SPEED = 0.5  # rad/s or m/s between two stations, as modcal plan has it
_SETTLING = 0.5  # s before the first reading
_READINGS = 10  # averaged at a station
_FIRST = 1.0e9  # s; any time, so that stamps are those of an instrument


class CellInProcess:
    """The cell of ``modcal simulate``, asked station by station. chosen: the parameters of ``simulated_cell``. kind: of
    readings. elapsed: seconds since the beginning.
    """

    def __init__(self, chosen: dict[str, Any]) -> None:
        """Raises ModcalError for choices that cannot be."""
        self.plant = Plant({**chosen, "stations": 0})
        self.kind = chosen["measurement"]
        self._period = 1.0 / chosen["tracker_rate_hz"]
        self.elapsed = 0.0  # s of the cell's own time

    def measure(self, station: Station) -> Station:
        """Go there and average some readings."""
        begin = self.elapsed
        here = self.plant.posture(begin)
        travel = max(float(np.abs(station.asked - here).max()) / _SPEED, 0.1)
        first = begin + travel + _SETTLING
        times = first + self._period * np.arange(_READINGS)
        legs = [(travel, station.asked), (float(times[-1]) + 0.1 - begin, station.asked)]
        if station.approach is not None:
            legs.insert(0, (0.7 * travel, from_side(station.asked, station.approach)))
        self.plant.go(legs, begin)
        poses = se3.to_pose(np.array([self.plant.read(self.plant.tool(t)) for t in times]))
        reading, scatter = averaged(poses[:, :3] if self.kind == POINT else poses)
        self.elapsed = float(times[-1]) + 0.1
        q, _, effort = self.plant.joints(float(times[-1]))
        stamp = _FIRST + float(times.mean())
        return station.measured(reading, q, stamp=stamp, effort=effort, sigma=scatter)


class Replay:
    """Stations of a recording: what was read there is given out when it is asked for. samples: one a station."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        self.kind = POSE if samples.is_pose.all() else POINT
        self.elapsed = 0.0

    def measure(self, station: Station) -> Station:
        """What the recording has of this station."""
        i = station.row
        s = self.samples
        reading = np.r_[s.reading[i], so3.to_quaternion(s.R[i])] if self.kind == POSE else s.reading[i]
        stamp = float(s.stamps[i])  # an order at least, which is not that in which stations are chosen
        sigma = float(s.sigma_position[i])
        effort: Array | None = s.effort[i] if np.isfinite(s.effort[i]).all() else None
        return replace(
            station.measured(reading, s.q[i], stamp=stamp, sigma=sigma, effort=effort), approach=s.approach[i].copy()
        )


def one_a_station(samples: Samples) -> Samples:
    """The samples with the first reading of each station, in one frame: what a replay can choose from."""
    frame = np.bincount(samples.frame).argmax()
    first = np.unique(samples.station[samples.frame == frame], return_index=True)[1]
    rows = np.flatnonzero(samples.frame == frame)[first]
    return samples.select(np.sort(rows))
