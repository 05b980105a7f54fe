"""Settings of the Python interpreter for low latency: garbage collector and switch interval."""

from __future__ import annotations

import gc
import sys

#: Switch interval of the interpreter.  With Python's default of 5 ms, a pose waits that long for an image.
_SWITCH_S = 0.0005


def tune_interpreter() -> None:
    """Exclude all existing objects from garbage collection, and set the switch interval.  Call this after the start.

    With rclpy and numpy loaded, a full collection takes tens of milliseconds.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_S)
