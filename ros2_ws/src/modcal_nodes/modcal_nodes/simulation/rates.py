"""How fast the simulated cell really speaks."""

from __future__ import annotations

import time
from collections.abc import Mapping

from modcal_nodes.ros import OK, WARN, Status
from modcal_nodes.simulation.plant import Grid

LATE = 0.1  # s of wall time that the cell may lag behind its own clock


class Rates:
    """Messages a second, counted from one report to the next, and how far the cell is behind."""

    def __init__(self, grids: Mapping[str, Grid], factor: float) -> None:
        self._grids, self._factor = grids, factor
        self._since = time.monotonic()
        self._counts = {name: grid.count for name, grid in grids.items()}
        self.lag = 0.0  # s of wall time, the worst since the last report

    def note(self, lag: float) -> None:
        """Take notice that the cell is behind by so many seconds of its own time."""
        self.lag = max(self.lag, lag / self._factor)

    def status(self) -> Status:
        """What was achieved since the last time."""
        now = time.monotonic()
        span = max(now - self._since, 1e-3)
        counts = {name: grid.count for name, grid in self._grids.items()}
        values: dict[str, object] = {
            f"{name} [Hz]": f"{(counts[name] - self._counts[name]) / span:.1f}" for name in counts
        }
        values["lag [s]"] = f"{self.lag:.4f}"
        late = self.lag > LATE
        self._since, self._counts, self.lag = now, counts, 0.0
        message = "behind its own clock: lower the rates or time_factor" if late else "publishes in time"
        return Status("rates", WARN if late else OK, message, values)
