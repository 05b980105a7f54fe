"""The start of the program: Ctrl-C ends it with one line, also while modules are imported.

Half a second passes before a verb runs.  An interrupt inside an import is a traceback of 20 to 57 lines, and parts in C
turn it into other errors.  Nothing has begun before the verb runs, so the process ends at once.  This module therefore
imports nothing before it has set the handler.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # as typing has it, which is imported later

if TYPE_CHECKING:
    from typing import Any, NoReturn

_INTERRUPTED = b"\nigtl-gateway: interrupted\n"


def main() -> int:
    """Run one verb; the console script ``igtl-gateway``."""
    # a program in the background may have ignored it: it stays ignored
    is_usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_usual:
        signal.signal(signal.SIGINT, _leave)
    try:
        from igtl_gateway.base.systems.leaving import leave_beside_threads
        from igtl_gateway.cli import main as run

        code = run(ready=_interrupt_normally if is_usual else None)
    except KeyboardInterrupt:
        _leave()
    finally:
        if is_usual:  # the result stands: no interrupt changes it
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    leave_beside_threads(code)
    return code


def _interrupt_normally() -> None:
    """Let Ctrl-C interrupt the verb, which ends in order."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(*_signal: Any) -> NoReturn:
    """End the process without the end of the interpreter, which may be in the middle of an import."""
    os.write(2, _INTERRUPTED)
    os._exit(1)
