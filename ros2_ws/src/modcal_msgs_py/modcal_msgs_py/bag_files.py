"""Which files a bag is made of, and a folder that becomes one at once."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from modcal_core.errors import BadRecording


def bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """The MCAP files of a bag, in order, and what a person should know of the folder."""
    if not path.exists():
        raise BadRecording(str(path), "does not exist", "give a bag folder or a .mcap file")
    if path.is_file():
        return [path], []
    metadata = path / "metadata.yaml"
    found = sorted(path.glob("*.mcap"), key=lambda p: (len(p.name), p.name))
    if metadata.is_file():
        try:
            information = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
            names = [path / Path(name).name for name in information["relative_file_paths"]]
        except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
            raise BadRecording(
                str(metadata), f"is damaged ({type(error).__name__})", "remove it; the .mcap is enough"
            ) from error
        missing = [name for name in names if not name.is_file()]
        if missing:
            raise BadRecording(str(missing[0]), "is named by metadata.yaml but not there", "put the file back")
        if any(name.suffix != ".mcap" for name in names):
            raise BadRecording(str(names[0]), "is not MCAP", "convert it: ros2 bag convert, with storage_id mcap")
        return names, []
    if found:
        return found, [f"{path.name} has no metadata.yaml: the recorder was stopped before it could close the bag."]
    if any(path.glob("*.db3")):
        raise BadRecording(str(path), "is a SQLite bag", "convert it: ros2 bag convert, with storage_id mcap")
    inside = sorted({inner.parent.name for inner in path.glob("*/*.mcap")})
    remedy = f"give one of the bags in it: {', '.join(inside[:3])}" if inside else "give a bag folder or a .mcap file"
    raise BadRecording(str(path), "holds no .mcap file", remedy)


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
