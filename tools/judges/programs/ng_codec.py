"""The Python codec of openigtlink-ng: reads and writes messages for the judge.  Argument: folder of its schemas.

A frame is a letter, u32 length, bytes: ``d`` a message to read, ``e`` words to write.  The answer is three times u32
length and bytes: words, the message written again, an error.
"""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ng_words
from oigtl import Header, lookup_message_class, pack_envelope, unpack_envelope
from oigtl.runtime.envelope import Envelope
from oigtl_corpus_tools.codec import oracle

HEAD = 58
SIZE = struct.Struct(">I")


def schemas(folder: str) -> dict[str, Any]:
    found = (json.loads(path.read_text("utf-8")) for path in Path(folder).glob("*.json"))
    return {schema["type_id"]: schema["fields"] for schema in found}


def decoded(data: bytes, fields: dict[str, Any]) -> tuple[list[str], bytes]:
    envelope = unpack_envelope(data)
    if envelope.header.version == 1:
        return shown(envelope, fields), bytes(pack_envelope(envelope))
    found = oracle.verify_wire_bytes(data, check_round_trip=False)
    if not found.ok:
        raise ValueError(found.error)
    extended = found.extended_header
    around = [ng_words.integer(extended["message_id"]), f"n{len(found.metadata)}"]
    for key, encoding, value in found.metadata:
        around += [ng_words.text(key), ng_words.integer(encoding), ng_words.octets(value)]
    # pack_envelope has neither: what stands around the content is kept, as its own oracle does
    end = len(data) - extended["metadata_header_size"] - extended["metadata_size"]
    again = data[: HEAD + extended["ext_header_size"]] + envelope.body.pack() + data[end:]
    return shown(envelope, fields, around), again


def shown(envelope: Any, fields: dict[str, Any], around: Sequence[str] = ("i0", "n0")) -> list[str]:
    """The words of a message; ``around`` are those of its message id and its metadata."""
    header = envelope.header
    words = [ng_words.integer(header.version), ng_words.text(header.type_id), ng_words.text(header.device_name)]
    words += [ng_words.integer(header.timestamp), *around]
    return [*words, *ng_words.written(fields[header.type_id], envelope.body)]


def made(words: Sequence[str], fields: dict[str, Any]) -> tuple[Any, str, int]:
    """The body, the device name and the stamp of a message without metadata."""
    _, kind, device, ticks, _, count, *rest = words
    assert count == "n0"
    name = bytes.fromhex(kind[1:]).decode()
    body = lookup_message_class(name)(**ng_words.read(fields[name], iter(rest)))
    return body, bytes.fromhex(device[1:]).decode(), int(ticks[1:])


def encoded(words: Sequence[str], fields: dict[str, Any]) -> bytes:
    body, device, ticks = made(words, fields)
    version = int(words[0][1:])
    header = Header(version=version, type_id=body.TYPE_ID, device_name=device, timestamp=ticks, body_size=0, crc=0)
    return bytes(pack_envelope(Envelope(header=header, body=body)))


def main() -> None:
    fields = schemas(sys.argv[1])
    stream, out = sys.stdin.buffer, sys.stdout.buffer
    while head := stream.read(5):
        payload = stream.read(SIZE.unpack(head[1:])[0])
        words, data, error = "", b"", ""
        try:
            if head[:1] == b"d":
                found, data = decoded(payload, fields)
                words = " ".join(found)
            else:
                data = encoded(payload.decode().split(" "), fields)
        except Exception as failure:
            error = f"{type(failure).__name__}: {failure}" or "error"
        for part in (words.encode(), data, error.encode()):
            out.write(SIZE.pack(len(part)) + part)
        if not stream.peek(1):
            out.flush()
    out.flush()


if __name__ == "__main__":
    main()
