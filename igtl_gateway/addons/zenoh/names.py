"""The formats of rmw_zenoh (Jazzy, 0.2.4 and later): keys, liveliness tokens, gids, attachments.

* A *data key* carries the messages of a topic or the calls of a service: ``DOMAIN/NAME/TYPE/HASH``.  Both ends have to
  write the same key, so a different type hash means that nothing passes.
* A *liveliness token* is a key that exists as long as its session: one for each node, publisher, subscription and
  service.  All tokens together are the ROS graph.
* The *gid* of an entity is the 128-bit XXH3 of its token.
* An *attachment* goes with every message: sequence number, time and gid of the sender.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

from igtl_gateway.addon import StrEnum
from igtl_gateway.addon.reading import Qos
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.zenoh.library import import_xxhash

#: The first chunk of all tokens of ROS.
SPACE = "@ros2_lv"
#: Hash of Humble, which has no hashes.
NO_HASH = "TypeHashNotSupported"

_ATTACHMENT = struct.Struct("<qqB16s")
ATTACHMENT_BYTES = _ATTACHMENT.size
_GID_BYTES = 16

#: QoS that a token leaves out: that of rmw_zenoh.
_DEPTH = 42
_BEST_EFFORT = 2
_LATCHED = 1
_QOS_GROUPS = 6
_USUAL = Qos(_DEPTH)

#: Longest token that is read; the names of ROS have 256 characters at most, and there are three of them.
LONGEST_TOKEN = 2048

_TOPIC = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+", re.ASCII)
_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
_ROS_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv)/([A-Z][A-Za-z0-9_]*)", re.ASCII)
_DDS_TYPE = re.compile(r"([a-z][a-z0-9_]*)::(msg|srv|action)::dds_::([A-Z][A-Za-z0-9_]*)_", re.ASCII)
_HASH = re.compile(rf"RIHS01_[0-9a-f]{{64}}|{NO_HASH}", re.ASCII)
_NUMBER = re.compile(r"[0-9]{1,18}", re.ASCII)
_ZID = re.compile(r"[0-9a-f]{1,32}", re.ASCII)


class Kind(StrEnum):
    """What a token stands for."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a session.

    Attributes:
        domain: number of the ROS domain.
        zid: id of the session, hexadecimal.
        number: of the node in its session.
        name: without namespace.
        namespace: beginning with a slash.
    """

    domain: int
    zid: str
    number: int
    name: str
    namespace: str = "/"

    @property
    def full_name(self) -> str:
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def token(self) -> str:
        """Return the token of the node itself."""
        return f"{self._head(self.number, Kind.NODE)}"

    def _head(self, entity: int, kind: Kind) -> str:
        place = f"{SPACE}/{self.domain}/{self.zid}/{self.number}/{entity}/{kind}"
        return f"{place}/%/{_mangled(self.namespace)}/{self.name}"

    def entity_token(self, entity: int, kind: Kind, topic: str, ros_type: str, type_hash: str, qos: Qos) -> str:
        """Return the token of a publisher, subscription or service; ``topic`` is the full name."""
        ends = (self._head(entity, kind), _mangled(topic), dds_type(ros_type), type_hash, qos_text(qos))
        return "/".join(ends)


@dataclass(frozen=True, slots=True)
class Entity:
    """What a token states.

    Attributes:
        node: where it belongs.
        number: of the entity in its session.
        kind: publisher, subscription …
        topic: full name of the topic or service; "" for a node.
        type: ``"pkg/msg/Name"``; "" for a node.
        type_hash: of the type; "" for a node.
        qos: offered or requested.
    """

    node: Node
    number: int
    kind: Kind
    topic: str = ""
    type: str = ""
    type_hash: str = ""
    qos: Qos = _USUAL

    @property
    def key(self) -> str:
        """The data key."""
        return data_key(self.node.domain, self.topic, self.type, self.type_hash)


def dds_type(ros_type: str) -> str:
    """Return ``pkg::msg::dds_::Name_`` for ``pkg/msg/Name``.  Raises ValueError."""
    found = _ROS_TYPE.fullmatch(ros_type)
    if not found:
        raise ValueError(f'found the type {ros_type!r}, expected "package/msg/Name"')
    return "{}::{}::dds_::{}_".format(*found.groups())


def data_key(domain: int, topic: str, ros_type: str, type_hash: str) -> str:
    """Return the key of the messages of a topic, or of the calls of a service.  Raises ValueError."""
    return f"{domain}/{checked_topic(topic).strip('/')}/{dds_type(ros_type)}/{type_hash}"


def checked_topic(topic: str) -> str:
    """Return a full name of a topic as it is.  Raises ValueError: in a key, other characters have a meaning."""
    if not _TOPIC.fullmatch(topic):
        raise ValueError(f"found the topic {topic!r}, expected a name such as /camera/image_raw")
    return topic


def checked_node(name: str) -> str:
    """Return the name of a node as it is.  Raises ValueError."""
    if not _NODE.fullmatch(name):
        raise ValueError(f"found the node name {name!r}, expected letters, digits and underscores")
    return name


def gid(token: str) -> bytes:
    """Return the 16 bytes that identify the entity of a token."""
    number: int = _xxhash().xxh3_128_intdigest(token.encode())
    return number.to_bytes(_GID_BYTES, "little")


def attachment(sequence: int, stamp_ns: int, of_gid: bytes) -> bytes:
    """Return what goes with a message: its number from 1 on, the time in UTC ns, and the sender's gid."""
    return _ATTACHMENT.pack(sequence, stamp_ns, _GID_BYTES, of_gid)


