"""The start of the program: Ctrl-C ends it quietly, also while modules are imported.

Half a second passes before a verb runs.  An interrupt inside an import is a traceback of 20 to 57 lines, and parts in C
turn it into other errors.  Nothing has begun before the verb runs, so an interrupt kills the process as it does a
program without a handler: a shell reports 130.  The first line sets that, with the module in C: ``signal`` imports
others.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # typeshed has no stub of the part in C

# a program in the background may have ignored it: it stays ignored
_IS_USUAL = _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler
if _IS_USUAL:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)


def main() -> int:
    """Run one verb; the console script ``igtl-gateway``."""
    import os

    try:
        from igtl_gateway.base.systems.leaving import leave_beside_threads
        from igtl_gateway.cli import main as run

        code = run(ready=_interrupt_normally if _IS_USUAL else None)
    except KeyboardInterrupt:
        os.write(2, b"\nigtl-gateway: interrupted\n")
        os._exit(1)  # without the end of the interpreter, which may be in the middle of an import
    finally:
        if _IS_USUAL:  # the result stands: no interrupt changes it
            _signal.signal(_signal.SIGINT, _signal.SIG_IGN)
    leave_beside_threads(code)
    return code


def _interrupt_normally() -> None:
    """Let Ctrl-C interrupt the verb, which ends in order."""
    _signal.signal(_signal.SIGINT, _signal.default_int_handler)
