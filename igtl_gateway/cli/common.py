"""What several verbs share: the configuration, numbers for people, the end of the program by signal."""

from __future__ import annotations

import shlex
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.signals import ENDINGS, KEPT_IGNORED, signals_in_thread
from igtl_gateway.cli.terminal import print_line

if TYPE_CHECKING:
    from igtl_gateway.config.configuration import Config

_NS_PER_MS = 1_000_000


def load_config(path: Path | None) -> Config:
    """The configuration of a file, or the default one."""
    from igtl_gateway.config.configuration import Config  # here: it imports all conversions

    return Config.from_toml(path) if path else Config()


@contextmanager
def stop_event() -> Iterator[threading.Event]:
    """An event that SIGINT (Ctrl-C), SIGTERM and SIGHUP set; a second signal ends the program the hard way.

    On Windows Ctrl-C and Ctrl-Break set it.  A thread sets it: see :func:`signals_in_thread`.
    """
    event = threading.Event()
    numbers = [
        number
        for number in ENDINGS
        if number not in KEPT_IGNORED or signal.getsignal(number) is not signal.SIG_IGN  # nohup: the terminal may go
    ]
    with signals_in_thread(dict.fromkeys(numbers, event.set), "igtl-signals", once=True):
        yield event


def print_damaged_indexes(path: Path, chunks: int) -> None:
    """Print that something around chunks is damaged, and the remedy; nothing if nothing is."""
    if chunks:
        print_line(
            f"DAMAGED: the index of messages of {count_text(chunks, 'chunk')}, or schemas and channels before it: all "
            "messages are there, but programs that use these may miss some; run: igtl-gateway recover "
            f"{shlex.quote(str(path))}"
        )


def utc_text(stamp_ns: int) -> str:
    """UTC nanoseconds for people, to the millisecond: ``2026-11-22T18:00:00.250Z``; otherwise the number itself."""
    try:
        moment = datetime.fromtimestamp(stamp_ns // NS_PER_S, timezone.utc)
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns} ns"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{stamp_ns % NS_PER_S // _NS_PER_MS:03}Z"
