"""The state of a gateway as a digest: two gateways of one digest make the same outputs from the same inputs.

A verification in segments begins each with a state that a few inputs give, and needs proof that it is the state at the
end of the segment before.  So the digest has all that the objects of a gateway hold, whatever it is, except for what
the table names: counts and text for people, and what is kept for speed.  What it does not know has no digest.
"""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from hashlib import blake2b
from types import BuiltinFunctionType, BuiltinMethodType, FunctionType, MethodType
from typing import Any

import numpy as np

from igtl_gateway.convert.assembly import VolumeAssembler
from igtl_gateway.gateway.activity import Activity
from igtl_gateway.gateway.core import Gateway
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions
from igtl_gateway.gateway.guard import Guard, GuardedStream
from igtl_gateway.gateway.guarded_stream import STILL_LOOKS
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.outcome import Bookkeeper
from igtl_gateway.gateway.peers import Peer

#: Attributes that decide nothing about outputs, apart from the text of notes.
_LEFT_OUT: Mapping[type, frozenset[str]] = {
    Gateway: frozenset({"fast_path", "fast", "prepare"}),  # equal results, or none
    Bookkeeper: frozenset({"ledger"}),
    Peer: frozenset({"sent"}),  # for the ledger
    ClockQuestions: frozenset(
        {"clocks", "_reported", "_asking", "_not_asked"}
    ),  # for people, and for the edge that asks
    Denials: frozenset({"_known"}),  # follows from the globs
    Guard: frozenset({"clock_text"}),
    GuardedStream: frozenset({"timing", "_stale_since_ns", "clock_text"}),  # estimates and durations for people
    VolumeAssembler: frozenset({"_state"}),  # a number of its changes, to know whether there was one
}


def _still_looks(stream: GuardedStream) -> int:
    """Checks without a new stamp: beyond the limit, one more is the same."""
    return min(stream._still, STILL_LOOKS)


#: Attributes of which only a part decides.
_IN_PART: Mapping[type, Mapping[str, Callable[[Any], object]]] = {
    GuardedStream: {
        "_still": _still_looks,
        "stale": lambda stream: stream.stale > 0,
        "episodes": lambda stream: {code: last_ns for code, (_, last_ns, _) in stream.episodes.items()},
    },
    Activity: {"_refused": lambda activity: activity._refused > 0},
    Guard: {"_streams": lambda guard: sorted(guard._streams.items(), key=lambda item: item[0])},
}
_CALLABLES = (FunctionType, MethodType, BuiltinFunctionType, BuiltinMethodType, type)
_TEXTS = (bytes, bytearray, memoryview)


class NoDigest(TypeError):
    """Something of a kind that the digest does not know."""


def state_digest(core: object) -> str:
    """The digest of all that later outputs of a core follow from.  Raises NoDigest."""
    walk = _Walk()
    walk.add(core)
    return walk.hash.hexdigest()


class _Walk:
    """Goes through all objects that an object holds, each once, in a fixed order."""

    def __init__(self) -> None:
        self.hash = blake2b(digest_size=20)
        self._known: dict[int, tuple[int, object]] = {}  # by identity; kept, so that no other one gets it

    def add(self, value: object) -> None:
        if value is None or isinstance(value, (bool, int, str)):
            self._put(type(value).__name__, repr(value).encode("utf-8", "surrogatepass"))
        elif isinstance(value, (float, np.generic)):
            self._put("number", np.asarray(value).tobytes())
        elif isinstance(value, _TEXTS):
            self._put("bytes", value)
        elif isinstance(value, Enum):
            self._put("enum", f"{type(value).__qualname__}.{value.name}".encode())
        elif isinstance(value, Entry):
            self._put("entry", value.data())
            self._add_all(
                (value.seq, value.stamp_ns, value.kind, value.channel, value.type, value.links, value.source_ns)
            )
        elif isinstance(value, _CALLABLES):
            self._put("callable", f"{value.__module__}.{value.__qualname__}".encode())
        elif isinstance(value, (struct.Struct, re.Pattern)):
            form = value.format if isinstance(value, struct.Struct) else value.pattern
            self._put("form", str(form).encode())
        elif type(value) is object:  # only where it is counts
            self._put("object", b"")
        elif isinstance(value, tuple):
            self._put("tuple", b"")
            self._add_all(value)
        elif isinstance(value, frozenset):
            self._put("frozenset", b"".join(sorted(map(_digest_of, value))))
        elif not self._is_known(value):
            self._add_object(value)

    def _add_object(self, value: object) -> None:
        if isinstance(value, dict):
            self._put("dict", b"")
            self._add_all(each for item in value.items() for each in item)
        elif isinstance(value, (list, deque)):
            self._put("list", b"")
            self._add_all(value)
        elif isinstance(value, set):
            self._put("set", b"".join(sorted(map(_digest_of, value))))
        elif isinstance(value, np.ndarray):
            self._put(f"array {value.dtype} {value.shape}", np.ascontiguousarray(value).tobytes())
        elif isinstance(value, partial):
            self._put("partial", b"")
            self._add_all((value.func, value.args, value.keywords))
        else:
            self._add_attributes(value)

    def _add_attributes(self, value: object) -> None:
        kind = type(value)
        if not kind.__module__.startswith(_PACKAGE):
            raise NoDigest(f"{kind.__module__}.{kind.__qualname__}")
        names = {name for each in kind.__mro__ for name in _slots(each)} | set(getattr(value, "__dict__", ()))
        left_out, in_part = _LEFT_OUT.get(kind, frozenset()), _IN_PART.get(kind, {})
        self._put("object", f"{kind.__module__}.{kind.__qualname__}".encode())
        for name in sorted(names - left_out):
            if name in in_part:
                self._add_all((name, in_part[name](value)))
            elif hasattr(value, name):
                self._add_all((name, getattr(value, name)))
        self._put("end", b"")

    def _add_all(self, values: Any) -> None:
        count = 0
        for value in values:
            self.add(value)
            count += 1
        self._put("count", str(count).encode())

    def _is_known(self, value: object) -> bool:
        """Whether it was seen before: then its number stands for it."""
        found = self._known.setdefault(id(value), (len(self._known), value))
        if found[0] == len(self._known) - 1 and len(self._known) > self._seen:
            self._seen = len(self._known)
            return False
        self._put("known", str(found[0]).encode())
        return True

    _seen = 0

    def _put(self, kind: str, data: bytes | bytearray | memoryview) -> None:
        size = data.nbytes if isinstance(data, memoryview) else len(data)
        self.hash.update(f"{kind} {size} ".encode())
        self.hash.update(data)


_PACKAGE = f"{__name__.partition('.')[0]}."


def _digest_of(value: object) -> bytes:
    walk = _Walk()
    walk.add(value)
    return walk.hash.digest()


def _slots(kind: type) -> tuple[str, ...]:
    slots: str | tuple[str, ...] = kind.__dict__.get("__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)
