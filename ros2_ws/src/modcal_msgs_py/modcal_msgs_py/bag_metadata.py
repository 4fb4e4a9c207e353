"""metadata.yaml of a bag, in the layout that ``ros2 bag record`` of Jazzy writes (version 9)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

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
    if len(text) > _MAX_QOS:
        return []
    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, AttributeError, RecursionError):
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
