"""The progress of a run over many files: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import shutil
from types import TracebackType
from typing import TYPE_CHECKING

from igtl_gateway.addon import NS_PER_S, Clock, Self, SystemClock
from igtl_gateway.addon.terminal import clear_live_line, count_text, is_terminal, live_line, print_line, seconds_text

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.running import RunSummary

#: Longest bar, and columns of what stands behind it.
_COLUMNS, _TEXT = 24, 54
#: Seconds between two states on a terminal, and between two lines elsewhere.
_LIVE_S, _LINE_S = 0.2, 30


class Progress:
    """Prints the progress to stderr; a context manager, and the function that takes the state.

    Args:
        quiet: print nothing.
        clock: for rate and time left.
    """

    def __init__(self, *, quiet: bool = False, clock: Clock | None = None) -> None:
        self._quiet, self._clock = quiet, clock or SystemClock()
        self._live = is_terminal(error=True)
        self._start_ns = self._shown_ns = self._clock.monotonic_ns()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live and not self._quiet:
            clear_live_line(error=True)

    def __call__(self, summary: RunSummary) -> None:
        """Print the state if it is time."""
        now_ns = self._clock.monotonic_ns()
        if self._quiet or now_ns - self._shown_ns < (_LIVE_S if self._live else _LINE_S) * NS_PER_S:
            return
        self._shown_ns = now_ns
        columns = shutil.get_terminal_size().columns if self._live else 80
        text = state_line(summary, (now_ns - self._start_ns) / NS_PER_S, columns)
        if self._live:
            live_line(text, error=True)
        else:
            print_line(text, error=True, flush=True)


def state_line(summary: RunSummary, seconds: float, columns: int = 80) -> str:
    """Return the state of a run: a bar, counts, rate and time left.

    Args:
        summary: the run so far.
        seconds: since its start.
        columns: of the terminal; a narrow one has a shorter bar, or none.
    """
    done, files = summary.before + summary.done, summary.files
    long = max(0, min(_COLUMNS, columns - _TEXT))
    filled = long * done // files if files else long
    rate = summary.done / seconds if seconds > 0 else 0.0
    left = f", {seconds_text((files - done) / rate)} left" if rate > 0 else ""
    failed = f", {summary.failed:,} without result" if summary.failed else ""
    bar = f"[{'#' * filled}{'.' * (long - filled)}] " if long else ""
    return f"{bar}{done:,} of {count_text(files, 'file')}, {rate:,.1f}/s{left}{failed}"
