"""The corners that a calibrator has taken, on disk, so that a restart goes on from them.

A fit and what watches it are not kept: both follow from the images in a second or two, and are the same again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modcal_core.camera import BoardView, PrintedTarget, target_to_data
from modcal_core.errors import BadTable
from modcal_core.geometry import Array

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
    folder.mkdir(parents=True, exist_ok=True)
    stage = folder / f".{_file(camera)}"
    with stage.open("wb") as stream:
        np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]
    os.replace(stage, folder / _file(camera))


def read_images(folder: Path, target: PrintedTarget, camera: int = 1) -> KeptImages | None:
    """The images of a folder, None where it holds none, or those of another target. camera: as written. Raises BadTable
    for damage.
    """
    path = folder / _file(camera)
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            arrays = {name: stored[name] for name in ("count", "ids", "pixels", "cov", "stamp", "q")}
        parts = np.split(np.arange(len(arrays["ids"])), np.cumsum(arrays["count"])[:-1])
        images = [
            (
                BoardView(
                    str(name), arrays["ids"][rows], arrays["pixels"][rows], arrays["cov"][rows], stamp=float(stamp)
                ),
                q,
            )
            for name, rows, stamp, q in zip(about["names"], parts, arrays["stamp"], arrays["q"], strict=True)
        ]
        width, height = (int(side) for side in about["size"])
    except Exception as error:  # zip, NumPy and JSON each have their own way to say that bytes are missing
        said = f"is damaged ({type(error).__name__})"
        raise BadTable(str(path), said, "remove it; images are collected again") from error
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
