"""Signals: which of them end a program, and how they reach a thread."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

if sys.platform == "win32":
    import socket

    from igtl_gateway.base.clock import process_ns

    #: What asks a program to end: Ctrl-C, Ctrl-Break, and the end of the session.
    ENDINGS: tuple[signal.Signals, ...] = (signal.SIGINT, signal.SIGBREAK, signal.SIGTERM)
    #: What the start of a program in the background may have ignored: nothing.
    KEPT_IGNORED: tuple[signal.Signals, ...] = ()
    #: What ends a whole group of processes at once, because one of them hangs: nothing.
    _OF_A_GROUP: tuple[signal.Signals, ...] = ()
    #: What saves a snapshot, and what pauses and resumes a recording: there are no signals for that.
    SAVE: signal.Signals | None = None
    PAUSE: signal.Signals | None = None
else:
    #: What asks a program to end: Ctrl-C, a service manager, the end of the terminal.
    ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    #: What the start of a program in the background may have ignored (nohup): it stays ignored.
    KEPT_IGNORED = (signal.SIGHUP,)
    #: What ends a whole group of processes at once, because one of them hangs: the watchdog of systemd, Ctrl-\\.
    _OF_A_GROUP = (signal.SIGABRT, signal.SIGQUIT)
    SAVE = signal.SIGUSR1
    PAUSE = signal.SIGUSR2


_NS_PER_S = 1_000_000_000
#: Of a timer: beyond it, its function looks again.
_LONGEST_NS = 1_000_000 * _NS_PER_S
_WATCH_S = 0.1
#: CPU time between two signals of a timer whose first one has come.
_REPEATED_S = 1.0


def ignore_endings() -> None:
    """Ignore what ends programs: another process decides when this one ends."""
    for number in (*ENDINGS, *_OF_A_GROUP):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def endings_interrupt() -> Iterator[None]:
    """Context manager: what asks a program to end raises KeyboardInterrupt, as Ctrl-C does, so that it can tidy up.

    Signals that are ignored, and those of a program that has its own handlers, stay as they are.
    """

    def on_signal(_number: int, _frame: Any) -> None:
        raise KeyboardInterrupt

    ours = threading.current_thread() is threading.main_thread()
    numbers = [number for number in ENDINGS if ours and signal.getsignal(number) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def endings_held() -> Iterator[Callable[[], None]]:
    """Context manager: what asks a program to end waits for a good moment: the call of the value, or the end of it.

    A handler that raises does so between any two steps of the main thread, such as after a lock was taken and before
    the block that releases it: the next to wait for that lock waits forever, and a process that was just started is
    not known yet.  Here its handler runs at that moment instead.
    """
    came: list[int] = []

    def on_signal(number: int, _frame: Any) -> None:
        came.append(number)

    ours = threading.current_thread() is threading.main_thread()
    before = {number: handler for number in ENDINGS if ours and callable(handler := signal.getsignal(number))}

    def look() -> None:
        if came:
            number = came[0]
            came.clear()  # one is enough: timeout(1) sends two
            before[signal.Signals(number)](number, None)

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield look
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        look()


@contextmanager
def endings_noted() -> Iterator[Callable[[], bool]]:
    """Context manager: what asks a program to end is noted, and the value returns whether it came.

    It is for work that looks often and tidies up by itself, whatever handlers the program has.  At the end of the block
    the signal has its usual effect; KeyboardInterrupt is raised where its handler raises nothing.  Threads other than
    the main one note nothing.
    """
    came: list[int] = []

    def on_signal(number: int, _frame: Any) -> None:
        came.append(number)

    ours = threading.current_thread() is threading.main_thread()
    usual = {number: signal.getsignal(number) for number in ENDINGS if ours}
    before = {number: handler for number, handler in usual.items() if handler not in (None, signal.SIG_IGN)}
    for number in before:
        signal.signal(number, on_signal)
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(came[0])
            raise KeyboardInterrupt from None  # one traceback, also if the work has raised it


@contextmanager
def cpu_alarm(look: Callable[[], int], first_ns: int, again_ns: int) -> Iterator[None]:
    """Context manager: call a function in the main thread when the process has used CPU time; nothing in other threads.

    Args:
        look: returns the CPU time until its next call, ns; it may raise.
        first_ns: CPU time until its first call, ns.
        again_ns: CPU time until its next call where it raises, ns.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(_number: int, _frame: Any) -> None:
        start(again_ns)
        start(look())

    start, end, number = _cpu_timer()
    before = signal.signal(number, on_signal)
    start(first_ns)
    try:
        yield
    finally:
        end()
        signal.signal(number, before)


