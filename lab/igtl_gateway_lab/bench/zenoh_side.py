"""The ROS side of a measurement over Zenoh: a node that hands bytes to Zenoh and takes them from it, and no more."""

from __future__ import annotations

from typing import Any

from igtl_gateway.addons.zenoh.edge import ZenohEdge
from igtl_gateway.addons.zenoh.inbox import Inbox, Waiting
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway.log.note import Note
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.pace import Send
from igtl_gateway_lab.bench.ros_side import queue_depth

_FOUND_S = 60.0


class _Direct(Inbox):
    """No buffer: the thread of Zenoh takes the message."""

    def put(self, topic: Waiting, payload: Any, size: int, stamp_ns: int) -> None:
        topic.deliver(payload, stamp_ns)


class _Node(ZenohEdge):
    """The gateway's edge, without what it does for a gateway with each message."""

    def _make_inbox(self) -> Inbox:
        return _Direct()


class ZenohTransport:
    """See ``programs.BenchTransport``."""

    def __init__(self, job: Job, heard: dict[str, Arrivals]) -> None:
        self._job = job
        self._now = now = SystemClock().monotonic_ns
        numbers = {part.topic: (payload(part.stream.kind).forms[0].number, heard[part.key]) for part in job.hears}

        def receive(topic: str, _type: str, cdr: bytes, _stamp_ns: int) -> None:
            at_ns = now()
            number, arrivals = numbers[topic]
            arrivals.take(number(cdr), at_ns, cdr)

        self._node = _Node(
            node_name=job.name, on_message=receive, wants=lambda *_: None, on_note=_no_note, endpoint=job.zenoh
        )

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
        kind = payload(part.stream.kind)
        make, publish, now, qos = kind.ros_maker(), self._node.publish, self._now, Qos(queue_depth(kind.size))

        def send(first: int, count: int) -> list[int]:
            times = []
            for number in range(first, first + count):
                message = make(number)
                times.append(now())
                publish(part.topic, kind.ros_type, message, qos)
            return times

        return send

    def close(self) -> None:
        self._node.stop()


def _no_note(_note: Note) -> None:
    """Notes of the node are not part of a measurement."""
