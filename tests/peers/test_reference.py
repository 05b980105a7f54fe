"""The peers themselves: what they decode is the corpus' JSON, what they encode is the corpus' bytes.

A plain socket stands for the gateway.  The corpus was made by the C++ 3.1 library, so this also shows
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

import numpy as np
import pytest
from fastcrc import crc64

from tests.peers import Message, PeerError, pyigtl_peer, reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ENCODERS, JUNK, MAP_UINT16, STAMP_NS, ReferencePeer
from tests.tables import all_hold
from tests.timing import WAIT_S
from tests.wire import handmade

CORPUS = Path(__file__).parents[1] / "data" / "corpus"
#: What the library wrote itself.
FILES = sorted({path.stem for name in ENCODERS for path in CORPUS.glob(f"{name}_v1_*.bin")} - handmade.files().keys())

needs_reference = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))


def load(stem: str) -> tuple[bytes, Message]:
    """Wire bytes and decoded message of a corpus file (one message each)."""
    (message,) = json.loads((CORPUS / f"{stem}.json").read_text())
    return (CORPUS / f"{stem}.bin").read_bytes(), message


def listener() -> socket.socket:
    sock = socket.create_server(("127.0.0.1", 0))
    sock.settimeout(WAIT_S)
    return sock


def accepted(server: socket.socket) -> socket.socket:
    link, _ = server.accept()
    link.settimeout(WAIT_S)
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
    with (
        listener() as server,
        ReferencePeer.client("127.0.0.1", server.getsockname()[1]) as peer,
        accepted(server) as link,
    ):
        yield peer, link


@needs_reference
def test_reference_decodes_the_corpus(pair: Pair) -> None:
    """All files over one connection: each also shows that the one before left the stream in step."""
    all_hold(FILES, lambda stem: decodes(*pair, stem))


def decodes(peer: ReferencePeer, link: socket.socket, stem: str) -> None:
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
    if expected["type"] == "IMGMETA":
        for element, other in zip(got["content"]["elements"], expected["content"]["elements"], strict=True):
            older, newer = element.pop("timestamp"), other.pop("timestamp")
            assert older["sec"] == newer["sec"]
            assert 0 <= newer["nanosec"] - older["nanosec"] <= STAMP_NS
    assert got["content"] == expected["content"]


def flat(values: list[Any]) -> list[float]:
    return [number for value in values for number in (flat(value) if isinstance(value, list) else [value])]


@needs_reference
def test_reference_encodes_the_corpus(pair: Pair) -> None:
    """``POSITION_v1_s1`` is a short form, see below."""
    all_hold([stem for stem in FILES if stem != "POSITION_v1_s1"], lambda stem: encodes(*pair, stem))


def encodes(peer: ReferencePeer, link: socket.socket, stem: str) -> None:
    wire, message = load(stem)
    type_name = message["type"]
    content = dict(message["content"])
    # the JSON has only the CRC of many values
    if isinstance(content.get("data"), dict):
        content["data"] = wire[58 + 72 :]
    if isinstance(content.get("table"), dict):
        content["table"] = np.frombuffer(wire[58 + 2 :], ">u2" if content["map_type"] == MAP_UINT16 else "u1")
    stamp = message["timestamp"]
    peer.send(type_name, message["device_name"], content, stamp["sec"], stamp["frac"])
    sent = read_message(link)
    assert sent[:50] == wire[:50]
    assert int.from_bytes(sent[50:58], "big") == crc64.ecma_182(sent[58:])
    assert sent[58:] == as_the_library_leaves_it(type_name, wire[58:], sent[58:])


#: Size of an element and where its reserved byte is.
RESERVED = {"TDATA": (70, 21), "QTDATA": (50, 21), "TRAJ": (150, 97), "IMGMETA": (260, 259), "LBMETA": (116, 85)}
SCAN_TIME_AT = 244


def as_the_library_leaves_it(type_name: str, body: bytes, sent: bytes) -> bytes:
    """``body`` with reserved bytes unwritten, and with the scan times of ``sent`` if they are close.

    (They come from the JSON's nanoseconds, so two conversions lie between.)
    """
    if type_name not in RESERVED:
        return body
    size, reserved = RESERVED[type_name]
    expected = bytearray(body)
    expected[reserved::size] = bytes([JUNK]) * (len(body) // size)
    for start in range(SCAN_TIME_AT, len(body), size) if type_name == "IMGMETA" else ():
        time = slice(start, start + 8)
        assert abs(int.from_bytes(sent[time], "big") - int.from_bytes(body[time], "big")) <= 2 * STAMP_NS / 1e9 * 2**32
        expected[time] = sent[time]
    return bytes(expected)


def message(type_name: str, body: bytes, *, device: str = "Dev", version: int = 1, crc: int | None = None) -> bytes:
    checksum = crc64.ecma_182(body) if crc is None else crc
    return struct.pack(">H12s20sQQQ", version, type_name.encode(), device.encode(), 0, len(body), checksum) + body


IDENTITY = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)


@needs_reference
def test_reference_reads_a_stream_that_comes_byte_by_byte(pair: Pair) -> None:
    peer, link = pair
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for byte in message("TRANSFORM", IDENTITY, device="A") + message("STRING", b"\0\3\0\2hi", device="B"):
        link.sendall(bytes([byte]))
    assert peer.receive()["content"]["matrix"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert peer.receive()["content"]["string"] == "hi"


@needs_reference
@pytest.mark.parametrize(
    ("odd", "sign"),
    [
        (message("TRANSFORM", IDENTITY, device="Odd", crc=1), ("crc_ok", False)),
        (message("GET_STATUS", b"", device="Odd", crc=1), ("crc_ok", False)),
        (message("COMMAND", bytes(138), device="Odd"), ("skipped", True)),
        (message("STP_IMAGE", b"", device="Odd"), ("skipped", True)),
        (message("GET_BIND", bytes(4), device="Odd"), ("skipped", True)),
        (message("STT_BIND", bytes(8), device="Odd"), ("skipped", True)),
        (message("TRANSFORM", bytes(12) + IDENTITY + bytes(2), device="Odd", version=2), ("skipped", True)),
        (message("FOREIGN", bytes(300_000), device="Odd"), ("skipped", True)),
    ],
    ids=[
        "bad crc",
        "bad crc of nothing",
        "newer type",
        "newer query",
        "read by the wrong layout",
        "read by the wrong layout, stream",
        "header version 2",
        "unknown type",
    ],
)
def test_reference_reports_what_it_cannot_decode_and_stays_in_step(
    pair: Pair, odd: bytes, sign: tuple[str, bool]
) -> None:
    peer, link = pair
    link.sendall(odd + message("TRANSFORM", IDENTITY, device="Next"))
    got = peer.receive()
    assert (got["device_name"], got[sign[0]]) == ("Odd", sign[1])
    assert "content" not in got
    assert peer.receive()["device_name"] == "Next"


@needs_reference
@pytest.mark.parametrize(("sent", "inside"), [(0, False), (30, True), (70, True)])
def test_reference_tells_an_end_between_messages_from_one_inside(pair: Pair, sent: int, inside: bool) -> None:
    peer, link = pair
    link.sendall(message("TRANSFORM", IDENTITY)[:sent])
    link.shutdown(socket.SHUT_WR)
    assert peer.wait_for_event("disconnected")["inside_message"] is inside
    with pytest.raises(PeerError, match="disconnected"):
        peer.receive("TRANSFORM")


@needs_reference
def test_reference_server_takes_one_client_after_the_other() -> None:
    with ReferencePeer.server() as peer:
        for round_number in (1, 2):
            with socket.create_connection(("127.0.0.1", peer.port), WAIT_S) as link:
                peer.wait_for_event("connected", round_number)
                peer.send("STRING", "Dev", {"string": f"hello {round_number}"})
                assert read_message(link)[62:] == f"hello {round_number}".encode()
                peer.send_raw(b"\x01\x02\x03")
                assert read_exactly(link, 3) == b"\x01\x02\x03"
                peer.disconnect()
                assert link.recv(1) == b""
            peer.wait_for_event("disconnected", round_number)


@needs_reference
def test_reference_client_that_nobody_answers() -> None:
    with listener() as server:
        port = server.getsockname()[1]
    with pytest.raises(PeerError, match="Failed to connect"):
        ReferencePeer.client("127.0.0.1", port)


@needs_reference
def test_receive_takes_matches_in_order_and_leaves_the_rest(pair: Pair) -> None:
    peer, link = pair
    for device in ("A", "B"):
        link.sendall(message("TRANSFORM", IDENTITY, device=device) + message("STRING", b"\0\3\0\0", device=device))
    assert peer.receive("STRING")["device_name"] == "A"
    assert peer.receive(device="B")["type"] == "TRANSFORM"
    assert [peer.receive()["device_name"] for _ in range(2)] == ["A", "B"]
    with pytest.raises(TimeoutError, match=r"POINT.*'STRING B'"):
        peer.receive("POINT", timeout_s=0.01)
    assert len(peer.messages) == 4


NO_UNIT = {"prefix": 0, "units": [[0, 0]] * 6}


@needs_reference
@pytest.mark.parametrize(
    ("type_name", "content", "complaint"),
    [
        ("POSITION", {"pack": "position_only", "position": [1, 2, 3], "quaternion": [0, 0, 0, 1]}, "heap"),
        ("POLYDATA", {"points": [], "vertices": [[0]]}, "uninitialised"),
        ("SENSOR", {"unit_decoded": NO_UNIT, "values": [0.0] * 256}, "wraps"),
        ("SENSOR", {"unit_decoded": NO_UNIT, "values": [], "status": 1}, "setter"),
        ("NDARRAY", {"scalar_type": 11, "size": [], "data": [1.0]}, "null"),
        ("BIND", {"children": []}, "uninitialised"),
        ("BIND", {"children": [{"type": "GET_IMAGE", "name": "x" * 21, "content": {}}]}, "unwritten"),
        ("GET_BIND", {"children": []}, "uninitialised"),
        ("STT_BIND", {"children": []}, "uninitialised"),
    ],
)
def test_what_spoils_the_librarys_memory_is_not_sent(
    pair: Pair, type_name: str, content: dict[str, Any], complaint: str
) -> None:
    peer, link = pair
    with pytest.raises(ValueError, match=complaint):
        peer.send(type_name, "Dev", content)
    peer.send("STRING", "Next", {"string": ""})
    assert read_message(link)[14:18] == b"Next"


SMALL_IMAGE = {"dimensions": [2, 2, 1], "scalar_type": 3, "wire_matrix": [0.0] * 12, "data": b"abcd"}
TENSOR = {"type": 3, "ncomponents": 3, "n": 1, "name": "short", "data": [0, 0, 0]}
TOOL = {"name": "Tool", "type": 2, "position": [0, 0, 0], "quaternion": [0, 0, 0, 1]}


@needs_reference
@pytest.mark.parametrize(
    ("type_name", "content", "complaint"),
    [
        ("IMAGE", SMALL_IMAGE | {"data": b"abc"}, "has 4 bytes of pixels, found 3"),
        ("IMAGE", SMALL_IMAGE | {"subvol_offset": [1, 0, 0]}, "refuses this sub-volume"),
        ("POLYDATA", {"points": [[0, 0, 0]], "attributes": [TENSOR]}, "refuses attribute type 3 with 3 components"),
        ("POLYDATA", {"points": [[0, 0, 0]], "attributes": [TENSOR | {"ncomponents": 9}]}, "too few words"),
        ("QTDATA", {"elements": [TOOL | {"name": "x" * 21}]}, "refuses this name"),
        ("QTDATA", {"elements": [TOOL | {"type": 5}]}, "refuses this type"),
        ("NDARRAY", {"scalar_type": 3, "size": [3], "data": [1, 2]}, "expected 3 bytes, found 2"),
        ("COLORT", {"index_type": 3, "map_type": 3, "table": [1, 2]}, "expected 256 bytes, found 2"),
        ("STT_TDATA", {"resolution": 0, "coordinate_name": "x" * 33}, "refuses this coordinate name"),
        ("GET_BIND", {"children": [{"type": "TwelveLetter", "name": ""}]}, "refuses this child"),
    ],
)
def test_what_the_library_cannot_encode_is_raised(
    pair: Pair, type_name: str, content: dict[str, Any], complaint: str
) -> None:
    peer, _ = pair
    peer.send(type_name, "Dev", content)
    with pytest.raises(PeerError, match=complaint):
        peer.receive()


def reflected(pair: Pair, type_name: str, content: dict[str, Any]) -> dict[str, Any]:
    """``content`` as the peer decodes it after having encoded it."""
    peer, link = pair
    peer.send(type_name, "Dev", content)
    link.sendall(read_message(link))
    got: dict[str, Any] = peer.receive()["content"]
    return got


@needs_reference
def test_values_that_are_easily_lost_survive_both_ways(pair: Pair) -> None:
    bounds = [[math.nan, math.inf, -math.inf, -0.0], [1e-45, 3.4028234663852886e38, 0.1, 1], [1] * 4, [0, 0, 0, 1]]
    got = reflected(pair, "TRANSFORM", {"matrix": bounds})["matrix"]
    assert struct.pack("8f", *flat(got[:2])) == struct.pack("8f", *flat(bounds[:2]))
    text = 'Zoë "\\\n\t'
    assert reflected(pair, "STRING", {"encoding": 106, "string": text})["string"] == text
    assert reflected(pair, "STATUS", {"code": 13, "subcode": -(2**63)}) == {
        "code": 13,
        "subcode": -(2**63),
        "error_name": "",
        "status_string": "",
        "nul_terminated": True,
    }
    assert reflected(pair, "POINT", {"elements": []}) == {"elements": []}
    cloud = {"points": [[1, 2, 3]] * 10_000, "vertices": [[i] for i in range(10_000)]}
    got = reflected(pair, "POLYDATA", cloud)
    assert (got["points"], got["vertices"]) == (cloud["points"], cloud["vertices"])
    pair[1].sendall(message("POLYDATA", bytes(40)))
    assert pair[0].receive()["content"]["num_points"] == 0


@needs_reference
def test_an_image_of_camera_size_survives_both_ways(pair: Pair) -> None:
    peer, link = pair
    pixels = bytes(range(256)) * (1920 * 1080 * 3 // 256)
    content = {
        "dimensions": [1920, 1080, 1],
        "num_components": 3,
        "scalar_type": 3,
        "spacing": [0.5, 0.5, 2],
        "matrix": [[1, 0, 0, 10], [0, -1, 0, 20], [0, 0, -1, 30], [0, 0, 0, 1]],
        "data": pixels,
    }
    peer.send("IMAGE", "Camera", content)
    wire = read_message(link)
    assert wire[58 + 72 :] == pixels
    link.sendall(wire)
    got = peer.receive()
    assert got["content"]["wire_matrix"] == [0.5, 0, 0, 0, -0.5, 0, 0, 0, -2, 10, 20, 30]
    assert got["lib"] == {"lib_spacing": content["spacing"], "lib_matrix": content["matrix"]}
    assert got["content"]["data_hex"] == pixels.hex()


@needs_reference
def test_a_child_that_the_library_has_not_is_skipped(pair: Pair) -> None:
    """The others of its BIND are read; one without a byte has no content."""
    peer, link = pair
    types = [("COMMAND", 3), ("TRANSFORM", 48), ("TRANSFORM", 0), ("POINT", 0)]
    names = b"A\0B\0C\0D\0"
    body = struct.pack(">H", len(types)) + b"".join(struct.pack(">12sQ", name.encode(), size) for name, size in types)
    link.sendall(message("BIND", body + struct.pack(">H", len(names)) + names + b"abc\0" + IDENTITY))
    unknown, transform, nothing, points = peer.receive()["content"]["children"]
    assert unknown == {"type": "COMMAND", "name": "A", "size": 3, "skipped": True}
    assert (transform["name"], transform["content"]["matrix"][3]) == ("B", [0, 0, 0, 1])
    assert nothing == {"type": "TRANSFORM", "name": "C", "size": 0, "content": {}}
    assert points == {"type": "POINT", "name": "D", "size": 0, "content": {"elements": []}}


@needs_reference
@pytest.mark.parametrize(
    "type_name", ["TRANSFORM", "STATUS", "IMAGE", "SENSOR", "NDARRAY", "COLORT", "BIND", "STT_TDATA", "RTS_BIND"]
)
def test_a_body_that_should_not_be_empty_leaves_the_stream_in_step(pair: Pair, type_name: str) -> None:
    """The library would wait for as many bytes as the type has by default."""
    peer, link = pair
    link.sendall(message(type_name, b"") + message("STRING", b"\0\3\0\2hi"))
    got = peer.receive(type_name)
    assert (got["crc_ok"], got["content"]) == (True, {})
    assert peer.receive("STRING")["content"]["string"] == "hi"


@needs_reference
def test_queries_of_bind_as_the_library_writes_them(pair: Pair) -> None:
    """No padding behind the names; the interval is whatever was in memory."""
    peer, link = pair
    content = {"children": [{"type": "TRANSFORM", "name": "AB"}, {"type": "IMAGE", "name": "C"}]}
    expected = struct.pack(">H12s12sH", 2, b"TRANSFORM", b"IMAGE", 5) + b"AB\0C\0"
    peer.send("GET_BIND", "Dev", content)
    assert read_message(link)[58:] == expected
    peer.send("STT_BIND", "Dev", content)
    assert read_message(link)[58:] == bytes([JUNK]) * 8 + expected


def polydata(*attributes: tuple[int, int, list[float]]) -> bytes:
    """Body with two points and the attributes (type, declared components, floats), named ``a``, ``b`` …"""
    count = len(attributes)
    names = b"".join(bytes([ord("a") + index, 0]) for index in range(count))
    floats = [value for _, _, data in attributes for value in data]
    return (
        struct.pack(">10I", 2, *[0] * 8, count)
        + bytes(24)
        + b"".join(struct.pack(">BBI", kind, components, 2) for kind, components, _ in attributes)
        + names
        + struct.pack(f">{len(floats)}f", *floats)
    )


QUIRKY = [(4, 4), (0x10, 1), (0x11, 3), (0x12, 3), (0x14, 4)]


@needs_reference
@pytest.mark.parametrize(("kind", "components"), QUIRKY)
def test_the_librarys_attribute_quirk_on_sending(pair: Pair, kind: int, components: int) -> None:
    """1.11, as 3.1, declares and sends 9 components; only the first of the floats are data."""
    peer, link = pair
    data = [0.25 * i for i in range(2 * components)]
    attribute = {"type": kind, "ncomponents": components, "n": 2, "name": "a", "data": data}
    peer.send("POLYDATA", "Dev", {"points": [[0, 0, 0]] * 2, "attributes": [attribute]})
    expected = polydata((kind, 9, data + [0.0] * (18 - len(data))))
    tail = 4 * (18 - len(data))
    body = read_message(link)[58:]
    assert (len(body), body[:-tail]) == (len(expected), expected[:-tail])


@needs_reference
@pytest.mark.parametrize(("kind", "components"), QUIRKY)
def test_the_librarys_attribute_quirk_on_receiving(pair: Pair, kind: int, components: int) -> None:
    """It takes 9 components off the wire, and gives as many as the type has (except cell scalars)."""
    peer, link = pair
    data = [0.25 * i for i in range(18)]
    link.sendall(message("POLYDATA", polydata((kind, 9, data), (0, 1, [7.0, 8.0]))))
    first, second = peer.receive()["content"]["attributes"]
    given = 9 if kind == 0x10 else components
    assert first == {"type": kind, "ncomponents": given, "n": 2, "name": "a", "data": data[: 2 * given]}
    assert second["data"] == [7.0, 8.0]


PYIGTL_FILES = [
    stem for stem in FILES if stem.startswith(("TRANSFORM", "STRING", "POINT", "IMAGE")) and "_sub" not in stem
]


def test_pyigtl_agrees_with_the_corpus() -> None:
    with (
        listener() as server,
        PyigtlPeer.client("127.0.0.1", server.getsockname()[1]) as peer,
        accepted(server) as link,
    ):
        all_hold(PYIGTL_FILES, lambda stem: agrees(peer, link, stem))


def agrees(peer: PyigtlPeer, link: socket.socket, stem: str) -> None:
    wire, expected = load(stem)
    link.sendall(wire)
    got = peer.receive(expected["type"])
    content = got["content"]
    if expected["type"] == "IMAGE":
        assert bytes.fromhex(content.pop("data_hex")) == wire[58 + 72 :]
        if isinstance(expected["content"]["data"], dict):
            del content["data"]
        if content["scalar_type"] in (2, 3):
            del content["endian"]  # numpy has no byte order for single bytes
    for element in expected["content"].get("elements", []):
        element["group"] = element["group"].rstrip()  # as pyigtl does on reading
    assert got["device_name"] == expected["device_name"]
    assert content == {key: expected["content"][key] for key in content}

    stamp = expected["timestamp"]
    outgoing = load(stem)[1]["content"] | ({"data": wire[58 + 72 :]} if expected["type"] == "IMAGE" else {})
    if outgoing.get("endian") == pyigtl_peer.BIG_ENDIAN:
        with pytest.raises(PeerError, match="big-endian"):
            peer.send(expected["type"], expected["device_name"], outgoing)
        return
    peer.send(expected["type"], expected["device_name"], outgoing, stamp["sec"], stamp["frac"])
    sent = read_message(link)
    assert sent[:34] + sent[42:] == wire[:34] + wire[42:]
    assert abs(int.from_bytes(sent[34:42], "big") - int.from_bytes(wire[34:42], "big")) < 2**32 * 1e-6


@needs_reference
def test_the_two_peers_understand_each_other() -> None:
    content = {"matrix": [[0, -1, 0, 1.5], [1, 0, 0, -2.5], [0, 0, 1, 1e3], [0, 0, 0, 1]]}
    with PyigtlPeer.server() as server, ReferencePeer.client("127.0.0.1", server.port) as client:
        client.send("TRANSFORM", "AToB", content)
        assert server.receive("TRANSFORM", "AToB")["content"] == content
        for number in range(150):  # more than pyigtl's own queue and store would keep
            server.send("STRING", "Words", {"string": str(number)})
        assert [client.receive("STRING")["content"]["string"] for _ in range(150)] == [str(n) for n in range(150)]


def test_what_pyigtl_cannot_send_is_raised() -> None:
    with PyigtlPeer.server() as peer, pytest.raises(PeerError, match="ascii"):
        peer.send("STRING", "Words", {"string": "Zoë"})
