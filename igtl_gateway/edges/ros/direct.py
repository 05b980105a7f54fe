"""Publishing bytes without rclpy's copies and guards, and, for pictures, without holding up other threads.

rclpy's publisher copies the bytes into a string of its own and holds the GIL all the while.  For large messages this
module calls ``rcl_publish_serialized_message``, which rclpy calls in the end, without a copy and with the GIL released:
a Full HD picture takes 4.3 ms instead of 6.4, and poses pass meanwhile.  (The C interface of rcl is the same in every
ROS 2 since Dashing.)  If rclpy or rcl are not as expected, rclpy's own publisher is used.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

from igtl_gateway.base.errors import RosError
from igtl_gateway.base.quantities import counted

#: ``rmw_fastrtps_cpp::get_datawriter`` and ``DataWriter::clear_history``, as C++ names them for the linker.
_WRITER_OF = "_ZN16rmw_fastrtps_cpp14get_datawriterEP15rmw_publisher_s"
_CLEAR = "_ZN8eprosima7fastdds3dds10DataWriter13clear_historyEPm"

#: From this size on a copy costs more than a call through ctypes, and other threads would notice the wait.
_LARGE_BYTES = 64 * 2**10


class RclPublisher(Protocol):
    """What is needed of an rclpy publisher."""

    def publish(self, msg: bytes, /) -> None: ...

    def get_subscription_count(self) -> int: ...

    def wait_for_all_acked(self, timeout: Any, /) -> bool: ...


@dataclass(frozen=True, slots=True)
class DirectPublisher:
    """The methods of a publisher, without the layers above them; see ``RclPublisher``.

    Attributes:
        pointer: address of the rcl_publisher_t; 0: unknown.
    """

    publish: Callable[[bytes], None]
    get_subscription_count: Callable[[], int]
    wait_for_all_acked: Callable[[Any], bool]
    pointer: int = 0


def direct_publisher(publisher: Any) -> RclPublisher:
    """Return the way into the middleware that rclpy's own publisher takes, without the guards around it.

    The guards keep a publisher from being destroyed while it is in use; without them its owner must ensure that
    (``TopicPublisher.close``).  A small message needs 12 µs instead of 14, after a pause 30 µs less.
    """
    handle: Any = getattr(publisher, "handle", None)
    if not (hasattr(handle, "publish_raw") and hasattr(handle, "get_subscription_count")):
        return publisher
    small, large = handle.publish_raw, _publish_large(getattr(handle, "pointer", 0))

    def publish(cdr: bytes) -> None:
        if len(cdr) < _LARGE_BYTES or large is None:
            small(cdr)
        else:
            large(cdr)

    pointer = getattr(handle, "pointer", 0)
    return DirectPublisher(publish, handle.get_subscription_count, publisher.wait_for_all_acked, pointer)


def refusing_publisher(cause: str) -> RclPublisher:
    """Return a publisher that refuses all messages, in place of one that is not made yet, or about to be destroyed."""

    def refuse(*_: Any) -> Any:
        raise RosError(cause)

    return DirectPublisher(refuse, int, refuse)


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t: never called, because nothing is resized."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero", "state"))


class _Serialized(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = (
        ("buffer", ctypes.c_char_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


class Rcl:
    """Functions of the rcl that rclpy has loaded.  Raises OSError or AttributeError for what cannot be found."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL("librcl.so")

    def function(self, name: str) -> Any:
        """Return a function for calls from Python."""
        return getattr(self._library, name)

    def address(self, name: str) -> int:
        """Return the address of a function, for the native passage."""
        return ctypes.cast(self.function(name), ctypes.c_void_p).value or 0


@cache
def _rcl_publish() -> Any:
    """Return ``rcl_publish_serialized_message``; None if it cannot be found."""
    try:
        function = Rcl().function("rcl_publish_serialized_message")
    except (OSError, AttributeError):
        return None
    function.argtypes = (ctypes.c_void_p, ctypes.POINTER(_Serialized), ctypes.c_void_p)
    function.restype = ctypes.c_int
    return function


def _publish_large(pointer: int) -> Callable[[bytes], None] | None:
    """Return what publishes bytes without a copy, by the rcl_publisher_t at ``pointer``; None without rcl."""
    rcl_publish = _rcl_publish()
    if not pointer or rcl_publish is None:
        return None

    def publish(cdr: bytes) -> None:
        message = _Serialized(cdr, len(cdr), len(cdr))
        code = rcl_publish(pointer, ctypes.byref(message), None)
        if code:
            raise RosError(f"rcl refused a message of {counted(len(cdr), 'byte')} (code {code})")

    return publish


def clear_history(publisher: RclPublisher) -> bool:
    """Have the middleware forget the last messages of a publisher, which late joiners would get; False: it cannot.

    ROS has no function for that.  Fast DDS has one, which needs no new publisher: subscribers stay matched.
    """
    pointer, functions = getattr(publisher, "pointer", 0), _history_functions()
    if not pointer or functions is None:
        return False
    handle_of, writer_of, clear = functions
    writer = writer_of(handle_of(pointer))
    return bool(writer) and clear(writer, None) == 0


@cache
def _history_functions() -> tuple[Any, Any, Any] | None:
    """Return what finds the rmw_publisher_t and the writer of Fast DDS, and clears it; None without one of them."""
    try:
        handle_of = Rcl().function("rcl_publisher_get_rmw_handle")
        rmw = ctypes.CDLL("librmw_fastrtps_cpp.so", mode=os.RTLD_NOLOAD | os.RTLD_NOW)
        writer_of, clear = rmw[_WRITER_OF], rmw[_CLEAR]
    except (OSError, AttributeError):
        return None
    for function in (handle_of, writer_of):
        function.argtypes, function.restype = (ctypes.c_void_p,), ctypes.c_void_p
    clear.argtypes, clear.restype = (ctypes.c_void_p, ctypes.c_void_p), ctypes.c_int
    return handle_of, writer_of, clear
