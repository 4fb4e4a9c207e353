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
from typing import IO, Any

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from modcal_core.calibration import Calibration
from modcal_core.camera import BoardView, PrintedTarget, target_to_data
from modcal_core.errors import BadTable, ModcalError
from modcal_core.files import write_folder
from modcal_core.geometry import Array
from modcal_core.measurements import SHARED, Samples, SignalTrack

_SAMPLES = "samples.npz"
_LOCK = ".in_use"
_TEXTS = (".yaml", ".json", ".html")


@dataclass(frozen=True)
class State:
    """The trusted calibration with its files' texts, and the samples that were remembered; each may be missing."""

    calibration: Calibration | None = None
    files: Mapping[str, str] | None = None
    samples: Samples | None = None


class StateFolder:
    """A folder that this process holds as long as it lives: two calibrators would overwrite each other's model.

    path: of it; None if nothing is kept, or no longer. Each file is replaced as a whole, so that a kill leaves the
    old or the new one.
    """

    def __init__(self, folder: str, log: RcutilsLogger) -> None:
        """Lock the folder. Raises BadTable where another process holds it, or it cannot be made."""
        self.path = Path(folder) if folder else None
        self._log = log
        self._lock: IO[str] | None = None
        if self.path is None:
            return
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = (self.path / _LOCK).open("a+")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            who = lock.read().strip() or "another process"
            lock.close()
            raise BadTable(folder, f"is in use by {who}", "give each calibrator a folder of its own") from None
        except OSError as error:
            if not self.path.is_dir():
                raise BadTable(folder, f"cannot be made ({error.strerror})", "choose another folder") from error
            log.warning(f"{folder}: cannot be locked ({error.strerror}): check that no other calibrator uses it")
            return
        lock.truncate(0)
        lock.write(f"process {os.getpid()}\n")
        lock.flush()
        self._lock = lock

    def release(self) -> None:
        """Let others have it."""
        if self._lock is not None:
            self._lock.truncate(0)
            self._lock.close()

    def read(self) -> State:
        """What it holds. Raises BadTable for what is damaged."""
        if self.path is None:
            return State()
        samples = _read_samples(self.path / _SAMPLES)
        if not (self.path / "calibration.yaml").is_file():
            return State(samples=samples)
        texts = (file for file in self.path.iterdir() if file.suffix in _TEXTS)
        files = {file.name: file.read_text(encoding="utf-8") for file in texts}
        return State(Calibration.load(self.path), files, samples)

    def write(self, files: Mapping[str, str], samples: Samples | None = None) -> None:
        """Keep the files of the trusted calibration, and samples, of either what there is."""
        if self.path and files:
            write_folder(self.path, files)
        if self.path and samples is not None:
            _write_samples(self.path / _SAMPLES, samples)

    def save(self, files: Mapping[str, str], samples: Samples | None) -> tuple[bool, str]:
        """Whether all was saved, and where or why not."""
        if not self.path:
            return False, "no folder: set the parameter state"
        try:
            self.write(files, samples)
        except OSError as error:
            return False, f"{self.path}: {error.strerror}: make room, or check its permissions"
        return True, f"saved in {self.path}"

    def save_samples(self, samples: Samples | None) -> None:
        """Keep the stations so far; a failure is logged."""
        saved, said = self.save({}, samples)
        if self.path and not saved:
            self._log.error(f"{said}; stations are not saved")


def _write_samples(path: Path, samples: Samples) -> None:
    arrays = {f.name: getattr(samples, f.name) for f in fields(samples) if f.name not in SHARED}
    about = {name: getattr(samples, name) for name in ("names", "frames", "sockets", "clock")}
    about["signals"] = [[track.name, track.topic] for track in samples.signals]
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
        arrays: dict[str, Any] = {f.name: stored[f.name] for f in fields(Samples) if f.name not in SHARED}
        names, frames, sockets = (tuple(about.get(name, ())) for name in ("names", "frames", "sockets"))
        clock = bool(about.get("clock", True))
        return Samples(names, frames, signals=signals, sockets=sockets, clock=clock, **arrays)


_IMAGES, _OF_VIEWS = "images.npz", ("ids", "pixels", "cov")


@dataclass(frozen=True)
class KeptImages:
    """images: of each camera, views with the joints at each, (n,). sizes: of each camera's images [px]. trusted:
    whether what they led to was trusted.
    """

    images: Sequence[list[tuple[BoardView, Array]]]
    sizes: Sequence[tuple[int, int]]
    trusted: bool


def write_images(folder: Path, kept: KeptImages, target: PrintedTarget) -> None:
    """Keep the images of all cameras in a folder, instead of those that it holds."""
    every = [one for some in kept.images for one in some]
    views = [view for view, _ in every]
    about = {"sizes": kept.sizes, "target": _form(target), "trusted": kept.trusted, "names": [v.name for v in views]}
    arrays = {name: np.concatenate([getattr(view, name) for view in views]) for name in _OF_VIEWS}
    arrays["camera"] = np.repeat(np.arange(len(kept.images)), [len(some) for some in kept.images])
    arrays["count"], arrays["stamp"] = np.array([len(view) for view in views]), np.array([v.stamp for v in views])
    _write_arrays(folder / _IMAGES, about, arrays | {"q": np.array([q for _, q in every])})


def read_images(folder: Path, target: PrintedTarget) -> KeptImages | None:
    """The images of a folder, None where it holds none, or those of another target. Raises BadTable for damage."""
    path = folder / _IMAGES
    if not path.is_file():
        return None
    with _arrays(path, "images") as (about, stored):
        of_views = (np.split(stored[name], np.cumsum(stored["count"])[:-1]) for name in _OF_VIEWS)
        views = map(BoardView, map(str, about["names"]), *of_views)
        images: list[list[tuple[BoardView, Array]]] = [[] for _ in about["sizes"]]
        for camera, view, stamp, q in zip(stored["camera"], views, stored["stamp"], stored["q"], strict=True):
            images[camera].append((replace(view, stamp=float(stamp)), q))
        sizes = [(int(width), int(height)) for width, height in about["sizes"]]
        return KeptImages(images, sizes, bool(about["trusted"])) if about["target"] == _form(target) else None


def forget_images(folder: Path) -> None:
    """Keep none any more, of any camera."""
    (folder / _IMAGES).unlink(missing_ok=True)


def _form(target: PrintedTarget) -> str:
    """What images of another target differ in: the sheet's size may have been measured since."""
    return json.dumps(target_to_data(target), sort_keys=True)
