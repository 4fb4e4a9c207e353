"""Those who measure a station in this process: the simulated cell, and a recording whose stations are chosen from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.measurements.samples import Samples
from modcal_core.measuring.motion import from_side
from modcal_core.measuring.session import Station
from modcal_nodes.simulation.plant import Plant

_SPEED = 0.5  # rad/s or m/s between two stations, as modcal plan has it
_SETTLING = 0.5  # s before the first reading
_READINGS = 10  # averaged at a station
_FIRST = 1.0e9  # s; any time, so that stamps are those of an instrument


class Measurer(Protocol):
    """What measures one station after the other."""

    def measure(self, station: Station) -> Station:
        """The station with what became of it."""

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""


class CellInProcess:
    """The cell of ``modcal simulate``, asked station by station. chosen: the parameters of ``simulated_cell``."""

    def __init__(self, chosen: dict[str, Any]) -> None:
        """Raises ModcalError for choices that cannot be."""
        self.plant = Plant({**chosen, "stations": 0})
        self._points = chosen["measurement"] == POINT
        self._period = 1.0 / chosen["tracker_rate_hz"]
        self._now = 0.0

    @property
    def elapsed(self) -> float:
        """Seconds of the cell's own time."""
        return self._now

    def measure(self, station: Station) -> Station:
        """Go there and average some readings."""
        here = self.plant.posture(self._now)
        begin = self._now
        travel = max(float(np.abs(station.asked - here).max()) / _SPEED, 0.1)
        first = begin + travel + _SETTLING
        times = first + self._period * np.arange(_READINGS)
        legs = [(travel, station.asked), (float(times[-1]) + 0.1 - begin, station.asked)]
        if station.approach is not None:
            legs.insert(0, (0.7 * travel, from_side(station.asked, station.approach)))
        self.plant.go(legs, begin)
        poses = np.array([self.plant.read(self.plant.tool(t)) for t in times])
        self._now = float(times[-1]) + 0.1
        q, _, effort = self.plant.joints(float(times[-1]))
        mean = np.eye(4)
        mean[:3, 3] = poses[:, :3, 3].mean(axis=0)
        mean[:3, :3] = so3.mean(poses[:, :3, :3])
        reading = mean[:3, 3] if self._points else se3.to_pose(mean)
        scatter = float(np.sqrt(np.mean(np.var(poses[:, :3, 3], axis=0, ddof=1)) / len(poses)))
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
