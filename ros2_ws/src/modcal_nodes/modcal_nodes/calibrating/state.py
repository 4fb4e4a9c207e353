"""What the calibrator keeps on disk, to go on where it was after a restart."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from modcal_core.calibration import Calibration
from modcal_core.errors import BadTable, ModcalError
from modcal_core.files import write_folder
from modcal_core.measurements import SHARED, Samples, SignalTrack
from modcal_nodes.io import read_calibration

_SAMPLES = "samples.npz"
_LOCK = ".in_use"


@dataclass(frozen=True)
class State:
    """The trusted calibration with its files' texts, and the samples that were remembered; each may be missing."""

    calibration: Calibration | None = None
    files: Mapping[str, str] | None = None
    samples: Samples | None = None


class StateLock:
    """Held on a folder as long as this process lives: two calibrators would overwrite each other's model."""

    def __init__(self, folder: Path) -> None:
        """Take it. Raises BadTable where another process holds it, or the folder cannot be made."""
        self.warning = ""  # why it could not be taken, where the file system knows no locks
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = (folder / _LOCK).open("a+")
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.seek(0)
            who = self._file.read().strip() or "another process"
            self._file.close()
            raise BadTable(str(folder), f"is in use by {who}", "give each calibrator a folder of its own") from None
        except OSError as error:
            if not folder.is_dir():
                raise BadTable(str(folder), f"cannot be made ({error.strerror})", "choose another folder") from error
            self.warning = f"{folder}: cannot be locked ({error.strerror}): check that no other calibrator uses it"
            return
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Give it up."""
        if not self.warning:
            self._file.truncate(0)
            self._file.close()


def read_state(folder: Path) -> State:
    """What a folder holds; nothing where it does not exist. Raises BadTable for what is damaged."""
    if not folder.is_dir():
        return State()
    calibration, files = None, None
    if (folder / "calibration.yaml").is_file():
        calibration = read_calibration(folder)
        files = {
            p.name: p.read_text(encoding="utf-8") for p in folder.iterdir() if p.suffix in (".yaml", ".json", ".html")
        }
    return State(calibration, files, _read_samples(folder / _SAMPLES))


def write_state(folder: Path, state: State) -> None:
    """Write what there is; each file is replaced as a whole, so that a kill leaves the old or the new one."""
    if state.files:
        write_folder(folder, state.files)
    if state.samples is not None:
        folder.mkdir(parents=True, exist_ok=True)
        _write_samples(folder / _SAMPLES, state.samples)


def _write_samples(path: Path, samples: Samples) -> None:
    arrays = {f.name: getattr(samples, f.name) for f in fields(samples) if f.name not in SHARED}
    about = {
        "names": samples.names,
        "frames": samples.frames,
        "sockets": samples.sockets,
        "clock": samples.clock,
        "signals": [[track.name, track.topic] for track in samples.signals],
    }
    for i, track in enumerate(samples.signals):
        arrays[f"signal_{i}_stamps"], arrays[f"signal_{i}_values"] = track.stamps, track.values
    stage = path.with_name(f".{path.name}")
    with stage.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)
    os.replace(stage, path)


def _read_samples(path: Path) -> Samples | None:
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            signals = tuple(
                SignalTrack(name, stored[f"signal_{i}_stamps"], stored[f"signal_{i}_values"], topic)
                for i, (name, topic) in enumerate(about["signals"])
            )
            arrays = {f.name: stored[f.name] for f in fields(Samples) if f.name not in SHARED and f.name in stored}
        names, frames, sockets = (tuple(about.get(name, ())) for name in ("names", "frames", "sockets"))
        clock = bool(about.get("clock", True))
        return Samples(names, frames, signals=signals, sockets=sockets, clock=clock, **arrays)
    except ModcalError:
        raise
    except Exception as error:  # zip, NumPy and JSON each have their own way to say that bytes are missing
        raise BadTable(
            str(path), f"is damaged ({type(error).__name__})", "remove it; stations are collected again"
        ) from error


# --- The folder in which the calibrator keeps what it trusts and what it has heard; without one nothing is kept


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
