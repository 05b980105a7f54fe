"""Mutation fuzzing of the wire layer: ``python tools/fuzz.py --seconds 600 --seed 1``.

Strategy: messages of the corpus are bent (bits, words, lengths, cuts, splices of two, other types' names), mostly given
a right body size and CRC again so that the damage gets past the framing, and sent through framer, decoder, encoder and
description.  A message must be refused by a WireError, or be encoded to the very bytes that were decoded; there is
nothing in between.  The sequence of messages depends on the seed only.

A message that breaks this is written to a file, and the program ends with exit code 1.
"""

from __future__ import annotations

import argparse
import json
import resource
import struct
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MessageTooLarge, TruncatedMessage, WireError
from igtl_gateway.wire import Message, decode, describe, encode
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import BODY_SIZE_AT, HEADER_SIZE, READING, TYPE, TYPE_AT, TYPE_SIZE, crc64
from igtl_gateway.wire.registry import BODIES, read_child

ROOT = Path(__file__).resolve().parents[1]

#: Larger files teach nothing that smaller ones do not, and take the time of many.
MAX_FILE = 8_192

#: Numbers at the edges of what fields and programs can hold.
EDGES = (0, 1, 2, 3, 12, 14, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 2**31 - 1, 2**31, 2**32 - 1,
         2**32, 2**63 - 1, 2**63, 2**64 - 1)  # fmt: skip


class Broken(Exception):
    """The wire layer did what it must never do."""


def corpus() -> list[bytes]:
    """The messages to begin with."""
    files = sorted((ROOT / "tests/data/corpus").glob("*.bin"))
    small = [path.read_bytes() for path in files if path.stat().st_size <= MAX_FILE]
    if not small:
        raise SystemExit("tools/fuzz.py: found no corpus, expected tests/data/corpus/*.bin")
    return small


# -- damage ----------------------------------------------------------------------------------------------------


def _place(rng: Random, data: bytearray, size: int = 1) -> int:
    """Somewhere to write ``size`` bytes: mostly near the beginning of the body, where the counts and sizes are."""
    last = max(len(data) - size, 0)
    first = HEADER_SIZE if last > HEADER_SIZE and rng.random() < 0.95 else 0
    return rng.randint(first, min(last, first + 80) if rng.random() < 0.5 else last)


def flip(rng: Random, data: bytearray, _: bytes) -> None:
    for _index in range(rng.randint(1, 4)):
        if data:
            data[_place(rng, data)] ^= 1 << rng.randrange(8)


def edge(rng: Random, data: bytearray, _: bytes) -> None:
    size = rng.choice((1, 2, 4, 8))
    at = _place(rng, data, size)
    data[at : at + size] = (rng.choice(EDGES) % 2 ** (8 * size)).to_bytes(size, "big")


def nudge(rng: Random, data: bytearray, _: bytes) -> None:
    """A count or a length that is a little off."""
    size = rng.choice((1, 2, 4, 8))
    at = _place(rng, data, size)
    number = int.from_bytes(data[at : at + size], "big") + rng.choice((-16, -8, -4, -2, -1, 1, 2, 4, 8, 16))
    data[at : at + size] = (number % 2 ** (8 * size)).to_bytes(size, "big")


def cut(rng: Random, data: bytearray, _: bytes) -> None:
    at = _place(rng, data)
    del data[at : at + (rng.randint(1, 16) if rng.random() < 0.5 else len(data))]


def grow(rng: Random, data: bytearray, _: bytes) -> None:
    at = _place(rng, data)
    data[at:at] = rng.randbytes(rng.randint(1, 16)) if rng.random() < 0.5 else data[at : at + rng.randint(1, 64)]


def splice(rng: Random, data: bytearray, other: bytes) -> None:
    at = _place(rng, data)
    data[at:] = other[at if rng.random() < 0.5 else _place(rng, bytearray(other)) :]


def rename(rng: Random, data: bytearray, other: bytes) -> None:
    """The content of one type under the name of another."""
    data[TYPE] = other[TYPE] if rng.random() < 0.5 else rng.choice(list(BODIES)).encode().ljust(TYPE_SIZE, b"\0")


def version(rng: Random, data: bytearray, _: bytes) -> None:
    data[:TYPE_AT] = rng.choice((1, 2, 2, 3, 0)).to_bytes(2, "big")


DAMAGE: tuple[Callable[[Random, bytearray, bytes], None], ...] = (
    flip, flip, edge, edge, nudge, nudge, nudge, cut, grow, splice, rename, version,
)  # fmt: skip


def repaired(data: bytearray) -> bytes:
    """With the body size and the CRC that the bytes have."""
    body = bytes(data[HEADER_SIZE:])
    return bytes(data[:BODY_SIZE_AT]) + struct.pack(">QQ", len(body), crc64(body)) + body


