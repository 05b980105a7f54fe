"""A program that runs verbs one after the other in one process, each with a look at its memory; a file of its own.

It imports nothing but the command line, so that it runs on any version: ``python worker.py RESULTS``, one JSON array
of arguments on each line of standard input.  The verbs' output goes to the files ``RESULTS.out`` and ``RESULTS.err``;
one JSON line for each verb goes to ``RESULTS``.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from pathlib import Path

#: Address space, and size of a file: enough for what a verb may take, not for what a bomb asks.
MEMORY, FILE = 2_500_000_000, 1_000_000_000
#: Seconds after which Ctrl-C ends a router.
ROUTER_S = 0.5


def peak_kb() -> int:
    """Most resident memory since the last :func:`reset`."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


def reset() -> None:
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")


def ran(arguments: list[str]) -> dict[str, object]:
    """The result of one verb; words with an equals sign before it are its environment."""
    given = list(arguments)
    environment = {}
    while "=" in given[0]:
        name, _, value = given.pop(0).partition("=")
        environment[name] = value
    before = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    over = threading.Event()
    ends = threading.Thread(target=interrupts, args=(over,))
    if given[0] == "zenoh-router":
        ends.start()
    try:
        return timed(given)
    finally:
        over.set()
        if ends.ident:
            ends.join()
        for name, text in before.items():
            if text is None:
                del os.environ[name]
            else:
                os.environ[name] = text


def interrupts(over: threading.Event) -> None:
    """Send Ctrl-C a while after the verb is ready for it."""
    usual = signal.getsignal(signal.SIGINT)
    while not over.wait(0.02):
        if signal.getsignal(signal.SIGINT) != usual:
            if not over.wait(ROUTER_S):
                os.kill(os.getpid(), signal.SIGINT)
            return


def timed(arguments: list[str]) -> dict[str, object]:
    """The result of one verb."""
    from igtl_gateway.cli import main

    started, spent = time.monotonic(), time.process_time()
    code: object = None
    trace = ""
    try:
        code = main(arguments)
    except SystemExit as ended:
        code = ended.code
    except BaseException:  # a traceback is what is looked for
        trace = traceback.format_exc()
    return {
        "code": code,
        "trace": trace,
        "seconds": time.monotonic() - started,
        "cpu": time.process_time() - spent,
    }


def tidied() -> None:
    """rerun keeps the threads of a recording stream until it collects unreferenced ones."""
    gc.collect()
    if rerun := sys.modules.get("rerun"):
        rerun.bindings.flush_and_cleanup_orphaned_recordings()


def flushed() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()


def run() -> None:
    place = sys.argv[1]
    libc = ctypes.CDLL(None)
    outputs = [os.open(f"{place}.{name}", os.O_RDWR | os.O_CREAT | os.O_TRUNC) for name in ("out", "err")]
    for number, output in enumerate(outputs, 1):
        os.dup2(output, number)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE, FILE))
    with open(place, "w", encoding="utf-8") as results:
        for line in sys.stdin:
            arguments = json.loads(line)
            for output in outputs:
                os.ftruncate(output, 0)
                os.lseek(output, 0, os.SEEK_SET)
            tidied()
            libc.malloc_trim(0)
            reset()
            outcome = ran(arguments)
            flushed()
            outcome["peak_mb"] = peak_kb() / 1024
            texts = [Path(f"{place}.{name}").read_bytes().decode("utf-8", "replace") for name in ("out", "err")]
            outcome["output"], outcome["errors"] = (
                text if len(text) < 200_000 else text[:200_000] + "…" for text in texts
            )
            results.write(json.dumps(outcome) + "\n")
            results.flush()


if __name__ == "__main__":
    run()
