"""Turns and faults of the direct receiver, on a stand-in for rclpy's wait set (`test_ros.py` has the real one).

Also the memory of messages that C takes (`_owned.h`), on a stand-in for rcl.
"""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import shlex
import subprocess
import sysconfig
import threading
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.edges.ros.receiver import DirectReceiver
from tests.places import ROOT
from tests.timing import WAIT_S


class Subscription:
    """A queue of messages; also its own handle."""

    pointer = 0

    def __init__(self, queued: list[str], callback: Callable[..., None], fails: bool = False) -> None:
        self.queue = deque(queued)
        self.callback = callback
        self.msg_type = str
        self.handle = self
        self.fails = fails
        self.event_handlers: list[Event] = []
        self.pointer = id(self)

    def take_message(self, _message_type: Any, _raw: bool) -> tuple[str, None] | None:
        if self.fails:
            self.queue.clear()
            raise RuntimeError("the middleware refuses")
        return (self.queue.popleft(), None) if self.queue else None


class Event:
    """A QoS event with its callback, as rclpy's EventHandler: gives its state only after it is marked as ready."""

    def __init__(self, total_count_change: int) -> None:
        self._ready_to_take_data = False
        self.state = SimpleNamespace(total_count_change=total_count_change)
        self.called: list[Any] = []
        self.callback = self.called.append

    def take_data(self) -> Any:
        ready, self._ready_to_take_data = self._ready_to_take_data, False
        return self.state if ready else None


class Context(threading.Event):
    """The event is what the guard condition triggers."""

    handle = None


class Guard:
    def __init__(self, *_: Any, context: Any) -> None:
        self.handle = context
        self.event = context

    def trigger(self) -> None:
        self.event.set()

    def destroy(self) -> None:
        self.event.clear()


class WaitSet:
    """Level-triggered as the real one: returns at once while there are messages, else at the guard condition."""

    def __init__(self, *sizes: Any) -> None:
        self.room = sizes[0]
        self.entries: list[Subscription] = []
        self.ready: list[int] = []

    def clear_entities(self) -> None:
        self.entries = []

    def add_guard_condition(self, handle: threading.Event) -> None:
        self.guard = handle

    def add_subscription(self, handle: Subscription) -> None:
        self.entries.append(handle)
        assert len(self.entries) <= self.room

    def wait(self, _timeout_ns: int) -> None:
        if not any(entry.queue for entry in self.entries):
            assert self.guard.wait(WAIT_S)
        self.guard.clear()
        self.ready = [entry.pointer for entry in self.entries if entry.queue]

    def get_ready_entities(self, _kind: str) -> list[int]:
        return self.ready


def stand_in(wait_set: type = WaitSet) -> Any:
    implementation = SimpleNamespace(WaitSet=wait_set, Subscription=Subscription)
    return SimpleNamespace(
        guard_condition=SimpleNamespace(GuardCondition=Guard),
        impl=SimpleNamespace(implementation_singleton=SimpleNamespace(rclpy_implementation=implementation)),
    )


class Log:
    def __init__(self, last: str) -> None:
        self.lines: list[str] = []
        self.errors: list[str] = []
        self.last = last
        self.done = threading.Event()

    def __call__(self, message: str, _info: None) -> None:
        self.lines.append(message)
        if message == self.last:
            self.done.set()

    def receiver(self) -> DirectReceiver:
        return DirectReceiver(stand_in(), Context(), lambda error: self.errors.append(str(error)))


def test_every_topic_comes_to_its_turn_and_keeps_its_order() -> None:
    log = Log(last="a499")
    busy = [f"a{number}" for number in range(500)]
    receiver = log.receiver()
    receiver.add(Subscription(busy, log))
    receiver.add(Subscription(["b0", "b1"], log))
    receiver.start()
    assert log.done.wait(WAIT_S)
    receiver.stop()
    assert [line for line in log.lines if line[0] == "a"] == busy
    assert log.lines.index("b1") < 100


def test_subscription_may_be_added_while_it_waits() -> None:
    log = Log(last="late")
    receiver = log.receiver()
    receiver.start()
    receiver.add(Subscription(["late"], log))
    assert log.done.wait(WAIT_S)
    receiver.stop()


def test_refusal_of_one_topic_is_reported_and_the_others_go_on() -> None:
    log = Log(last="good")
    receiver = log.receiver()
    receiver.add(Subscription(["x"], log, fails=True))
    receiver.add(Subscription(["good"], log))
    receiver.start()
    assert log.done.wait(WAIT_S)
    receiver.stop()
    assert (log.lines, log.errors) == (["good"], ["the middleware refuses"])


def test_events_are_polled_and_only_news_are_told() -> None:
    receiver = Log(last="").receiver()
    subscription = Subscription([], print)
    news, none = Event(2), Event(0)
    subscription.event_handlers = [news, none]
    receiver.add(subscription)
    receiver.poll_events()
    assert (news.called, none.called) == ([news.state], [])


def test_no_executor_waits_for_subscriptions_or_their_events() -> None:
    group = Log(last="").receiver().group
    assert not group.can_execute(Subscription([], print)) and not group.can_execute(Event(1))


