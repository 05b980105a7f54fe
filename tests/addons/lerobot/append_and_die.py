"""A program that appends sessions to a set again and again, each time in a child that kills itself at a step.

Arguments: the folder with the set ``set``, the recordings.  For each line of its input, the number of a step, it
answers with the signal of the child, or 0 after one that ended; a number beyond the last step ends none.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

from igtl_gateway.addons.lerobot.appending import append_sessions

#: What changes a file system, or gives a chance to see it half changed.
EVENTS = frozenset(
    {"open", "os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "shutil.rmtree", "ctypes.dlsym"}
)


def die_at(folder: Path, step: int) -> None:
    """Kill this process at a step that names something in a folder."""
    steps = iter(range(1, 1 << 30))

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in EVENTS and (event.startswith("ctypes") or str(folder) in str(arguments[0])) and next(steps) == step:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def main() -> None:
    folder, files = Path(sys.argv[1]), [Path(each) for each in sys.argv[2:]]
    for line in sys.stdin:
        child = os.fork()
        if not child:
            die_at(folder, int(line))
            append_sessions(files, None, folder / "set")
            os._exit(0)
        sys.stdout.write(f"{os.WTERMSIG(os.waitpid(child, 0)[1])}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
