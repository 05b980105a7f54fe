"""Runs of programs in Python that share the start of their interpreter, for `tools/evidence/resim_runs.py`.

Most of the CPU time of a short run are imports.  Here one interpreter imports, with the library of resim loaded, and
each program is a fork of it.  Hash seed and addresses in memory are those of this interpreter: a new one begins after
some runs.  Everything else is as in a run of its own: context, threads, clocks, messages.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

if __name__ != "__main__":
    from igtl_gateway.addons.resim.library import library_path
    from igtl_gateway.addons.resim.processes import Process
    from igtl_gateway.base.systems.processes import KILL, end_session

#: What the programs of tests/addons/resim/programs import; types of messages, whose support is loaded, too.
MODULES = ("runpy", "numpy", "pyigtl", "rclpy", "rclpy.node", "rclpy.executors", "rclpy.lifecycle", "rclpy.action")
TYPES = (
    "std_msgs.msg String", "tf2_msgs.msg TFMessage", "geometry_msgs.msg TransformStamped", "sensor_msgs.msg Image",
    "std_srvs.srv SetBool", "lifecycle_msgs.srv ChangeState", "lifecycle_msgs.msg Transition",
)  # fmt: skip
#: Seconds that a program has to end after the session.
_END_S = 2.0


class Start:
    """An interpreter that has imported; ends with this process."""

    def __init__(self, *modules: str) -> None:
        env = {**os.environ, "LD_PRELOAD": str(library_path()), "LTTNG_UST_REGISTER_TIMEOUT": "0"}
        self._child = subprocess.Popen(
            [sys.executable, __file__, *modules], env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def fork(self, command: Sequence[str], env: Mapping[str, str]) -> int:
        """Start a program: script and arguments; its number."""
        assert self._child.stdin and self._child.stdout
        print(json.dumps([list(command), dict(env)]), file=self._child.stdin, flush=True)
        return int(self._child.stdout.readline())

    def close(self) -> None:
        assert self._child.stdin
        self._child.stdin.close()
        self._child.wait()


class Forked(Process if __name__ != "__main__" else object):  # type: ignore[misc]
    """A fork of the interpreter in the place of a process."""

    #: The interpreter of all of them.
    start: Start

    def __init__(self, name: str, command: Sequence[str], env: Mapping[str, str], folder: Path | None) -> None:
        self.name = name
        assert command[0] == sys.executable, "only programs in Python can share a start"
        self._ros_pid = self._pid = self.start.fork(command[1:], {**env, "LD_PRELOAD": ""})

    @property
    def _root(self) -> int:
        return self._pid

    @property
    def is_running(self) -> bool:
        with suppress(OSError):
            return Path(f"/proc/{self._pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] not in "ZX"
        return False

    @property
    def has_failed(self) -> bool:
        return not self.is_running

    def wait(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while self.is_running and time.monotonic() < until_s:
            time.sleep(0.002)

    def exit_text(self) -> str:
        return "ended"

    def end(self) -> None:
        for number in (signal.SIGINT, KILL):
            with suppress(ProcessLookupError):
                os.kill(self._pid, number)
            self.wait(_END_S)
        end_session(self._pid)

    def close(self) -> None:
        pass


def _import(modules: Sequence[str]) -> None:
    for name in (*MODULES, *modules):
        with suppress(ImportError):
            importlib.import_module(name)
    with suppress(ImportError):
        from rclpy.type_support import check_for_type_support

        importlib.import_module("rcl_interfaces.srv")
        for row in TYPES:
            place, name = row.split()
            check_for_type_support(getattr(importlib.import_module(place), name))


def _become(command: Sequence[str], env: Mapping[str, str]) -> None:
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.environ.clear()
    os.environ.update(env)
    nothing = os.open(os.devnull, os.O_RDWR)
    for file in (0, 1):
        os.dup2(nothing, file)
    sys.argv = list(command)
    sys.path[0] = str(Path(command[0]).parent)
    code = 0
    try:
        runpy.run_path(command[0], run_name="__main__")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except KeyboardInterrupt:
        code = 130
    os._exit(code)


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # their exit codes are not needed
    _import(sys.argv[1:])
    while line := os.read(0, 1 << 20):
        command, env = json.loads(line)
        if os.fork():
            continue
        if pid := os.fork():  # nor is this interpreter its launcher, whose other children would belong to it
            os.write(1, b"%d\n" % pid)
            os._exit(0)
        _become(command, env)


if __name__ == "__main__":
    main()
