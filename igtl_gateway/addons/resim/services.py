"""Services that only the recording has: their requests and responses, from the events of service introspection.

ROS publishes these events on ``SERVICE/_service_event``, if introspection is on with contents.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass

from igtl_gateway.addon.checking import ElementArray, LeafDecoder, Undecodable
from igtl_gateway.addon.messages import SERVICE_EVENT, service_of
from igtl_gateway.addon.reading import Entry, Kind, SessionFile

# kind of event, seconds, nanoseconds, client, number of the request; then both contents, each as a sequence of 0 or 1
_EVENT = struct.Struct("=4xB3xiI16s4xq")
_COUNT = struct.Struct("=I")
#: Bytes of an event before the content of a request, behind the encapsulation.
_HEAD = _EVENT.size - 4 + _COUNT.size
#: Kinds of events that belong together: as the client has them, which includes the way, or else as the server has them.
_SIDES = ((0, 3), (1, 2))
#: Leaves that are not of the request.
_BESIDE = ("head_", "tail_", "__msgtype__")
_SEPARATOR = "=" * 80


@dataclass(frozen=True, slots=True)
class RecordedAnswer:
    """A response as CDR, and how long after its request it came."""

    data: bytes
    latency_ns: int


class RecordedService:
    """The answers of one service.

    Args:
        name: of the service.
        type: ``package/srv/Name``.
        definition: of its events, with what they need; ``""`` if the recording has none.
    """

    def __init__(self, name: str, type: str, definition: str) -> None:
        self.name, self.type = name, type
        self._answers: dict[Hashable, deque[RecordedAnswer]] = {}
        package, _, last = type.partition("/")
        request = f"{package}/{last.rpartition('/')[2]}_Request request\n"
        needed = "".join(definition.partition(_SEPARATOR)[1:])
        texts = {
            "request/msg/Alone": request + needed,
            "request/msg/InEvent": f"uint8[{_HEAD}] head_\n{request}uint32 tail_\n{needed}",
        }
        self._decoder = LeafDecoder(texts if needed else {})

    @property
    def count(self) -> int:
        """Answers that are left."""
        return sum(map(len, self._answers.values()))

    def add(self, request_event: bytes, answer: RecordedAnswer) -> None:
        """Add the answer to a request, which is known as its event."""
        self._answers.setdefault(self._content(request_event, in_event=True), deque()).append(answer)

    def take(self, request: bytes) -> RecordedAnswer | None:
        """The next answer to a request with this content; None if the recording has no more."""
        answers = self._answers.get(self._content(request, in_event=False))
        return answers.popleft() if answers else None

    def _content(self, data: bytes, *, in_event: bool) -> Hashable:
        """The values of a request, wherever it is: its place decides about the bytes between them."""
        name = "request/msg/InEvent" if in_event else "request/msg/Alone"
        try:
            leaves = self._decoder.leaves(Entry(1, 0, Kind.ROS_IN, self.name, name, (data,)))
            return tuple((path, _plain(value)) for path, value in leaves if path not in _BESIDE)
        except Undecodable:  # values of up to 4 bytes have the same bytes at both places
            return (data[4 + _HEAD : -_COUNT.size] if in_event else data[4:]).rstrip(b"\0")


def _plain(value: object) -> Hashable:
    return value.values.tobytes() if isinstance(value, ElementArray) else repr(value)


def _events(file: SessionFile) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of all events."""
    if any(channel.count and channel.topic.endswith(SERVICE_EVENT) for channel in file.channels):
        for entry in file.entries_of_kinds([Kind.ROS_IN]):
            if entry.channel.endswith(SERVICE_EVENT) and entry.type.endswith("_Event"):
                yield entry.channel, entry.type, bytes(entry.data())


def recorded_services(file: SessionFile) -> dict[str, RecordedService]:
    """Return the services of a recording whose answers it has, by name."""
    events: dict[tuple[str, str], dict[tuple[bytes, int], dict[int, tuple[int, bytes]]]] = {}
    for topic, type_, data in _events(file):
        if len(data) >= _EVENT.size + 2 * _COUNT.size and data[1] == 1:
            kind, seconds, rest_ns, client, number = _EVENT.unpack_from(data)
            key = service_of(topic), type_.removesuffix("_Event")
            exchange = events.setdefault(key, {}).setdefault((client, number), {})
            exchange.setdefault(kind, (seconds * 10**9 + rest_ns, data))
    found = {}
    for (name, type_), exchanges in events.items():
        service = RecordedService(name, type_, file.definitions.get(f"{type_}_Event", ""))
        for request, response in _SIDES:
            for (asked_ns, asked), (answered_ns, answered) in _pairs(exchanges, request, response):
                data = answered[:4] + answered[_EVENT.size + 2 * _COUNT.size :]
                service.add(asked, RecordedAnswer(data, max(0, answered_ns - asked_ns)))
            if service.count:
                found[name] = service
                break
    return found


def _pairs(
    exchanges: dict[tuple[bytes, int], dict[int, tuple[int, bytes]]], request: int, response: int
) -> Iterator[tuple[tuple[int, bytes], tuple[int, bytes]]]:
    """Requests and responses of one side that have contents."""
    for each in exchanges.values():
        if request in each and response in each:
            asked, answered = each[request], each[response]
            counts = [
                *_COUNT.unpack_from(asked[1], _EVENT.size),
                *struct.unpack_from("=II", answered[1], _EVENT.size),
            ]
            if counts == [1, 0, 1]:
                yield asked, answered
