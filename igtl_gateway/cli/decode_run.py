"""``igtl-gateway decode``: a raw OpenIGTLink byte stream as JSON lines."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BufferedReader, BufferedWriter, FileIO
from pathlib import Path

from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConfigError, GatewayError, MessageTooLarge, WireError
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.untrusted import cpu_time
from igtl_gateway.base.untrusted.files import is_same, near_file
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.record.sessionfile.new_file import open_new
from igtl_gateway.record.sessionfile.whole_files import written
from igtl_gateway.wire import decode, describe, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import HEADER_VERSIONS, READING

#: This number of bytes at the start of a file shows its format.
_START = 512
#: The format of raw messages, as the add-on ``exchange`` names it.
_IGTL = "igtl"

#: This number of consecutive messages with an unknown header version is another protocol, or an endless device.
_FOREIGN = 1000


def run(options: argparse.Namespace) -> int:
    if options.overwrite and not options.output:
        raise ConfigError("--overwrite: found no -o OUT, expected it: the option has no effect here")
    with ExitStack() as stack:
        source = stack.enter_context(_source(options.file))
        target = stack.enter_context(_target(options, source)) if options.output else None
        return _decode(options, source, target)


def _source(name: str) -> BufferedReader[FileIO]:
    """Open the input: a file, a FIFO or a device.  Raises ConfigError."""
    if name == "-" and sys.stdin is None:
        raise ConfigError("-: standard input is closed, expected a stream of messages")
    try:
        return BufferedReader(FileIO(sys.stdin.fileno() if name == "-" else name, closefd=name != "-"))
    except (OSError, ValueError) as error:
        near = near_file(Path(name)) if isinstance(error, FileNotFoundError) else ""
        raise ConfigError(f"{name}: {_reason(error)}{near}") from None


@contextmanager
def _target(options: argparse.Namespace, source: BufferedReader[FileIO]) -> Iterator[BufferedWriter]:
    """Context manager for the output.  Raises ConfigError if it is the input, GatewayError if it cannot be written."""
    path: Path = options.output
    if is_same(path, Path(f"/dev/fd/{source.fileno()}")):
        raise ConfigError(f"--output: found {path}, which is the input, expected another file")
    with written(path, overwrite=options.overwrite) as place, open_new(place) as file:
        yield file


def _decode(options: argparse.Namespace, source: BufferedReader[FileIO], target: BufferedWriter | None) -> int:
    start = _check_format(options.file, source)
    damaged = foreign = 0
    framer = Framer(options.max_body)
    offset = 0
    try:
        for index, data in enumerate(_messages(options.file, source, framer)):
            cpu_time.opened(Path(options.file), offset + len(data))  # a stream has no size
            facts = {"index": index, "offset": offset, **describe(data)}
            print_json(facts)
            damaged += "error" in facts
            foreign = foreign + 1 if facts["header_version"] not in HEADER_VERSIONS and "error" in facts else 0
            if foreign == _FOREIGN:
                raise GatewayError(
                    f"offset {offset}: found {count_text(foreign, 'message')} in a row of an unknown header version, "
                    "expected OpenIGTLink"
                )
            if target:
                target.writelines(_encoded(data))
            offset += len(data)
    except MessageTooLarge as error:
        if not offset and int.from_bytes(start[:2], "big") not in HEADER_VERSIONS:
            found = start[:8].hex(" ")
            raise ConfigError(f"{options.file}: found {found} at its start, expected OpenIGTLink bytes") from None
        raise GatewayError(f"offset {offset}: {error}") from None
    if framer.pending:
        found = (
            f"found {counted(framer.pending, 'byte')} of a message, expected a complete message: the stream ends "
            "inside it"
        )
        print_line(f"igtl-gateway decode: offset {offset}: {found}", error=True)
    return 1 if damaged or framer.pending else 0


def _check_format(name: str, source: BufferedReader[FileIO]) -> bytes:
    """Return the first bytes.  Raises ConfigError if there are none, or for a format that `import` reads."""
    try:
        start = source.peek(_START)[:_START]
    except OSError as error:
        raise ConfigError(f"{name}: {_reason(error)}") from None
    if not start:
        raise ConfigError(f"{name}: found no bytes, expected OpenIGTLink bytes")
    kind = part_of("exchange", "formats:format_of")(start) if is_present("exchange") else None
    if kind and kind.name != _IGTL:
        raise ConfigError(
            f"{name}: found a file of the format {kind.name} ({' '.join(kind.suffixes)}), expected OpenIGTLink bytes; "
            "`igtl-gateway info` shows a recording, `igtl-gateway import` reads other formats"
        )
    return start


def _messages(name: str, source: BufferedReader[FileIO], framer: Framer) -> Iterator[Buffer]:
    while True:
        try:
            read = source.readinto1(framer.buffer())
        except OSError as error:
            raise ConfigError(f"{name}: {_reason(error)}") from None
        yield from framer.received(read)  # at the end of the input: raises the error of the last bytes
        if not read:
            return


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _encoded(data: Buffer) -> list[Buffer]:
    """Return the message, decoded and encoded again; a message that cannot be decoded is returned unchanged."""
    try:
        return encode(decode(data, reading=READING))
    except WireError:
        return [data]
