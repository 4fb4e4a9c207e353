"""The folder in which the calibrator keeps what it trusts and what it has heard; without one nothing is kept."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from modcal_core.calibration.store import Calibration
from modcal_core.measurements.samples import Samples
from modcal_nodes.calibrating.state import State, StateLock, read_state, write_state


class _WarningLog(Protocol):
    def warning(self, message: str) -> Any: ...

    def error(self, message: str) -> Any: ...


class StateFolder:
    """path: of the folder, None where nothing is kept."""

    def __init__(self, folder: str, log: _WarningLog) -> None:
        """Lock the folder. Raises BadTable where another calibrator uses it."""
        self.path = Path(folder) if folder else None
        self._log = log
        self._lock = StateLock(self.path) if self.path else None
        if self._lock is not None and self._lock.warning:
            log.warning(self._lock.warning)

    def read(self) -> State:
        """What it holds. Raises BadTable for what is damaged."""
        return read_state(self.path) if self.path else State()

    def leave_alone(self) -> None:
        """What it holds is of another arm: from now on nothing is written."""
        self.path = None

    def keep(self, calibration: Calibration, files: Mapping[str, str]) -> None:
        """What is trusted from now on."""
        if self.path:
            write_state(self.path, State(calibration, files))

    def save(
        self, calibration: Calibration | None, files: Mapping[str, str], samples: Samples | None
    ) -> tuple[bool, str]:
        """Whether all was saved, and where or why not."""
        if not self.path:
            return False, "no folder: set the parameter state"
        try:
            write_state(self.path, State(calibration, files if calibration else None, samples))
        except OSError as error:
            return False, f"{self.path}: {error.strerror}: make room, or check its permissions"
        return True, f"saved in {self.path}"

    def save_samples(self, samples: Samples | None) -> None:
        """The stations so far; a failure is logged."""
        if self.path and samples is not None:
            try:
                write_state(self.path, State(samples=samples))
            except OSError as error:
                self._log.error(f"{self.path}: {error.strerror}: stations are not saved")

    def release(self) -> None:
        """Let others have it."""
        if self._lock is not None:
            self._lock.release()
