"""Export to rosbag2: a directory with one MCAP file and its ``metadata.yaml``, with the ROS topics of a session.

Messages are copied byte for byte with both times; ``header.stamp`` has the corrections that the recording states.
OpenIGTLink messages and notes are not exported.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Metadata
from mcap.writer import CompressionType, Writer

from igtl_gateway.addon import __version__
from igtl_gateway.addon.reading import Qos, layout
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.folder import new_folder
from igtl_gateway.addons.exchange.rostypes import with_hash
from igtl_gateway.addons.exchange.selection import ROS_KINDS, Recording, chosen_entries

_CHUNK_BYTES = 1 << 20
_VERSION = 8
#: Attachment with the metadata of the session.
_SESSION = "session.json"

#: Policy → number in rmw.
_NUMBERS = {
    "keep_last": 1,
    "keep_all": 2,
    "reliable": 1,
    "best_effort": 2,
    "transient_local": 1,
    "volatile": 2,
    "automatic": 1,
}
_POLICY = re.compile(rf"^([ -]*(?:history|reliability|durability|liveliness): )({'|'.join(_NUMBERS)})$", re.MULTILINE)


def export_rosbag2(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises UnsupportedRecording if it is not empty; OSError."""
    account = ExportAccount()
    name = f"{out.resolve().name or 'rosbag2'}_0.mcap"
    topics: dict[tuple[str, str], _BagTopic] = {}
    first = last = 0
    with new_folder(out, account) as folder:
        with folder.create(name) as stream:
            writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            writer.start(layout.MCAP_PROFILE, f"igtl-gateway {__version__}")
            register = _TopicRegistry(writer, recording, account)
            for sequence, entry in enumerate(chosen_entries(recording, ROS_KINDS, globs, account), 1):
                row, key = account.row(entry), (entry.channel, entry.type)
                topic = topics[key] = topics.get(key) or register.topic(*key)
                writer.add_message(
                    topic.channel,
                    log_time=entry.stamp_ns,
                    data=entry.data(),
                    publish_time=entry.source_ns or entry.stamp_ns,
                    sequence=sequence & 0xFFFFFFFF,
                )
                row.taken += 1
                topic.count += 1
                first, last = first or entry.stamp_ns, entry.stamp_ns
            # Jazzy and later read the version of the metadata of channels from here
            described = _metadata(name, first, last, list(topics.values()), _custom(recording))
            inner = textwrap.dedent(described.split("\n", 1)[1])
            writer.add_metadata(layout.ROSBAG2_METADATA, {"serialized_metadata": inner, "ROS_DISTRO": "jazzy"})
            # at least one metadata record and one attachment, which checkers of MCAP files expect
            writer.add_metadata("igtl_gateway.export", {"igtl_gateway_version": __version__})
            session = json.dumps(dict(recording.session), sort_keys=True)
            writer.add_attachment(0, 0, _SESSION, "application/json", session.encode())
            for each in recording.beside():
                if isinstance(each, Metadata):
                    writer.add_metadata(each.name, each.metadata)
                elif each.name != _SESSION:
                    writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
            writer.finish()  # type: ignore[no-untyped-call]
        with folder.create("metadata.yaml") as stream:
            stream.write(described.encode())
    account.files = 2
    return account


@dataclass(slots=True)
class _BagTopic:
    """A channel of the bag: its id, its facts for ``metadata.yaml``, and the number of messages so far."""

    channel: int
    name: str
    type: str
    qos: str
    type_hash: str
    count: int = 0


