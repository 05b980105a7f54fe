"""Sessions of processes, among which Linux may share the processors (autogroup)."""

from __future__ import annotations

import os
from pathlib import Path


def knows_sessions() -> bool:
    """Whether this system shares among sessions of processes: some do not report it, or do not allow to set it."""
    try:
        told = Path("/proc/self/autogroup").read_text()
        return bool(told.strip()) and os.access("/proc/self/autogroup", os.W_OK)
    except OSError:
        return False
