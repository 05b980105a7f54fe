"""The upload beside a bridge: a process of its own, which is started again if it ends."""

from __future__ import annotations

import json
import os
import shlex
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from igtl_gateway.addon import python_command
from igtl_gateway.addon.processes import Child
from igtl_gateway.addon.reading import Level, Note
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.upload.place import UploadPlace
from igtl_gateway.addons.upload.upload_process import END_S
from igtl_gateway.addons.upload.uploading import WAITS

_COMMAND = python_command("igtl_gateway.addons.upload.upload_process")
#: Time until a process that ended is started again, seconds, and how often that happens.
_AGAIN_S, _MOST_STARTS = 1.0, 100
#: Time for the end of the process beyond that for what is left, seconds.
_MARGIN_S = 3.0
_NONE = {"waiting": 0, "waiting_bytes": 0, "sent_bytes": 0, "confirmed": 0, "last_confirmed_ns": 0, "problem": ""}


class BridgeUploads:
    """Uploads the closed files of a recording, and those of earlier recordings in its folder that still wait.

    Args:
        path: the recording.
        place: where to.
        rate: bytes per second; 0: no limit.
        on_note: takes notes; called in a thread.
    """

    def __init__(self, path: Path, place: UploadPlace, rate: float, on_note: Callable[[Note], None]) -> None:
        self._folder = path.absolute().parent
        self._place = place
        self._settings = {"folder": str(self._folder), "base": path.name.removesuffix(".mcap")}
        self._settings |= {"to": str(place), "rate": rate}  # type: ignore[dict-item]  # a number
        self._on_note = on_note
        self._lock = threading.Lock()  # guards all that follows
        self._counts: dict[str, Any] = dict(_NONE)
        self._before: dict[str, Any] = dict(_NONE)  # of the processes that have ended
        self._child: Child | None = None
        self._stop = threading.Event()
        # a child ends with the thread that started it
        self._thread = threading.Thread(target=self._supervise, name="igtl-uploads", daemon=True)
        self._thread.start()

    def counters(self) -> dict[str, Any]:
        """Return what waits, was sent and was confirmed, so far."""
        with self._lock:
            found = dict(self._counts)
            for key in ("sent_bytes", "confirmed"):
                found[key] += self._before[key]
            last_ns = max(found.pop("last_confirmed_ns"), self._before["last_confirmed_ns"])
        return found | {"last_confirmed_s": last_ns / 1e9}

    def stop(self) -> None:
        """Upload what is left, for a limited time."""
        self._stop.set()
        with self._lock:
            child = self._child
        if child:
            child.write("end\n")
            child.wait(END_S + _MARGIN_S)
            child.kill()
        self._thread.join()

    def left_text(self) -> str:
        """Return what was uploaded, and what is left and how it is finished."""
        found = self.counters()
        done = f"upload: {count_text(found['confirmed'], 'file')} confirmed"
        if not found["waiting"]:
            return done
        command = f"igtl-gateway keep {shlex.quote(str(self._folder))} --upload {shlex.quote(str(self._place))}"
        why = f" ({found['problem']})" if found["problem"] else ""
        return f"{done}, {found['waiting']:,} LEFT{why}: {command} finishes it"

    def _supervise(self) -> None:
        """Start the process, and start it again when it ends too early."""
        for number in range(_MOST_STARTS):
            try:
                child = self._start(first=number == 0)
            except OSError as error:
                self._on_note(Note(Level.ERROR, WAITS, f"no upload: no process can be started: {error.strerror}"))
                return
            child.wait()
            child.kill()
            self._keep_counts()
            if self._stop.is_set() or self._stop.wait(_AGAIN_S):
                return
            self._on_note(Note(Level.WARN, WAITS, "upload: its process ended, and is started again"))

    def _start(self, *, first: bool) -> Child:
        path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
        child = Child("upload", _COMMAND, on_line=self._on_line, env={**os.environ, "PYTHONPATH": path})
        child.write(json.dumps(self._settings | {"begin": first}) + "\n")
        with self._lock:
            self._child = child
        if self._stop.is_set():  # meanwhile: stop did not see it
            child.write("end\n")
        return child

    def _on_line(self, line: str) -> None:
        try:
            found = json.loads(line)
            if counts := found.get("counts"):
                with self._lock:
                    self._counts = counts
            if note := found.get("note"):
                self._on_note(Note(Level(note["level"]), note["code"], note["text"], data=note["data"]))
        except (ValueError, KeyError, TypeError, AttributeError):
            return  # a line that was cut off

    def _keep_counts(self) -> None:
        """Add the counts of a process that has ended to those of the processes before."""
        with self._lock:
            for key in ("sent_bytes", "confirmed"):
                self._before[key] += self._counts[key]
            self._before["last_confirmed_ns"] = max(
                self._before["last_confirmed_ns"], self._counts["last_confirmed_ns"]
            )
            self._counts = self._counts | {"sent_bytes": 0, "confirmed": 0, "last_confirmed_ns": 0}
