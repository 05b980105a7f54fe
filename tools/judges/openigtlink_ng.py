"""The codecs of openigtlink-ng in Python, TypeScript and C++ against ours, both directions, on generated messages.

``python tools/judges/openigtlink_ng.py --program FOLDER --python PATH``: a copy of openigtlink-ng in which a person has
built ``core-ts/dist`` (tsc) and ``core-cpp/build`` (CMake: oigtl_messages, oigtl_runtime, oigtl_ergo), and a Python
that imports ``oigtl`` and numpy.  Writes docs/evidence/real-programs/openigtlink-ng.jsonl; exit code 1 if anything
differs.

Strategy: Hypothesis draws messages of every type here, which each codec reads and writes again; random values over
the ranges of each of its schemas are written by each codec, and read and written again here.  Values are compared as
words (``programs/ng_words``), bytes as bytes.  ``ng_deviations`` explains what differs.
"""

from __future__ import annotations

import argparse
import json
import re
import struct
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import hypothesis
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import WireError
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.transform import Transform
from tests import strategies
from tools.judges import results
from tools.judges.ng_deviations import Case, explained
from tools.judges.ng_values import random_words, words_of
from tools.judges.results import CANNOT, DIFFERS, EXACT, FAILS, Row

PROGRAMS = Path(__file__).with_name("programs")
#: Messages of a type that are drawn at a time.
ROUND = 300
SIZE = struct.Struct(">I")
#: Bytes of a message in the data of tests.
SHORT = 1_200
#: Where its vectors are read; other directions are a language and what it does.
HERE = "here"
Schemas = dict[str, list[dict[str, Any]]]


class Codec:
    """A program that reads and writes.

    Attributes:
        row: of what it writes of header version 2: nothing, or a message that is read here.
    """

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        self.name = name
        # the one in Python looks for its schemas from where it is
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=folder)
        message = Message("TRANSFORM", "Tool", Transform((1.0,) * 12), 5, 2, 7)
        _, data, error = self.ask(b"e", [words_of(message).encode()])[0]
        result = EXACT if data == join(encode(message)) else CANNOT if error else FAILS
        text = "its envelopes have no extended header: what is around the content is kept" * (result == CANNOT)
        self.row = Row("header version 2", f"{name} writes", result, 1, text)

    def ask(self, kind: bytes, payloads: Sequence[bytes]) -> list[tuple[str, bytes, str]]:
        """Words, bytes and error of each; all are sent before the first is awaited."""
        assert self.process.stdin is not None
        sender = threading.Thread(target=self._send, args=(kind, payloads))
        sender.start()
        answers = [(self._part().decode(), self._part(), self._part().decode()) for _ in payloads]
        sender.join()
        return answers

    def _send(self, kind: bytes, payloads: Sequence[bytes]) -> None:
        assert self.process.stdin is not None
        for payload in payloads:
            self.process.stdin.write(kind + SIZE.pack(len(payload)) + payload)
        self.process.stdin.flush()

    def _part(self) -> bytes:
        assert self.process.stdout is not None
        head = self.process.stdout.read(SIZE.size)
        if len(head) < SIZE.size:
            raise SystemExit(f"openigtlink_ng: the {self.name} program ended, expected an answer")
        return self.process.stdout.read(SIZE.unpack(head)[0])

    def close(self) -> None:
        self.process.communicate()


# -- messages ---------------------------------------------------------------------------------------------------------


@st.composite
def of_type(draw: st.DrawFn, kind: str) -> Message:
    """A message of a type, of either header version."""
    content = draw(strategies.bodies()[kind])
    ticks = draw(st.sampled_from([0, 1, 2**64 - 1]) | st.integers(0, 2**64 - 1))
    device = draw(strategies.fixed_text(20))
    if draw(st.booleans()):
        return Message(kind, device, content, ticks)
    items = draw(st.lists(strategies.items | strategies.full_names, max_size=3))
    return Message(kind, device, content, ticks, 2, draw(st.integers(0, 2**32 - 1)), tuple(items))


SEVEN_BITS = bytes(each if each < 0x80 else each & 0x3F | 0x40 for each in range(256))


