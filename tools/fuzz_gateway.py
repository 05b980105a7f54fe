"""Mutation fuzzing of framer and gateway: ``python -m tools.fuzz_gateway --messages 5000000 --seed 1``.

Strategy: mutate the inputs that the edges would deliver, and check all outputs.  A *stage* is one session
(`Session(Gateway(Config))`) with its links.  Each link has a framer that receives pieces of a byte stream, as
from a socket; between them are ROS messages, ticks, link events and notes of the edges.  Two stages alternate: an old
one, which exists for the complete run and must not grow, and a young one, which is replaced with the next of
``CONFIGS``.  The beginning of a young stage is replayed with and without the fast path; the outputs must be equal to
the last bit.

Settings change as ``ros2 param set`` changes them.  Mutated are the messages of both corpora, the ROS messages of
``fixtures/every-type.mcap``, poses, strings and clouds with their numbers and stamps (for the fast path), and the
latest outputs of the gateway (so that replies match open requests).  The seed determines the sequence.  If a check
fails, the inputs are written to a file for ``--repeat``.
"""

from __future__ import annotations

import argparse
import base64
import faulthandler
import gc
import hashlib
import json
import resource
import signal
import statistics
import struct
import sys
import time
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MessageTooLarge
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert import express
from igtl_gateway.convert.clouds import polydata_to_cloud
from igtl_gateway.convert.common_msgs import PoseStamped, TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.convert.rosmsg import RosMessage, TransformStamped
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, Role
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, LISTENED, TICK, Gateway, Session
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.changes import SETTINGS
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import BODY_SIZE, HEADER_SIZE, NAMES, TICKS, TICKS_AT, TYPE_AT
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Position, Transform
from tests.wire.vectors import vectors
from tools.fuzz import DAMAGE, EDGES, MAX_FILE, ROOT, Broken, corpus, repaired

T0_NS = 1_700_000_000 * NS_PER_S

#: One input of a session: gateway time, kind, payload, topic, ROS type, links, stamp of the source.
Input = tuple[int, Kind, bytes, str, str, tuple[int, ...], int]

#: Peers that are connected at once, and the addresses that they come from.
LINKS = 5
PEERS = tuple(f"10.0.0.{number}:{4_000 + number}" for number in range(4))

#: The framer of the fuzz: corpus messages are below 8 KiB, so that whatever announces more has been bent.
MAX_BODY = 1 << 20

#: Messages after which a young stage is replaced; inputs at its beginning that are replayed.
YOUNG, AGAIN = 20_000, 400

#: Processor time in which everything has to be done that one round of about 16 messages leads to.
HANG_S = 10.0

#: The outputs of one in this number of inputs are decoded; the others are counted.
SAMPLE = 16

#: Messages between two looks at the memory of the process.
LOOK = 25_000

#: Memory may grow by so much in what is left of a run when a third of it is over, MiB for each million messages.
MOST_GROWTH = 2.0

_OWN: tuple[type[RosMessage], ...] = (LinkStatusList, Metadata, RawMessage, CommandReply)
_MESSAGES = (*(row.message for row in TO_ROS), *(row.message for row in TO_IGTL), *_OWN)
_CLASSES = {message.TYPE: message for message in _MESSAGES}
#: What ROS may bring: all types that have a way to OpenIGTLink.
_TAKEN = {*(row.message.TYPE for row in TO_IGTL), RawMessage.TYPE, TFMessage.TYPE}


class Hang(BaseException):
    """A round that takes too long.  No Exception: the gateway must not take it for one of its own."""


# -- what is played -----------------------------------------------------------------------------------------------


def _rows() -> tuple[ToIgtlRow, ...]:
    """A row for each way on which ROS messages can go that is not that of their type."""
    usual = {row.message.TYPE: row for row in reversed(TO_IGTL)}
    other = [row for row in TO_IGTL if usual[row.message.TYPE] is not row]
    return tuple(ToIgtlRow(topic=f"/as/{row.igtl_type}/{row.message.TYPE[-9:]}", type=row.igtl_type) for row in other)


_EVERYTHING = tuple(sorted({f"+{row.kind}" for row in TO_ROS if row.role is Role.ON_REQUEST}))
_AGED = (ToIgtlRow(topic="/igtl/out/P*", max_age_s=2.0, stamp="receive"), ToIgtlRow(max_age_s=1.0))
#: Without stream requests, so that outgoing messages use the fast path.
_NO_QUERIES = ("STT_*", "STP_*", "GET_*")
_META = ToIgtlRow(topic="/igtl/out/T*", metadata=(("owner", "1111111111111111111"),), device="A name of more than 20")

#: Of the stage that lives as long as the run.
OLD_CONFIG = Config(watch=True, to_igtl=_rows())

