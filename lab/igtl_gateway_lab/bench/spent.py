"""Runs a program, and writes what it took to a new file: ``python spent.py FILE PROGRAM WORD ...``.

A small process does so, because the kernel counts the memory of the process that starts a program to that program.
"""

import json
import os
import sys


def main() -> int:
    """Run the program; the file is JSON: exit code, seconds of CPU, peak in KiB."""
    child = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
    _, status, usage = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    figures = {"code": code, "cpu_s": usage.ru_utime + usage.ru_stime, "peak_kib": usage.ru_maxrss}
    with open(sys.argv[1], "x", encoding="ascii") as file:
        json.dump(figures, file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
