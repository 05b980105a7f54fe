"""Waiting for a change of the ROS graph, instead of looking at it again and again.

rcl has a guard condition that the middleware triggers whenever a node, a publisher or a subscription comes or goes.
rclpy does not pass it on, so this module waits for it with rcl's own wait set, through ctypes: with the GIL released,
in the thread of the caller.  Where rclpy or rcl are not as expected the caller has to look by itself.
"""

from __future__ import annotations

import ctypes
import threading
from functools import cache
from typing import Any, Protocol

from igtl_gateway.base.stamp import NS_PER_S

_POINTER, _SIZE = ctypes.c_void_p, ctypes.c_size_t
_WAITED = (0, 2)  # RCL_RET_OK, RCL_RET_TIMEOUT
_REFUSED_S = 0.05  # after a wait that rcl refuses: the next one might be refused as quickly


class GraphWatch(Protocol):
    """Where one thread waits, until the graph changes or another thread wakes it.

    Attributes:
        sees_changes: whether `wait` notices changes; if not, the caller looks at the graph by itself.
    """

    sees_changes: bool

    def wait(self, timeout_ns: int) -> bool:
        """Wait for a change, for `wake`, or for ``timeout_ns``; return whether the graph has changed."""
        ...

    def wake(self) -> None:
        """End the wait, or the next one at once; from any thread."""
        ...

    def close(self) -> None:
        """Free what the waits need; `wake` does nothing from here on."""
        ...


def watch_graph(rclpy: Any, context: Any, node: Any) -> GraphWatch:
    """Return what waits for the graph of an rclpy node."""
    rcl = _rcl()
    own = rclpy.guard_condition.GuardCondition(None, None, context=context)
    handles = (context.handle, node.handle, own.handle)
    if rcl is None or not all(hasattr(handle, "pointer") for handle in handles):
        own.destroy()
        return BlindWatch()
    watch = RclGraphWatch(rcl, context, node, own)
    if watch.is_open:
        return watch
    watch.close()
    return BlindWatch()


class BlindWatch:
    """Waits for `wake` only."""

    sees_changes = False

    def __init__(self) -> None:
        self._event = threading.Event()

    def wait(self, timeout_ns: int) -> bool:
        self._event.wait(timeout_ns / NS_PER_S)
        self._event.clear()
        return False

    def wake(self) -> None:
        self._event.set()

    def close(self) -> None:
        """There is nothing to free."""


class _WaitSet(ctypes.Structure):
    """rcl_wait_set_t: for each kind of entity an array and its size, and what the middleware has."""

    _fields_ = (
        *(
            (name, kind)
            for entity in ("subscriptions", "guards", "timers", "clients", "services", "events")
            for name, kind in ((entity, ctypes.POINTER(_POINTER)), (f"{entity}_size", _SIZE))
        ),
        ("rest", _POINTER),
    )


class _Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = tuple((name, _POINTER) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state"))


class RclGraphWatch:
    """A wait set of rcl with two guard conditions: that of the graph, and our own for `wake`.

    Args:
        rcl: the library.
        context, node: of rclpy; both live until `close`.
        own: our guard condition, an rclpy object.

    Attributes:
        is_open: whether rcl accepted all of it.
    """

    sees_changes = True

    def __init__(self, rcl: Any, context: Any, node: Any, own: Any) -> None:
        self._rcl = rcl
        self._own: Any = own
        self._never = threading.Event()
        self._lock = threading.Lock()  # keeps our guard condition while another thread triggers it
        self._graph = rcl.rcl_node_get_graph_guard_condition(node.handle.pointer)
        self._set = rcl.rcl_get_zero_initialized_wait_set()
        sizes = (0, 2, 0, 0, 0, 0)  # guard conditions only
        allocator = rcl.rcutils_get_default_allocator()
        done = rcl.rcl_wait_set_init(ctypes.byref(self._set), *sizes, context.handle.pointer, allocator)
        self.is_open = done == 0 and bool(self._graph)

    def wait(self, timeout_ns: int) -> bool:
        rcl, place = self._rcl, ctypes.byref(self._set)
        rcl.rcl_wait_set_clear(place)
        rcl.rcl_wait_set_add_guard_condition(place, self._own.handle.pointer, None)
        rcl.rcl_wait_set_add_guard_condition(place, self._graph, None)
        code = rcl.rcl_wait(place, max(0, timeout_ns))
        if code not in _WAITED:  # the context is shut down: there is no change to wait for, and no wait to end
            self._never.wait(_REFUSED_S)
            return False
        return bool(self._set.guards[1])  # what was not triggered is set to NULL

    def wake(self) -> None:
        with self._lock:
            if self._own is not None:
                self._own.trigger()

    def close(self) -> None:
        self.is_open = False
        self._rcl.rcl_wait_set_fini(ctypes.byref(self._set))
        with self._lock:
            own, self._own = self._own, None
        if own is not None:
            own.destroy()


@cache
def _rcl() -> Any:
    """Return the rcl that rclpy has loaded, with the types of its functions; None if it cannot be found."""
    try:
        rcl = ctypes.CDLL("librcl.so")
        rcl.rcl_node_get_graph_guard_condition.argtypes = (_POINTER,)
        rcl.rcl_node_get_graph_guard_condition.restype = _POINTER
        rcl.rcl_get_zero_initialized_wait_set.restype = _WaitSet
        rcl.rcutils_get_default_allocator.restype = _Allocator
        rcl.rcl_wait_set_init.argtypes = (_POINTER, *[_SIZE] * 6, _POINTER, _Allocator)
        rcl.rcl_wait_set_clear.argtypes = (_POINTER,)
        rcl.rcl_wait_set_add_guard_condition.argtypes = (_POINTER, _POINTER, _POINTER)
        rcl.rcl_wait.argtypes = (_POINTER, ctypes.c_int64)
        rcl.rcl_wait_set_fini.argtypes = (_POINTER,)
    except (OSError, AttributeError):
        return None
    return rcl