def damaged(rng: Random, pool: list[bytes]) -> bytes:
    """The next message."""
    data = bytearray(rng.choice(pool))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        rng.choice(DAMAGE)(rng, data, rng.choice(pool))
    return repaired(data) if len(data) >= HEADER_SIZE and rng.random() < 0.9 else bytes(data)


# -- judgement -------------------------------------------------------------------------------------------------


def judge(data: bytes) -> str:
    """Reads one message in every way: ``"decoded"`` or the code of the error.  Raises Broken, or what escaped."""
    try:
        message = decode(data, reading=READING)
    except WireError as error:
        outcome = error.code
    else:
        outcome = "decoded"
        _judge_encoding(data, message)
    _judge_description(data)
    return outcome


def _judge_encoding(data: bytes, message: Message) -> None:
    try:
        again = join(encode(message))
    except WireError as error:
        raise Broken(f"decoded, but not encoded: {error}") from None
    if again != data:
        raise Broken(f"encoded to other bytes: {again.hex()}")
    _judge_children(message.content)


def _judge_children(content: Body) -> None:
    for child in content.children if isinstance(content, Bind) else ():
        try:
            body = read_child(child)
        except WireError:
            continue
        try:
            again = join(body.pack())
        except WireError as error:
            raise Broken(f"child {child.name!r} is decoded, but not encoded: {error}") from None
        if again != bytes(child.content):
            raise Broken(f"child {child.name!r} is encoded to other bytes")
        _judge_children(body)


def _judge_description(data: bytes) -> None:
    try:
        shown = describe(data)
    except TruncatedMessage:
        if len(data) >= HEADER_SIZE:
            raise Broken("description raises for a whole header") from None
        return
    json.dumps(shown)
    try:
        decode(data, reading=READING)
    except WireError:
        if "error" not in shown:
            raise Broken("description hides an error") from None
    else:
        if "error" in shown:
            raise Broken(f"description has an error of its own: {shown['error']}")


def judge_stream(rng: Random, messages: list[bytes]) -> None:
    """Several messages through the framer, in pieces of any size: nothing may be lost or made up."""
    stream = b"".join(messages)
    framer = Framer(max_body=1 << 20)
    got, at = [], 0
    try:
        while at < len(stream):
            size = rng.choice((1, 7, 57, 58, 59, 1000, 70_000))
            got += [bytes(one) for one in framer.feed(stream[at : at + size])]
            at += size
        framer.received(0)
        rest = stream[sum(map(len, got)) :]
        if framer.pending != len(rest):
            raise Broken(f"the framer holds {framer.pending} bytes of {len(rest)}")
    except MessageTooLarge:
        pass
    if not stream.startswith(b"".join(got)):
        raise Broken("the framer gives other bytes than it got")


# -- the run ---------------------------------------------------------------------------------------------------


@dataclass
class Report:
    """What came of a run."""

    outcomes: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    #: The message or stream that broke something, and how.
    broken: tuple[bytes, str] | None = None

    @property
    def count(self) -> int:
        return sum(self.outcomes.values())

    def text(self) -> str:
        rate = self.count / self.seconds if self.seconds else 0.0
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        told = ", ".join(f"{outcome} {count}" for outcome, count in self.outcomes.most_common())
        return f"{self.count} messages in {self.seconds:.0f} s ({rate:.0f}/s), peak {peak:.0f} MiB: {told}"


def run(seed: int, goes_on: Callable[[int], bool]) -> Report:
    """Messages until ``goes_on`` (given their number so far) is false, or until one breaks something."""
    rng, pool, report = Random(seed), corpus(), Report()
    began = time.monotonic()
    recent: list[bytes] = []
    while goes_on(report.count):
        data = damaged(rng, pool)
        subject = data
        try:
            report.outcomes[judge(data)] += 1
            recent.append(data)
            if len(recent) == 16:
                subject = b"".join(recent)
                judge_stream(rng, recent)
                recent.clear()
        except Exception:  # anything at all that escapes is what is looked for
            report.broken = subject, traceback.format_exc()
            break
    report.seconds = time.monotonic() - began
    return report


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other messages (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("fuzz-broken.igtl"), help="where a culprit goes (%(default)s)")
    options = parser.parse_args()
    end = time.monotonic() + options.seconds
    report = run(options.seed, lambda _: time.monotonic() < end)
    print(f"seed {options.seed}: {report.text()}")
    if report.broken is None:
        return 0
    data, error = report.broken
    options.out.write_bytes(data)
    print(
        f"{error}\nbroken by message {report.count + 1} of seed {options.seed}, written to {options.out}",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
