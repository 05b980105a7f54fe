"""The keys and signals that control the recording of ``bridge``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from igtl_gateway.app.recording import pause, resume, snapshot, start, stop
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.systems.signals import PAUSE as PAUSE_SIGNAL
from igtl_gateway.base.systems.signals import SAVE, signals_in_thread
from igtl_gateway.cli.keys import NEXT, PAUSE, RECORD, LineInput, can_read_keys, keyboard
from igtl_gateway.cli.terminal import clear_live_line, is_terminal, print_line, show_typed

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder


@contextmanager
def recording_controls(recorder: Recorder | None, mark: Callable[[str, int], None]) -> Iterator[str]:
    """Context manager: keys and signals control the recorder.  Yields a line that names them, or "".

    Args:
        recorder: None: there is no recording, and no keys.
        mark: called with the line that the user types after the key ``m``, and the ns since then; raises GatewayError.
    """
    with ExitStack() as stack:
        if recorder is None:
            yield ""
            return
        snapshots = recorder.options.snapshot_s > 0

        def toggle() -> None:
            (resume if recorder.paused else pause)(recorder)

        def save() -> None:
            snapshot(recorder)  # a note reports the result

        def begin_or_end() -> None:
            (start if recorder.rests else stop)(recorder)

        number, action = (SAVE, save) if snapshots else (PAUSE_SIGNAL, toggle)
        stack.enter_context(signals_in_thread({number: action} if number else {}, "igtl-steering"))
        keys = can_read_keys()
        if keys:
            # key s means "next message" in a replay
            bound = {NEXT: save} if snapshots else {PAUSE: toggle, RECORD: begin_or_end}
            line = LineInput(b"m", lambda text, ago_ns: _mark(text, ago_ns, mark), _show_line)
            stack.enter_context(keyboard(lambda command: bound.get(command, _nothing)(), line=line))
        ways = (["key s" if snapshots else "space"] if keys else []) + ([number.name] if number else [])
        if snapshots:
            does = f"saves the last {recorder.options.snapshot_s:g} s"
        else:
            does = "pauses and resumes, r stops and starts" if keys else ""
        words = [f"{' or '.join(ways)} {does}"] if ways and does else []
        yield "; ".join([*words, "m and a line of text makes a mark"] if keys else words)


def _mark(text: str, ago_ns: int, mark: Callable[[str, int], None]) -> None:
    """Make a mark, or print why it cannot be made."""
    try:
        mark(text, ago_ns)
    except GatewayError as error:
        if is_terminal():
            clear_live_line()
        print_line(f"! {error}", error=True)


def _show_line(text: str | None) -> None:
    show_typed("" if text is None else f"mark (LABEL: text, +LABEL begins, -LABEL ends): {text}")


def _nothing() -> None:
    """Ignore another key."""
