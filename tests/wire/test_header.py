"""The offsets of the header: against the protocol's document, against the C part, and importable without the codecs."""

from __future__ import annotations

import re
import subprocess
import sys

from igtl_gateway.wire import header, message
from igtl_gateway.wire.header import Header
from tests.places import PACKAGE

_C_SOURCE = PACKAGE / "native" / "kernel" / "_bytes.h"
#: What the recorder's process must not wait for.
_HEAVY = ("numpy", "igtl_gateway.wire.message", "igtl_gateway.wire.registry")


def test_offsets_of_the_document() -> None:
    offsets = (header.TYPE_AT, header.DEVICE_NAME_AT, header.TICKS_AT, header.BODY_SIZE_AT, header.CRC_AT)
    assert (*offsets, header.HEADER_SIZE) == (2, 14, 34, 42, 50, 58)


def test_slices_are_the_fields() -> None:
    data = Header(2, "STRING", "Probe", 1, 2, 3).pack()
    assert data[header.NAMES] == b"\0\2STRING".ljust(14, b"\0") + b"Probe".ljust(20, b"\0")
    assert data[header.TYPE].rstrip(b"\0") == b"STRING"
    assert data[header.DEVICE_NAME].rstrip(b"\0") == b"Probe"
    numbers = [header.U64.unpack(data[part])[0] for part in (header.TICKS, header.BODY_SIZE, header.CRC)]
    assert numbers == [1, 2, 3]


def test_the_c_part_has_the_same_numbers() -> None:
    found = {name: int(number) for name, number in re.findall(r"#define (\w+) (\d+)\n", _C_SOURCE.read_text())}
    names = ("HEADER_SIZE", "TICKS_AT", "BODY_SIZE_AT", "CRC_AT")
    assert {name: found[name] for name in names} == {name: getattr(header, name) for name in names}
    assert found["EXTENDED_SIZE"] == message.EXTENDED_SIZE


def test_offsets_are_known_without_the_codecs() -> None:
    program = f"import sys, igtl_gateway.wire.header; print([name for name in {_HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
