"""A bag as its publishers sent it: the bytes of every message in the order of reception, and the QoS of each topic."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import NamedTuple

from modcal_msgs_py.bag_files import bag_files, named_qos
from modcal_msgs_py.bag_open import PackedMessage, bag_file, packed_messages, topics_of, unpacked
from modcal_msgs_py.topics import LATCHED, TF_STATIC

_WINDOW = 500_000_000  # ns; a recorder takes topic by topic, so a file is nearly in the order of reception


class OfferedTopic(NamedTuple):
    """A topic of a bag, and the QoS that satisfies all who heard its publishers. depth: 0 where it is not stated."""

    type_name: str
    reliable: bool
    latched: bool
    depth: int


def offered_topics(path: Path) -> dict[str, OfferedTopic]:
    """The topics of a bag that have messages, as they were offered; by the contract where nothing is stated."""
    out = {}
    with unpacked(bag_files(path)[0]) as files:
        for file in map(bag_file, files):
            for (name, type_name), count in topics_of(file).items():
                if count:
                    out[name] = _offered(name, type_name, file.offered.get(name, ""))
    return out


def _offered(name: str, type_name: str, stated: str) -> OfferedTopic:
    """What satisfies reliable and late listeners satisfies the others too."""
    if not (profiles := named_qos(stated)):
        return OfferedTopic(type_name, True, name == TF_STATIC or name.endswith(tuple(f"/{r}" for r in LATCHED)), 0)
    reliable = any(profile.get("reliability") != "best_effort" for profile in profiles)
    latched = any(profile.get("durability") == "transient_local" for profile in profiles)
    depths = [depth for profile in profiles if isinstance(depth := profile.get("depth"), int)]
    return OfferedTopic(type_name, reliable, latched, max(depths, default=0))


def messages_in_order(
    path: Path, topics: Collection[str], heard: Callable[[float], None], said: Callable[[str], None]
) -> Iterator[PackedMessage]:
    """The messages of these topics in the order of reception. heard, said: as of packed_messages."""
    waiting: list[tuple[int, int, PackedMessage]] = []
    for number, message in enumerate(packed_messages(path, topics, heard, said)):
        heappush(waiting, (message.received_ns, number, message))
        while waiting[0][0] <= message.received_ns - _WINDOW:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]
