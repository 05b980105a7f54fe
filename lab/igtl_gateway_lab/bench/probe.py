"""The native part of the measuring programs: ``_probe.c``, compiled when it is first needed, and its streams.

A loop of it runs in a thread of Python's, without the GIL (ctypes releases it).  Python prepares the messages
and reads the times at the end.  No time passes in Python between two messages.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from ctypes import POINTER, Structure, c_double, c_int32, c_int64, c_size_t, c_uint8, c_uint32, c_uint64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import igtl_gateway.native.passage
from igtl_gateway.wire.header import CRC, HEADER_SIZE, crc64
from igtl_gateway_lab.bench.jobs import JobStream
from igtl_gateway_lab.bench.payloads import ID_AT, Form, Payload
from igtl_gateway_lab.bench.processes import BenchError

SOURCE = Path(__file__).with_name("_probe.c")
_RCL_HEADERS = Path(igtl_gateway.native.passage.__file__).parent
_FLAGS = ("-O2", "-fPIC", "-shared", "-std=gnu11", "-Wall", "-Wextra")
_COMPILE_S = 120.0
_DEVICE_SIZE, _INITIAL_SIZE = 20, 16

#: How a number is written, in the order of the enumeration in ``_probe.c``.
_LAYOUTS = ("<i", ">I", "text", "<d", ">f", "<I", "cloud")

#: The functions of rcl, in the order of ``struct probe_rcl``.
_RCL = (
    "rcl_publish_serialized_message",
    "rcl_take_serialized_message",
    "rcl_get_zero_initialized_wait_set",
    "rcl_wait_set_init",
    "rcl_wait_set_clear",
    "rcl_wait_set_add_subscription",
    "rcl_wait_set_add_guard_condition",
    "rcl_wait",
    "rcl_wait_set_fini",
)


def lacks_probe() -> str:
    """Why the native programs cannot be used here; "" if they can."""
    if not sys.platform.startswith("linux"):
        return "the native programs need Linux"
    return "" if shutil.which("cc") else "no C compiler (cc)"


def compile_probe(folder: Path) -> Path:
    """Compile into ``folder``, once; returns the library.  Raises BenchError."""
    made = folder / "probe.so"
    if made.exists():
        return made
    words = ["cc", *_FLAGS, f"-I{_RCL_HEADERS}", "-o", str(made), str(SOURCE), "-lm", "-pthread"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", timeout=_COMPILE_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchError(f"native programs: {error}") from None
    if done.returncode:
        found = [line for line in done.stderr.splitlines() if "error" in line] or ["cc failed"]
        raise BenchError(f"native programs: {found[0]}")
    return made


class _Form(Structure):
    _fields_ = (("at", c_int64), ("kind", c_uint32), ("size", c_uint32))


class _Message(Structure):
    _fields_ = (
        ("bytes", c_void_p),
        ("size", c_size_t),
        ("form", _Form),
        ("flips", c_void_p),
        ("crc", c_uint64),
        ("initial", c_uint8 * _INITIAL_SIZE),
        ("id_at", c_int64),
        ("id_flips", c_void_p),
    )


class _Out(Structure):
    _fields_ = (
        ("message", _Message),
        ("publisher", c_void_p),
        ("link", c_void_p),
        ("rate_hz", c_double),
        ("count", c_int64),
        ("offset_ns", c_int64),
        ("progress", c_void_p),
        ("window", c_int64),
        ("sent", POINTER(c_int64)),
        ("capacity", c_int64),
        ("done", c_int64),
        ("over", c_int64),
        ("news_ns", c_int64),
    )


class _In(Structure):
    _fields_ = (
        ("device", c_uint8 * _DEVICE_SIZE),
        ("subscription", c_void_p),
        ("form", _Form),
        ("forward", c_void_p),
        ("progress", c_void_p),
        ("numbers", POINTER(c_int64)),
        ("times", POINTER(c_int64)),
        ("capacity", c_int64),
        ("done", c_int64),
        ("first", c_void_p),
        ("first_size", c_size_t),
        ("knocked", c_int32),
    )


class Flag(ctypes.c_int32):
    """A flag that the loops look at."""

    def set(self, up: bool = True) -> None:
        self.value = int(up)


class OutStream:
    """A stream that is sent.

    Args:
        data: its message with number 0.
        form: where its number is.
        publisher: address of the rcl_publisher_t; 0: it is sent on ``link``.
        link: the connection.
    """

    def __init__(self, data: bytes, form: Form, *, publisher: int = 0, link: int = 0) -> None:
        self.data = np.frombuffer(data, np.uint8).copy()
        self._progress: memoryview | None = None
        # a message of OpenIGTLink whose number is in its body: the CRC changes with each
        in_body = not publisher and form.is_in_body
        self._flips = _crc_flips(self.data, form.place(data), form.size) if in_body else None
        self._id_flips = _crc_flips(self.data, ID_AT, 4) if in_body and form.has_id else None
        self.struct = _Out(publisher=publisher, link=link)
        message = self.struct.message
        message.bytes, message.size, message.form = self.data.ctypes.data, self.data.nbytes, _form(form)
        if self._flips is not None:
            message.flips = self._flips.ctypes.data
            message.crc = int.from_bytes(data[CRC], "big")
        if self._id_flips is not None:
            message.id_at, message.id_flips = ID_AT, self._id_flips.ctypes.data
        ctypes.memmove(message.initial, form.write(0), form.size)

    def pace(self, part: JobStream, offset_ns: int, progress: memoryview | None) -> None:
        """Send at the rate of a job; ``progress`` is the last received number, for a window."""
        self.struct.rate_hz, self.struct.count = part.stream.rate_hz, part.count
        self.struct.offset_ns, self.struct.window = offset_ns, part.window
        self._progress = progress  # its memory must not go before the loop has ended
        if progress is not None:
            self.struct.progress = ctypes.addressof(ctypes.c_int64.from_buffer(progress))

    def sent(self) -> npt.NDArray[np.int64]:
        """When each message was sent."""
        return _times(self.struct.sent, self.struct.done)


class InStream:
    """A stream that is received.

    Args:
        form: where its number is.
        device: of OpenIGTLink.
        subscription: address of the rcl_subscription_t.
        forward: send each message on there, with the same number.
        progress: where the last number is stored.
    """

    def __init__(
        self,
        form: Form,
        *,
        device: str = "",
        subscription: int = 0,
        forward: OutStream | None = None,
        progress: memoryview | None = None,
    ) -> None:
        self._kept = (forward, progress)
        self.struct = _In(form=_form(form), subscription=subscription)
        name = device.encode().ljust(_DEVICE_SIZE, b"\0")
        ctypes.memmove(self.struct.device, name, _DEVICE_SIZE)
        if forward is not None:
            self.struct.forward = ctypes.addressof(forward.struct)
        if progress is not None:
            self.struct.progress = ctypes.addressof(ctypes.c_int64.from_buffer(progress))

    @property
    def done(self) -> int:
        """How many have arrived."""
        return int(self.struct.done)

    def first(self) -> bytes | None:
        """The first message with number 0; None before it has arrived."""
        return ctypes.string_at(self.struct.first, self.struct.first_size) if self.struct.knocked else None

    def arrivals(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Numbers and times."""
        return _times(self.struct.numbers, self.done), _times(self.struct.times, self.done)