def seven_bits(value: Any) -> Any:
    """A message whose text is ASCII, as its documents want it; theirs refuse every other."""
    if isinstance(value, str):
        return value.encode("utf-8", "surrogateescape").translate(SEVEN_BITS).decode()
    if isinstance(value, tuple):
        return tuple(map(seven_bits, value))
    if isinstance(value, Item):
        return Item(seven_bits(value.key), value.value, value.encoding)
    if isinstance(value, Elements):
        rows = value.elements.copy()
        for name in rows.dtype.names or ():
            if rows.dtype[name].kind == "S":
                rows[name] = [old.translate(SEVEN_BITS) for old in rows[name].tolist()]
        return type(value)(rows)
    if is_dataclass(value) and not isinstance(value, (type, PolyData)):
        return replace(
            value, **{each.name: seven_bits(getattr(value, each.name)) for each in fields(value) if each.init}
        )
    return value


def with_signals(message: Message) -> Message:
    """With signalling NaN, which Python cannot pack, where there were quiet ones."""
    data = join(encode(seven_bits(message))).replace(b"\x7f\xc0\0\0", b"\x7f\x80\0\1")
    return decode(data, check_crc=False)


#: What is done to some of eight messages; the others have ASCII only.
LOUD: dict[int, Callable[[Message], Message]] = {0: lambda message: message, 1: with_signals}


def ours(kind: str, count: int, seed: int) -> list[Message]:
    """Messages of a type; the seed decides which."""
    found: list[Message] = []

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(of_type(kind), st.integers(0, 7))
    def take(message: Message, chance: int) -> None:
        found.append(LOUD.get(chance, seven_bits)(message))  # type: ignore[no-untyped-call]

    take()
    return found


def reads(codec: Codec, messages: Sequence[Message]) -> Iterator[Case]:
    """What we write, read there."""
    data = [join(encode(message)) for message in messages]
    for message, sent, (words, again, error) in zip(messages, data, codec.ask(b"d", data), strict=True):
        yield Case(codec.name, True, message.type, sent, words_of(decode(sent)), words, again, error)


def writes(codec: Codec, kind: str, schemas: Schemas, rng: Random, count: int) -> Iterator[Case]:
    """What is written there, read here."""
    wanted = [
        random_words(rng, kind, schemas[kind], is_new=codec.row.result == EXACT and rng.random() < 0.5)
        for _ in range(count)
    ]
    for words, (_, data, error) in zip(wanted, codec.ask(b"e", [one.encode() for one in wanted]), strict=True):
        case = Case(codec.name, False, kind, data, words, error=error)
        yield case if error else _read_here(case)


def _read_here(case: Case) -> Case:
    try:
        message = decode(case.data)
    except WireError as error:
        return replace(case, error=f"here: {error}")
    return replace(case, read=words_of(message), again=join(encode(message)))


# -- results -----------------------------------------------------------------------------------------------------------


class Tally:
    """Cases by their results."""

    def __init__(self, log: Path) -> None:
        self.exact: Counter[tuple[str, str]] = Counter()
        self.differs: Counter[tuple[str, str]] = Counter()
        self.unexplained: Counter[tuple[str, str]] = Counter()
        self.log = log

    def add(self, case: Case) -> None:
        if case.is_equal:
            self.exact[case.type, case.direction] += 1
        elif what := explained(case):
            self.differs[what, case.direction] += 1
        else:
            self.unexplained[case.type, case.direction] += 1
            if self.unexplained[case.type, case.direction] <= 20:
                shown = {**vars(case), "data": case.data.hex(), "again": case.again.hex()}
                with self.log.open("a", encoding="utf-8") as file:
                    print(json.dumps(shown), file=file)

    def rows(self) -> list[Row]:
        rows = [Row(what, direction, EXACT, cases) for (what, direction), cases in sorted(self.exact.items())]
        rows += [Row(what, direction, DIFFERS, cases) for (what, direction), cases in sorted(self.differs.items())]
        return rows + [Row(*key, FAILS, cases, "not explained") for key, cases in sorted(self.unexplained.items())]


