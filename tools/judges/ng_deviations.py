"""What differs between our codec and those of openigtlink-ng, and whose doing it is, for its judge.

Strategy: each deviation undoes itself in a case that has it, and leaves every other case alone; a case that is equal
when all are undone is explained by the first that it had.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

from igtl_gateway.base.errors import WireError
from igtl_gateway.wire import decode
from igtl_gateway.wire.query import EmptyQuery, StartPolyData
from igtl_gateway.wire.registry import BODIES
from tools.judges.ng_values import words_of
from tools.judges.programs.ng_words import octets, text

HEAD, STAMP, CRC = 58, slice(34, 42), slice(50, 58)
#: Bytes of a STATUS in front of its text.
STATUS = 30
#: Words in front of the content, without metadata; the last is the number of its items.
HEAD_WORDS = 6


@dataclass(frozen=True)
class Case:
    """A message that one side wrote and the other side read and wrote again.

    Attributes:
        codec: language of theirs.
        is_ours: whether ours wrote it.
        type: type name.
        data: as written.
        words: its values where it was written.
        read: its values where it was read.
        again: as written again there.
        error: why it was not read, or not written.
    """

    codec: str
    is_ours: bool
    type: str
    data: bytes
    words: str
    read: str = ""
    again: bytes = b""
    error: str = ""

    @property
    def direction(self) -> str:
        return f"{self.codec} {'reads' if self.is_ours else 'writes'}"

    @property
    def is_equal(self) -> bool:
        return not self.error and self.words == self.read and self.data == self.again

    @property
    def content(self) -> bytes:
        return content_of(self.data)

    def accepted(self) -> Case:
        """As if it had been read, and written again, without a difference."""
        return replace(self, read=self.words, again=self.data, error="")


Undo = Callable[[Case], Case]


def content_of(data: bytes) -> bytes:
    """The content of a whole message."""
    return data[_place(data)]


def _place(data: bytes) -> slice:
    if data[:2] == b"\0\1":
        return slice(HEAD, len(data))
    extended, head, metadata = struct.unpack_from(">HHI", data, HEAD)
    return slice(HEAD + extended, len(data) - head - metadata)


def explained(case: Case) -> str | None:
    """The first deviation of a case, if it has no others than those that are known."""
    first = None
    for what, undo in DEVIATIONS.items():
        undone = undo(case)
        if undone != case:
            first, case = first or what, undone
        if case.is_equal:
            return first
    return None


# -- refusals ---------------------------------------------------------------------------------------------------------


def refused(pattern: str, has: Callable[[Case], bool]) -> Undo:
    """The refusal of a case that has something, with an error of this pattern."""
    return lambda case: case.accepted() if re.search(pattern, case.error) and has(case) else case


def _is_lacked(case: Case) -> bool:
    return case.type in LACKED


def _has_eight_bits(case: Case) -> bool:
    """In the names of the header, or in the content."""
    return any(each & 0x80 for each in case.data[14:34] + case.content)


def _is_empty(case: Case) -> bool:
    return not case.content and (
        case.type in ("GET_BIND", "STT_BIND", "STT_TDATA", "STT_QTDATA") or case.type[:3] == "RTS"
    )


def _is_interval(case: Case) -> bool:
    return case.type == "STT_BIND" and len(case.content) == 8


def _is_too_long(case: Case) -> bool:
    return case.type in TOO_LONG and len(case.content) > TOO_LONG[case.type]


def _has_no_order(case: Case) -> bool:
    return case.type == "IMAGE" and case.content[4] == 3


# -- differences ------------------------------------------------------------------------------------------------------


def _dropped(case: Case) -> Case:
    if case.error or not _is_too_long(case):
        return case
    is_cut = content_of(case.again) == case.content[: TOO_LONG[case.type]]
    is_read = case.words == case.read or case.words.startswith(case.read + " ")
    return case.accepted() if is_cut and is_read else case


def _bytes_only(case: Case) -> Case:
    if case.type != "RTS_STRING" or case.error:
        return case
    head, _, status = case.words.rpartition(" i")
    return replace(case, read=case.words) if case.read == f"{head} {octets(bytes([int(status) % 256]))}" else case


def _signed(case: Case) -> Case:
    if case.error or not case.type.startswith(("RTS_", "TRAJ")):
        return case
    here, there = (case.words, case.read) if case.is_ours else (case.read, case.words)
    ours, theirs = here.split(" "), there.split(" ")
    is_all = len(ours) == len(theirs) and all(
        one == other or _is_signed(one, other) for one, other in zip(ours, theirs, strict=True)
    )
    return replace(case, read=case.words) if is_all else case


def _is_signed(ours: str, theirs: str) -> bool:
    return ours[0] == theirs[0] == "i" and 128 <= int(ours[1:]) < 256 and int(ours[1:]) - 256 == int(theirs[1:])


def _replaced_keys(case: Case) -> Case:
    here, there = case.words.split(" "), case.read.split(" ")
    end = HEAD_WORDS + 3 * int(here[HEAD_WORDS - 1][1:])
    if len(there) < end:
        return case
    for at in range(HEAD_WORDS, end, 3):
        if text(bytes.fromhex(here[at][1:]).decode("utf-8", "replace")) == there[at]:
            there[at] = here[at]
    return replace(case, read=" ".join(there))


def _padded_codec(case: Case) -> Case:
    at = {"STT_VIDEO": 0, "VIDEO": 2}.get(case.type)
    if at is None or case.error:
        return case
    here, there = case.words.split(" "), case.read.split(" ")
    at += HEAD_WORDS + 3 * int(here[HEAD_WORDS - 1][1:])
    if there[at : at + 1] == [here[at].ljust(9, "0")]:
        there[at] = here[at]
    return replace(case, read=" ".join(there))


def _unterminated(case: Case) -> Case:
    content = case.content
    if case.type != "STATUS" or case.error or content[STATUS:].endswith(b"\0"):
        return case
    cut = case.codec == "TypeScript" and len(content) > STATUS
    wanted, word = (content[:-1], case.words[:-2]) if cut else (content, case.words)
    again = content_of(case.again)
    if case.read != word or again[STATUS:] != wanted[STATUS:] + b"\0":
        return case
    place = _place(case.data)
    whole = case.data[: place.start] + again[:STATUS] + content[STATUS:] + case.data[place.stop :]
    return replace(case, read=case.words, again=whole)


def _stamped(case: Case) -> Case:
    if case.codec != "C++" or not case.is_ours or any(case.data[STAMP]) or not case.again:
        return case
    return replace(case, again=case.again[: STAMP.start] + bytes(8) + case.again[STAMP.stop :])


def _cleared(case: Case) -> Case:
    is_cleared = _has_equal_values(case) and all(ours == theirs or not theirs for ours, theirs in _bytes(case))
    return replace(case, again=case.data) if is_cleared else case


def _quieted(case: Case) -> Case:
    is_quieted = _has_equal_values(case) and all(
        ours | 0x40 == theirs or ours == theirs for ours, theirs in _bytes(case)
    )
    return replace(case, again=case.data) if is_quieted and "7ff8000000000000" in case.words else case


def _has_equal_values(case: Case) -> bool:
    """Where it was read, and in the bytes that were written again."""
    if case.error or case.words != case.read or len(case.again) != len(case.data):
        return False
    try:
        return words_of(decode(case.again, check_crc=False)) == case.words
    except WireError:
        return False


def _bytes(case: Case) -> zip[tuple[int, int]]:
    """Those of both, without the CRC."""
    ours, theirs = (data[: CRC.start] + data[CRC.stop :] for data in (case.data, case.again))
    return zip(ours, theirs, strict=True)


# -- tables -----------------------------------------------------------------------------------------------------------

#: Types that it has no schema for: of PLUS, other spellings, and queries that only we expect.
LACKED = {
    "CLIENTINFO", "CAPABIL", "GET_TRANSFOR", "STT_TRANSFOR", "STP_TRANSFOR", "RTS_TRANSFOR", "GET_VIDEO", "RTS_VIDEO",
    "STT_SENSOR",
}  # fmt: skip
#: Queries that may have more content here than in the schemas → bytes there.
TOO_LONG = {name: 0 for name, body in BODIES.items() if body in (EmptyQuery, StartPolyData)} | {"STT_VIDEO": 8}
_TOO_SHORT = "must be|requires|short buffer|unpack_from|outside the bounds"

_MORE = "content of a query without fields, interval of STT_POLYDATA, ninth byte of STT_VIDEO"

#: What differs, and whose doing it is.
DEVIATIONS: dict[str, Undo] = {
    "type without a schema there (CLIENTINFO of PLUS, CAPABIL, GET_VIDEO, GET_TRANSFOR …): its bytes only": refused(
        "no class for|no (typed class|codec) registered", _is_lacked
    ),
    "text that is not ASCII: refused there, as the documents want ASCII": refused(
        "(?i)non-ascii|'ascii' codec", _has_eight_bits
    ),
    "RTS_, STT_TDATA or _BIND without content, as documents or the C++ library have them: refused there": refused(
        _TOO_SHORT, _is_empty
    ),
    "STT_BIND of an interval only, which asks for all: refused there": refused(_TOO_SHORT, _is_interval),
    f"{_MORE}: refused there": refused(_TOO_SHORT, _is_too_long),
    "byte order 3 (host) of an IMAGE, of no use to a receiver: refused here": refused(
        "here: IMAGE content, offset 4, endian: found 3", _has_no_order
    ),
    "key of metadata that is not ASCII: replaced there": _replaced_keys,
    "codec of fewer than four letters: with its NULs there": _padded_codec,
    f"{_MORE}: dropped there": _dropped,
    "RTS_STRING, which string.md excludes: its bytes only here": _bytes_only,
    "RTS_ status and TRAJ type above 127: unsigned here, in documents and C++ classes; signed there and in C": _signed,
    "STATUS without a final NUL: gets one there, in TypeScript for its last letter": _unterminated,
    "stamp 0: the time of packing there": _stamped,
    "bytes behind the NUL of text: cleared there": _cleared,
    "signalling NaN: quiet there": _quieted,
}
