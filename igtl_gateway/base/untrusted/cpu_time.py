"""The CPU time of a verb on untrusted files: bounded as a whole, also inside of one message.

A reader checks its ``Deadline`` between messages.  What one message costs, and what is done with what was read, is
bounded here: the system counts the CPU time of the process, and interrupts the main thread beyond the bound.
The bound is ``seconds`` of the limits, and ``seconds`` and ``seconds_per_mb`` of each file that is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from igtl_gateway.base.clock import process_ns
from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.systems.signals import cpu_alarm
from igtl_gateway.base.untrusted import limits

_NS_PER_S = 1_000_000_000
#: CPU time between two interruptions of a program that goes on: a library has swallowed the one before, or it tidies
#: up.
_AGAIN_NS = 1_000_000_000
#: Interruptions, until the process ends without tidying up.
_MOST = 6
_BYTES_PER_MB = 1_000_000


class OutOfTime(KeyboardInterrupt):
    """The CPU time is over; what tidies up after Ctrl-C does so."""


class _Account:
    """The time of one verb.

    Args:
        give_up: called with the error where interruptions do not end the program; it does not return.
    """

    def __init__(self, give_up: Callable[[LimitExceeded], object] | None) -> None:
        self.files: dict[str, int] = {}  # → bytes
        self.free_ns = 0  # what did not count
        self.is_counting = True
        self.interrupted = 0
        self._give_up = give_up
        self._limits = limits.current_limits()
        self._began_ns = process_ns()

    def look(self) -> int:
        """Return the time until the next look, ns.  Raises OutOfTime beyond the bound."""
        left_ns = self._allowed_s * _NS_PER_S - (process_ns() - self._began_ns - self.free_ns)
        if left_ns > 0 or not self.is_counting:  # files have given time since
            return max(left_ns, _AGAIN_NS)
        self.interrupted += 1
        if self.interrupted > _MOST and self._give_up:
            self._give_up(self.error())
        raise OutOfTime

    @property
    def _allowed_s(self) -> int:
        size = sum(self.files.values())
        return self._limits.seconds * (len(self.files) or 1) + self._limits.seconds_per_mb * size // _BYTES_PER_MB

    def error(self) -> LimitExceeded:
        place = next(reversed(self.files), "work")
        return limits.exceeded("seconds", f"more than {self._allowed_s} s of work", place, f"{self._allowed_s} s")


#: Of the verb that runs, which is one at a time: the threads of its libraries have no context of their own.
_accounts: list[_Account] = []


def opened(path: Path, size: int) -> None:
    """A file was opened, which gives time."""
    if _accounts:
        _accounts[-1].files[str(path)] = size


@contextmanager
def bounded(give_up: Callable[[LimitExceeded], object] | None = None) -> Iterator[None]:
    """Context manager: its CPU time is bounded by the limits in force.  Raises LimitExceeded.

    Only the main thread has a bound.

    Args:
        give_up: ends the process, where a program goes on in spite of several interruptions.
    """
    account = _Account(give_up)
    _accounts.append(account)
    try:
        with cpu_alarm(account.look, limits.current_limits().seconds * _NS_PER_S, _AGAIN_NS):
            yield
    except KeyboardInterrupt:
        if not account.interrupted:
            raise
    finally:
        _accounts.remove(account)
    if account.interrupted:
        raise account.error()


@contextmanager
def not_counted() -> Iterator[None]:
    """Context manager: its time does not count: it lasts as long as a user looks, or a peer is observed."""
    account = _accounts[-1] if _accounts else _Account(None)
    began_ns = process_ns()
    account.is_counting = False
    try:
        yield
    finally:
        account.free_ns += process_ns() - began_ns
        account.is_counting = True
