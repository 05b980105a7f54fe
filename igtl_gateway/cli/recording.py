"""How ``bridge`` records: its options, and how a person or a script steers a recording that is under way."""

from __future__ import annotations

import argparse
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from igtl_gateway.app.recording import pause, resume, snapshot
from igtl_gateway.cli.keys import NEXT, PAUSE, can_read_keys, keyboard
from igtl_gateway.errors import ConfigError
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import Selection

#: Options that mean nothing without a file, with what they are without being given.
_OF_A_RECORDING: dict[str, Any] = {
    "record_topics": [],
    "record_all": False,
    "record_include": [],
    "record_exclude": [],
    "custom_data": [],
    "split_size": 0,
    "split_duration": 0.0,
    "snapshot": 0.0,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All but ``--record`` itself."""
    given = RecordOptions()
    globs = parser.add_argument_group("recording").add_argument
    globs(
        "--record-topics",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help="record these ROS topics too, besides those that are bridged (* one level, ** any)",
    )
    globs("--record-all", action="store_true", help="record all ROS topics")
    globs(
        "--record-include",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help="record only what comes in on these streams (TYPE/device, device or topic) and what follows from it",
    )
    globs(
        "--record-exclude",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help="do not record what comes in on these streams, nor what follows from it",
    )
    globs(
        "--custom-data",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="say this in the recording, too: operator=Kim, phantom=B",
    )
    globs("--overwrite", action="store_true", help="replace an existing recording")
    globs(
        "--compression",
        choices=("none", "lz4", "zstd"),
        default=given.compression,
        help="of chunks (%(default)s, which rests where nothing gets smaller)",
    )
    globs(
        "--flush-interval",
        type=float,
        default=given.flush_s,
        metavar="S",
        help="what a loss of power may cost (%(default)s s); a crash of the bridge alone costs nothing",
    )
    globs(
        "--fsync",
        choices=("never", "flush", "close"),
        default=given.fsync,
        help="when the disk itself has what is written, against loss of power: with each flush, or at the end "
        "(%(default)s)",
    )
    globs("--split-size", type=int, default=0, metavar="MIB", help="begin a new file after so many MiB")
    globs("--split-duration", type=float, default=0.0, metavar="S", help="begin a new file after so many seconds")
    globs(
        "--snapshot",
        type=float,
        default=0.0,
        metavar="S",
        help="keep the last S seconds in memory only; key s, SIGUSR1 or the service ~/snapshot writes them to "
        "FILE_<UTC time>.mcap",
    )
    globs(
        "--on-record-failure",
        choices=("continue", "stop"),
        default="continue",
        help="what the bridge does when the recording fails, as on a full disk (%(default)s)",
    )


def record_options(options: argparse.Namespace) -> RecordOptions:
    """What the command line says.  Raises ConfigError."""
    if not options.record:
        given = [name for name, nothing in _OF_A_RECORDING.items() if getattr(options, name) != nothing]
        if given:
            names = " and ".join(f"--{name.replace('_', '-')}" for name in given)
            raise ConfigError(f"{names}: about a recording, but --record FILE is missing")
    for name in ("flush_interval", "split_size", "split_duration", "snapshot"):
        value = getattr(options, name)
        if not 0 <= value < float("inf"):
            raise ConfigError(f"--{name.replace('_', '-')}: found {value:g}, expected a number from 0 up")
    if options.snapshot and (options.split_size or options.split_duration):
        raise ConfigError("--snapshot keeps what it has in memory: there is nothing to split")
    custom = [text.partition("=") for text in options.custom_data]
    for key, equals, _ in custom:
        if not (key and equals):
            raise ConfigError(f"--custom-data: found {key + equals!r}, expected KEY=VALUE")
    return RecordOptions(
        compression=options.compression,
        flush_s=options.flush_interval,
        fsync=options.fsync,
        split_bytes=options.split_size << 20,
        split_s=options.split_duration,
        snapshot_s=options.snapshot,
        selection=Selection(tuple(options.record_include), tuple(options.record_exclude)),
        overwrite=options.overwrite,
        stop_on_failure=options.on_record_failure == "stop",
        custom=tuple((key, value) for key, _, value in custom),
    )


@contextmanager
def recording_controls(recorder: Recorder | None) -> Iterator[str]:
    """While inside, keys and signals reach the recorder; gives a line that says which, or nothing."""
    with ExitStack() as stack:
        if recorder is None:
            yield ""
            return
        snapshots = recorder.options.snapshot_s > 0

        def toggle() -> None:
            (resume if recorder.paused else pause)(recorder)

        def save() -> None:
            # what becomes of it is told by a note
            snapshot(recorder)

        actions = {signal.SIGUSR1: save} if snapshots else {signal.SIGUSR2: toggle}
        stack.enter_context(_signals(actions))
        keys = can_read_keys()
        if keys:
            # the s of a replay steps
            bound = {NEXT: save} if snapshots else {PAUSE: toggle}
            stack.enter_context(keyboard(lambda command: bound.get(command, _nothing)()))
        if snapshots:
            yield f"{'key s or ' if keys else ''}SIGUSR1 writes the last {recorder.options.snapshot_s:g} s"
        else:
            yield f"{'space or ' if keys else ''}SIGUSR2 pauses and resumes" if keys else ""


def _nothing() -> None:
    """Another key."""


@contextmanager
def _signals(actions: dict[signal.Signals, Callable[[], None]]) -> Iterator[None]:
    """Act on signals, in a thread: in the handler a lock that is taken may be our own."""
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
