"""``tools/fuzz.py``: a short part of every run, and that it would notice."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Any

import pytest

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.registry import BODIES
from tools import fuzz


def first(count: int) -> Any:
    return lambda done: done < count


def test_the_wire_layer_stands() -> None:
    report = fuzz.run(0, first(3000))
    assert report.broken is None
    assert report.count == 3000
    # much of it gets past the framing, and some of it through
    assert report.outcomes["decoded"] > 500
    assert report.outcomes["malformed"] > 500
    assert report.outcomes["truncated"] > 100


def test_the_seed_decides() -> None:
    one, again, other = (fuzz.run(seed, first(200)).outcomes for seed in (1, 1, 2))
    assert one == again != other


@dataclass(frozen=True, slots=True)
class Crashing(Raw):
    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        raise IndexError("crashed")


@dataclass(frozen=True, slots=True)
class Forgetting(Raw):
    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        return cls(content[:-1])


@dataclass(frozen=True, slots=True)
class Unspeakable(Raw):
    def describe(self) -> dict[str, Any]:
        raise MalformedBody("here", 1, 2)


@dataclass(frozen=True, slots=True)
class Unwritable(Raw):
    def pack(self) -> list[Buffer]:
        raise MalformedBody("here", 1, 2)


CODECS = [(Crashing, "crashed"), (Forgetting, "other bytes"), (Unspeakable, "own"), (Unwritable, "not encoded")]


@pytest.mark.parametrize(("codec", "error"), CODECS)
def test_what_breaks_is_noticed(codec: type[Raw], error: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BODIES, "POINT", codec)
    report = fuzz.run(0, first(3000))
    assert report.broken is not None
    data, told = report.broken
    assert error in told
    assert data[2:14].rstrip(b"\0") == b"POINT" or b"POINT" in data  # in a BIND
    with pytest.raises((IndexError, fuzz.Broken)):
        fuzz.judge(data)
    monkeypatch.undo()
    fuzz.judge(data)


def test_a_framer_that_loses_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = fuzz.corpus()[:5]
    fuzz.judge_stream(Random(0), messages)
    monkeypatch.setattr(Framer, "feed", lambda self, data: [])
    with pytest.raises(fuzz.Broken):
        fuzz.judge_stream(Random(0), messages)


def test_the_report_is_one_line() -> None:
    report = fuzz.Report(seconds=2.0)
    report.outcomes.update(decoded=3, malformed=1)
    assert report.text().startswith("4 messages in 2 s (2/s)")
    assert report.text().endswith("decoded 3, malformed 1")


def test_damaged_messages_keep_their_frame() -> None:
    data = bytearray(fuzz.corpus()[0])
    data[-1] ^= 1
    assert fuzz.judge(bytes(data)) == "bad_crc"
    assert fuzz.judge(fuzz.repaired(data)) in {"decoded", "malformed", "truncated"}
