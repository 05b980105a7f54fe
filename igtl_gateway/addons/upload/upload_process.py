"""The process that uploads while a bridge records; it has the lowest priority.

``python -m igtl_gateway.addons.upload.upload_process``: the first line of its input has the settings, the last is
``end``.  Its output has a JSON object a line: ``note`` or ``counts``.  If its input ends without ``end``, the bridge is
gone: it ends at once, and the next upload continues.
"""

from __future__ import annotations

import json
import sys
import threading
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, ConfigError, SystemClock
from igtl_gateway.addon.processes import ignore_endings, report_facts, stand_back
from igtl_gateway.addon.reading import Level, Note
from igtl_gateway.addons.upload.place import upload_place
from igtl_gateway.addons.upload.uploading import WAITS, Uploader

#: Time between two looks at the folder, seconds.
_LOOK_S = 1.0
#: Time between two reports, seconds.
_REPORT_S = 0.5
#: Time for what is left when the bridge ends, seconds.
END_S = 10.0


def main() -> None:
    """The process."""
    # a service manager signals all processes of a service at once: the bridge decides when this one ends
    ignore_endings()
    stand_back(19)
    settings = json.loads(sys.stdin.readline() or "null")
    if settings:
        _Process(settings).run()


#: Lines are whole: two threads write them.


class _Process:
    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._woken = threading.Event()
        self._never = threading.Event()
        self._clock = SystemClock()
        self._end_ns = 0  # on the monotonic clock, once the bridge has ended the recording
        self._gone = False
        threading.Thread(target=self._listen, daemon=True).start()

    def run(self) -> None:
        settings = self._settings
        try:
            place = upload_place(settings["to"])
            uploader = Uploader(
                Path(settings["folder"]), settings["base"], place, settings["rate"], self._clock, _note, self._stops
            )
            if settings["begin"]:
                uploader.begin()
            threading.Thread(target=self._report, args=(uploader,), daemon=True).start()
        except (ConfigError, OSError) as error:
            _note(Note(Level.ERROR, WAITS, f"no upload: {error}"))
            return
        with suppress(BrokenPipeError):
            while not self._stops():
                ending = self._end_ns
                done = uploader.step()
                if ending and done:
                    break
                self._woken.wait(0.2 if self._end_ns else _LOOK_S)
            report_facts({"counts": asdict(uploader.counts)})
        uploader.close()

    def _report(self, uploader: Uploader) -> None:
        """Write the counts from time to time, also while a large file is sent."""
        with suppress(BrokenPipeError):
            while True:
                report_facts({"counts": asdict(uploader.counts)})
                self._never.wait(_REPORT_S)

    def _stops(self) -> bool:
        return self._gone or 0 < self._end_ns < self._clock.monotonic_ns()

    def _listen(self) -> None:
        for line in sys.stdin:
            if line.strip() == "end":
                self._end_ns = self._clock.monotonic_ns() + int(END_S * NS_PER_S)
                self._woken.set()
        self._gone = not self._end_ns
        self._woken.set()


def _note(note: Note) -> None:
    report_facts({"note": {"level": note.level.value, "code": note.code, "text": note.text, "data": note.data}})


if __name__ == "__main__":
    main()
