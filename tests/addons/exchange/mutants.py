"""Recordings with flipped bits and correct checksums: an export reads damaged data that no checksum reveals.

A recording is taken apart into the records of its chunks.  Some messages are kept, bits of some records are flipped,
and the file is put together again with right lengths, offsets and checksums; the CRC of half of the OpenIGTLink
messages is repaired too.  ``python -m tests.addons.exchange.mutants SEED COUNT`` runs many.
"""

from __future__ import annotations

import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from io import StringIO
from itertools import count, islice
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory, gettempdir

from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.cli import main
from igtl_gateway.wire.header import HEADER_SIZE, crc64
from tests.places import FIXTURES
from tools import mcap_build as build

#: Messages of a mutant, at most.
KEPT = 40
_KNOWN = (build.SCHEMA, build.CHANNEL)
_MESSAGE_HEAD = 22  # bytes of a message record before its data


@cache
def _parts(name: str) -> tuple[list[build.Record], list[build.Record]]:
    """What is not a message, and the messages of a recording."""
    data = (FIXTURES / f"{name}.mcap").read_bytes()
    found = [one for part in build.parse(data) for one in (part.records if isinstance(part, build.Chunk) else (part,))]
    messages = [one for one in found if one[0] == build.MESSAGE]
    others = dict.fromkeys(one for one in found if one[0] != build.MESSAGE)
    return list(others), messages


def mutants(seed: int) -> Iterator[tuple[str, bytes]]:
    """Mutants without end: a name and the bytes of the file."""
    chance = Random(seed)
    for number in count():
        name = chance.choice(("every-type", "paper-types"))
        others, messages = _parts(name)
        places = sorted(chance.sample(range(len(messages)), min(KEPT, len(messages))))
        chosen = [messages[place] for place in places]
        sort = chance.random()
        if sort < 1 / 8:  # definitions, topics and their facts
            others = [_flipped(one, 2, chance) if one[0] in _KNOWN else one for one in others]
        elif sort < 1 / 4:  # messages and the recorder's statements about them
            chosen = [_flipped(one, _MESSAGE_HEAD, chance) for one in chosen]
        else:  # what peers and nodes sent, nothing around it
            chosen = [_flipped(one, _content_at(one[1]), chance) for one in chosen]
        known = [one for one in others if one[0] in _KNOWN]
        rest = [one for one in others if one[0] not in _KNOWN]
        chunk = build.Chunk((*known, *chosen), chance.choice(("", "zstd")))
        yield f"{seed}-{number}:{name}", build.assemble([*rest, chunk]).finish()


def _flipped(record: build.Record, first: int, chance: Random) -> build.Record:
    """A record, at random with one to three bits flipped from the byte ``first`` on."""
    opcode, content = record
    if first >= len(content) or chance.random() < 0.5:
        return record
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 3))):
        bit = chance.randrange(8 * first, 8 * len(changed))
        changed[bit // 8] ^= 1 << bit % 8
    at = _wire_at(content)
    if at and chance.random() < 0.7:
        changed[at + 50 : at + HEADER_SIZE] = crc64(bytes(changed[at + HEADER_SIZE :])).to_bytes(8, "big")
    return opcode, bytes(changed)


def _content_at(content: bytes) -> int:
    """Where that part of a message record begins that a peer or a node wrote; its end where that is nothing."""
    if b"link\0" in content[:60] or b"note\0" in content[:60]:
        return len(content)
    return _wire_at(content) or _MESSAGE_HEAD


def _wire_at(content: bytes) -> int:
    """Where the OpenIGTLink message of a record begins that ends with one; else 0."""
    for at in range(_MESSAGE_HEAD, min(len(content) - HEADER_SIZE, 200) + 1):
        size = int.from_bytes(content[at + 42 : at + 50], "big")
        if content[at : at + 2] in (b"\0\1", b"\0\2") and size == len(content) - at - HEADER_SIZE:
            return at
    return 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one export: exit code, output, seconds of computing."""

    code: int
    printed: str
    seconds: float


def export(data: bytes, to: str, *more: str) -> Outcome:
    """Export a file by the command line, in this process; what is not caught there is raised."""
    with TemporaryDirectory() as folder:
        path, printed = Path(folder) / "some.mcap", StringIO()
        path.write_bytes(data)
        start = time.process_time()
        globs = ["--streams", "Slice", "--streams", "TRANSFORM/*"] if to == "igs.mha" else []
        with redirect_stdout(printed), redirect_stderr(printed):
            code = main(["export", str(path), "--to", to, "-o", str(Path(folder) / "out"), *globs, *more])
        return Outcome(code, printed.getvalue(), time.process_time() - start)


def run(seed: int, number: int) -> None:
    """Export this number of mutants to every format, and report what broke."""
    worst, codes, broken = 0.0, Counter[tuple[str, int]](), 0
    for name, data in islice(mutants(seed), number):
        for to in TARGETS:
            try:
                outcome = export(data, to)
            except Exception:
                broken += 1
                (Path(gettempdir()) / f"broken-{name}-{to}.mcap").write_bytes(data)
                sys.stdout.write(f"{name} {to}\n{traceback.format_exc(-3)}\n")
                continue
            codes[to, outcome.code] += 1
            if outcome.seconds > worst:
                worst = outcome.seconds
                sys.stdout.write(f"{name} {to}: {worst:.2f} s\n")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    sys.stdout.write(f"{number} mutants, {broken} broken, {worst:.2f} s, {peak} MB, {sorted(codes.items())}\n")


if __name__ == "__main__":
    run(int(sys.argv[1]), int(sys.argv[2]))
