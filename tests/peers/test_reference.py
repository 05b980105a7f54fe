"""The peers themselves: what they decode is the corpus' JSON, what they encode is the corpus' bytes.

A plain socket stands for the gateway.  The corpus was made by the C++ 3.1 library, so this also says
where Debian's 1.11 and pyigtl agree with it.
"""

from __future__ import annotations

import json
import math
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.peers import Message, PeerError, pyigtl_peer, reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ENCODERS, ReferencePeer

CORPUS = Path(__file__).parents[3] / "shared" / "corpus"
FILES = sorted(path.stem for name in ENCODERS for path in CORPUS.glob(f"{name}_v1_*.bin"))
TIMEOUT_S = 10.0

needs_reference = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))
needs_pyigtl = pytest.mark.skipif(pyigtl_peer.available() is not None, reason=str(pyigtl_peer.available()))
needs_corpus = pytest.mark.skipif(not FILES, reason="no corpus beside the project")


def load(stem: str) -> tuple[bytes, Message]:
    """Wire bytes and decoded message of a corpus file (one message each)."""
    (message,) = json.loads((CORPUS / f"{stem}.json").read_text())
    return (CORPUS / f"{stem}.bin").read_bytes(), message


def listener() -> socket.socket:
    sock = socket.create_server(("127.0.0.1", 0))
    sock.settimeout(TIMEOUT_S)
    return sock


def accepted(server: socket.socket) -> socket.socket:
    link, _ = server.accept()
    link.settimeout(TIMEOUT_S)
    return link


def read_exactly(link: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = link.recv(size - len(data))
        assert part, f"closed after {len(data)} of {size} bytes"
        data += part
    return data


def read_message(link: socket.socket) -> bytes:
    header = read_exactly(link, 58)
    return header + read_exactly(link, struct.unpack_from(">Q", header, 42)[0])


Pair = tuple[ReferencePeer, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """The C++ peer as a client, and our end of its connection."""
    with listener() as server, ReferencePeer.client("127.0.0.1", server.getsockname()[1]) as peer, accepted(server) as link:
        yield peer, link


@pytest.fixture(scope="module")
def shared_pair() -> Iterator[Pair]:
    """One connection for all corpus files: each test also proves that the one before left the stream in step."""
    with listener() as server, ReferencePeer.client("127.0.0.1", server.getsockname()[1]) as peer, accepted(server) as link:
        yield peer, link


@needs_reference
@needs_corpus
@pytest.mark.parametrize("stem", FILES)
def test_reference_decodes_the_corpus(shared_pair: Pair, stem: str) -> None:
    peer, link = shared_pair
    wire, expected = load(stem)
    link.sendall(wire)
    got = peer.receive(expected["type"])
    assert got["crc_ok"]
    for key in ("header_version", "device_name", "body_size", "crc"):
        assert got[key] == expected[key]
    assert (got["timestamp"]["sec"], got["timestamp"]["frac"]) == (
        expected["timestamp"]["sec"],
        expected["timestamp"]["frac"],
    )
    pixels = got["content"].pop("data_hex", None)
    if pixels is not None:
        assert bytes.fromhex(pixels) == wire[58 + 72 :]
        for key, values in expected.get("lib", {}).items():
            assert flat(got["lib"][key]) == pytest.approx(flat(values), rel=1e-6)
    assert got["content"] == expected["content"]


def flat(values: list[Any]) -> list[float]:
    return [number for value in values for number in (flat(value) if isinstance(value, list) else [value])]


@needs_reference
@needs_corpus
@pytest.mark.parametrize("stem", FILES)
def test_reference_encodes_the_corpus(shared_pair: Pair, stem: str) -> None:
    peer, link = shared_pair
    wire, message = load(stem)
    content = dict(message["content"])
    if isinstance(content.get("data"), dict):  # the JSON has only the CRC of many pixels
        content["data"] = wire[58 + 72 :]
    stamp = message["timestamp"]
    if content.get("pack", "all") != "all":
        with pytest.raises(ValueError, match="heap"):
            peer.send(message["type"], message["device_name"], content)
        return
    peer.send(message["type"], message["device_name"], content, stamp["sec"], stamp["frac"])
    assert read_message(link) == wire