def read_attachment(found: bytes) -> tuple[int, int, bytes]:
    """Return sequence number, time and gid.  Raises ValueError for anything else than ``attachment`` makes."""
    if len(found) != ATTACHMENT_BYTES:
        raise ValueError(f"found an attachment of {counted(len(found), 'byte')}, expected {ATTACHMENT_BYTES}")
    sequence, stamp_ns, size, of_gid = _ATTACHMENT.unpack(found)
    if size != _GID_BYTES:
        raise ValueError(f"found a gid of {counted(size, 'byte')} in the attachment, expected {_GID_BYTES}")
    return sequence, stamp_ns, of_gid


def qos_text(qos: Qos) -> str:
    """Return the QoS as a token has it: what rmw_zenoh takes for granted is left out."""
    reliability = "" if qos.reliable else str(_BEST_EFFORT)
    durability = str(_LATCHED) if qos.latched else ""
    depth = "" if qos.depth == _DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def read_qos(text: str) -> Qos:
    """Return the QoS of a token.  Raises ValueError."""
    groups = text.split(":")
    if len(groups) < _QOS_GROUPS:
        raise ValueError(f"found the quality of service {text!r}, expected {_QOS_GROUPS} groups")
    reliability, durability = (int(group) if group else 0 for group in groups[:2])
    depth = groups[2].partition(",")[2]
    return Qos(int(depth) if depth else _DEPTH, reliability != _BEST_EFFORT, durability == _LATCHED)


def read_token(token: str) -> Entity:
    """Return what a token states.  Raises ValueError: any program may write tokens.

    Later releases append fields, which are ignored.
    """
    if len(token) > LONGEST_TOKEN:
        raise ValueError(f"found a token of {counted(len(token), 'character')}, expected {LONGEST_TOKEN} at most")
    fields = token.split("/")
    if len(fields) < 9 or fields[0] != SPACE:
        raise ValueError(f"found {counted(len(fields), 'field')}, expected 9 or more after {SPACE}")
    _, domain, zid, node_number, number, kind, _enclave, namespace, name = fields[:9]
    if not (_NUMBER.fullmatch(domain) and _NUMBER.fullmatch(node_number) and _NUMBER.fullmatch(number)):
        raise ValueError("found no numbers for domain, node and entity")
    if not _ZID.fullmatch(zid):
        raise ValueError(f"found {zid!r}, expected the id of a session")
    namespace = namespace.replace("%", "/")
    if namespace != "/":
        checked_topic(namespace)
    node = Node(int(domain), zid, int(node_number), checked_node(name), namespace)
    what = Kind(kind)
    if what is Kind.NODE:
        return Entity(node, int(number), what)
    if len(fields) < 13:
        raise ValueError(f"found {counted(len(fields), 'field')}, expected 13 or more")
    topic, of_type, type_hash, qos = fields[9:13]
    found = _DDS_TYPE.fullmatch(of_type)
    if not found:
        raise ValueError(f"found the type {of_type!r}, expected package::msg::dds_::Name_")
    if not _HASH.fullmatch(type_hash):
        raise ValueError(f"found the type hash {type_hash!r}, expected RIHS01_ and 64 hexadecimal digits")
    topic = checked_topic(topic.replace("%", "/"))
    return Entity(node, int(number), what, topic, "/".join(found.groups()), type_hash, read_qos(qos))


@cache
def _xxhash() -> Any:
    return import_xxhash()


def _mangled(name: str) -> str:
    return name.replace("/", "%")
