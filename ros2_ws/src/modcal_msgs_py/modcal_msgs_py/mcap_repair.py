"""A whole bag from one that was cut: every message that is whole, byte for byte, with index and metadata.yaml.

What can be read of a cut file is what ``mcap_read`` reads of it; here it is copied, with channels, schemas, stamps and
sequence numbers as they were. The bag that is repaired is only read.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer

from modcal_core.errors import BadRecording, BadTable
from modcal_core.files import parse_yaml
from modcal_msgs_py.bag_files import (
    BagFile,
    BagTopic,
    appearing,
    bag_files,
    information,
    listed_files,
    named_qos,
    to_yaml,
)
from modcal_msgs_py.bag_open import PACKED
from modcal_msgs_py.mcap_walk import McapFile, read_index
from modcal_msgs_py.mcap_write import CHUNK_BYTES, LIBRARY

_COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
_RECORD_HEAD = 9
_MANY = 1000  # messages between two words of how far it is

Heard: TypeAlias = Callable[[str, float], None]


@dataclass(frozen=True)
class Repair:
    """What a repair did. folder: the new bag; None: the old one is whole, nothing was written.

    saved: messages by topic. reasons: what was wrong, a sentence for each.
    """

    folder: Path | None
    saved: Mapping[str, int]
    reasons: tuple[str, ...]


def repair_bag(path: Path, out: Path, heard: Heard = lambda stage, share: None) -> Repair:
    """Write what is whole of the bag ``path`` (a folder or a .mcap file) as a whole bag ``out``.

    Nothing is written when the bag is whole already. ``out`` appears at once and complete, or not at all. heard: is
    told what is being done, and the share of it that is. Raises BadRecording when no message can be saved, ``out``
    exists, or the disk is full.
    """
    files, stated, reasons = _files(path)
    counts, more = _examined(files, heard)
    reasons += more
    if path.is_dir() and not reasons and _listed(stated) != counts:
        reasons = ["metadata.yaml counts other messages than the files hold."]
    if not reasons:
        return Repair(None, counts, ())
    if not counts:
        why = " ".join(reasons).rstrip(".")
        raise BadRecording(str(path), f"holds no whole message ({why})", "record again")
    if out.exists():
        raise BadRecording(str(out), "exists already", "give --out another name, or remove it")
    if path.is_dir() and out.resolve().is_relative_to(path.resolve()):
        raise BadRecording(str(out), "lies in the bag that is to be repaired", "give --out a folder beside it")
    try:
        copied = partial(heard, f"writing {out.name}")
        return Repair(out, _rewritten(files, stated, out, sum(counts.values()), copied), tuple(reasons))
    except OSError as error:
        raise BadRecording(
            str(out), f"cannot be written ({error.strerror})", "give --out a folder on a disk that has room"
        ) from error


def _files(path: Path) -> tuple[list[Path], dict[str, Any], list[str]]:
    """(files in order, what metadata.yaml states, what is wrong with the folder). Raises BadRecording for a bag that is
    not made of plain MCAP files.
    """
    names, stated, wrong = [path], dict[str, Any](), list[str]()
    if path.is_dir():
        metadata = path / "metadata.yaml"
        try:
            names = listed_files(path)
            stated = parse_yaml(metadata.read_text(encoding="utf-8"), str(metadata))["rosbag2_bagfile_information"]
        except (OSError, BadTable, KeyError, TypeError, ValueError):
            what = "damaged" if metadata.is_file() else "missing"
            wrong.append(f"metadata.yaml is {what}: the recorder did not close the bag.")
            names = sorted(path.glob("*.mcap"), key=lambda p: (len(p.name), p.name)) or bag_files(path)[0]
    for name in names:
        if ".db3" in name.name:
            raise BadRecording(str(name), "is a SQLite bag", "repair it with sqlite3's .recover, or convert it")
        if name.name.endswith(PACKED):
            raise BadRecording(str(name), "is packed", "unpack it first: zstd -d")
    wrong += [f"{name.name} is named by metadata.yaml, but not there." for name in names if not name.is_file()]
    return [name for name in names if name.is_file()], stated, wrong


def _examined(files: list[Path], heard: Heard) -> tuple[dict[str, int], list[str]]:
    """(whole messages by topic, what is wrong with the files)."""
    counts: dict[str, int] = {}
    reasons = []
    for i, name in enumerate(files):
        file = McapFile(name, cdr_only=False)
        try:
            for message in file.messages():
                counts[message.topic] = counts.get(message.topic, 0) + 1
                if file.count % _MANY == 1:
                    heard("reading all messages", (i + file.share) / len(files))
        except BadRecording as error:
            if len(files) == 1:
                raise
            reasons.append(f"{name.name} {error.limit}.")
            continue
        if damaged := sum(_extra(*extra) is None for extra in file.extras):
            reasons.append(f"{name.name}: {damaged} attachments or metadata records are damaged: they are left out.")
        fault = file.cut or _index_fault(name, file.count)
        if fault:
            reasons.append(f"{name.name}: {fault}.")
    return counts, reasons


def _listed(stated: dict[str, Any]) -> dict[str, int]:
    try:
        topics = stated["topics_with_message_count"]
        return {t["topic_metadata"]["name"]: t["message_count"] for t in topics if t["message_count"]}
    except (KeyError, TypeError, IndexError):
        return {}


def _index_fault(path: Path, count: int) -> str | None:
    """What the index at the end of a file lacks, for readers that go by it."""
    try:
        index = read_index(path)
    except (ValueError, OSError) as error:
        return f"its index is damaged ({error})"
    if index is None or index.messages is None:
        return "it has no index"
    if index.messages != count:
        return f"its index counts {index.messages} messages, it holds {count}"
    if index.listed != index.chunks:
        return f"its index lists {index.listed} of {index.chunks} chunks"
    return None


def _rewritten(
    files: list[Path], stated: dict[str, Any], out: Path, count: int, heard: Callable[[float], None]
) -> dict[str, int]:
    """Number of messages by topic in the repaired bag ``out``, which is one file."""
    topics: dict[str, BagTopic] = {}
    schemas: dict[Any, int] = {}
    seen = BagFile(f"{out.name}_0.mcap")
    with appearing(out) as stage:
        stage.mkdir()
        with (stage / seen.name).open("wb") as stream:
            writer: Any = None
            for source in (McapFile(name, cdr_only=False) for name in files):
                channels: dict[int, int] = {}
                with contextlib.suppress(BadRecording):  # a file that is no MCAP at all is among the reasons already
                    for m in source.messages():
                        if writer is None:
                            compression = _COMPRESSION.get(source.compression or "", CompressionType.NONE)
                            writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=compression)
                            writer.start(profile="ros2", library=LIBRARY)
                        if m.channel not in channels:
                            channels[m.channel] = _channel(writer, source, m.channel, topics, schemas)
                        topics[m.topic].count += 1
                        seen.add(m.received_ns)
                        writer.add_message(channels[m.channel], m.received_ns, bytes(m.cdr), m.published_ns, m.sequence)
                        if seen.count % _MANY == 1:
                            heard(seen.count / count)
                if writer is not None:
                    for channel in source.channels.keys() - channels.keys():  # topics without a message belong to it
                        _channel(writer, source, channel, topics, schemas)
                    for opcode, record in source.extras:
                        _add_extra(writer, _extra(opcode, record))
            writer.finish()
            stream.flush()
            os.fsync(stream.fileno())
        texts = {key: text for key, text in stated.items() if isinstance(text, str)}
        custom = stated.get("custom_data")
        distro = texts.get("ros_distro") or "unknown"
        whole = information(topics.values(), [seen], distro, custom if isinstance(custom, dict) else None)
        for key in ("compression_format", "compression_mode"):  # of single messages, which are copied as they are
            whole[key] = texts.get(key, "")
        with (stage / "metadata.yaml").open("w", encoding="utf-8") as listed:
            listed.write(to_yaml({"rosbag2_bagfile_information": whole}))
            listed.flush()
            os.fsync(listed.fileno())
    return {topic.name: topic.count for topic in topics.values()}


def _channel(writer: Any, source: McapFile, number: int, topics: dict[str, BagTopic], schemas: dict[Any, int]) -> int:
    """A channel of a source in the new file, with its schema, and its topic among those of the bag."""
    channel = source.channels[number]
    schema = source.schema_records.get(channel.schema_id)
    key = None if schema is None else (schema.name, schema.encoding, schema.data)
    if key is not None and key not in schemas:
        schemas[key] = writer.register_schema(*key)
    registered = 0 if key is None else schemas[key]
    type_hash = channel.metadata.get("topic_type_hash", "")
    made = BagTopic(channel.topic, "" if schema is None else schema.name, type_hash, encoding=channel.message_encoding)
    topic = topics.setdefault(channel.topic, made)
    offered = named_qos(channel.metadata.get("offered_qos_profiles", ""))
    topic.qos += [profile for profile in offered if profile not in topic.qos]
    return int(writer.register_channel(channel.topic, channel.message_encoding, registered, dict(channel.metadata)))


def _add_extra(writer: Any, extra: Attachment | Metadata | None) -> None:
    if isinstance(extra, Attachment):
        writer.add_attachment(extra.create_time, extra.log_time, extra.name, extra.media_type, extra.data)
    elif extra is not None and extra.name != "rosbag2":  # which repeats metadata.yaml, of the bag as it was
        writer.add_metadata(extra.name, extra.metadata)


def _extra(opcode: int, record: bytes) -> Attachment | Metadata | None:
    """An attachment or metadata out of a whole record; None for one that is damaged."""
    stream = ReadDataStream(BytesIO(record[_RECORD_HEAD:]))
    try:
        return Attachment.read(stream) if opcode == Opcode.ATTACHMENT else Metadata.read(stream)
    except (McapError, struct.error, UnicodeDecodeError, ValueError, MemoryError):
        return None
