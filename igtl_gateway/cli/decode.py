"""``igtl-gateway decode``: a raw OpenIGTLink byte stream as JSON lines."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from io import BufferedReader, FileIO
from pathlib import Path

from igtl_gateway.buffers import Buffer
from igtl_gateway.cli.terminal import print_json, say
from igtl_gateway.errors import ConfigError, MessageTooLarge, WireError
from igtl_gateway.wire import decode, describe, encode
from igtl_gateway.wire.framer import DEFAULT_MAX_BODY, Framer

EXAMPLES = """\
  igtl-gateway decode capture.igtl                    one JSON object per message
  nc localhost 18944 | igtl-gateway decode -          what a server sends, live
  igtl-gateway decode in.igtl --reencode out.igtl     decode, encode again, write

exit code 1 if a message is damaged or the stream ends inside one; what can be read is printed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="file with messages one after the other; - for standard input")
    parser.add_argument(
        "--reencode",
        metavar="OUT",
        type=Path,
        help="write the messages, encoded again from what was decoded (damaged ones as they were)",
    )
    parser.add_argument(
        "--max-body", type=int, default=DEFAULT_MAX_BODY, metavar="BYTES", help="refuse longer bodies (%(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    try:
        source = BufferedReader(FileIO(sys.stdin.fileno() if options.file == "-" else options.file))
        target = options.reencode.open("wb") if options.reencode else None
    except OSError as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None
    damaged = 0
    framer = Framer(options.max_body)
    offset = 0
    try:
        with source:
            for index, data in enumerate(_messages(source, framer)):
                told = {"index": index, "offset": offset, **describe(data)}
                print_json(told)
                damaged += "error" in told or not told["crc_ok"]
                if target:
                    target.writelines(_encoded(data))
                offset += len(data)
    except MessageTooLarge as error:
        say(f"igtl-gateway decode: offset {offset}: {error}", error=True)
        return 1
    except BrokenPipeError:
        raise  # of our output, not of the file
    except OSError as error:
        raise ConfigError(f"{options.file}: {error.strerror}") from None
    finally:
        if target:
            target.close()
    if framer.pending:
        say(
            f"igtl-gateway decode: offset {offset}: found {framer.pending} bytes of a message, expected a whole one: "
            f"the stream ends inside it",
            error=True,
        )
    return 1 if damaged or framer.pending else 0


def _messages(source: BufferedReader[FileIO], framer: Framer) -> Iterator[Buffer]:
    while read := source.readinto1(framer.buffer()):
        yield from framer.received(read)
    yield from framer.received(0)  # raises what the last bytes announced


def _encoded(data: Buffer) -> list[Buffer]:
    """The message, encoded anew; what cannot be decoded, or is not what its sender meant, stays as it was."""
    try:
        return encode(decode(data))
    except WireError:
        return [data]
