"""Regular expressions of a profile, with a bound of time: ``(a+)+$`` takes longer than anyone lives on 60 letters.

A search of ``re`` cannot be ended from within, so a process of its own does it: ``python -m
igtl_gateway.addons.deidentify.patterns`` reads ``[pattern, by, text]`` (JSON) a line, and writes the new text a line.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.terminal import count_text

#: Seconds for one text.
MOST_S = 5.0

_LOCK = threading.Lock()
_processes: list[subprocess.Popen[str]] = []


def replaced(pattern: str, by: str, text: str) -> str:
    """Return the text with ``by`` for all matches.

    Raises ConfigError if that takes longer than `MOST_S`, GatewayError if the process cannot be started.
    """
    with _LOCK:
        process = _running()
        assert process.stdin and process.stdout
        late = threading.Event()

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(MOST_S, end)
        timer.daemon = True
        timer.start()
        try:
            process.stdin.write(json.dumps([pattern, by, text]) + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except OSError:
            answer = ""
        finally:
            timer.cancel()
        if answer:
            return str(json.loads(answer))
        _processes.clear()
        process.kill()
        process.communicate()
    if late.is_set():
        raise ConfigError(
            f"text: pattern {pattern!r}: found text of {count_text(len(text), 'character')} that takes more than "
            f"{MOST_S:g} s, "
            "expected a pattern without repetitions of repetitions, such as (a+)+"
        )
    raise GatewayError(f"text: pattern {pattern!r}: found an end of the process that replaces text")


def _running() -> subprocess.Popen[str]:
    if not _processes:
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        except OSError as error:
            raise GatewayError(f"text: no process for patterns: {error.strerror or error}") from None
        _processes.append(process)
    return _processes[0]


def close() -> None:
    """End the process, if there is one."""
    with _LOCK:
        for process in _processes:
            process.communicate()  # its input ends
        _processes.clear()


def _replaced(pattern: str, by: str, text: str) -> str:
    return re.sub(pattern, lambda _: by, text)  # no template: a backslash stays


def main() -> None:
    """The process; it ends with its input."""
    for line in sys.stdin:
        pattern, by, text = json.loads(line)
        data = json.dumps(_replaced(pattern, by, text)).encode() + b"\n"
        while data:
            data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()
