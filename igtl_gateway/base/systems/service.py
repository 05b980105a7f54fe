"""The service manager that started this process, such as systemd, as its environment states it.

``NOTIFY_SOCKET`` is a datagram socket that takes lines (sd_notify(3)); ``JOURNAL_STREAM`` names the output that goes to
the journal, where ``<3>`` in front of a line is its priority (sd-daemon(3)).  Without these variables, nothing is done.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import TextIO

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted.numbers import whole_number

#: Priorities of the journal, those of syslog.
ERROR, WARNING, INFO = 3, 4, 6

#: Shortest timeout of a watchdog, for a program that reports once a second: a busy machine delays a report.
LEAST_WATCHDOG_US = 5_000_000


class ServiceManager:
    """Sends the state of this process to its service manager, if there is one.

    Args:
        environ: of the process.

    Attributes:
        is_present: whether there is one.

    Raises:
        ConfigError: the watchdog is shorter than the reports allow.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        place = environ.get("NOTIFY_SOCKET", "")
        self.is_present = sys.platform != "win32" and place[:1] in ("/", "@")
        if not self.is_present:
            return
        ours = environ.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
        watchdog_us = whole_number(environ.get("WATCHDOG_USEC", "")) if ours else None
        if watchdog_us is not None and watchdog_us < LEAST_WATCHDOG_US:
            raise ConfigError(
                f"WATCHDOG_USEC: found {watchdog_us}, expected at least {LEAST_WATCHDOG_US} (WatchdogSec=5)"
            )
        self._address = f"\0{place[1:]}" if place.startswith("@") else place  # @: Linux's abstract names
        self._socket = _datagram_socket()

    def send(self, *lines: str) -> None:
        """Send lines such as ``READY=1`` as one message.  A manager that does not read must not stop the program."""
        if self.is_present:
            with suppress(OSError):
                self._socket.sendto("\n".join(lines).encode("utf-8", "replace"), self._address)


def is_journal(stream: TextIO, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether what is written to this stream goes to the journal."""
    device, _, inode = environ.get("JOURNAL_STREAM", "").partition(":")
    if not inode:
        return False
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):  # closed, or in memory
        return False
    return (str(status.st_dev), str(status.st_ino)) == (device, inode)


if sys.platform != "win32":
    import socket

    def _datagram_socket() -> socket.socket:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.setblocking(False)
        return made