def judge(codecs: Sequence[Codec], schemas: Schemas, count: int, seed: int, log: Path) -> list[Row]:
    """Compare ``count`` messages of each type, in each direction, with each codec."""
    tally = Tally(log)
    for begin in range(0, count, ROUND):
        size = min(ROUND, count - begin)
        for number, kind in enumerate(sorted(BODIES)):
            messages = ours(kind, size, seed * 1_000_003 + begin * 1_009 + number)
            for codec in codecs:
                for case in reads(codec, messages):
                    tally.add(case)
        for kind in sorted(schemas):
            for codec in codecs:
                rng = Random(f"{seed} {begin} {kind} {codec.name}")
                for case in writes(codec, kind, schemas, rng, size):
                    tally.add(case)
        total = sum((tally.exact + tally.differs + tally.unexplained).values())
        print(f"{total} messages, {tally.differs.total()} explained, {tally.unexplained.total()} not", file=sys.stderr)
    return tally.rows()


def agreed(codecs: Sequence[Codec], schemas: Schemas, seed: int) -> Iterator[dict[str, str]]:
    """For tests: a short message of each schema which all codecs write alike, and which is read alike here."""
    for kind in sorted(schemas):
        for number in range(100):
            words = random_words(Random(f"{seed} {kind} {number}"), kind, schemas[kind], is_new=False)
            data, *others = (codec.ask(b"e", [words.encode()])[0][1] for codec in codecs)
            if all(other == data for other in others) and len(data) < SHORT and words_of(decode(data)) == words:
                yield {"message": data.hex(), "words": words}
                break


#: Why a vector that it refuses is read here.
READ_HERE = {
    "content_bind_nametable_size_odd": "the C++ library does not pad its table of names: read here, and written again"
}


def vectors(folder: Path) -> list[Row]:
    """Its own vectors: those of the C library's tests, and those that no reader may accept."""
    corpus = folder / "spec" / "corpus"
    fixtures = json.loads((corpus / "upstream-fixtures.json").read_text("utf-8"))["fixtures"]
    good = [bytes.fromhex(one["wire_hex"]) for one in fixtures.values()]
    equal = sum(join(encode(decode(data))) == data for data in good)
    rows = [Row("vectors of the C library, read and written again", HERE, EXACT, equal)]
    rows += [Row("vectors of the C library", HERE, FAILS, len(good) - equal)] * (equal < len(good))
    index = json.loads((corpus / "negative" / "index.json").read_text("utf-8"))["entries"]
    read = [name for name, one in index.items() if _is_read((corpus / "negative" / one["path"]).read_bytes())]
    rows.append(Row("vectors that must be refused", HERE, EXACT, len(index) - len(read)))
    for name in read:
        result = DIFFERS if name in READ_HERE else FAILS
        rows.append(Row("vectors that must be refused", HERE, result, 1, READ_HERE.get(name, name)))
    return rows


def _is_read(data: bytes) -> bool:
    try:
        decode(data)
    except WireError:
        return False
    return True


# -- programs ---------------------------------------------------------------------------------------------------------


def cpp_headers(folder: Path) -> str:
    """A header that visits the fields of every message of theirs, from the structures in its headers."""
    lines, names = [], []
    for path in sorted(folder.glob("include/oigtl/messages/*.hpp")):
        source = path.read_text("utf-8")
        if not (
            match := re.search(r"^struct (\w+) \{\n    static constexpr const char\* kTypeId", source, re.MULTILINE)
        ):
            continue
        lines.append(f'#include "oigtl/messages/{path.name}"')
        names.append(match[1])
        body = source[match.start() : source.index("\n};", match.start())]
        for inner, members in re.findall(r"^    struct (\w+) \{\n(.*?)^    \};", body, re.MULTILINE | re.DOTALL):
            lines.append(_visitor(f"{match[1]}::{inner}", members))
        lines.append(_visitor(match[1], re.sub(r"^    struct .*?^    \};", "", body, flags=re.MULTILINE | re.DOTALL)))
    each = " ".join(f"each({name})" for name in names)
    return "\n".join(
        ["#include <array>", *lines, "using namespace oigtl::messages;", f"#define MESSAGES(each) {each}", ""]
    )


