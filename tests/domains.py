"""ROS domains of the tests: each process reserves its own, so that test runs on one machine do not share a graph."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path

#: The default domain 0 belongs to the user.  Above 101, DDS uses ports that Linux also gives to outgoing connections.
DOMAINS = range(1, 101)

_locks: list[int] = []


def reserve() -> int:
    """A domain that no other process has reserved.  It is free again when this process ends.

    Raises RuntimeError if all domains are reserved.
    """
    for offset in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + offset) % len(DOMAINS)]
        try:
            lock = os.open(Path(tempfile.gettempdir(), f"igtl-gateway-domain-{domain}"), os.O_RDWR | os.O_CREAT, 0o666)
        except PermissionError:  # another user's
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            continue
        _locks.append(lock)
        return domain
    raise RuntimeError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are reserved by tests")


#: The domain of this process, in its environment (conftest).
OWN = reserve()
