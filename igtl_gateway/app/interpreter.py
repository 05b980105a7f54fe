"""How Python is to run while messages are on their way."""

from __future__ import annotations

import gc
import sys

#: A thread that computes lets the others in after so long.  The usual 5 ms are what a pose would wait behind a picture.
_SWITCH_S = 0.0005


def tune_interpreter() -> None:
    """For a program that has started and now serves: no pause of the garbage collector over what stays anyway (tens
    of milliseconds with rclpy and numpy loaded), and no thread for long."""
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_S)