class Probe:
    """The loops.

    Args:
        library: what ``compile_probe`` has made.
        ros: rclpy is imported, and topics are used.
    """

    def __init__(self, library: Path, *, ros: bool) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.probe_link_new.restype = c_void_p
        if ros:
            rcl = ctypes.CDLL("librcl.so")
            functions = (c_void_p * len(_RCL))(*(ctypes.cast(getattr(rcl, name), c_void_p).value for name in _RCL))
            self._library.probe_use_rcl(functions)

    def link(self, descriptor: int) -> int:
        """A connection for ``OutStream``; -1: none yet."""
        return int(self._library.probe_link_new(c_int32(descriptor)))

    def set_link(self, link: int, descriptor: int) -> None:
        """Another connection instead; -1: none."""
        self._library.probe_link_set(c_void_p(link), c_int32(descriptor))

    def send_one(self, stream: OutStream, number: int) -> None:
        """Send a message now.  Raises BenchError."""
        _check("send", self._library.probe_send_one(ctypes.byref(stream.struct), c_int64(number)))

    def send(self, streams: list[OutStream], begin_ns: int, until_ns: int, stop: Flag) -> None:
        """Send all at their rates.  Raises BenchError."""
        pointers = _pointers(streams)
        code = self._library.probe_send(
            pointers, c_int32(len(streams)), c_int64(begin_ns), c_int64(until_ns), ctypes.byref(stop)
        )
        _check("send", code)

    def receive_link(self, descriptor: int, streams: list[InStream], pause: Flag) -> None:
        """Read a connection until its end.  Raises BenchError."""
        code = self._library.probe_receive_link(
            c_int32(descriptor), _pointers(streams), c_int32(len(streams)), ctypes.byref(pause)
        )
        _check("receive", code)

    def receive_ros(self, context: int, guard: int, streams: list[InStream], stop: Flag) -> None:
        """Take the messages of subscriptions until ``stop`` is set and then ``guard`` triggered.  Raises BenchError.

        Args:
            context: address of the rcl_context_t.
            guard: address of the rcl_guard_condition_t; each loop needs its own.
            streams: which.
            stop: see above.
        """
        pointers = _pointers(streams)
        code = self._library.probe_receive_ros(
            c_void_p(context), c_void_p(guard), pointers, c_int32(len(streams)), ctypes.byref(stop)
        )
        _check("receive", code)


def ros_bytes(made: Payload) -> bytes:
    """The ROS message with number 0."""
    return bytes(made.ros_maker()(0))


def igtl_bytes(made: Payload, device: str) -> bytes:
    """The OpenIGTLink message with number 0."""
    return bytes(made.igtl_maker(device)(0))


def _form(form: Form) -> _Form:
    return _Form(form.at, _LAYOUTS.index(form.layout), form.size)


def _crc_flips(data: npt.NDArray[np.uint8], place: int, size: int) -> npt.NDArray[np.uint64]:
    """Which bits of the CRC change with each bit of a number at this place."""
    body = data[HEADER_SIZE:].copy()
    at = place - HEADER_SIZE
    crc = crc64(body.data)
    flips = []
    for bit in range(8 * size):
        body[at + bit // 8] ^= 1 << bit % 8
        flips.append(crc ^ crc64(body.data))
        body[at + bit // 8] ^= 1 << bit % 8
    return np.array(flips, np.uint64)


def _pointers(streams: list[Any]) -> Any:
    return (c_void_p * len(streams))(*(ctypes.addressof(stream.struct) for stream in streams))


def _times(pointer: Any, count: int) -> npt.NDArray[np.int64]:
    return np.ctypeslib.as_array(pointer, (count,)).copy() if count else np.empty(0, np.int64)


def _check(what: str, code: int) -> None:
    if code:
        raise BenchError(f"native programs: {what} failed (code {code})")
