"""Long work on recordings: the verbs of the command line as processes, with progress, and cancelled by a press."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, SystemClock, python_command
from igtl_gateway.addon.processes import Child, is_present, part_of
from igtl_gateway.addon.terminal import PROGRAM, PROGRESS, PROGRESS_VARIABLE
from igtl_gateway.addons.page.recordings import child_environment
from igtl_gateway.addons.page.starting import Start, directly

#: Jobs at a time, jobs that are remembered, and lines of each.
MAX_RUNNING, _MAX_KEPT, _LINES = 3, 40, 400
RUNNING, DONE, FAILED, CANCELLED = "running", "done", "failed", "cancelled"
#: State of work that a recording has nothing for, and where an action has what its output has then.
NOTHING = "nothing"
#: The page wraps the lines.
_COLUMNS = "4000"
_HAS_NOTHING = {"review": ("review", "addon:NOTHING")}
#: Begin of a line of `view` that a browser has no use for.
_TERMINAL = "Press Ctrl-C"
#: Time between two looks at a process, and for its end after Ctrl-C, seconds.
_LOOK_S, _END_S = 0.1, 3.0


def _verify(path: Path) -> list[str]:
    return ["verify", str(path), "--all"]


def _lint(path: Path) -> list[str]:
    return ["doctor", str(path)]


def _review(path: Path) -> list[str]:
    return ["review", str(path)]


def _seal(path: Path) -> list[str]:
    return ["verify", str(path), "--seal"]


def _view(path: Path) -> list[str]:
    return ["view", str(path), "--web"]


def _export(path: Path) -> list[str]:
    return ["export", str(path), "--to", "csv", "-o", str(path.with_name(f"{path.stem}-csv"))]


def _scene(path: Path) -> list[str]:
    return ["export", str(path), "--to", "mrb", "-o", str(path.with_name(f"{path.stem}.mrb"))]


#: Action of the page → its words on the command line, and the add-on that it needs.
ACTIONS: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "verify": (_verify, ""),
    "seal": (_seal, ""),
    "lint": (_lint, ""),
    "review": (_review, "review"),
    "view": (_view, "view"),
    "export": (_export, "exchange"),
    "scene": (_scene, "exchange"),
}


class Job:
    """One process of a verb.

    Args:
        mark: size and time of change (ns) of the recording.
        command: words of the command line.
        on_end: called in the job's thread.
        start: starts the process.
    """

    def __init__(
        self,
        number: int,
        action: str,
        name: str,
        mark: tuple[int, int],
        command: list[str],
        on_end: Callable[[Job], None],
        start: Start = directly,
    ) -> None:
        self._start = start
        self.mark = mark
        self.number, self.action, self.name = number, action, name
        self._error, self._path = f"{PROGRAM} {command[0]}: ", f"{command[1]}: "  # begin of the line of an error
        self.state = RUNNING
        self.lines: deque[str] = deque(maxlen=_LINES)
        self.link = ""
        self.progress = ""  # such as ``34 %``; "": the verb reports none
        self._clock = SystemClock()
        self._begun_ns = self._ended_ns = self._clock.monotonic_ns()
        self._on_end = on_end
        self._cancelled = threading.Event()
        threading.Thread(target=self._run, args=(command,), name="igtl-page-job", daemon=True).start()

    def cancel(self) -> None:
        """Have the process end as by Ctrl-C, and kill it if it does not."""
        self._cancelled.set()

    def facts(self) -> dict[str, Any]:
        """Return what the page shows."""
        running = self.state == RUNNING
        end_ns = self._clock.monotonic_ns() if running else self._ended_ns
        return {
            "number": self.number,
            "action": self.action,
            "name": self.name,
            "state": self.state,
            "seconds": (end_ns - self._begun_ns) / NS_PER_S,
            "last": self._last(),
            "link": self.link if running else "",
            "progress": self.progress if running else "",
        }

    def _last(self) -> str:
        """Return the last line but those of what to do next, or in a terminal."""
        lines = [self._plain(line) for line in self.lines]
        return next(
            (each for each in reversed(lines) if each and each != "next" and not each.startswith((PROGRAM, _TERMINAL))),
            "",
        )

    def _plain(self, line: str) -> str:
        """Return a line without the names of the verb and the file."""
        return line.strip().removeprefix(self._error).removeprefix(self._path)

    def _failure(self) -> str:
        """Return the state of work that has failed: by the begin of its error, as its exit code shows no more."""
        place = _HAS_NOTHING.get(self.action)
        words = part_of(*place) if place else ()
        errors = [self._plain(line) for line in self.lines if line.startswith(self._error)]
        return NOTHING if any(error.startswith(words) for error in errors) else FAILED

    def _take(self, line: str) -> None:
        if line.startswith(PROGRESS):
            self.progress = line.removeprefix(PROGRESS).strip()
            return
        self.lines.append(line)
        if self.action == "view" and line.strip().startswith("http://127.0.0.1:"):
            self.link = line.strip()

    def _run(self, command: list[str]) -> None:
        """Start the process and wait for it."""
        state = FAILED
        try:
            child = self._start(
                lambda: Child(
                    "page-job",
                    [*python_command("igtl_gateway"), *command],
                    on_line=self._take,
                    on_error_line=self._take,
                    env=child_environment() | {"NO_COLOR": "1", "COLUMNS": _COLUMNS, PROGRESS_VARIABLE: "1"},
                )
            )
        except OSError as error:
            self._take(f"cannot be started: {error.strerror}")
        else:
            child.close_input()
            while (code := child.wait(_LOOK_S)) is None and not self._cancelled.is_set():
                pass
            if code is None:
                child.interrupt()
                child.wait(_END_S)
            child.kill()  # its output is read now
            state = CANCELLED if code is None else DONE if code == 0 else self._failure()
        self._ended_ns = self._clock.monotonic_ns()
        self.state = state
        self._on_end(self)


class Jobs:
    """The jobs of a page; ``on_end`` is called with each that has ended, in a thread of its own."""

    def __init__(self, on_end: Callable[[Job], None] = lambda job: None, start: Start = directly) -> None:
        self._on_end = on_end
        self._start = start
        self._lock = threading.Lock()
        self._jobs: dict[int, Job] = {}
        self._number = 0

    def start(self, action: str, name: str, path: Path, mark: tuple[int, int] = (0, 0)) -> tuple[bool, str]:
        """Start a job; return whether that was possible, and a sentence for people."""
        if action not in ACTIONS:
            return False, f"found {action[:40]!r}, expected one of {', '.join(ACTIONS)}"
        words, addon = ACTIONS[action]
        if addon and not is_present(addon):
            return False, f"the add-on {addon} is not installed"
        with self._lock:
            running = [job for job in self._jobs.values() if job.state == RUNNING]
            if any(job.action == action and job.name == name for job in running):
                return False, f"{action} of {name} runs already"
            if len(running) >= MAX_RUNNING:
                return False, f"{MAX_RUNNING} jobs run already; wait for one, or cancel it"
            self._number += 1
            self._jobs[self._number] = Job(self._number, action, name, mark, words(path), self._on_end, self._start)
            for old in [job.number for job in self._jobs.values() if job.state != RUNNING][:-_MAX_KEPT]:
                del self._jobs[old]
        return True, f"{action} of {name} has begun"

    def cancel(self, number: int) -> tuple[bool, str]:
        """Cancel a job."""
        job = self._jobs.get(number)
        if job is None or job.state != RUNNING:
            return False, "this job does not run"
        job.cancel()
        return True, f"{job.action} of {job.name} is cancelled"

    def rows(self) -> list[dict[str, Any]]:
        """Return the facts of all jobs, the newest first."""
        with self._lock:
            return [job.facts() for job in reversed(self._jobs.values())]

    def lines(self, number: int) -> list[str]:
        """Return the last lines of a job."""
        job = self._jobs.get(number)
        return list(job.lines) if job else []

    def close(self) -> None:
        """Cancel all."""
        with self._lock:
            for job in self._jobs.values():
                job.cancel()
