"""The keyboard of ``replay`` and ``bridge``: the keys of ``ros2 bag play``, and lines on standard input.

The terminal reports single keys without echo; its settings are restored at the end.  Ctrl-C stays a signal.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any

from igtl_gateway.base.clock import SystemClock

if sys.platform == "win32":
    import _thread
    import msvcrt
else:
    import termios

PAUSE, NEXT, FASTER, SLOWER, QUIT = "pause", "next", "faster", "slower", "quit"
RECORD = "record"

_KEYS = {
    b" ": PAUSE,
    b"\x1b[C": NEXT,
    b"\x1bOC": NEXT,
    b"\n": NEXT,
    b"\r": NEXT,
    b"s": NEXT,  # of rosbag in ROS 1
    b"\x1b[A": FASTER,
    b"\x1bOA": FASTER,
    b"\x1b[B": SLOWER,
    b"\x1bOB": SLOWER,
    b"q": QUIT,
    b"r": RECORD,
}
_LONGEST = max(map(len, _KEYS))
_LONGEST_TYPED = 4_400  # bytes of a line: more than any mark has
_POLL_DS = 1  # tenths of a second that a read waits for a key, so that the thread sees the end

HELP = "keys: space pause or resume, → next message while paused, ↑ ↓ rate, q quit"


def parse_keys(typed: bytes) -> tuple[list[str], bytes]:
    """Return the commands of the typed keys, and the bytes of an incomplete key."""
    found = []
    while typed:
        for key, command in _KEYS.items():
            if typed.startswith(key):
                found.append(command)
                typed = typed[len(key) :]
                break
        else:
            if len(typed) < _LONGEST and any(key.startswith(typed) for key in _KEYS):
                break
            typed = typed[1:]
    return found, typed


class LineInput:
    """A line of text that the user types after a key: Enter ends it, Escape drops it, Backspace and Ctrl-U take back.

    Args:
        key: what opens it.
        on_line: called with the text of each line that is not empty, and the time since the key, ns.
        show: called with the text so far, while it is typed, and with None at the end.
    """

    def __init__(self, key: bytes, on_line: Callable[[str, int], None], show: Callable[[str | None], None]) -> None:
        self.key = key
        self._on_line = on_line
        self._show = show
        self._typed: bytes | None = None
        self._clock = SystemClock()
        self._opened_ns = 0  # monotonic

    def take(self, typed: bytes) -> tuple[bytes, bytes, bool]:
        """Return the bytes before a line, those after it, and whether a line took the bytes in between."""
        if self._typed is not None:
            return b"", self._feed(typed), True
        before, key, after = typed.partition(self.key)
        if not key:
            return before, b"", False
        self._typed, self._opened_ns = b"", self._clock.monotonic_ns()
        self._show("")
        return before, self._feed(after), True

    def _feed(self, typed: bytes) -> bytes:
        """Add typed bytes to the line; return those after its end."""
        assert self._typed is not None
        for place, byte in enumerate(typed, start=1):
            key = bytes((byte,))
            if key in b"\r\n\x1b":
                text, self._typed = self._text(), None
                self._show(None)
                if text.strip() and key != b"\x1b":
                    self._on_line(text, self._clock.monotonic_ns() - self._opened_ns)
                return typed[place:]
            if key in b"\x7f\b":
                self._typed = self._text()[:-1].encode()
            elif key == b"\x15":
                self._typed = b""
            elif byte >= 0x20 and len(self._typed) < _LONGEST_TYPED:
                self._typed += key
        self._show(self._text())
        return b""

    def _text(self) -> str:
        return (self._typed or b"").decode("utf-8", "ignore")  # a character may have arrived in part


def _handle(typed: bytes, on_command: Callable[[str], None], line: LineInput | None) -> bytes:
    """Pass typed bytes on; return those of an incomplete key."""
    rest = b""
    while typed:
        before, typed, is_line = line.take(typed) if line else (typed, b"", False)
        found, rest = parse_keys(before)
        for command in found:
            on_command(command)
        if is_line:
            rest = b""
    return rest


def can_read_keys(stream: IO[Any] | None = None) -> bool:
    """Return whether keys can be read: from a terminal with this program in its foreground."""
    stream = stream or sys.stdin
    try:
        if sys.platform == "win32":
            return stream.isatty()
        return stream.isatty() and os.tcgetpgrp(stream.fileno()) == os.getpgrp()
    except (OSError, ValueError, AttributeError):
        return False


if sys.platform == "win32":
    #: Keys without a character come as two.
    _ARROWS = {"M": NEXT, "H": FASTER, "P": SLOWER}
    _FIRST_OF_TWO = ("\0", "\xe0")
    _INTERRUPT = "\x03"

    @contextmanager
    def keyboard(
        on_command: Callable[[str], None], stream: IO[Any] | None = None, line: LineInput | None = None
    ) -> Iterator[None]:
        """Context manager: a thread calls ``on_command`` for every key with a meaning; keys come from the console."""
        over = threading.Event()

        def read() -> None:
            while not over.wait(0 if msvcrt.kbhit() else _POLL_DS / 10):
                if not msvcrt.kbhit():
                    continue
                key = msvcrt.getwch()
                if key == _INTERRUPT:
                    _thread.interrupt_main()
                    continue
                if key not in _FIRST_OF_TWO:
                    _handle(key.encode("utf-8", "replace"), on_command, line)
                elif command := _ARROWS.get(msvcrt.getwch()):
                    on_command(command)

        reader = threading.Thread(target=read, name="igtl-keyboard", daemon=True)
        reader.start()
        try:
            yield
        finally:
            over.set()
            reader.join()

else:

    @contextmanager
    def keyboard(
        on_command: Callable[[str], None], stream: IO[Any] | None = None, line: LineInput | None = None
    ) -> Iterator[None]:
        """Context manager: a thread calls ``on_command`` for every key with a meaning; ``line`` takes its lines."""
        descriptor = (stream or sys.stdin).fileno()
        before = termios.tcgetattr(descriptor)
        raw = termios.tcgetattr(descriptor)
        raw[3] &= ~(termios.ICANON | termios.ECHO)
        raw[6][termios.VMIN], raw[6][termios.VTIME] = 0, _POLL_DS
        over = threading.Event()

        def read() -> None:
            rest = b""
            while not over.is_set():
                typed = os.read(descriptor, 64)
                # no more bytes arrived: the pending byte was a key by itself
                rest = _handle(rest + typed, on_command, line) if typed else b""

        reader = threading.Thread(target=read, name="igtl-keyboard", daemon=True)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, raw)
        try:
            reader.start()
            yield
        finally:
            over.set()
            reader.join()
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def read_lines(on_line: Callable[[], object], on_end: Callable[[], None], stream: IO[Any] | None = None) -> None:
    """Start a thread that calls ``on_line`` for every line of standard input, and ``on_end`` after the last."""
    # not by the stream's own reader: the interpreter cannot end while a thread waits inside that
    descriptor = (stream or sys.stdin).fileno()

    def read() -> None:
        begun = False
        while typed := os.read(descriptor, 4096):
            *lines, rest = typed.split(b"\n")
            for _ in lines:
                on_line()
            begun = bool(rest)
        if begun:
            on_line()
        on_end()

    threading.Thread(target=read, name="igtl-lines", daemon=True).start()
