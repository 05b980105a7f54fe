"""The ROS side of a measurement: a node that hands bytes to the middleware and takes them from it, and no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.subscribing import Callback
from igtl_gateway.edges.ros.topics import TopicSubscription
from igtl_gateway.gateway.log.note import Note
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.pace import Send
from igtl_gateway_lab.bench.payloads import Number

_FOUND_S = 60.0
#: Enough for a reader that lags by a second at 1 kHz; large messages, which would cost memory, are not kept as long.
_DEPTH_BYTES, _DEPTH_MOST, _DEPTH_LEAST = 256 << 20, 20_000, 5


class _Node(RosEdge):
    """The gateway's edge, without what it does for a gateway with each message."""

    def __init__(self, name: str, heard: dict[str, tuple[Number, Arrivals]]) -> None:
        super().__init__(node_name=name, on_message=_no_message, wants=lambda *_: None, on_note=_no_note)
        self._now = SystemClock().monotonic_ns
        self._heard = heard

    def raw_publisher(self, topic: str) -> Callable[[bytes], None]:
        """What hands bytes to the middleware."""
        return self._topics.publishers[topic].publisher.publish

    def _callback(self, subscription: TopicSubscription) -> Callback:
        now = self._now
        number, heard = self._heard[subscription.topic]

        def receive(cdr: bytes, _info: dict[str, Any]) -> None:
            at_ns = now()
            heard.take(number(cdr), at_ns, cdr)

        return receive


class RosTransport:
    """See ``programs.BenchSide``."""

    def __init__(self, job: Job, heard: dict[str, Arrivals]) -> None:
        self._job = job
        self._now = SystemClock().monotonic_ns
        numbers = {part.topic: (payload(part.stream.kind).forms[0].number, heard[part.key]) for part in job.hears}
        self._node = _Node(job.name, numbers)

    def open(self) -> None:
        self._node.start()
        for join, parts in ((self._node.subscribe, self._job.hears), (self._node.advertise, self._job.sends)):
            for part in parts:
                kind = payload(part.stream.kind)
                join(part.topic, kind.ros_type, Qos(queue_depth(kind.size)))

    def wait_for_peers(self) -> None:
        for part in self._job.sends:
            if not self._node.wait_for_subscribers(part.topic, 1, _FOUND_S):
                raise GatewayError(f"{part.topic}: no subscriber within {_FOUND_S:g} s")

    def sender(self, part: JobStream) -> Send:
        make, publish, now = payload(part.stream.kind).ros_maker(), self._node.raw_publisher(part.topic), self._now

        def send(first: int, count: int) -> list[int]:
            times = []
            for number in range(first, first + count):
                message = make(number)
                times.append(now())
                publish(message)
            return times

        return send

    def close(self) -> None:
        self._node.stop()


def queue_depth(size: int) -> int:
    """Deep enough that a flood of small messages is not cut off by the program that measures it."""
    return max(_DEPTH_LEAST, min(_DEPTH_MOST, _DEPTH_BYTES // size))


def _no_message(*_: object) -> None:
    """The node takes them where they come in."""


def _no_note(_note: Note) -> None:
    """Notes of the node are not part of a measurement."""
