"""The recording of ``bridge``: its options, and the keys and signals that control it."""

from __future__ import annotations

import argparse
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.app.recording import pause, resume, snapshot
from igtl_gateway.cli.keys import NEXT, PAUSE, can_read_keys, keyboard
from igtl_gateway.cli.options import STREAM, Options, add_overwrite, default
from igtl_gateway.errors import ConfigError
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.selection import Selection

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder

#: Options that need a file, with their value when they are not given.
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


def add_arguments(group: Options) -> None:
    """Options of a recording."""
    given = RecordOptions()
    add = group.add_argument
    add("--record", type=Path, metavar="FILE", help="record all messages to this MCAP file")
    add_overwrite(group, "an existing recording")
    add(
        "--record-topics",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help="also record these ROS topics, in addition to the bridged ones; * matches one level, ** any number "
        "(repeatable)",
    )
    add("--record-all", action="store_true", help="also record all ROS topics")
    add(
        "--record-include",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help=f"record only inputs of these streams and their outputs; {STREAM} (repeatable)",
    )
    add(
        "--record-exclude",
        action="extend",
        nargs="+",
        default=[],
        metavar="GLOB",
        help="do not record inputs of these streams and their outputs (repeatable)",
    )
    add(
        "--custom-data",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="add this key and value to the metadata of the recording, such as operator=Kim (repeatable)",
    )
    add(
        "--compression",
        choices=("none", "lz4", "zstd"),
        default=given.compression,
        help="compression of chunks; streams that do not shrink are stored uncompressed " + default(given.compression),
    )
    add(
        "--flush-interval",
        type=float,
        default=given.flush_s,
        metavar="SECONDS",
        help="interval between flushes: the most that a power failure loses; a crash of the bridge loses nothing "
        + default(given.flush_s),
    )
    add(
        "--fsync",
        choices=("never", "flush", "close"),
        default=given.fsync,
        help="when to force data to the disk, against power failures: at each flush, or when the file is closed "
        + default(given.fsync),
    )
    add("--split-size", type=int, default=0, metavar="MIB", help="start a new file after this size")
    add("--split-duration", type=float, default=0.0, metavar="SECONDS", help="start a new file after this time")
    add(
        "--snapshot",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="record to memory, and write the last SECONDS to FILE_<UTC time>.mcap on key s, SIGUSR1 or the ROS "
        "service ~/snapshot",
    )
    add(
        "--on-record-failure",
        choices=("continue", "stop"),
        default="continue",
        help="what the bridge does if the recording fails, for example if the disk is full " + default("continue"),
    )


def record_options(options: argparse.Namespace) -> RecordOptions:
    """Return the options of the recording.  Raises ConfigError."""
    if not options.record:
        given = [name for name, nothing in _OF_A_RECORDING.items() if getattr(options, name) != nothing]
        if given:
            names = " and ".join(f"--{name.replace('_', '-')}" for name in given)
            raise ConfigError(f"{names}: found no --record FILE, expected it with options of a recording")
    for name in ("flush_interval", "split_size", "split_duration", "snapshot"):
        value = getattr(options, name)
        if not 0 <= value < float("inf"):
            raise ConfigError(f"--{name.replace('_', '-')}: found {value:g}, expected a number from 0 up")
    if options.snapshot and (options.split_size or options.split_duration):
        raise ConfigError("--snapshot: found --split-size or --split-duration, expected neither: it records to memory")
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
