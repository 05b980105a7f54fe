"""VIDEO, VIDEOMETA and odd queries, made field by field with ``struct``: nothing of our own codec is used.

The reference library of the corpus was built without video.  According to its documents and code, it would write
these files.  Run as a program, this module writes them into ``data/corpus``.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

CORPUS = Path(__file__).parents[1] / "data" / "corpus"

MATRIX = [0.0, 0.5, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 2.0, 10.0, -20.5, 30.0]
#: Of MATRIX, as bytes: written out, so that a column-wise mistake cannot hide.
MATRIX_HEX = (
    "00000000 3f000000 00000000"
    "bf000000 00000000 00000000"
    "00000000 00000000 40000000"
    "41200000 c1a40000 41f00000"
)  # fmt: skip


def crc64(data: bytes) -> int:
    """CRC-64/ECMA-182, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
    return crc


def field(text: bytes, width: int) -> bytes:
    return text + bytes(width - len(text))


def video(codec: bytes, frame_type: int, data: bytes, endian: int = 2, coordinate: int = 1) -> tuple[bytes, Any]:
    """Content of a VIDEO of 64 × 48 pixels, and what it means."""
    head = struct.pack(">HB", 1, endian) + codec + struct.pack(">HB", frame_type, coordinate)
    geometry = struct.pack(">HHH", 64, 48, 1) + bytes.fromhex(MATRIX_HEX) + struct.pack(">HHHHHH", 0, 0, 0, 64, 48, 1)
    content = head + geometry + data
    assert len(content) == 76 + len(data)
    return content, {
        "video_version": 1,
        "endian": endian,
        "codec": codec.decode(),
        "frame_type": frame_type,
        "coordinate": coordinate,
        "size": [64, 48, 1],
        "wire_matrix": MATRIX,
        "subvol_offset": [0, 0, 0],
        "subvol_size": [64, 48, 1],
        "data_size": len(data),
        "data_crc64": f"{crc64(data):016x}",
    }


def video_meta(name: bytes, zoom: int, focal_length: float) -> tuple[bytes, Any]:
    """One element of VIDEOMETA."""
    texts = field(name, 64) + field(b"Endoscope", 64) + field(b"Doe^Jane", 64) + field(b"4711", 64)
    numbers = struct.pack(">hd", zoom, focal_length) + struct.pack(">HHH", 1920, 1080, 1)
    element = texts + numbers + bytes.fromhex(MATRIX_HEX) + b"\x03\x00"
    assert len(element) == 322
    return element, {
        "name": name.decode(),
        "device_name": "Endoscope",
        "patient_name": "Doe^Jane",
        "patient_id": "4711",
        "zoom_level": zoom,
        "focal_length": focal_length,
        "size": [1920, 1080, 1],
        "wire_matrix": MATRIX,
        "scalar_type": 3,
    }


def message(
    kind: bytes, device: bytes, content: bytes, meaning: Any, metadata: tuple[tuple[bytes, bytes], ...] | None = None
) -> tuple[bytes, Any]:
    """A version 1 message, or with ``metadata`` a version 2 one, and what it means."""
    seconds, fraction, nanosec, message_id = 1_700_000_000, 0x80000000, 500_000_000, 7
    version, body = 1, content
    extra: dict[str, Any] = {}
    if metadata is not None:
        items = b"".join(struct.pack(">HHI", len(key), 3, len(value)) for key, value in metadata)
        head, data = struct.pack(">H", len(metadata)) + items, b"".join(key + value for key, value in metadata)
        version, body = 2, struct.pack(">HHII", 12, len(head), len(data), message_id) + content + head + data
        extra["ext"] = {
            "ext_header_size": 12,
            "metadata_header_size": len(head),
            "metadata_size": len(data),
            "message_id": message_id,
        }
        extra["metadata"] = [{"key": key.decode(), "encoding": 3, "value": value.decode()} for key, value in metadata]
    header = struct.pack(">H", version) + field(kind, 12) + field(device, 20)
    header += struct.pack(">II", seconds, fraction) + struct.pack(">QQ", len(body), crc64(body))
    assert len(header) == 58
    return header + body, {
        "index": 0,
        "offset": 0,
        "header_version": version,
        "type": kind.decode(),
        "device_name": device.decode(),
        "timestamp": {"sec": seconds, "frac": fraction, "nanosec": nanosec},
        "body_size": len(body),
        "crc": f"{crc64(body):016x}",
        "crc_ok": True,
        **extra,
        "content_size": len(content),
        "content": meaning,
    }


def files() -> dict[str, tuple[bytes, Any]]:
    """File name without suffix → bytes and meaning."""
    stream = bytes.fromhex("00000001 6742000a f841a2 00000001 68ce3880 00000001 65888421a0")
    key = video(b"H264", 1, stream)
    delta = video(b"VP90", 0, b"\x86\x00\x40\x92", coordinate=2)
    grey = video(b"I420", 0x100, bytes(range(7)), endian=1)
    metas = [video_meta(b"Left eye", 4, 50.0), video_meta(b"Right eye", -2, 20.5)]
    table = b"".join(element for element, _ in metas), {"elements": [meaning for _, meaning in metas]}
    start = struct.pack(">4sI", b"H264", 40), {"codec": "H264", "resolution": 40}
    wanted = {"children": [{"type": "TRANSFORM", "name": "Tool"}, {"type": "IMAGE", "name": "US"}]}
    bind = struct.pack(">H", 2) + field(b"TRANSFORM", 12) + field(b"IMAGE", 12) + b"\x00\x08Tool\0US\0"
    wish = b'<ClientInfo><MessageTypes><Message Type="TDATA" /></MessageTypes></ClientInfo>'
    info = struct.pack(">HH", 3, len(wish)) + wish, {"encoding": 3, "string": wish.decode(), "string_hex": wish.hex()}
    return {
        "CLIENTINFO_v1_tdata": message(b"CLIENTINFO", b"Client", *info),
        "CLIENTINFO_v2_tdata": message(b"CLIENTINFO", b"Client", *info, metadata=()),
        "VIDEO_v1_key": message(b"VIDEO", b"Endoscope", *key),
        "VIDEO_v1_grey": message(b"VIDEO", b"Endoscope", *grey),
        "VIDEO_v2_delta": message(b"VIDEO", b"Endoscope", *delta, metadata=((b"Exposure", b"12 ms"), (b"Gain", b"3"))),
        "VIDEOMETA_v1_s1": message(b"VIDEOMETA", b"", *table),
        "VIDEOMETA_v2_s1": message(b"VIDEOMETA", b"", *table, metadata=()),
        "STT_VIDEO_v1_eight": message(b"STT_VIDEO", b"Endoscope", *start),
        "STT_VIDEO_v1_nine": message(b"STT_VIDEO", b"Endoscope", start[0] + b"\0", start[1]),
        "STT_POLYDATA_v1_ns": message(
            b"STT_POLYDATA", b"Liver", struct.pack(">Q", 50_000_000), {"resolution_ns": 50_000_000}
        ),
        "GET_BIND_v1_two": message(b"GET_BIND", b"", bind, wanted),
        "STT_BIND_v1_two": message(
            b"STT_BIND", b"", struct.pack(">Q", 10**9) + bind, {"resolution_ns": 10**9, **wanted}
        ),
        "GET_VMETA_v1_all": message(b"GET_VMETA", b"", b"", {}),
    }


if __name__ == "__main__":
    for name, (data, meaning) in files().items():
        (CORPUS / f"{name}.bin").write_bytes(data)
        (CORPUS / f"{name}.json").write_text(json.dumps([meaning], indent=1) + "\n", "utf-8")
