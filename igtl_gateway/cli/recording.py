"""The keys and signals that control the recording of ``bridge``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from igtl_gateway.app.recording import pause, resume, snapshot
from igtl_gateway.base.systems.signals import PAUSE as PAUSE_SIGNAL
from igtl_gateway.base.systems.signals import SAVE, signals_in_thread
from igtl_gateway.cli.keys import NEXT, PAUSE, can_read_keys, keyboard

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder


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

        number, action = (SAVE, save) if snapshots else (PAUSE_SIGNAL, toggle)
        stack.enter_context(signals_in_thread({number: action} if number else {}, "igtl-steering"))
        keys = can_read_keys()
        if keys:
            # key s means "next message" in a replay
            bound = {NEXT: save} if snapshots else {PAUSE: toggle}
            stack.enter_context(keyboard(lambda command: bound.get(command, _nothing)()))
        ways = (["key s" if snapshots else "space"] if keys else []) + ([number.name] if number else [])
        if snapshots:
            does = f"saves the last {recorder.options.snapshot_s:g} s"
        else:
            does = "pauses and resumes" if keys else ""
        yield f"{' or '.join(ways)} {does}" if ways and does else ""


def _nothing() -> None:
    """Ignore another key."""