@contextmanager
def signals_in_thread(
    actions: Mapping[signal.Signals, Callable[[], None]], name: str, *, once: bool = False
) -> Iterator[None]:
    """Context manager: a thread does the action of each signal, and the main thread waits for none.

    A handler runs in the main thread, perhaps while that holds the lock which the action needs: there it would wait
    forever.  On Windows it does not even run while the main thread waits for a lock, so the system itself
    wakes the thread there.

    Args:
        actions: signal → action.
        name: of the thread.
        once: the second signal of a kind has the system's own effect.
    """
    if not actions:
        yield
        return
    read, write, close = _channel()

    def watch() -> None:
        while (number := read()) != b"\0":
            if number and number[0] in actions:
                actions[signal.Signals(number[0])]()

    def on_signal(number: int, _frame: Any) -> None:
        if sys.platform != "win32":  # there the system has written it already
            write(bytes([number]))
        if once:
            signal.signal(number, signal.SIG_DFL)

    watcher = threading.Thread(target=watch, name=name, daemon=True)
    watcher.start()
    before = {number: signal.signal(number, on_signal) for number in actions}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        write(b"\0")
        watcher.join()
        close()


if sys.platform == "win32":

    def _cpu_timer() -> tuple[Callable[[int], object], Callable[[], object], signal.Signals]:
        """Return functions that start and end a timer of CPU time (ns), and its signal.  No timer of the system counts
        that there: a thread looks.
        """
        over, due_ns = threading.Event(), [0]

        def watch() -> None:
            while not over.wait(_WATCH_S):
                if process_ns() >= due_ns[0]:
                    signal.raise_signal(signal.SIGBREAK)

        def start(left_ns: int) -> None:
            due_ns[0] = process_ns() + left_ns

        def end() -> None:
            over.set()
            watcher.join()

        start(_LONGEST_NS)
        watcher = threading.Thread(target=watch, name="igtl-cpu-time", daemon=True)
        watcher.start()
        return start, end, signal.SIGBREAK

    def _channel() -> tuple[Callable[[], bytes], Callable[[bytes], object], Callable[[], None]]:
        """Return functions that read a byte, write one, and close; the system writes the numbers of signals to it."""
        reader, writer = socket.socketpair()
        writer.setblocking(False)
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

        def close() -> None:
            signal.set_wakeup_fd(before)
            reader.close()
            writer.close()

        return lambda: reader.recv(1), writer.send, close

else:

    def _cpu_timer() -> tuple[Callable[[int], object], Callable[[], object], signal.Signals]:
        """Return functions that start and end a timer of CPU time (ns), and its signal."""

        def start(left_ns: int) -> None:
            # Repeated: the main thread can overlook a signal that another thread gets while it looks for those before.
            signal.setitimer(signal.ITIMER_PROF, min(left_ns, _LONGEST_NS) / _NS_PER_S, _REPEATED_S)

        return start, lambda: signal.setitimer(signal.ITIMER_PROF, 0), signal.SIGPROF

    def _channel() -> tuple[Callable[[], bytes], Callable[[bytes], object], Callable[[], None]]:
        """Return functions that read a byte, write one, and close."""
        reader, writer = os.pipe()

        def close() -> None:
            os.close(reader)
            os.close(writer)

        return lambda: os.read(reader, 1), lambda data: os.write(writer, data), close