#: Configurations of the young stages; the second value: topics with a subscriber, None for all (recorded).
CONFIGS: tuple[tuple[Config, frozenset[str] | None], ...] = (
    (Config(watch=True, to_igtl=_rows(), to_ros=(ToRosRow(kinds=_EVERYTHING),)), None),
    (Config(check_crc=False, max_streams=400, command_timeout_s=0.5, deny_in=_NO_QUERIES), None),
    (Config(stamp="receive", publish_tf=False, profile="slicer", ros_unit="mm"), frozenset({"/tf", "/igtl/links"})),
    (Config(watch=True, to_ros=(ToRosRow(max_age_s=3.0),), to_igtl=_AGED, deny_in=_NO_QUERIES), None),
    (Config(profile="plus", igtl_unit="um", to_igtl=(_META, *_rows()), to_ros=(ToRosRow(topic="/in/{device}"),)), None),
    (Config(deny_in=("GET_*", "COMMAND"), deny_out=("IMAGE", "TRANSFORM", "POLYDATA")), None),
    (Config(tf_out=(TfOutRow(frames=("tool", "probe", "base"), base="map", device="S", type="TDATA"),)), None),
    (Config(profile="legacy-v1", watch=True, to_ros=(ToRosRow(kinds=("transform", "image", "points")),)), frozenset()),
    (Config(profile="holoscan", tf_out=(TfOutRow(frames=("tool",), base="map"),), to_igtl=_rows()), None),
    (Config(profile="brainlab", stamp="now", watch=True, deny_in=_NO_QUERIES), None),
    (Config(watch=True, to_igtl=_rows(), deny_in=_NO_QUERIES), None),
)


#: Values of the settings that change while a stage runs, and what no setting can be.
_CHANGES: dict[str, tuple[Any, ...]] = {
    "deny_in": ((), ("GET_*",), ("IMAGE", "T*"), ("*",)),
    "deny_out": ((), ("POLYDATA",), ("TRANSFORM", "STATUS"), ("*",)),
    "kinds": ((), _EVERYTHING, ("transform", "image"), ("+slices",)),
    "max_age_s": (0.0, 0.001, 3.0),
    "active": (True, True, False),
}
_IMPOSSIBLE: tuple[Any, ...] = (None, -1, 1e400, "x", ["\0", 5], {"a": 1}, [[]])


def ros_seeds() -> list[tuple[str, bytes]]:
    """(ROS type, CDR) of the golden recording: all types that the gateway takes."""
    found: dict[tuple[str, bytes], None] = {}
    with SessionFile.open(ROOT / "fixtures/every-type.mcap") as file:
        for entry in file.entries_of_kinds({Kind.ROS_IN, Kind.ROS_OUT}):
            if entry.size <= MAX_FILE and entry.type in _TAKEN:
                found[entry.type, entry.data()] = None
    if not found:
        raise SystemExit("tools/fuzz_gateway.py: found no ROS messages in fixtures/every-type.mcap")
    return list(found)


def igtl_seeds() -> list[bytes]:
    """The messages of the corpus, and the vectors of the protocol."""
    return corpus() + [vector.data for vector in vectors() if len(vector.data) <= MAX_FILE]


_POSE = Transform((0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6, 1.0, 2.0, 3.0))
_PLACE = Position((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8), "all")
_CLOUD = PolyData(np.arange(21, dtype=">f4").reshape(7, 3))


def _points(count: int) -> Points:
    elements = np.zeros(count, Points.DTYPE)
    elements["position"] = np.arange(3 * count).reshape(count, 3)
    return Points(elements)


def express_seeds() -> list[bytes]:
    """Messages that may take the fast path, of devices that send nothing else."""
    contents: tuple[tuple[str, Body], ...] = (
        ("TRANSFORM", _POSE),
        ("POSITION", _PLACE),
        ("TRANSFORM", _POSE),
        ("STRING", String(b"a text in ASCII")),
        ("POINT", _points(1)),
        ("POINT", _points(4)),
        ("POLYDATA", _CLOUD),
        ("IMAGE", Image((4, 3, 1), 3, bytes(range(36)), 3)),
        ("IMAGE", Image((4, 3, 1), 5, bytes(range(24)))),
    )
    found = []
    for version in (1, 2):
        for number, (kind, content) in enumerate(contents):
            items = (Item.of("owner", "me"),) if number == 2 and version == 2 else ()
            message = Message(kind, f"Tool{number}{version}", content, ns_to_ticks(T0_NS), version, 7, items)
            found.append(join(encode(message)))
    return found


