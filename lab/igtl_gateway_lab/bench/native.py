"""The native sides of a measurement: nodes and connections, whose loops are those of ``probe``."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.ros.middleware import import_rclpy, interface_class, profile_of
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.probe import Flag, InStream, OutStream, Probe, igtl_bytes, ros_bytes
from igtl_gateway_lab.bench.processes import BenchError
from igtl_gateway_lab.bench.ros_side import queue_depth
from igtl_gateway_lab.bench.window import progress

#: Larger messages have a thread of their own where that helps: in ROS, not on the one connection.
LARGE_BYTES = 64 << 10
SOCKET_BYTES = 4 << 20
_FOUND_S, _LOOK_S = 60.0, 0.02
_CONNECT_S = 120.0

Stream = TypeVar("Stream")


class PlainNode:
    """A ROS node without an executor: only its publishers and subscriptions are used, by their pointers.

    Attributes:
        stop: set by ``end_loops``; the loops of ``receivers`` end then.
    """

    def __init__(self, name: str) -> None:
        self._rclpy = import_rclpy()
        self._context = self._rclpy.context.Context()
        self._context.init(args=[])
        self._node = self._rclpy.node.Node(
            name, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._guards: list[Any] = []
        self.stop = Flag()

    def publisher(self, topic: str, type_name: str, depth: int) -> Any:
        return self._node.create_publisher(interface_class(type_name), topic, self._profile(depth))

    def subscription(self, topic: str, type_name: str, depth: int) -> Any:
        return self._node.create_subscription(
            interface_class(type_name), topic, _no_message, self._profile(depth), raw=True
        )

    def receivers(self, probe: Probe, sized: Sequence[tuple[int, InStream]]) -> list[Callable[[], None]]:
        """The loops that take the messages of subscriptions, for a thread each.

        Args:
            probe: where the loops are.
            sized: the size of the messages of each stream in bytes, and the stream.
        """
        loops: list[Callable[[], None]] = []
        for group in by_size(sized):
            guard = self._rclpy.guard_condition.GuardCondition(None, None, context=self._context)
            self._guards.append(guard)
            pointers = self._context.handle.pointer, guard.handle.pointer
            loops.append(partial(probe.receive_ros, *pointers, group, self.stop))
        return loops

    def end_loops(self) -> None:
        """Have the loops end; their threads are to be joined before ``close``."""
        self.stop.set()
        for guard in self._guards:
            guard.trigger()

    def close(self) -> None:
        for guard in self._guards:
            guard.destroy()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _profile(self, depth: int) -> Any:
        return profile_of(self._rclpy, Qos(depth))


class _NativeSide:
    """What both sides have in common: streams that are sent and received by loops in threads.

    Args:
        job: see ``jobs``; its ``native`` is the file of ``probe.compile_probe``.
        ros: whether the functions of rcl are needed.
    """

    def __init__(self, job: Job, *, ros: bool) -> None:
        self._job = job
        self._probe = Probe(Path(job.native), ros=ros)
        self._outs: list[tuple[JobStream, OutStream]] = []
        self._ins: list[tuple[JobStream, InStream]] = []
        self._stop, self._pause = Flag(), Flag()
        self._threads: list[threading.Thread] = []
        self._faults: list[BenchError] = []

    def knock(self) -> None:
        """Send message 0 of every stream."""
        for _, stream in self._outs:
            self._probe.send_one(stream, 0)

    def send(self, begin_ns: int, until_ns: int) -> list[npt.NDArray[np.int64]]:
        """Send everything; for each stream when its messages were sent.  Raises BenchError."""
        for index, (part, stream) in enumerate(self._outs):
            period_ns = NS_PER_S / part.stream.rate_hz if part.stream.rate_hz else 0.0
            shared = progress(part.progress) if part.window else None
            stream.pace(part, round(period_ns * index / len(self._outs)), shared)
        threads = [
            self._thread(partial(self._probe.send, group, begin_ns, until_ns, self._stop))
            for group in self._sending_groups()
        ]
        for thread in threads:
            thread.join()
        if self._faults:
            raise self._faults[0]
        return [stream.sent() for _, stream in self._outs]

    def stop_sending(self) -> None:
        self._stop.set()

    def stall(self, stopped: bool) -> None:
        """Read nothing, or read again."""
        self._pause.set(stopped)

    def count(self) -> int:
        """How many messages have arrived."""
        return sum(stream.done for _, stream in self._ins)

    def firsts(self) -> list[tuple[JobStream, bytes]]:
        """The first message of each stream that has arrived so far."""
        return [(part, first) for part, stream in self._ins if (first := stream.first()) is not None]

    def columns(self) -> dict[str, npt.NDArray[np.int64]]:
        """What has arrived, after ``close``.  Raises BenchError if a loop failed."""
        if self._faults:
            raise self._faults[0]
        arrays = {}
        for part, stream in self._ins:
            arrays[f"numbers {part.key}"], arrays[f"received {part.key}"] = stream.arrivals()
        return arrays

    def _sending_groups(self) -> list[list[OutStream]]:
        """The streams of each thread that sends."""
        return by_size([(stream.data.nbytes, stream) for _, stream in self._outs])

    def _thread(self, loop: Callable[[], None]) -> threading.Thread:
        def run() -> None:
            try:
                loop()
            except BenchError as error:
                self._faults.append(error)
                self._stop.set()

        thread = threading.Thread(target=run, name="igtl-bench-native", daemon=True)
        thread.start()
        return thread


class NativeRosSide(_NativeSide):
    """A ROS node whose messages pass rcl only: no Python, no executor."""

    def __init__(self, job: Job) -> None:
        self._node = PlainNode(job.name)
        super().__init__(job, ros=True)
        self._publishers: list[Any] = []
        self._subscriptions: list[Any] = []

    def open(self) -> None:
        sized: list[tuple[int, InStream]] = []
        for part in self._job.hears:
            made = payload(part.stream.kind)
            subscription = self._node.subscription(part.topic, made.ros_type, queue_depth(made.size))
            self._subscriptions.append(subscription)
            shown = progress(part.progress) if part.progress else None
            stream = InStream(made.forms[0], subscription=subscription.handle.pointer, progress=shown)
            sized.append((made.size, stream))
            self._ins.append((part, stream))
        for part in self._job.sends:
            made = payload(part.stream.kind)
            publisher = self._node.publisher(part.topic, made.ros_type, queue_depth(made.size))
            self._publishers.append(publisher)
            self._outs.append((part, OutStream(ros_bytes(made), made.forms[0], publisher=publisher.handle.pointer)))
        self._threads += map(self._thread, self._node.receivers(self._probe, sized))

    def wait_for_peers(self) -> None:
        """Until each topic that is published has a subscriber.  Raises BenchError."""
        rest, clock = threading.Event(), SystemClock()
        until_ns = clock.monotonic_ns() + round(_FOUND_S * NS_PER_S)
        for part, publisher in zip(self._job.sends, self._publishers, strict=True):
            while not publisher.get_subscription_count():
                if clock.monotonic_ns() > until_ns:
                    raise BenchError(f"{part.topic}: no subscriber within {_FOUND_S:g} s")
                rest.wait(_LOOK_S)

    def close(self) -> None:
        self._stop.set()
        self._node.end_loops()
        for thread in self._threads:
            thread.join()
        self._node.close()


class NativeIgtlSide(_NativeSide):
    """Connections, one for each client that we are."""

    def __init__(self, job: Job, listening: Callable[[str, int], None]) -> None:
        super().__init__(job, ros=False)
        self._listening = listening
        self._sockets: list[socket.socket] = []

    def open(self) -> None:
        clients: dict[int, list[InStream]] = {}
        for part in self._job.hears:
            shown = progress(part.progress) if part.progress else None
            stream = InStream(payload(part.stream.kind).forms[1], device=part.device, progress=shown)
            self._ins.append((part, stream))
            clients.setdefault(part.client, []).append(stream)
        for streams in list(clients.values()) or [[]]:
            link = self._connection()
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)
            self._sockets.append(link)
            read = partial(self._probe.receive_link, link.fileno(), streams, self._pause)
            self._threads.append(self._thread(read))
        sending = self._probe.link(self._sockets[0].fileno())
        for part in self._job.sends:
            made = payload(part.stream.kind)
            self._outs.append((part, OutStream(igtl_bytes(made, part.device), made.forms[1], link=sending)))

    def wait_for_peers(self) -> None:
        """A connection is all."""

    def close(self) -> None:
        self._stop.set()
        self._pause.set(False)
        for link in self._sockets:
            try:
                link.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # the other end has closed the connection before
        for thread in self._threads:
            thread.join()
        for link in self._sockets:
            link.close()

    def _sending_groups(self) -> list[list[OutStream]]:
        """One thread: on one connection a message cannot overtake another."""
        return [[stream for _, stream in self._outs]] if self._outs else []

    def _connection(self) -> socket.socket:
        if self._job.listen:
            with socket.create_server(self._job.address) as server:
                self._listening(*server.getsockname()[:2])
                return server.accept()[0]
        return connect(self._job.address)


def by_size(sized: Sequence[tuple[int, Stream]]) -> list[list[Stream]]:
    """Small messages and large ones, which have a thread of their own: a picture must not delay a pose."""
    small = [stream for size, stream in sized if size <= LARGE_BYTES]
    large = [stream for size, stream in sized if size > LARGE_BYTES]
    return [group for group in (small, large) if group]


def connect(address: tuple[str, int]) -> socket.socket:
    """Connect; a bridge that has just been started might not listen yet.  Raises BenchError."""
    rest, clock = threading.Event(), SystemClock()
    until_ns = clock.monotonic_ns() + round(_CONNECT_S * NS_PER_S)
    while True:
        try:
            return socket.create_connection(address)
        except ConnectionRefusedError as error:
            if clock.monotonic_ns() > until_ns:
                raise BenchError(f"{address[0]}:{address[1]}: {error}") from None
            rest.wait(_LOOK_S)


def _no_message(_message: Any) -> None:
    """The loop takes the messages."""
