"""Which files a bag is made of, and a folder that becomes one at once."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from modcal_core.errors import BadRecording, BadTable
from modcal_core.files import parse_yaml

SUFFIXES = tuple(f"{kind}{packed}" for kind in (".mcap", ".db3") for packed in ("", ".zstd", ".zst"))

_MAX_NAME = 240  # bytes; file systems take 255, suffix included
_MAX_METADATA = 1 << 22  # bytes


def bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """The files of a bag, MCAP or SQLite, in order, and what a person should know of the folder."""
    if not path.exists():
        raise BadRecording(str(path), "does not exist", "give a bag folder or a .mcap file")
    if path.is_file():
        return [path], []
    metadata = path / "metadata.yaml"
    found = [file for suffix in SUFFIXES for file in path.glob(f"*{suffix}")]
    found.sort(key=lambda p: (len(p.name), p.name))
    if metadata.is_file():
        try:
            names = listed_files(path)
        except (BadTable, KeyError, TypeError, ValueError) as error:
            raise BadRecording(
                str(metadata), f"is damaged ({type(error).__name__})", "remove it; the other files are enough"
            ) from error
        missing = [name for name in names if not name.is_file()]
        if missing:
            raise BadRecording(str(missing[0]), "is named by metadata.yaml but not there", "put the file back")
        if strange := [name for name in names if not name.name.endswith(SUFFIXES)]:
            said = "is neither MCAP nor SQLite"
            raise BadRecording(str(strange[0]), said, "convert it: ros2 bag convert, with storage_id mcap")
        return names, []
    if found:
        return found, [f"{path.name} has no metadata.yaml: the recorder was stopped before it could close the bag."]
    inside = sorted({inner.parent.name for suffix in SUFFIXES for inner in path.glob(f"*/*{suffix}")})
    remedy = f"give one of the bags in it: {', '.join(inside[:3])}" if inside else "give a bag folder or a .mcap file"
    raise BadRecording(str(path), "holds no .mcap or .db3 file", remedy)


def listed_files(folder: Path) -> list[Path]:
    """The files that metadata.yaml names, wherever it was written; of packed ones the name with or without suffix.

    Raises BadTable for what is no YAML, and what another layout than rosbag2's leads to.
    """
    file = folder / "metadata.yaml"
    if file.stat().st_size > _MAX_METADATA:
        raise ValueError("it is too large")
    text = file.read_text(encoding="utf-8")
    stated = parse_yaml(text, str(file))["rosbag2_bagfile_information"]["relative_file_paths"]
    if not isinstance(stated, list) or not stated or not all(isinstance(name, str) and name for name in stated):
        raise ValueError("relative_file_paths is not a list of names")
    if any(len(Path(name).name.encode()) > _MAX_NAME for name in stated):
        raise ValueError("a name in relative_file_paths is too long for a file")
    out = []
    for name in (folder / Path(name).name for name in stated):
        packed = [name.with_name(f"{name.name}{end}") for end in (".zstd", ".zst")]
        out.append(next((p for p in packed if p.is_file()), name) if not name.is_file() else name)
    return out


@contextmanager
def appearing(folder: Path) -> Iterator[Path]:
    """A place beside ``folder``, and of its name, for what shall appear there at once: whole, or not at all.

    It is moved into place when the block ends, and removed when anything is raised in it, Ctrl-C included. Raises
    BadRecording when the folder exists, or its parent cannot be made.
    """
    if folder.exists():
        raise BadRecording(str(folder), "exists already", "give another name, or remove it")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise BadRecording(str(folder), f"cannot be written ({error.strerror})", "give a folder that can be") from error
    try:
        # a temporary folder is for its owner alone, which one in it is not
        yield stage / folder.name
        os.rename(stage / folder.name, folder)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
