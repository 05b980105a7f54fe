"""The recording of ``bridge``: its options, and the keys and signals that control it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from igtl_gateway.app.recording import pause, resume, snapshot
from igtl_gateway.cli.keys import NEXT, PAUSE, can_read_keys, keyboard
from igtl_gateway.cli.options import Options
from igtl_gateway.cli.settings import add_settings

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder


def add_arguments(group: Options) -> None:
    """Options of a recording."""
    add_settings(group, "record", "overwrite", "file_mode")
    add_settings(group, "record_topics", words=True)
    add_settings(group, "record_all")
    add_settings(group, "record_include", "record_exclude", "custom_data", words=True)
    add_settings(group, "compression", "flush_interval", "fsync", "split_size", "split_duration", "snapshot")
    add_settings(group, "seal", "retention", "upload", "upload_rate", "on_record_failure")


@contextmanager
def recording_controls(recorder: Recorder | None) -> Iterator[str]:
    """Context manager: keys and signals control the recorder.  Yields a line that names them, or ""."""
    with ExitStack() as stack:
        if recorder is None:
            yield ""
            return
        snapshots = recorder.options.snapshot_s > 0

        def toggle() -> None:
            (resume if recorder.paused else pause)(recorder)

        def save() -> None:
            snapshot(recorder)  # a note reports the result

        actions = {signal.SIGUSR1: save} if snapshots else {signal.SIGUSR2: toggle}
        stack.enter_context(_signals(actions))
        keys = can_read_keys()
        if keys:
            # key s means "next message" in a replay
            bound = {NEXT: save} if snapshots else {PAUSE: toggle}
            stack.enter_context(keyboard(lambda command: bound.get(command, _nothing)()))
        if snapshots:
            yield f"{'key s or ' if keys else ''}SIGUSR1 saves the last {recorder.options.snapshot_s:g} s"
        else:
            yield f"{'space or ' if keys else ''}SIGUSR2 pauses and resumes" if keys else ""


def _nothing() -> None:
    """Ignore another key."""


@contextmanager
def _signals(actions: dict[signal.Signals, Callable[[], None]]) -> Iterator[None]:
    """Context manager that handles signals in a thread: in a handler, this thread might itself hold the lock needed."""
    reader, writer = os.pipe()
    numbers = {bytes([number]): action for number, action in actions.items()}

    def watch() -> None:
        while (number := os.read(reader, 1)) in numbers:
            numbers[number]()

    watcher = threading.Thread(target=watch, name="igtl-steering", daemon=True)
    watcher.start()
    before = {
        number: signal.signal(number, lambda number, _frame: os.write(writer, bytes([number])) and None)
        for number in actions
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(writer, b"\0")
        watcher.join()
        os.close(reader)
        os.close(writer)
