"""Foreign bytes for the native passage, from a peer and from ROS: each ends its message or its link, and nothing else.

`make sanitize` repeats it with other seeds, in the passage with the sanitizers: then a read or write that is out of
place ends the process.
"""

from __future__ import annotations

import os
import random
import time
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.header import HEADER_SIZE, crc64
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import String
from tests.gateway.fastpath.test_passage_streams import Peer, Scene, picture, pose, scene, transform, wait_for

pytestmark = pytest.mark.skipif(not is_compiled(), reason="without the native passage")

ROUNDS = int(os.environ.get("PASSAGE_ROUNDS", "150"))
SEED = int(os.environ.get("SEED", "1"))
#: Sizes at which sums and signs of 32 and 64 bits go wrong.
SIZES = (0, 1, 57, 2**16, 2**31 - 1, 2**32 - 1, 2**32, 2**63 - 59, 2**63 - 58, 2**63, 2**64 - 59, 2**64 - 50, 2**64 - 1)


def messages() -> list[bytes]:
    """One message of each form that passes natively, small and large."""
    places: Any = np.full((6_000, 3), 1.5, ">f4")
    contents: list[tuple[str, Any]] = [
        ("STRING", String.of("text")),
        ("POINT", Points.of(places[:700])),
        ("POINT", Points.of(places[:3])),
        ("POLYDATA", PolyData(places)),
        ("IMAGE", Image((400, 300, 1), 3, bytes(360_000), 3)),
    ]
    ticks = ns_to_ticks(time.time_ns())
    made = [join(encode(Message(name, f"{name}{i}", content, ticks))) for i, (name, content) in enumerate(contents)]
    return [transform(1.0), transform(1.0, device="Second", version=2), picture(1), *made]


def changed(rng: random.Random, data: bytes) -> bytes:
    """A message with a few wrong numbers, most with the right CRC."""
    wrong = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5])):
        if rng.random() < 0.3:
            wrong[rng.randrange(len(wrong))] ^= 1 << rng.randrange(8)
        else:
            at = rng.choice([HEADER_SIZE, HEADER_SIZE + 4 * rng.randrange(18), rng.randrange(len(wrong) - 4)])
            at = min(at, len(wrong) - 4)
            wrong[at : at + 4] = (rng.choice(SIZES) & 0xFFFFFFFF).to_bytes(4, rng.choice(["big", "little"]))
    if rng.random() < 0.3:
        del wrong[max(HEADER_SIZE, len(wrong) - rng.choice([1, 4, 12, 136, 4_000])) :]
        wrong[42:50] = (len(wrong) - HEADER_SIZE).to_bytes(8, "big")
    if rng.random() < 0.7:
        wrong[50:58] = crc64(bytes(wrong[HEADER_SIZE:])).to_bytes(8, "big")
    if rng.random() < 0.2:
        wrong[42:50] = rng.choice(SIZES).to_bytes(8, "big")
    return bytes(wrong)


def send(rng: random.Random, peer: Peer, data: bytes) -> bool:
    """Send in some pieces; return whether the link is still there."""
    with suppress(OSError):
        while data:
            size = rng.choice([len(data), 57, 58, 70_000, len(data) // 2 + 1])
            peer.send(data[:size])
            data = data[size:]
        return True
    return False


def from_ros(rng: random.Random, here: Scene, number: int) -> None:
    """Deliver a message of ROS, one of three with wrong numbers."""
    places = np.full((rng.choice([3, 3, 4_000]), 3), 1.5, np.float32)
    fields = tuple(rosmsg.PointField(name, 4 * place, 7, 1) for place, name in enumerate("xyz"))
    header = Header(time.time_ns(), "base")
    cloud = rosmsg.PointCloud2(header, 1, len(places), fields, False, 12, places.nbytes, places.tobytes(), True)
    those: list[tuple[str, Any]] = [("tool", pose(number)), ("cloud", cloud), ("text", rosmsg.String("text"))]
    topic, message = rng.choice(those)
    cdr = bytearray(message.pack())
    if number % 3 == 0:
        at = rng.randrange(4, len(cdr) - 4)
        cdr[at : at + 4] = (rng.choice(SIZES) & 0xFFFFFFFF).to_bytes(4, "little")
        del cdr[len(cdr) - rng.choice([0, 0, 1, 30]) :]
    here.ros.deliver(f"/igtl/out/{topic}", message.TYPE, bytes(cdr), header.stamp_ns)


def test_foreign_bytes_end_their_message_or_their_link(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, valid, native = random.Random(SEED), messages(), 0
    with scene(monkeypatch) as here:
        peer = Peer(here.bridge.addresses[0])
        is_open = False
        for number in range(ROUNDS):
            if not is_open:
                peer.close()
                peer = Peer(here.bridge.addresses[0])
                is_open = True
                for _ in range(6):  # the streams are compiled
                    is_open = is_open and send(rng, peer, b"".join(valid))
                    time.sleep(0.004)
            from_ros(rng, here, number)
            one = rng.choice(valid)
            is_open = send(rng, peer, changed(rng, one) if number % 2 else one) and is_open and rng.random() > 0.05
            native = max(native, here.native)
        peer.close()
        last = here.received("igtl_in")
        peer = Peer(here.bridge.addresses[0])
        peer.send(transform(2.0))
        wait_for(lambda: here.received("igtl_in") > last)
        peer.close()
        assert native > 5
        assert here.bridge.tcp.link_faults().get("too_large", 0) > 0