def test_missing_internals_are_seen() -> None:
    assert DirectReceiver.available(stand_in())
    assert not DirectReceiver.available(stand_in(wait_set=type("WaitSet", (), {})))


# The memory of taken messages

_MODULE = """
#define PY_SSIZE_T_CLEAN
#include "python/_owned.h"

static PyObject *take(PyObject *module, PyObject *args)
{
    static struct rcl_serialized memory;
    unsigned long long address;
    (void)module;
    if (!PyArg_ParseTuple(args, "K", &address))
        return NULL;
    memory.allocator = TAKE_ALLOCATOR;
    struct rcl_message_info info = {0};
    int32_t code = ((rcl_take_function)(uintptr_t)address)(NULL, &memory, &info, NULL);
    if (code == RCL_RET_SUBSCRIPTION_TAKE_FAILED)
        Py_RETURN_NONE;
    if (code != RCL_RET_OK)
        return PyErr_Format(PyExc_RuntimeError, "rcl cannot take a message (code %d)", (int)code);
    return Py_BuildValue("NLK", python_bytes(&memory), (long long)info.source_ns,
                         (unsigned long long)info.publication_number);
}

static PyMethodDef functions[] = {{"take", take, METH_VARARGS, ""}, {NULL, NULL, 0, NULL}};
static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "taking", "", -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit_taking(void) { return begin_owned() ? NULL : PyModule_Create(&definition); }
"""


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Any]:
    """Return a function that takes a message, with the address of the function of rcl as its argument."""
    folder = tmp_path_factory.mktemp("take")
    source, target = folder / "taking.c", folder / "taking.so"
    source.write_text(_MODULE)
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    includes = [f"-I{sysconfig.get_path('include')}", f"-I{ROOT / 'igtl_gateway' / 'native' / 'passage'}"]
    warnings = ["-Wall", "-Wextra", "-Wno-unused-variable", "-Werror"]
    command = [compiler, "-shared", "-fPIC", *warnings, *includes, "-o", str(target), str(source)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except OSError:
        pytest.skip("needs a C compiler")
    spec = importlib.util.spec_from_file_location("taking", target)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    function: Callable[[int], Any] = module.take
    return function


_REALLOCATE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)


class Serialized(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = (
        *((name, ctypes.c_size_t) for name in ("buffer", "length", "capacity")),
        *((name, ctypes.c_void_p) for name in ("allocate", "deallocate")),
        ("reallocate", _REALLOCATE),
        *((name, ctypes.c_void_p) for name in ("zero_allocate", "state")),
    )


class Info(ctypes.Structure):
    """rmw_message_info_t up to the publication number."""

    _fields_ = (("source_ns", ctypes.c_int64), ("received_ns", ctypes.c_int64), ("number", ctypes.c_uint64))


class Rcl:
    """A stand-in for rcl with messages to take, and the code of an error to return after the last one."""

    def __init__(self, *messages: bytes, code: int = 401) -> None:
        self.messages = deque(messages)
        self.code = code
        pointer = ctypes.POINTER
        kind = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, pointer(Serialized), pointer(Info), ctypes.c_void_p)
        self._function = kind(self._take)
        self.address = ctypes.cast(self._function, ctypes.c_void_p).value or 0

    def _take(self, _subscription: int | None, message: Any, info: Any, _allocation: int | None) -> int:
        if not self.messages:
            return self.code
        data, one = self.messages.popleft(), message[0]
        if one.capacity < len(data):
            one.buffer = one.reallocate(one.buffer, len(data), one.state)
            one.capacity = len(data)
        one.length = len(data)
        ctypes.memmove(one.buffer, data, len(data))
        info[0].source_ns, info[0].number = 1_700_000_000_000_000_000, 10**10 + len(self.messages)
        return 0


def test_small_messages_are_bytes_and_large_ones_views(take: Callable[[int], Any]) -> None:
    messages = [b"small", b"a" * 100_000, b"", b"b" * 16_383, b"c" * 16_384, b"d" * 1_000_000]
    rcl = Rcl(*messages)
    taken = [take(rcl.address) for _ in messages]
    assert take(rcl.address) is None
    gc.collect()
    assert [bytes(cdr) for cdr, _, _ in taken] == messages
    assert [type(cdr) for cdr, _, _ in taken] == [bytes, memoryview, bytes, bytes, memoryview, memoryview]
    assert {source_ns for _, source_ns, _ in taken} == {1_700_000_000_000_000_000}
    assert [number - 10**10 for _, _, number in taken] == [5, 4, 3, 2, 1, 0]


def test_a_view_is_read_only_and_keeps_the_memory(take: Callable[[int], Any]) -> None:
    cdr = take(Rcl(b"x" * 50_000 + b"end").address)[0]
    assert cdr.readonly and cdr.format == "B" and cdr.c_contiguous
    end = cdr[-3:]
    del cdr
    gc.collect()
    take(Rcl(b"y" * 50_003).address)
    assert bytes(end) == b"end"


def test_rcl_refuses(take: Callable[[int], Any]) -> None:
    with pytest.raises(RuntimeError, match=r"rcl cannot take a message \(code 1\)"):
        take(Rcl(code=1).address)