def ros_express_seeds(ros: Sequence[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
    """The same from ROS: recorded poses, strings, clouds of x, y and z."""
    found = [(ros_type, cdr) for ros_type, cdr in ros if ros_type in (TransformStamped.TYPE, PoseStamped.TYPE)]
    cloud = polydata_to_cloud(_CLOUD, ToRosContext("d", T0_NS, "frame", ""))
    picture = RosImage(RosHeader(T0_NS, "camera"), 3, 4, "bgr8", 0, 12, bytes(range(36)))
    bulk = (cloud, picture, replace(picture, encoding="mono8", step=4, data=bytes(12)), RosString("hello"))
    return [*found, *[(message.TYPE, message.pack()) for message in bulk] * 3]


# -- damage -------------------------------------------------------------------------------------------------------


def bent(rng: Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    """A message with damage: mostly with the right size and CRC, so that it gets past the framing."""
    damaged = bytearray(data)
    fate = rng.random()
    for _ in range(1 if fate < 0.5 else rng.choice((2, 3, 6))):
        rng.choice(DAMAGE)(rng, damaged, rng.choice(pool))
    fate = rng.random()
    if len(damaged) < HEADER_SIZE or fate < 0.004:
        return bytes(damaged)  # the stream may lose its step here
    if fate < 0.05:
        damaged[BODY_SIZE] = (len(damaged) - HEADER_SIZE).to_bytes(8, "big")
        return bytes(damaged)  # wrong CRC, very likely
    return repaired(damaged)


def bent_express(rng: Random, data: bytes, other: bytes, now_ns: int) -> bytes:
    """A message that differs in its numbers and its stamp: most of them take the fast path, which the others end."""
    damaged = bytearray(data)
    stamp_ns, fate = now_ns, rng.random()
    if fate < 0.05:
        damaged[rng.randrange(HEADER_SIZE, len(damaged))] ^= 1 << rng.getrandbits(3)
        stamp_ns = rng.choice((0, 1, now_ns - NS_PER_S, now_ns - 40 * NS_PER_S, now_ns + NS_PER_S))
    elif fate < 0.1:
        rng.choice(DAMAGE)(rng, damaged, other)
        damaged[NAMES] = data[NAMES]
        damaged = damaged.ljust(HEADER_SIZE, b"\0")
    else:  # the last bits of a number
        damaged[len(damaged) - 1 - (rng.getrandbits(3) >> 2)] ^= 1 << rng.getrandbits(3)
    damaged[TICKS] = ns_to_ticks(stamp_ns).to_bytes(8, "big")
    return repaired(damaged)


def bent_express_cdr(rng: Random, ros_type: str, data: bytes, other: bytes, now_ns: int) -> bytes:
    """The same from ROS."""
    fate = rng.random()
    damaged = bytearray(bent_cdr(rng, data, other)) if fate < 0.05 else bytearray(data)
    if ros_type == RosString.TYPE:
        if len(damaged) > 8:
            damaged[8] ^= 1 << rng.getrandbits(2)
        return bytes(damaged)
    seconds = now_ns // NS_PER_S - (rng.choice((1, 40, -2, now_ns // NS_PER_S)) if fate > 0.97 else 0)
    if len(damaged) > 70:
        damaged[4:12] = seconds.to_bytes(4, "little") + (now_ns % NS_PER_S).to_bytes(4, "little")
        damaged[len(damaged) - 57 + 8 * rng.randrange(4) + rng.getrandbits(2)] ^= 1 << rng.getrandbits(3)
    return bytes(damaged)


_LITTLE = (struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<d"))
_NUMBERS = (0.0, -0.0, 1e-320, 1.0, -1.0, 1e39, 1e308, float("inf"), float("-inf"), float("nan"))


def bent_cdr(rng: Random, data: bytes, other: bytes) -> bytes:
    """A damaged ROS message; mostly in counts and lengths of strings and sequences."""
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        size = len(damaged)
        at = rng.randrange(4, max(size, 5)) & ~3 if rng.random() < 0.98 else 0
        match rng.randrange(8):
            case 0:
                if size:
                    damaged[min(at, size - 1)] ^= 1 << rng.getrandbits(3)
            case 1 | 2:  # a count a little off, or far
                if size >= at + 4:
                    (number,) = _LITTLE[1].unpack_from(damaged, at)
                    number = number + rng.choice((-4, -2, -1, 1, 2, 4)) if rng.getrandbits(1) else rng.choice(EDGES)
                    _LITTLE[1].pack_into(damaged, at, number & 0xFFFFFFFF)
            case 3:
                if size >= at + 8:
                    _LITTLE[3].pack_into(damaged, at, rng.choice(_NUMBERS))
            case 4:
                del damaged[at : at + (4 << rng.getrandbits(3))]
            case 5:
                damaged[at:at] = rng.randbytes(4 << rng.getrandbits(3))
            case 6:
                damaged[at:] = other[at:]
            case _:
                if size > at:
                    damaged[at : at + 4] = rng.randbytes(4)
    return bytes(damaged)


class Counted(Gateway):
    """A gateway that counts what takes the full path; the rest takes the fast path."""

    handled = 0

    def handle(self, entry: Entry) -> list[Entry]:
        self.handled += 1
        return super().handle(entry)


# -- one session and its edges --------------------------------------------------------------------------------------


@dataclass(slots=True)
class Link:
    """The edge's side of a peer."""

    framer: Framer
    received: int = 0
    sent: int = 0
    dropped: int = 0


@dataclass
class Figures:
    """What came of a run."""

    bent: int = 0
    whole: int = 0  #: sent as they are: poses that start the fast path, the messages with which a stage begins
    inputs: Counter[str] = field(default_factory=Counter)
    outputs: Counter[str] = field(default_factory=Counter)
    notes: Counter[str] = field(default_factory=Counter)
    fates: Counter[str] = field(default_factory=Counter)
    planned: int = 0
    stages: int = 0
    lost_step: int = 0
    #: processor seconds and what the input was, the five slowest
    slow: list[tuple[float, str]] = field(default_factory=lambda: [(0.0, "")] * 5)
    #: bytes out, bytes in and what the input was: the most bytes, and the most for each byte that came
    most: tuple[int, int, str] = (0, 0, "")
    worst: tuple[float, int, int, str] = (0.0, 0, 0, "")
    bytes_in: int = 0
    bytes_out: int = 0
    #: (messages, resident MiB, blocks of Python's allocator), one for each ``LOOK``
    memory: list[tuple[int, float, int]] = field(default_factory=list)
    seconds: float = 0.0
    cpu_s: float = 0.0
    broken: str = ""
    culprit: tuple[int, list[Input]] | None = None


class Stage:
    """See the module.

    Args:
        number: of the configuration in ``CONFIGS``, −1 for the old stage.
        rng: decides everything.
        figures: added to.
    """

    def __init__(self, number: int, rng: Random, figures: Figures, seeds: Seeds) -> None:
        self.number, self.rng, self.figures, self.seeds = number, rng, figures, seeds
        self.session, self.gateway = opened(number)
        self.quiet = "STT_*" in self.gateway.config.deny_in
        self.now_ns = T0_NS
        self.links: dict[int, Link] = {}
        self.gone = Link(Framer(1))  # sums over the closed links
        self.last_link = 0
        self.first: list[Input] | None = [] if number >= 0 else None
        self.told = hashlib.blake2b()
        self.recent: deque[Input] = deque(maxlen=2_000)
        self.echo_igtl: list[bytes] = list(seeds.igtl[:8])
        self.echo_ros: list[tuple[str, bytes]] = list(seeds.ros[:8])
        self.seq = self.stamp_ns = self.count = 0
        for _ in range(3):
            self.come()

    # -- inputs ---------------------------------------------------------------------------------------------------

    def bring(
        self,
        kind: Kind,
        data: bytes,
        channel: str = "",
        ros_type: str = "",
        links: tuple[int, ...] = (),
        source_ns: int = 0,
    ) -> None:
        """One input, and a look at what comes of it."""
        one = (self.now_ns, kind, data, channel, ros_type, links, source_ns)
        self.recent.append(one)
        began = time.thread_time()
        entries = brought(self.session, one)
        took = time.thread_time() - began
        self._judge(one, entries, took)

    def _judge(self, one: Input, entries: list[Entry], took: float) -> None:
        figures = self.figures
        self.count += 1
        figures.inputs[one[1].value] += 1
        size = 0
        for entry in entries[1:]:
            size += entry.size
            kind = entry.kind
            figures.outputs[kind.value] += 1
            if kind is Kind.NOTE:
                code = code_of(entry)
                figures.notes[code] += 1
                if code == "internal_error":
                    raise Broken(entry.data().decode("utf-8", "replace"))
            elif kind is Kind.IGTL_OUT:
                self._send(entry)
        length = len(one[2])
        figures.bytes_in += length
        figures.bytes_out += size
        if took > figures.slow[-1][0]:
            figures.slow = sorted([*figures.slow[:-1], (took, told(one))], reverse=True)
        if size > figures.most[0]:
            figures.most = (size, length, told(one))
        if size > figures.worst[0] * length and length:
            figures.worst = (size / length, size, length, told(one))
        if self.first is not None and len(self.first) < AGAIN:
            self.first.append(one)
            for entry in entries:
                fingerprint(self.told, entry)
        if self.count % SAMPLE == 0 or length > 2_000:
            self._read_again(entries)
        if entries[0].seq != self.seq + 1 or entries[0].stamp_ns <= self.stamp_ns:
            raise Broken("entries out of order")
        self.seq, self.stamp_ns = entries[-1].seq, entries[-1].stamp_ns

    def _send(self, entry: Entry) -> None:
        """What the edge would do with a message to peers."""
        rng = self.rng
        for number in entry.links:
            link = self.links.get(number)
            if link is None:
                raise Broken(f"{entry.channel} is sent to link {number}, which is not there")
            if rng.random() < 0.01:
                link.dropped += 1
            else:
                link.sent += 1
        if entry.size <= 4_096 and rng.random() < 0.1:
            self.echo_igtl[rng.randrange(len(self.echo_igtl))] = entry.data()
            if len(self.echo_igtl) < 64:
                self.echo_igtl.append(entry.data())

    def _read_again(self, entries: list[Entry]) -> None:
        """Whatever goes out can be read."""
        seq, stamp_ns = entries[0].seq, entries[0].stamp_ns
        for entry in entries[1:]:
            seq, stamp_ns = seq + 1, stamp_ns + 1
            if entry.seq != seq or entry.stamp_ns != stamp_ns:
                raise Broken("outputs out of order")
            data = entry.data()
            if entry.kind is Kind.IGTL_OUT:
                if decode(data).ticks == 0 and entry.source_ns:
                    raise Broken(f"{entry.channel} is sent without a stamp")
            elif entry.kind is Kind.ROS_OUT:
                _CLASSES[entry.type].unpack(data)
                if len(data) <= 4_096 and self.rng.random() < 0.2:
                    self.echo_ros[self.rng.randrange(len(self.echo_ros))] = (entry.type, data)
                    if len(self.echo_ros) < 64:
                        self.echo_ros.append((entry.type, data))
            else:
                Note.unpack(data)

    # -- links ----------------------------------------------------------------------------------------------------

    def come(self) -> None:
        """A peer comes."""
        self.last_link += 1
        rng, number = self.rng, self.last_link
        self.links[number] = Link(Framer(MAX_BODY))
        facts = {"peer": rng.choice(PEERS), "local": "0.0.0.0:18944", "role": rng.choice(("server", "client"))}
        self.bring(Kind.LINK, Note(Level.INFO, LINK_UP, "up", "", facts).pack(), links=(number,))
        if number % 2:  # it shows that it reads version 2
            self.stream(number, [self.seeds.hello])

    def go(self, number: int) -> None:
        """A peer disconnects, and its link reports the fate of the messages to it."""
        link = self.links[number]
        counts = {"sent_messages": link.sent, "dropped": {"all": link.dropped} if link.dropped else {}}
        self.bring(Kind.LINK, Note(Level.INFO, LINK_DOWN, "down", "", counts).pack(), links=(number,))
        del self.links[number]
        for name in ("received", "sent", "dropped"):
            setattr(self.gone, name, getattr(self.gone, name) + getattr(link, name))

    def stream(self, number: int, messages: list[bytes]) -> None:
        """Messages of a peer, in pieces of any size."""
        rng, link = self.rng, self.links[number]
        data = b"".join(messages)
        at = 0
        try:
            while at < len(data):
                size = rng.choice((1, 57, 59, 300, 1_000, 5_000, 70_000))
                for message in link.framer.feed(data[at : at + size]):
                    link.received += 1
                    self.bring(Kind.IGTL_IN, bytes(message), links=(number,))
                at += size
            link.framer.received(0)
            lost = link.framer.pending
        except MessageTooLarge:
            lost = 1
        if lost:  # it has lost its step, or is silent in the middle of a message: the edge closes it
            self.figures.lost_step += 1
            self.go(number)
            self.come()

    # -- rounds ---------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """All messages as they are: so that those that follow meet what they are about."""
        number = next(iter(self.links))
        for data in self.seeds.igtl:
            if len(data) >= HEADER_SIZE and len(data) == HEADER_SIZE + int.from_bytes(data[BODY_SIZE], "big"):
                self.figures.whole += 1
                self.stream(number, [data])
                number = number if number in self.links else self.last_link
        for ros_type, cdr in self.seeds.ros:
            self.figures.whole += 1
            self.bring(Kind.ROS_IN, cdr, self.topic(ros_type), ros_type)

    def topic(self, ros_type: str) -> str:
        """A topic for a ROS message."""
        rng = self.rng
        chance = rng.random()
        if chance < 0.002:
            return f"/igtl/out/{rng.getrandbits(16)}"
        if chance < 0.01:
            return "/camera/not_bridged"
        others = self.seeds.topics.get(ros_type)
        if others and chance < 0.5:
            return rng.choice(others)
        name = ros_type.rpartition("/")[2]
        return f"/igtl/out/{name}{rng.getrandbits(1)}" if ros_type != "tf2_msgs/msg/TFMessage" else "/tf"

    def round(self) -> None:
        """About 16 messages, or something else."""
        rng = self.rng
        chance = rng.random()
        self.now_ns += rng.randrange(100_000, 20 * NS_PER_MS)
        if chance < 0.40:
            self._stream_bent()
        elif chance < 0.58:
            self._ros_bent()
        elif chance < (0.78 if self.quiet else 0.90):  # nothing takes the fast path to peers that asked for streams
            self._express_in()
        elif chance < 0.94:
            self._express_out()
        elif chance < 0.98:
            self._tick()
        elif chance < 0.983:
            self._note()
        elif chance < 0.99:
            self._change()
        else:
            self._churn()

    def _stream_bent(self) -> None:
        rng, seeds = self.rng, self.seeds
        messages = []
        for _ in range(rng.randrange(8, 24)):
            base = rng.choice(self.echo_igtl if rng.random() < 0.15 else seeds.igtl)
            messages.append(bent(rng, base, seeds.igtl))
        self.figures.bent += len(messages)
        self.stream(rng.choice(list(self.links)), messages)

    def _ros_bent(self) -> None:
        rng, seeds = self.rng, self.seeds
        for _ in range(rng.randrange(8, 24)):
            ros_type, cdr = rng.choice(self.echo_ros if rng.random() < 0.2 else seeds.ros)
            data = bent_cdr(rng, cdr, rng.choice(seeds.ros)[1])
            self.figures.bent += 1
            self.bring(Kind.ROS_IN, data, self.topic(ros_type), ros_type, source_ns=self.now_ns)

    def _express_in(self) -> None:
        """A run of messages from one device, now and then one as it should be."""
        rng = self.rng
        base, messages = rng.choice(self.seeds.express), []
        for _ in range(rng.randrange(12, 40)):
            self.now_ns += NS_PER_MS
            if rng.random() < 0.02:
                messages.append(base)
                self.figures.whole += 1
            else:
                messages.append(bent_express(rng, base, rng.choice(self.seeds.igtl), self.now_ns))
                self.figures.bent += 1
        self.stream(rng.choice(list(self.links)), messages)

    def _express_out(self) -> None:
        """The same from ROS."""
        rng = self.rng
        ros_type, cdr = rng.choice(self.seeds.ros_express)
        topic = self.topic(ros_type)
        for _ in range(rng.randrange(12, 40)):
            self.now_ns += NS_PER_MS
            if rng.random() < 0.02:
                data = cdr
                self.figures.whole += 1
            else:
                data = bent_express_cdr(rng, ros_type, cdr, rng.choice(self.seeds.ros)[1], self.now_ns)
                self.figures.bent += 1
            self.bring(Kind.ROS_IN, data, topic, ros_type, source_ns=self.now_ns)

    def _tick(self) -> None:
        due_ns = self.gateway.due_ns
        if due_ns is not None and self.rng.random() < 0.1:
            self.now_ns = max(self.now_ns, due_ns)
        if due_ns is not None and due_ns <= self.now_ns:
            self.bring(Kind.EDGE_NOTE, Note(Level.INFO, TICK, "a deadline has come").pack())
        if self.rng.random() < 0.02:
            self.now_ns += self.rng.choice((-5, 1, 10, 600)) * NS_PER_S

    def _note(self) -> None:
        """What edges and recorder report."""
        code = self.rng.choice(("queue_drop", "idle", LISTENED, "recorder_drop"))
        stream = self.rng.choice(("/igtl/links", "/tf", "IMAGE/Probe", "", "/igtl/in/Probe/transform"))
        self.bring(Kind.EDGE_NOTE, Note(Level.WARN, code, "as it were", stream).pack())

    def _change(self) -> None:
        """Settings change, mostly back to those of the configuration; a few changes are impossible."""
        rng, own = self.rng, LiveSettings.of(self.gateway.config)
        fate = rng.random()
        settings = own if fate < 0.6 else replace(own, **{name: rng.choice(all_) for name, all_ in _CHANGES.items()})
        note = settings.note(own)
        if fate > 0.95:
            values = dict(note.data[SETTINGS]) | {rng.choice((*_CHANGES, "other")): rng.choice(_IMPOSSIBLE)}
            note = replace(note, data={SETTINGS: rng.choice((values, [], None))})
        self.bring(Kind.EDGE_NOTE, note.pack())

    def _churn(self) -> None:
        rng = self.rng
        if len(self.links) >= LINKS or (len(self.links) > 2 and rng.getrandbits(1)):
            self.go(rng.choice(list(self.links)))
        if len(self.links) < LINKS:
            self.come()

    # -- the end --------------------------------------------------------------------------------------------------

    def check(self) -> None:
        """The ledger closes."""
        every = [self.gone, *self.links.values()]
        links = {
            str(number): {
                "sent_messages": link.sent,
                "received_messages": link.received,
                "dropped": {"all": link.dropped},
                "ignored": {},
            }
            for number, link in enumerate(every)
        }
        if found := gaps({"streams": self.gateway.ledger.to_dict(), "links": links}):
            raise Broken(f"the ledger does not close: {'; '.join(found)}")

    def end(self) -> None:
        """Judge a young stage as a whole."""
        self.check()
        add_fates(self.figures.fates, self.gateway)
        self.figures.planned += self.count - self.gateway.handled
        if self.first is None:
            return
        for what in ("as it was", "without the fast path", "in plain Python"):
            again = played(self.number, self.first, what)
            if again != self.told.hexdigest():
                self.recent = deque(self.first)
                raise Broken(f"replayed {what}, the outputs of the session differ")


def add_fates(fates: Counter[str], gateway: Gateway) -> None:
    """The fates of incoming messages, from the ledger of a session."""
    for direction in ("igtl_in", "ros_in"):
        for row in gateway.ledger.to_dict().get(direction, {}).values():
            for fate, number in row.items():
                if fate == "dropped":
                    fates.update({f"{direction} {reason}": count for reason, count in number.items()})
                elif fate not in ("received", "decoded"):
                    fates[f"{direction} {fate}"] += number


def opened(number: int, *, fast_path: bool = True) -> tuple[Session, Counted]:
    """The session of a stage."""
    config, heard = (OLD_CONFIG, None) if number < 0 else CONFIGS[number]
    gateway = Counted(config, fast_path=fast_path)
    if heard is not None:
        gateway.has_subscriber = lambda topic, _type: topic in heard
    return Session(gateway), gateway


def brought(session: Session, one: Input) -> list[Entry]:
    now_ns, kind, data, channel, ros_type, links, source_ns = one
    return session.input(now_ns, kind, (data,), channel=channel, type_name=ros_type, links=links, source_ns=source_ns)


def fingerprint(digest: Any, entry: Entry) -> None:
    """Add all of an entry."""
    names = (entry.seq, entry.stamp_ns, entry.kind.value, entry.channel, entry.type, entry.links, entry.source_ns)
    digest.update(repr(names).encode("utf-8", "backslashreplace"))
    digest.update(entry.data())


def played(number: int, inputs: Sequence[Input], what: str) -> str:
    """The fingerprint of a session with these inputs."""
    digest = hashlib.blake2b()
    session, _ = opened(number, fast_path=what != "without the fast path")
    names = ("pose_to_ros", "pose_to_igtl", "bulk_to_ros", "bulk_to_igtl")
    in_use = {name: getattr(express, name) for name in names}
    if what == "in plain Python":
        vars(express).update(zip(names, (*express.PLAIN, None, None), strict=True))
    try:
        for one in inputs:
            for entry in brought(session, one):
                fingerprint(digest, entry)
    finally:
        vars(express).update(in_use)
    return digest.hexdigest()


_CODE_AT = len('{"code":"')


def code_of(entry: Entry) -> str:
    """The code of a note, without reading all of it."""
    data = entry.data()
    return data[_CODE_AT : data.index(b'"', _CODE_AT)].decode()


def told(one: Input) -> str:
    """An input in a few words."""
    _, kind, data, channel, ros_type, _, _ = one
    name = (
        data[TYPE_AT:TICKS_AT].replace(b"\0", b" ").decode("ascii", "replace")
        if kind is Kind.IGTL_IN
        else f"{channel} {ros_type}"
    )
    return f"{kind.value} {' '.join(name.split())!r}, {len(data):,} bytes"


# -- the run ------------------------------------------------------------------------------------------------------


@dataclass
class Seeds:
    """What is bent; read once, never changed."""

    igtl: list[bytes]
    ros: list[tuple[str, bytes]]
    express: list[bytes]
    ros_express: list[tuple[str, bytes]]
    topics: dict[str, list[str]]
    hello: bytes

    @classmethod
    @cache
    def load(cls) -> Seeds:
        ros = ros_seeds()
        topics: dict[str, list[str]] = {}
        for row in _rows():
            for kind in {seed[0] for seed in ros}:
                if row.topic.endswith(kind[-9:]):
                    topics.setdefault(kind, []).append(row.topic)
        hello = join(encode(Message("GET_STATUS", "", EmptyQuery(), header_version=2)))
        return cls(igtl_seeds(), ros, express_seeds(), ros_express_seeds(ros), topics, hello)


@contextmanager
def watchdog() -> Iterator[Callable[[], None]]:
    """Gives what has to be called more often than every ``HANG_S`` of processor time; else Hang is raised."""

    def bark(_signal: int, _frame: object) -> None:
        raise Hang(f"more than {HANG_S:g} s of processor time in one round")

    before = signal.signal(signal.SIGPROF, bark)
    try:
        yield lambda: _arm(HANG_S)
    finally:
        _arm(0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Gives a list that Ctrl-C, or SIGTERM, puts something into."""
    stop: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _frame: stop.append(number)) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _arm(seconds: float) -> None:
    signal.setitimer(signal.ITIMER_PROF, seconds)


def run(seed: int, messages: int, say: Callable[[str], None] = lambda line: None, every_s: float = 60.0) -> Figures:
    """Run stages until ``messages`` mutated messages were sent, a check fails, or Ctrl-C ends it between rounds."""
    figures, rng = Figures(), Random(seed)
    seeds = Seeds.load()
    began, cpu = time.monotonic(), time.process_time()
    stage: Stage | None = None
    with warnings.catch_warnings(), watchdog() as fed, interruptible() as stop:
        warnings.simplefilter("error", RuntimeWarning)  # numpy must not talk to the user's console
        try:
            fed()
            stage = old = Stage(-1, rng, figures, seeds)
            old.begin()
            stage = young = Stage(0, rng, figures, seeds)
            renew, look, said = YOUNG, 0, began
            while figures.bent < messages and not stop:
                fed()
                if figures.bent >= renew:
                    stage = young
                    young.end()
                    old.check()
                    figures.stages += 1
                    stage = young = Stage(figures.stages % len(CONFIGS), rng, figures, seeds)
                    renew = figures.bent + YOUNG
                stage = young if rng.randrange(4) else old
                stage.round()
                if figures.bent >= look:
                    look += LOOK
                    figures.memory.append((figures.bent, resident(), sys.getallocatedblocks()))
                    now = time.monotonic()
                    if now - said >= every_s:
                        said = now
                        figures.seconds, figures.cpu_s = now - began, time.process_time() - cpu
                        say(line_of(figures))
            stage = young
            young.end()
            stage = old
            old.end()
        except (Exception, Hang):  # anything at all that escapes is what is looked for
            figures.broken = traceback.format_exc()
            figures.culprit = (stage.number, list(stage.recent)) if stage else None
    figures.seconds, figures.cpu_s = time.monotonic() - began, time.process_time() - cpu
    return figures


def resident() -> float:
    """Resident memory of the process, MiB."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def growth(samples: Sequence[tuple[int, float]]) -> float:
    """How much a figure grows in a million messages, from the last two thirds of the samples: the median of the slopes
    between all pairs (Theil and Sen), which single peaks do not move."""
    late = samples[len(samples) // 3 :]
    late = late[:: max(1, len(late) // 200)]
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) * 1e6 for i, a in enumerate(late) for b in late[i + 1 :] if b[0] > a[0]]
    return statistics.median(slopes) if slopes else 0.0


def line_of(figures: Figures) -> str:
    rate = figures.bent / figures.seconds if figures.seconds else 0.0
    mib, blocks = figures.memory[-1][1:]
    return (
        f"{time.strftime('%H:%M:%S')} {figures.bent:,} bent in {figures.seconds:,.0f} s ({rate:,.0f}/s, processor "
        f"{figures.cpu_s:,.0f} s), {mib:.0f} MiB, {blocks:,} blocks, {figures.stages} stages, slowest "
        f"{figures.slow[0][0] * 1e3:.0f} ms, worst x{figures.worst[0]:,.0f}"
    )


def report(figures: Figures) -> str:
    """All figures, as lines."""

    def table(counts: Counter[str]) -> str:
        return ", ".join(f"{name} {count:,}" for name, count in counts.most_common())

    rate = figures.bent / figures.seconds if figures.seconds else 0.0
    resident_mib = [(at, mib) for at, mib, _ in figures.memory]
    blocks = [(at, float(count)) for at, _, count in figures.memory]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return "\n".join(
        (
            f"mutated messages: {figures.bent:,}; unchanged: {figures.whole:,}; {figures.seconds:,.0f} s, "
            f"{rate:,.0f}/s, CPU {figures.cpu_s:,.0f} s",
            f"inputs of the gateway: {table(figures.inputs)}; by the fast path: {figures.planned:,}",
            f"outputs: {table(figures.outputs)}",
            f"fates: {table(figures.fates)}",
            f"notes: {table(figures.notes)}",
            f"streams that lost synchronisation: {figures.lost_step:,}; young sessions: {figures.stages + 1:,}",
            "slowest inputs: " + "; ".join(f"{took * 1e3:.1f} ms ({what})" for took, what in figures.slow),
            f"bytes in {figures.bytes_in:,}, out {figures.bytes_out:,}; largest output of one input: "
            f"{figures.most[0]:,} bytes of {figures.most[1]:,} ({figures.most[2]})",
            f"largest output per byte: x{figures.worst[0]:,.0f}, {figures.worst[1]:,} bytes of {figures.worst[2]:,} "
            f"({figures.worst[3]})",
            f"memory: peak {peak:.0f} MiB; last two thirds: {growth(resident_mib):+.2f} MiB and {growth(blocks):+,.0f} "
            "blocks per million messages",
        )
    )


def write_culprit(path: Path, culprit: tuple[int, list[Input]]) -> None:
    """What broke something, one input a line behind the number of the configuration."""
    number, inputs = culprit
    lines = [json.dumps(number)]
    for now_ns, kind, data, *rest in inputs:
        lines.append(json.dumps([now_ns, kind.value, base64.b64encode(data).decode(), *rest]))
    path.write_text("\n".join(lines) + "\n", "utf-8", "surrogateescape")


def repeat(path: Path) -> list[str]:
    """Play written inputs in a new session; return the errors in its notes."""
    first, *lines = path.read_text("utf-8", "surrogateescape").splitlines()
    session, _ = opened(json.loads(first))
    inputs = []
    for line in lines:
        now_ns, kind, data, channel, ros_type, links, source_ns = json.loads(line)
        inputs.append((now_ns, Kind(kind), base64.b64decode(data), channel, ros_type, tuple(links), source_ns))
    up = Note(Level.INFO, LINK_UP, "up", "", {"peer": PEERS[0], "role": "server"}).pack()
    for link in sorted({link for one in inputs for link in one[5]}):  # of an old session, whose beginning is not there
        brought(session, (T0_NS, Kind.LINK, up, "", "", (link,), 0))
    found = []
    for one in inputs:
        for entry in brought(session, one):
            if entry.kind is Kind.NOTE and code_of(entry) == "internal_error":
                found.append(f"{told(one)}: {entry.data().decode('utf-8', 'replace')}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--messages", type=int, default=100_000, help="number of mutated messages (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the mutations (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("fuzz-broken.jsonl"), help="where a culprit goes (%(default)s)"
    )
    parser.add_argument("--repeat", type=Path, help="play what was written there, and nothing else")
    options = parser.parse_args()
    if options.repeat:
        print("\n".join(repeat(options.repeat)) or "nothing is broken")
        return 0
    faulthandler.enable()  # the part in C may crash
    gc.collect()
    figures = run(options.seed, options.messages, lambda line: print(line, flush=True))
    print(f"seed {options.seed}, fast path {'compiled' if express.COMPILED else 'in plain Python'}\n{report(figures)}")
    if figures.broken:
        if figures.culprit:
            write_culprit(options.out, figures.culprit)
        print(f"{figures.broken}\nwritten to {options.out}", file=sys.stderr)
        return 1
    grown = growth([(at, mib) for at, mib, _ in figures.memory])
    if figures.bent >= 1_000_000 and grown > MOST_GROWTH:
        print(f"memory grows by {grown:.1f} MiB for each million messages", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
