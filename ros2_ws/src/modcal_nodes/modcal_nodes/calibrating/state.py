"""What the calibrator keeps on disk, to go on where it was after a restart: model, samples, and corners of images.

A fit of images and what watches it are not kept: both follow from the corners in a second or two, and are the same.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from modcal_core.calibration import Calibration
from modcal_core.camera import BoardView, PrintedTarget, target_to_data
from modcal_core.errors import BadTable, ModcalError
from modcal_core.files import write_folder
from modcal_core.geometry import Array
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
    _write_arrays(path, about, arrays)


def _write_arrays(path: Path, about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and what JSON can say of them; the file is replaced as a whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = path.with_name(f".{path.name}")
    with stage.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]
    os.replace(stage, path)


@contextmanager
def _arrays(path: Path, again: str) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """What was written, while the block lasts. again: what is collected again. Raises BadTable for damage."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            yield json.loads(str(stored["about"])), stored
    except ModcalError:
        raise
    except Exception as error:  # zip, NumPy and JSON each have their own way to say that bytes are missing
        said = f"is damaged ({type(error).__name__})"
        raise BadTable(str(path), said, f"remove it; {again} are collected again") from error


def _read_samples(path: Path) -> Samples | None:
    if not path.is_file():
        return None
    with _arrays(path, "stations") as (about, stored):
        signals = tuple(
            SignalTrack(name, stored[f"signal_{i}_stamps"], stored[f"signal_{i}_values"], topic)
            for i, (name, topic) in enumerate(about["signals"])
        )
        arrays: dict[str, Any] = {
            f.name: stored[f.name] for f in fields(Samples) if f.name not in SHARED and f.name in stored
        }
        names, frames, sockets = (tuple(about.get(name, ())) for name in ("names", "frames", "sockets"))
        clock = bool(about.get("clock", True))
        return Samples(names, frames, signals=signals, sockets=sockets, clock=clock, **arrays)


class StateFolder:
    """path: of the folder, None where nothing is kept."""

    def __init__(self, folder: str, log: RcutilsLogger) -> None:
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


_FILES = "images*.npz"


@dataclass(frozen=True)
class KeptImages:
    """images: views with the joints at each, (n,). size: [px]. trusted: whether what they led to was trusted."""

    images: list[tuple[BoardView, Array]]
    size: tuple[int, int]
    trusted: bool


def write_images(
    folder: Path,
    images: Sequence[tuple[BoardView, Array]],
    size: tuple[int, int],
    target: PrintedTarget,
    trusted: bool,
    camera: int = 1,
) -> None:
    """Keep images in a folder; the file is replaced as a whole. camera: number of a further one, from 2."""
    about = {"size": size, "target": _form(target), "trusted": trusted, "names": [view.name for view, _ in images]}
    views = [view for view, _ in images]
    arrays = {
        "count": np.array([len(view) for view in views]),
        "ids": np.concatenate([view.ids for view in views]),
        "pixels": np.concatenate([view.pixels for view in views]),
        "cov": np.concatenate([view.cov for view in views]),
        "stamp": np.array([view.stamp for view in views]),
        "q": np.array([q for _, q in images]),
    }
    _write_arrays(folder / _file(camera), about, arrays)


def read_images(folder: Path, target: PrintedTarget, camera: int = 1) -> KeptImages | None:
    """The images of a folder, None where it holds none, or those of another target. camera: as written. Raises BadTable
    for damage.
    """
    path = folder / _file(camera)
    if not path.is_file():
        return None
    with _arrays(path, "images") as (about, stored):
        of_views = (stored[name] for name in ("ids", "pixels", "cov"))
        ids, pixels, cov = (np.split(values, np.cumsum(stored["count"])[:-1]) for values in of_views)
        views = map(BoardView, map(str, about["names"]), ids, pixels, cov)
        stamped = zip(views, stored["stamp"], stored["q"], strict=True)
        images = [(replace(view, stamp=float(stamp)), q) for view, stamp, q in stamped]
        width, height = (int(side) for side in about["size"])
    if about.get("target") != _form(target):
        return None
    return KeptImages(images, (width, height), bool(about.get("trusted")))


def forget_images(folder: Path) -> None:
    """Keep none any more, of any camera."""
    for path in folder.glob(_FILES):
        path.unlink(missing_ok=True)


def _file(camera: int) -> str:
    return "images.npz" if camera == 1 else f"images_{camera}.npz"


def _form(target: PrintedTarget) -> str:
    """What images of another target differ in: the sheet's size may have been measured since."""
    return json.dumps(target_to_data(target), sort_keys=True)
