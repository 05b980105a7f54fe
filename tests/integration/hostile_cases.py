"""Hostile peers, one row each: what a peer sends, and the result.

``test_hostile`` plays every row against a running bridge, and compares ``docs/evidence/hostile.md`` with ``page()``.
``python -m tests.integration.hostile_cases`` writes the page again.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum

from fastcrc import crc64

from tests.integration.bridge import HEADER_SIZE, extended, header, message, string
from tests.places import ROOT

PAGE = ROOT / "docs" / "evidence" / "hostile.md"


class Manner(Enum):
    """How the bytes are sent, and what follows them."""

    WHOLE = "at once"
    BYTEWISE = "byte by byte"
    LEAVES = "then FIN"
    RESETS = "then RST"


@dataclass(frozen=True)
class Case:
    """One hostile peer.

    Attributes:
        name: of the case, and the device of what it sends (20 bytes at most).
        what: the same for people.
        data: what it sends.
        counted: of the case's stream in the ledger, beside what was received: fate or reason → messages.
        noted: codes of all notes about its link, beside those that every link has.
        kept: whether its link goes on; if not, it is ended, and counted as ``noted`` among the link faults.
        answer: types of the messages that it gets.
        stream: in the ledger, where that is not its type and ``name``.
    """

    name: str
    what: str
    data: bytes
    counted: dict[str, int] = field(default_factory=dict)
    noted: tuple[str, ...] = ()
    kept: bool = True
    answer: tuple[str, ...] = ()
    manner: Manner = Manner.WHOLE
    stream: str = ""

    @property
    def ledger_stream(self) -> str:
        return self.stream or self.data[2:14].rstrip(b"\0").decode(errors="replace") + f"/{self.name}"


def raw(kind: bytes, device: bytes, body: bytes, *, version: int = 1, ticks: int = 0) -> bytes:
    """A message with names of any bytes, and a right CRC."""
    return struct.pack(">H12s20sQQQ", version, kind, device, ticks, len(body), crc64.ecma_182(body)) + body


def text(content: bytes, encoding: int = 3) -> bytes:
    """The body of a STRING."""
    return struct.pack(">HH", encoding, len(content)) + content


def image(
    dimensions: Sequence[int],
    pixels: bytes = b"",
    *,
    scalar: int = 3,
    components: int = 1,
    endian: int = 2,
    offset: Sequence[int] = (0, 0, 0),
    part: Sequence[int] = (),
    scale: float = 1.0,
) -> bytes:
    """The body of an IMAGE with the given pixels, even if they contradict the other fields."""
    matrix = (scale, 0, 0, 0, scale, 0, 0, 0, scale, 0, 0, 0)
    fields = (1, components, scalar, endian, 1, *dimensions, *matrix, *offset, *(part or dimensions))
    return struct.pack(">HBBBB3H12f3H3H", *fields) + pixels


def polydata(points: int, polygons: tuple[int, int], data: bytes, vertices: tuple[int, int] = (0, 0)) -> bytes:
    """POLYDATA whose counts are as given, whatever the data is."""
    return struct.pack(">10I", points, *vertices, 0, 0, *polygons, 0, 0, 0) + data


def cells(*pieces: Sequence[int]) -> bytes:
    """Cells as the format has them: the number of points of each, and their indices."""
    return b"".join(struct.pack(f">{len(piece) + 1}I", len(piece), *piece) for piece in pieces)


def vertex_cells(count: int) -> bytes:
    """As many points, and a cell for each."""
    points = struct.pack(f">{3 * count}f", *range(3 * count))
    pieces = struct.pack(f">{2 * count}I", *(word for index in range(count) for word in (1, index)))
    return polydata(count, (0, 0), points + pieces, (count, len(pieces)))


def metadata(items: Iterable[tuple[bytes, bytes]], content: bytes, encoding: int = 106) -> bytes:
    """The body of a version 2 message with these pairs."""
    pairs = list(items)
    index = struct.pack(">H", len(pairs))
    index += b"".join(struct.pack(">HHI", len(key), encoding, len(value)) for key, value in pairs)
    data = b"".join(key + value for key, value in pairs)
    return struct.pack(">HHII", 12, len(index), len(data), 0) + content + index + data


def bind(kind: str, body: bytes) -> bytes:
    """The body of a BIND with one child."""
    name = b"c\0"
    head = struct.pack(">H12sQ", 1, kind.encode(), len(body)) + struct.pack(">H", len(name)) + name
    return head + body + b"\0" * (len(body) % 2)


def deep_bind(depth: int) -> bytes:
    kind, body = "STRING", text(b"deep")
    for _ in range(depth):
        kind, body = "BIND", bind(kind, body)
    return body


def damaged(data: bytes, at: int = -1) -> bytes:
    """With one bit flipped."""
    spoilt = bytearray(data)
    spoilt[at] ^= 1
    return bytes(spoilt)


def transform(*numbers: float) -> bytes:
    return struct.pack(">12f", *numbers)


_TRIANGLE = struct.pack(">9f", 0, 0, 0, 10, 0, 0, 0, 10, 0)
_NAN, _INF = float("nan"), float("inf")
_HTTP = b"GET / HTTP/1.1\r\nHost: 127.0.0.1:18944\r\nUser-Agent: Mozilla/5.0\r\nAccept: */*\r\n\r\n"
_HELLO = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + random.Random(3).randbytes(500)
_REFUSED, _MALFORMED, _TRUNCATED = {"malformed": 1}, ("malformed",), ("truncated",)
_FINE = {"converted": 1}


def _sizes() -> Iterable[Case]:
    for power, size in (("31", 2**31), ("62", 2**62), ("64-1", 2**64 - 1)):
        what = f"A header that announces {size:,} bytes"
        yield Case(f"size-2^{power}", what, header("IMAGE", size, 0), noted=("too_large",), kept=False)
    yield Case(
        "string-of-3MiB",
        "A string of 3 MiB: within the general limit, above the limit of strings",
        header("STRING", 3 << 20, 0),
        noted=("too_large",),
        kept=False,
    )
    yield Case(
        "size-too-small",
        "A size that is too small: the rest is interpreted as the next header",
        message("STRING", text(b"short"), device="size-too-small") + b"\xff" * 100,
        _FINE,
        ("too_large",),
        kept=False,
    )
    yield Case(
        "garbage-between",
        "Garbage between two messages in one segment: the first one is processed, the second cannot be found",
        string("first", "garbage-between") + random.Random(5).randbytes(90) + string("second", "garbage-between"),
        _FINE,
        ("too_large",),
        kept=False,
    )
    yield Case("garbage", "100,000 random bytes", random.Random(7).randbytes(100_000), noted=("too_large",), kept=False)
    yield Case("web-browser", "A web browser", _HTTP, noted=("too_large",), kept=False)
    yield Case("tls-hello", "TLS at a port without it", _HELLO, noted=("refused",), kept=False)


def _pieces() -> Iterable[Case]:
    yield Case(
        "byte-by-byte",
        "Two messages, byte by byte",
        string("first", "byte-by-byte") + string("second", "byte-by-byte"),
        {"converted": 2},
        manner=Manner.BYTEWISE,
    )
    yield Case(
        "leaves",
        "A complete message, then a half-closed connection (it can still read)",
        string("last message", "leaves"),
        _FINE,
        kept=False,
        manner=Manner.LEAVES,
    )
    yield Case(
        "asks-and-leaves",
        "A query, then a half-closed connection",
        message("GET_STATUS", b"", device="asks-and-leaves"),
        _FINE,
        kept=False,
        answer=("STATUS",),
        manner=Manner.LEAVES,
    )
    yield Case(
        "leaves-in-header",
        "Half a header, then the end of the connection",
        string("never", "leaves-in-header")[: HEADER_SIZE // 2],
        noted=_TRUNCATED,
        kept=False,
        manner=Manner.LEAVES,
    )
    yield Case(
        "leaves-in-body",
        "A message without its last bytes, then the end of the connection",
        string("cut off", "leaves-in-body")[:-3],
        noted=_TRUNCATED,
        kept=False,
        manner=Manner.LEAVES,
    )
    yield Case(
        "resets",
        "A complete message, then RST",
        string("last message", "resets"),
        _FINE,
        kept=False,
        manner=Manner.RESETS,
    )
    yield Case(
        "resets-in-body",
        "RST inside the body of an image of 1 MiB",
        header("IMAGE", 1 << 20, 0, device="resets-in-body") + bytes(300_000),
        noted=_TRUNCATED,
        kept=False,
        manner=Manner.RESETS,
    )


def _headers() -> Iterable[Case]:
    good = string("damaged on its way", "wrong-crc")
    yield Case("wrong-crc", "A wrong CRC", damaged(good), {"bad_crc": 1}, ("bad_crc",))
    many = damaged(string("", "wrong-crcs"), 57) * 500
    yield Case("wrong-crcs", "500 messages with a wrong CRC", many, {"bad_crc": 500}, ("bad_crc",))
    for version in (0, 4, 65535):
        name = f"version-{version}"
        data = message("STRING", text(b"x"), device=name, version=version)
        yield Case(name, f"Header version {version}", data, _REFUSED, _MALFORMED)
    data = message("STRING", text(b"x"), device="version-3", version=3)
    yield Case("version-3", "Header version 3, as some programs write it", data, _FINE, ("deviation_read",))
    full = raw(b"ABCDEFGHIJKL", b"names-without-a-NUL.", b"xyz")
    yield Case(
        "names-without-a-NUL.",
        "Type and device name of full length, without a NUL; an unknown type is published unchanged",
        full,
        _FINE,
        ("no_conversion",),
    )
    yield Case(
        "no-names",
        "No type and no device name",
        raw(b"", b"", b"xyz"),
        _FINE,
        ("no_conversion",),
        stream="/",
    )
    yield Case(
        "device-not-utf-8",
        "A device name that is not UTF-8: its bytes are recorded, readers get U+FFFD",
        raw(b"STRING", b"\xff\xfe\xc3\x28bad", text(b"x")),
        _FINE,
        stream="STRING/\ufffd\ufffd\ufffd(bad",
    )
    yield Case(
        "type-not-utf-8",
        "A type that is not UTF-8",
        raw(b"\xff\xfe\xc3\x28", b"type-not-utf-8", b"x"),
        _FINE,
        ("no_conversion",),
        stream="\ufffd\ufffd\ufffd(/type-not-utf-8",
    )
    yield Case(
        "terminal",
        "Control characters in a device name: escaped in all output",
        raw(b"STRING", b"\x1b[2J\n\r\x07evil", text(b"x")),
        _FINE,
        stream="STRING/\x1b[2J\n\r\x07evil",
    )
    yield Case(
        "path",
        "A device name that is a path",
        raw(b"STRING", b"../../etc/passwd", text(b"x")),
        _FINE,
        stream="STRING/../../etc/passwd",
    )
    yield Case(
        "stamp-2^64-1",
        "A stamp in 2106",
        raw(b"STRING", b"stamp-2^64-1", text(b"x"), ticks=2**64 - 1),
        _FINE,
        ("stamp_future",),
    )


def _texts() -> Iterable[Case]:
    for encoding, name in ((3, "US-ASCII"), (4, "Latin-1"), (106, "UTF-8"), (1015, "UTF-16"), (65535, "none known")):
        device = f"string-{encoding}"
        data = message("STRING", text(b"\xff\xfe\x80\xc3(", encoding), device=device)
        what = f"A string that is invalid in its encoding {encoding} ({name}): invalid bytes become U+FFFD"
        yield Case(device, what, data, _FINE)
    data = message("STRING", struct.pack(">HH", 3, 70_000 & 0xFFFF) + b"x" * 70_000, device="string-70000")
    yield Case("string-70000", "A string of 70,000 bytes, whose length field has 16 bits", data, _REFUSED, _MALFORMED)
    data = message("STRING", struct.pack(">HH", 3, 70) + b"x" * 7, device="string-short")
    yield Case("string-short", "A string of 7 bytes with the length 70", data, _REFUSED, _MALFORMED)
    pairs = [(b"\xff\xfe", b"\x80\x81"), (b"", b""), (b"frame_id", b"\xff")]
    data = message("STRING", metadata(pairs, text(b"x")), device="metadata-not-utf-8", version=2)
    yield Case("metadata-not-utf-8", "Metadata that is not UTF-8, keys and values", data, _FINE)
    body = struct.pack(">HHII", 12, 0xFFFF, 0xFFFFFFF0, 1) + bytes(30)
    data = message("STATUS", body, device="metadata-sizes", version=2)
    yield Case("metadata-sizes", "Metadata of 4 GB in a body of 42 bytes", data, _REFUSED, _MALFORMED)
    data = message("STRING", extended(text(b"x"), {"k": "v" * (1 << 20)}), device="metadata-of-1MiB", version=2)
    yield Case("metadata-of-1MiB", "Metadata above 1 MiB", data, _REFUSED, _MALFORMED)
    data = message("STRING", metadata([(b"", b"")] * 1024, text(b"x")), device="metadata-1024", version=2)
    yield Case("metadata-1024", "1,024 items of metadata, all empty", data, _FINE)
    data = message("STRING", metadata([(b"", b"")] * 1025, text(b"x")), device="metadata-1025", version=2)
    yield Case("metadata-1025", "1,025 items of metadata", data, _REFUSED, _MALFORMED)
    data = message("STRING", b"xx", device="no-extended-header", version=2)
    yield Case("no-extended-header", "Version 2 without its extended header", data, {"truncated": 1}, _TRUNCATED)


def _surfaces() -> Iterable[Case]:
    most = 0xFFFFFFFF
    rows = (
        ("points-2^32-1", "2^32 - 1 points in 12 bytes", polydata(most, (0, 0), bytes(12)), "truncated"),
        ("cells-2^32-1", "2^32 - 1 polygons in no bytes", polydata(1, (most, most - 3), bytes(12)), "truncated"),
        ("all-2^32-1", "All counts 2^32 - 1", b"\xff" * 40, "truncated"),
        (
            "cell-of-2^32-1",
            "A polygon of 2^32 - 1 points",
            polydata(1, (1, 16), bytes(12) + struct.pack(">4I", most, 0, 0, 0)),
            "malformed",
        ),
        (
            "index-beyond",
            "A polygon of points that do not exist",
            polydata(1, (1, 16), bytes(12) + cells((0, 1, 2))),
            "malformed",
        ),
    )
    for name, what, body, code in rows:
        yield Case(name, f"POLYDATA: {what}", message("POLYDATA", body, device=name), {code: 1}, (code,))
    data = message("POLYDATA", vertex_cells(200_000), device="vertices-200000")
    yield Case("vertices-200000", "POLYDATA: 200,000 vertex cells, a cloud", data, _FINE)
    body = polydata(3, (2, 24), _TRIANGLE + cells((0,), (0, 1, 2)))
    data = message("POLYDATA", body, device="polygon-of-1")
    yield Case("polygon-of-1", "POLYDATA: a polygon of 1 vertex beside a triangle: omitted", data, _FINE)
    body = polydata(3, (1, 4), _TRIANGLE + cells(()))
    data = message("POLYDATA", body, device="polygon-of-0")
    yield Case("polygon-of-0", "POLYDATA: a polygon of no vertices", data, _FINE)


def _images() -> Iterable[Case]:
    rows = (
        ("image-too-short", "10 pixels of 1000 × 1000", image((1000, 1000, 1), bytes(10)), "malformed"),
        ("image-too-long", "400 pixels of 10 × 10", image((10, 10, 1), bytes(400)), "malformed"),
        ("image-65535", "65535 × 65535 × 65535", image((65535, 65535, 65535), bytes(10)), "malformed"),
        ("image-scalar", "scalar type 99", image((2, 2, 1), bytes(4), scalar=99), "malformed"),
        ("image-endian", "byte order 9", image((2, 2, 1), bytes(4), endian=9), "malformed"),
        ("image-components", "no components", image((2, 2, 1), bytes(4), components=0), "malformed"),
        ("image-header", "half its header", image((2, 2, 1))[:30], "truncated"),
        (
            "image-part",
            "a sub-volume outside of the volume",
            image((4, 4, 1), bytes(4), offset=(3, 3, 0), part=(2, 2, 1)),
            "malformed",
        ),
    )
    for name, what, body, code in rows:
        yield Case(name, f"IMAGE: {what}", message("IMAGE", body, device=name), {code: 1}, (code,))
    data = message("IMAGE", image((0, 0, 0)), device="image-0")
    yield Case("image-0", "IMAGE: 0 × 0 × 0", data, _FINE)
    data = message("IMAGE", image((2, 2, 1), bytes(4), scale=_NAN), device="image-nan")
    yield Case("image-nan", "IMAGE: a matrix of NaN; its pixels are valid", data, _FINE)


def _others() -> Iterable[Case]:
    for name, what, numbers in (
        ("pose-nan", "NaN", [_NAN] * 12),
        ("pose-inf", "infinite", [_INF] * 12),
        ("pose-0", "all 0", [0.0] * 12),
    ):
        reason = "conversion" if name == "pose-0" else "not_finite"
        data = message("TRANSFORM", transform(*numbers), device=name)
        yield Case(name, f"TRANSFORM: {what}", data, {reason: 1}, ("conversion",))
    data = message("TRANSFORM", bytes(44), device="pose-short")
    yield Case("pose-short", "TRANSFORM: 44 bytes of 48", data, _REFUSED, _MALFORMED)
    data = message("BIND", deep_bind(5_000), device="bind-in-bind")
    yield Case("bind-in-bind", "BIND: 5,000 deep", data, _REFUSED, _MALFORMED)
    data = message("MYSTERY", b"\x01\x02\x03", device="unknown-type")
    yield Case("unknown-type", "An unknown type: published unchanged", data, _FINE, ("no_conversion",))
    data = message("GET_STATUS", b"", device="query") * 3
    yield Case("query", "Three queries", data, {"converted": 3}, answer=("STATUS",) * 3)


CASES: tuple[Case, ...] = (
    *_sizes(),
    *_pieces(),
    *_headers(),
    *_texts(),
    *_surfaces(),
    *_images(),
    *_others(),
)


#: Cases with their own test: test, what the peer does, and what is answered, noted and counted.
OTHERS: tuple[tuple[str, str, str, str, str], ...] = (
    (
        "test_slow_peers_are_given_up[header]",
        "Half a header, then silence",
        "closed after `--stall-s`",
        "`stalled`",
        "`link_faults`: `stalled`",
    ),
    (
        "test_slow_peers_are_given_up[loris]",
        "A header byte by byte, never silent for `--stall-s` (slow loris)",
        "closed shortly after `--stall-s`",
        "`stalled` (too slow)",
        "`link_faults`: `stalled`",
    ),
    (
        "test_a_peer_that_never_reads",
        "A peer that reads nothing of 40 images of 1 MiB",
        "all strings and the newest images, when it reads again",
        "`queue_drop`",
        "`dropped` of its link",
    ),
    (
        "test_a_peer_that_asks_and_never_listens",
        "1,000 queries for a string of 60,000 bytes from a peer that reads no answer",
        "closed: strings are not dropped, and the queue is bounded",
        "`queue_full`",
        "`link_faults`: `queue_full`; answers `dropped`",
    ),
    (
        "test_200_at_once",
        "200 simultaneous connections, 12 allowed",
        "the others are closed immediately",
        "`refused`, once a second",
        "`refused`: `12 clients are connected already`",
    ),
    (
        "test_tiny_messages",
        "2,000 messages without a body in one segment",
        "nothing",
        "`no_conversion`, once",
        "2,000 `received` and `converted`",
    ),
    (
        "test_no_body_for_every_type",
        "A message without a body, of every type",
        "queries are answered",
        "`empty` and others",
        "each under its stream",
    ),
    (
        "test_promises_reserve_nothing",
        "8 peers that announce 250 MiB each and send 100 kB",
        "memory grows with the received bytes",
        "`truncated` when they disconnect, `stalled` if they stay",
        "`link_faults`: the same",
    ),
    (
        "test_a_text_of_70000_bytes_from_ros",
        "A string of 70,000 bytes from ROS",
        "not sent",
        "`conversion`",
        "`dropped`: `conversion`",
    ),
)


def page() -> str:
    """The tables of ``docs/evidence/hostile.md``."""
    lines = ["| Peer | Sent | Answered | Noted | Counted |", "| --- | --- | --- | --- | --- |"]
    for case in CASES:
        answer = ", ".join(f"`{kind}`" for kind in dict.fromkeys(case.answer)) if case.answer else "nothing"
        if not case.kept and case.manner is Manner.WHOLE:
            answer = "the connection is closed"
        noted = ", ".join(f"`{code}`" for code in case.noted)
        counted = [f"`{word}`" + (f" {number}" if number > 1 else "") for word, number in case.counted.items()]
        if case.noted and not case.kept:
            counted.append(f"`link_faults`: {noted}")
        lines.append(f"| {case.what} | {case.manner.value} | {answer} | {noted} | {', '.join(counted)} |")
    lines += ["", "| Peer | Answered | Noted | Counted |", "| --- | --- | --- | --- |"]
    lines += [f"| {what} | {answered} | {noted} | {counted} |" for _, what, answered, noted, counted in OTHERS]
    return "\n".join(lines) + "\n"


#: Mark before the tables of the page.
MARK = "<!-- generated by tests/integration/hostile_cases.py: python -m tests.integration.hostile_cases -->\n"

if __name__ == "__main__":
    PAGE.write_text(PAGE.read_text("utf-8").partition(MARK)[0] + MARK + page(), "utf-8")
