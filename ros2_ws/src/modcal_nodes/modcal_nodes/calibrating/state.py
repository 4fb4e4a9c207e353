"""What the calibrator keeps on disk, to go on where it was after a restart."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadTable, ModcalError
from modcal_core.files import write_folder
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import SHARED, Samples
from modcal_nodes.io.inputs import read_calibration

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
