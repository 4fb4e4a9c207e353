"""Which files a bag is made of, and a folder that becomes one at once."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from modcal_core.errors import BadRecording, BadTable
from modcal_core.files import parse_yaml

SUFFIXES = tuple(f"{kind}{packed}" for kind in (".mcap", ".db3") for packed in ("", ".zstd", ".zst"))

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
        except (BadTable, OSError, KeyError, TypeError, ValueError) as error:
            raise BadRecording(str(metadata), f"is damaged ({type(error).__name__})", "remove it: files do") from error
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


# --- metadata.yaml of a bag, in the layout that ``ros2 bag record`` of Jazzy writes (version 9)

FOREVER = {"sec": 9223372036, "nsec": 854775807}
_MAX_QOS = 1 << 16  # letters
# Bags before version 9 hold the middleware's numbers, later ones the names.
_QOS_NAMES = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all", 3: "unknown"},
    "reliability": {0: "system_default", 1: "reliable", 2: "best_effort", 3: "unknown"},
    "durability": {0: "system_default", 1: "transient_local", 2: "volatile", 3: "unknown"},
    "liveliness": {0: "system_default", 1: "automatic", 2: "manual_by_node", 3: "manual_by_topic", 4: "unknown"},
}


@dataclass
class BagTopic:
    """A topic as metadata.yaml lists it. qos: one profile for each kind that its publishers offered."""

    name: str
    type_name: str
    type_hash: str = ""
    qos: list[dict[str, Any]] = field(default_factory=list)
    encoding: str = "cdr"
    count: int = 0


@dataclass
class BagFile:
    """One file of a bag: its name, how many messages are in it, and when the first and last were received [ns]."""

    name: str
    count: int = 0
    first: int = 0
    last: int = 0

    def add(self, received_ns: int) -> None:
        """Count one more message."""
        self.first = received_ns if self.count == 0 else min(self.first, received_ns)
        self.last = received_ns if self.count == 0 else max(self.last, received_ns)
        self.count += 1

    def timing(self) -> dict[str, Any]:
        """Start and duration, the way metadata.yaml states them."""
        return {
            "starting_time": {"nanoseconds_since_epoch": self.first},
            "duration": {"nanoseconds": self.last - self.first},
        }


def qos_profile(latched: bool = False, reliable: bool = True, depth: int = 10) -> dict[str, Any]:
    """An offered QoS profile as bags hold it."""
    return {
        "history": "keep_last",
        "depth": 1 if latched else depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
        "deadline": FOREVER,
        "lifespan": FOREVER,
        "liveliness": "automatic",
        "liveliness_lease_duration": FOREVER,
        "avoid_ros_namespace_conventions": False,
    }


def named_qos(text: str) -> list[dict[str, Any]]:
    """The QoS profiles that a channel states in YAML, with names instead of numbers; none when it is not legible."""
    try:
        profiles = parse_yaml(text, "QoS") if len(text) <= _MAX_QOS else None
    except BadTable:
        return []
    if not isinstance(profiles, list) or not all(isinstance(profile, dict) for profile in profiles):
        return []
    return [{key: _named(key, value) for key, value in profile.items()} for profile in profiles]


def _named(key: str, value: Any) -> Any:
    known = _QOS_NAMES.get(key, {}) if isinstance(key, str) else {}
    return known.get(value, value) if isinstance(value, int) else value


class _Plain(yaml.SafeDumper):
    """Writes what is equal twice: the readers of bags are not all fond of anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def to_yaml(data: Any) -> str:
    """YAML text without anchors, keys in the order given."""
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)


def information(
    topics: Iterable[BagTopic],
    files: Sequence[BagFile],
    ros_distro: str = "jazzy",
    custom_data: dict[str, str] | None = None,
) -> dict[str, Any]:
    """The entry ``rosbag2_bagfile_information`` for these topics and files."""
    filled = [file for file in files if file.count]
    whole = BagFile("", sum(file.count for file in filled))
    if filled:
        whole.first, whole.last = min(file.first for file in filled), max(file.last for file in filled)
    return {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": whole.timing()["duration"],
        "starting_time": whole.timing()["starting_time"],
        "message_count": whole.count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": topic.encoding,
                    "offered_qos_profiles": topic.qos,
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.count,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": file.name, **file.timing(), "message_count": file.count} for file in files],
        "custom_data": custom_data,
        "ros_distro": ros_distro,
    }