def _visitor(name: str, members: str) -> str:
    found = re.findall(r"^ +(?!static )[\w:]+(?:<[^;()]*>)? (\w+)(?:\{\})?;", members, re.MULTILINE)
    calls = " ".join(f"visit(m.{field});" for field in found)
    return f"template <class V> void each(V& visit, oigtl::messages::{name}& m) {{ (void)visit; (void)m; {calls} }}"


def compiled(folder: Path, target: Path) -> Path:
    """The program in C++ against their libraries."""
    core = folder / "core-cpp"
    (target / "ng_messages.hpp").write_text(cpp_headers(core), "utf-8")
    libraries = [str(core / "build" / f"liboigtl_{name}.a") for name in ("messages", "ergo", "runtime")]
    program = target / "ng_codec"
    command = ["g++", "-std=c++17", "-O1", f"-I{target}", f"-I{core / 'include'}", str(PROGRAMS / "ng_codec.cpp")]
    subprocess.run([*command, *libraries, "-pthread", "-o", str(program)], check=True)
    return program


def arguments(what: str) -> argparse.ArgumentParser:
    """The options of every judge of openigtlink-ng."""
    parser = argparse.ArgumentParser(description=what, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, required=True, help="folder of openigtlink-ng, built")
    parser.add_argument("--python", type=Path, required=True, help="interpreter that imports oigtl and numpy")
    return parser


#: What a person builds, in the folder → what it is.
SCHEMAS = {"spec/schemas/transform.json": "a copy of openigtlink-ng"}
TYPESCRIPT = {"core-ts/dist/codec.js": "core-ts, built (npm run build)"}
CPP = {"core-cpp/build/liboigtl_ergo.a": "core-cpp, built with CMake in core-cpp/build"}


def parsed(parser: argparse.ArgumentParser, wanted: dict[str, str]) -> argparse.Namespace:
    """The options; ends with what is missing of openigtlink-ng."""
    given = parser.parse_args()
    paths = {given.program / path: what for path, what in wanted.items()}
    paths[given.python] = "a Python that imports oigtl and numpy"
    lacking = [f"found no {path}, expected {what}" for path, what in paths.items() if not path.is_file()]
    if lacking:
        raise SystemExit("\n".join(f"{parser.prog}: {line}" for line in lacking))
    return given


def schemas_of(folder: Path) -> Schemas:
    """Type name → the fields of its content; without the parts of headers."""
    found = {path.stem: json.loads(path.read_text("utf-8")) for path in (folder / "spec" / "schemas").glob("*.json")}
    return {one["type_id"]: one["fields"] for name, one in found.items() if not name.startswith("framing_")}


def version_of(folder: Path) -> str:
    name = ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"]
    return subprocess.run(name, capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=2_000, help="messages of a type, direction and codec")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--log", type=Path, default=Path("openigtlink-ng.log"), help="what is not explained, as JSON lines"
    )
    parser.add_argument("--vectors", type=Path, help="write only a message of each type that all write alike")
    given = parsed(parser, SCHEMAS | TYPESCRIPT | CPP)
    schemas = str(given.program / "spec" / "schemas")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        node = ["node", str(PROGRAMS / "ng_codec.mjs"), schemas, str(given.program / "core-ts" / "dist")]
        python = [str(given.python), str(PROGRAMS / "ng_codec.py"), schemas]
        codecs = [
            Codec("Python", python, given.program),
            Codec("TypeScript", node, given.program),
            Codec("C++", [str(compiled(given.program, folder))], given.program),
        ]
        for codec in codecs:
            stack.callback(codec.close)
        if given.vectors:
            lines = map(json.dumps, agreed(codecs, schemas_of(given.program), given.seed))
            given.vectors.write_text("".join(f"{line}\n" for line in lines), "utf-8")
            return 0
        rows = [*vectors(given.program), *(codec.row for codec in codecs)]
        rows += judge(codecs, schemas_of(given.program), given.count, given.seed, given.log)
    role = "codecs in Python, TypeScript and C++"
    return results.write("openigtlink-ng", "openigtlink-ng", version_of(given.program), role, rows)


if __name__ == "__main__":
    sys.exit(main())
