"""The end of the program where a library has threads that outlive the interpreter.

Python ends a thread that asks for the GIL while the interpreter is finalised.  A thread in Rust does not survive that:
the process aborts after all is done, with "FATAL: exception not rethrown".
"""

from __future__ import annotations

import atexit
import os

_libraries: set[str] = set()


def expect_threads_of(library: str) -> None:
    """A library was loaded whose threads may outlive the interpreter."""
    _libraries.add(library)


def leave_beside_threads(code: int) -> None:
    """End the process without the end of the interpreter, if such a library was loaded.

    Outputs are flushed before; exit functions run here.
    """
    if not _libraries:
        return
    atexit._run_exitfuncs()
    os._exit(code)
