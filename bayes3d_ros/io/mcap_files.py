# SPDX-License-Identifier: Apache-2.0

"""The recorded messages of a bag, undecoded: rosbag2 folders with MCAP storage, or bare .mcap files.

Files are read from the front, without their index, so that a bag whose recorder was killed still gives every message
before the damage. Errors are one line that names the file and what was expected.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import yaml
from mcap.exceptions import InvalidMagic
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from bayes3d_ros.lists import hint

_TRANSIENT_LOCAL = 1  # rmw_qos_durability_policy_t
_SQLITE_MAGIC = b"SQLite format 3\0"
_REMEDY = "ros2 bag convert makes one"
_SQLITE = f"expected an MCAP file, it is of storage sqlite3 ({_REMEDY})"


class BagError(Exception):
    """A bag that cannot be used; one line naming the file or topic and what was expected."""


class BagDamage(BagError):
    """Part of a bag could not be read; raised after everything else in it has been delivered."""


class RawMessage(NamedTuple):
    """A recorded message: `t_ns` is when it was recorded, `data` its CDR bytes; `latched`: see `Topic`."""

    topic: str
    msgtype: str
    t_ns: int
    data: bytes
    latched: bool = False


@dataclass(frozen=True)
class Topic:
    """A recorded topic with `count` messages. `latched`: its publisher was transient_local, so that whoever subscribed
    late got the last message."""

    name: str
    msgtype: str
    count: int
    latched: bool = False


def raw_messages(bag: Path) -> Iterator[RawMessage]:
    """Every message of a bag in the order of recording. Raises BagError; BagDamage after the last readable message."""
    damage: BagDamage | None = None
    for file in _files(bag):
        try:
            yield from _messages(file)
        except BagDamage as error:  # the other files of a split bag may well be whole
            damage = damage or error
    if damage is not None:
        raise damage


def topics(bag: Path) -> dict[str, Topic]:
    """The topics of a bag that hold messages, by name; of a damaged bag, those that can be read.

    Raises BagError, also where damage leaves nothing.
    """
    found: dict[str, Topic] = {}
    try:
        for message in raw_messages(bag):
            before = found.get(message.topic, Topic(message.topic, message.msgtype, 0))
            latched = before.latched or message.latched
            found[message.topic] = Topic(message.topic, message.msgtype, before.count + 1, latched)
    except BagDamage as error:
        if not found:
            raise BagError(str(error)) from None
    return dict(sorted(found.items()))


def _files(bag: Path) -> list[Path]:
    """The .mcap files of a bag in order: those its metadata.yaml lists, else (recorder killed) all of the folder."""
    if not bag.exists():
        raise BagError(f"{bag}: no such file or folder, expected a rosbag2 folder or an .mcap file")
    if not bag.is_dir():
        if ".db3" in bag.suffixes:
            raise BagError(f"{bag}: {_SQLITE}")
        return [bag]
    files = sorted(bag.glob("*.mcap"))
    metadata = bag / "metadata.yaml"
    if metadata.exists():
        try:
            information = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
            storage, mode = information["storage_identifier"], information.get("compression_mode", "")
            files = [bag / name for name in information["relative_file_paths"]]
        except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
            raise BagError(f"{metadata}: expected the metadata of a rosbag2 recording") from None
        if storage != "mcap":
            raise BagError(f"{metadata}: expected storage_identifier mcap, got {storage} ({_REMEDY})")
        if mode.lower() not in ("", "none"):
            raise BagError(
                f"{metadata}: expected no rosbag2 compression (MCAP's own is read), got compression_mode {mode}"
            )
    if not files:
        other = next(iter(sorted(bag.glob("*.db3*"))), None)
        found = f"none{_bags_inside(bag)}" if other is None else f"{other.name}, storage sqlite3 ({_REMEDY})"
        raise BagError(f"{bag}: expected an .mcap file in this folder, found {found}")
    for file in files:
        if not file.exists():
            raise BagError(f"{file}: expected this file, which {metadata.name} lists")
    return files


def _bags_inside(folder: Path) -> str:
    """Names the folders inside that are bags: one of them was probably meant."""
    inside = {file.parent.name for file in folder.glob("*/*.mcap")}
    return hint("folders in it that hold one", sorted(inside))


def _messages(file: Path) -> Iterator[RawMessage]:
    try:
        stream = file.open("rb")
    except OSError as error:
        raise BagError(f"{file}: expected a readable file: {error.strerror}") from None
    with stream:
        if file.stat().st_size == 0:
            raise BagError(f"{file}: expected an MCAP file, it is empty (0 bytes)")
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        latched: dict[int, bool] = {}
        count = 0
        records = StreamReader(stream, emit_chunks=True).records
        while True:
            try:
                record = next(records)
                inside = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
            except StopIteration:
                return
            except InvalidMagic:
                if count or channels:  # the magic at the end
                    raise _damage(file, count) from None
                stream.seek(0)
                if stream.read(len(_SQLITE_MAGIC)) == _SQLITE_MAGIC:
                    raise BagError(f"{file}: {_SQLITE}") from None
                raise BagError(f"{file}: expected an MCAP file, it does not begin like one") from None
            except Exception:  # whatever a decoder raises on damaged bytes: short reads, checksums, decompression
                raise _damage(file, count) from None
            inside = [r for r in inside if isinstance(r, Schema | Channel | Message)]
            for definition in inside:
                if isinstance(definition, Schema):
                    schemas[definition.id] = definition
                elif isinstance(definition, Channel):
                    channels[definition.id] = definition
                    latched[definition.id] = _is_latched(definition)
            for message in sorted((r for r in inside if isinstance(r, Message)), key=lambda m: m.log_time):
                channel = channels.get(message.channel_id)
                if channel is None or channel.schema_id not in schemas:
                    raise BagError(f"{file}: channel {message.channel_id}: expected its topic and message definition")
                if channel.message_encoding != "cdr":
                    raise BagError(
                        f"{file}: {channel.topic}: expected messages in cdr, got {channel.message_encoding!r}"
                    )
                count += 1
                yield RawMessage(
                    channel.topic,
                    schemas[channel.schema_id].name,
                    message.log_time,
                    message.data,
                    latched[message.channel_id],
                )


def _is_latched(channel: Channel) -> bool:
    """Whether a publisher that was recorded offered transient_local, by the QoS profiles that rosbag2 writes: as a word
    since Jazzy, before that as rmw's number."""
    try:
        profiles = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
        return any(profile["durability"] in ("transient_local", _TRANSIENT_LOCAL) for profile in profiles)
    except (yaml.YAMLError, TypeError, KeyError):
        return False  # written by others


def _damage(file: Path, count: int) -> BagDamage:
    return BagDamage(f"{file}: expected a whole MCAP file, it is truncated or damaged after {count} readable messages")