class _TopicRegistry:
    """Registers schemas and channels with the writer."""

    def __init__(self, writer: Writer, recording: Recording, account: ExportAccount) -> None:
        self._writer, self._recording, self._account = writer, recording, account
        self._offered = {(channel.topic, channel.type): channel.qos for channel in recording.channels}
        self._schemas: dict[str, tuple[int, str]] = {}

    def topic(self, name: str, ros_type: str) -> _BagTopic:
        """Register a channel."""
        if ros_type not in self._schemas:
            self._schemas[ros_type] = self._schema(ros_type)
        number, type_hash = self._schemas[ros_type]
        qos = numbered_qos(layout.qos_yaml(self._offered.get((name, ros_type)) or Qos()))
        facts = {layout.QOS_KEY: qos, layout.TYPE_HASH_KEY: type_hash}
        channel = self._writer.register_channel(name, layout.MESSAGE_ENCODING, number, facts)
        return _BagTopic(channel, name, ros_type, qos, type_hash)

    def _schema(self, ros_type: str) -> tuple[int, str]:
        notes = self._account.notes
        given = self._recording.definition_of(ros_type)
        found = with_hash(ros_type, given, notes.append) if given else None
        if found is None:
            if not (given and given.data.strip()):
                notes.append(f"{ros_type}: the session has no definition of this type")
            return self._writer.register_schema(ros_type, "", b""), ""
        return self._writer.register_schema(ros_type, found.encoding, found.data), found.file_hash(ros_type)


def numbered_qos(text: str) -> str:
    """Return QoS profiles with the numbers of rmw instead of the names of policies."""
    return _POLICY.sub(lambda match: f"{match[1]}{_NUMBERS[match[2]]}", text)


def _custom(recording: Recording) -> dict[str, str]:
    """Return what the user has put into the metadata of the session."""
    try:
        found = json.loads(recording.session.get(layout.CUSTOM_KEY, "{}"))
    except ValueError:
        return {}
    return {key: str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def _metadata(name: str, first: int, last: int, topics: list[_BagTopic], custom: dict[str, str]) -> str:
    """Return ``metadata.yaml`` version 8, that of Iron, which Humble, Jazzy and later also read.

    In this version QoS profiles are a string with numbers for policies; Humble and Iron reject names.
    """
    total = sum(topic.count for topic in topics)
    lines = [
        "rosbag2_bagfile_information:",
        f"  version: {_VERSION}",
        "  storage_identifier: mcap",
        "  duration:",
        f"    nanoseconds: {last - first}",
        "  starting_time:",
        f"    nanoseconds_since_epoch: {first}",
        f"  message_count: {total}",
        f"  topics_with_message_count:{'' if topics else ' []'}",
    ]
    for topic in topics:
        lines += [
            "    - topic_metadata:",
            f"        name: {_yaml(topic.name)}",
            f"        type: {_yaml(topic.type)}",
            f"        serialization_format: {layout.MESSAGE_ENCODING}",
            f"        offered_qos_profiles: {_yaml(topic.qos)}",
            f"        type_description_hash: {_yaml(topic.type_hash)}",
            f"      message_count: {topic.count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        "  relative_file_paths:",
        f"    - {_yaml(name)}",
        "  files:",
        f"    - path: {_yaml(name)}",
        "      starting_time:",
        f"        nanoseconds_since_epoch: {first}",
        "      duration:",
        f"        nanoseconds: {last - first}",
        f"      message_count: {total}",
        *(["  custom_data:"] if custom else ["  custom_data: ~"]),
        *(f"    {_yaml(key)}: {_yaml(value)}" for key, value in sorted(custom.items())),
        "  ros_distro: jazzy",
        "",
    ]
    return "\n".join(lines)


def _yaml(text: str) -> str:
    """Return text as a YAML string: a JSON string, but without surrogate pairs for characters above U+FFFF."""
    pairs = re.compile(r"\\u(d[89ab][0-9a-f]{2})\\u(d[c-f][0-9a-f]{2})")

    def whole(match: re.Match[str]) -> str:
        high, low = (int(half, 16) for half in match.groups())
        return f"\\U{0x10000 + (high - 0xD800 << 10) + low - 0xDC00:08x}"

    return pairs.sub(whole, json.dumps(text))
