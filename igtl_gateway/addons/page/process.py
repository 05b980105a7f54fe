"""The process of the page: what it shows, from the bridge, the folder, the jobs and the replay.

``python -m igtl_gateway.addons.page.process`` beside a bridge: the first line of its input has its settings as JSON,
the end of its input ends it.  The verb ``page`` runs a `Page` without a bridge.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import NS_PER_S, GatewayError, SystemClock, __version__, failure_text
from igtl_gateway.addon.live import TlsFiles
from igtl_gateway.addon.processes import ignore_endings, stand_back
from igtl_gateway.addon.reading import ago_ns
from igtl_gateway.addons.page.disk import DiskLook
from igtl_gateway.addons.page.jobs import CANCELLED, RUNNING, Job, Jobs
from igtl_gateway.addons.page.now import Now, headline, others, slowest, with_names, wrong_things
from igtl_gateway.addons.page.recordings import MAX_LISTED, Recordings
from igtl_gateway.addons.page.replays import Replay
from igtl_gateway.addons.page.results import Results, keep_newest
from igtl_gateway.addons.page.server import PageServer
from igtl_gateway.addons.page.source import BridgeSource, Poller
from igtl_gateway.addons.page.starting import Starters, directly

if TYPE_CHECKING:
    from igtl_gateway.addons.page.curves import Curves

#: Actions that are the bridge's.
_BRIDGE = ("start", "stop", "pause", "resume", "mark", "snapshot", "split", "end")
#: Time over which the growth of a recording is measured, ns.
_GROWTH_NS = 30 * NS_PER_S
#: Names of peers that are remembered.
_MAX_NAMES = 1_000
#: The state of jobs and replay is looked at again after this time, ns, or a press.
_FRESH_NS = NS_PER_S // 5
#: Messages are being lost for this time after the last one, ns.
_LOSING_NS = 5 * NS_PER_S


class Page:
    """What the page shows.

    Args:
        folder: of the recordings; None: there is none.
        source: the bridge; None: there is none.
        starters: start processes; None: with the priority of this one.
    """

    def __init__(self, folder: Path | None, source: BridgeSource | None, starters: Starters | None = None) -> None:
        work, replays = (starters.work, starters.replays) if starters else (directly, directly)
        self._clock = SystemClock()
        self._source = source
        self._curves: Curves | None = None
        self.recordings = Recordings(folder, work) if folder else None
        self.jobs = Jobs(self._take_result, work)
        self._results = Results(folder)
        self.replay = Replay(replays)
        self._disk = DiskLook()
        self._now = Now()
        self._lock = threading.Lock()
        self._answers = False
        self._shown = _json(None)  # of the bridge
        self._wrong = 0
        self._state = 0, b""  # with its version
        self._made_ns = 0  # when it was looked at last, monotonic; 0: it has changed since
        self._growth: deque[tuple[int, int]] = deque()
        self._session = self._file = ""
        self._begun_ns = 0  # of the file
        self._begun: dict[str, int] = {}  # name in the list → when its recording began, UTC ns
        self._lasted: dict[str, float] = {}  # the same → how long it took, s, of those that the bridge has closed
        self._path: Path | None = None  # of the last file
        self._dropped = 0  # entries since the file began, at the last sample
        self._lost_ns = 0  # when the last one was, monotonic
        self._is_paused = False
        self._last = ""  # the same of the last recording
        self._written = ""  # name in the list of what is being recorded
        self._names: dict[str, str] = {}  # address of a peer → its name
        self._poller = Poller(source, self._take) if source else None

    def close(self) -> None:
        """End jobs and replay."""
        if self._poller:
            self._poller.close()
        self.jobs.close()
        self.replay.close()

    def state(self) -> tuple[int, bytes]:
        """Return a number that changes with the state, and the state as JSON: the same bytes for all browsers.

        It is made a few times a second at most, however many ask; its large part once for each sample.
        """
        with self._lock:
            now_ns = self._clock.monotonic_ns()
            if not self._made_ns or now_ns - self._made_ns >= _FRESH_NS:
                version, before = self._state
                made = _json(self._facts())[:-1] + b',"bridge":' + self._shown + b"}"
                self._state = version + (made != before), made
                self._made_ns = now_ns
            return self._state

    def sessions(self) -> list[dict[str, Any]]:
        """Return the recordings, with the results of the jobs on each."""
        running: dict[str, dict[str, str]] = {}
        for job in self.jobs.rows():
            if job["state"] == RUNNING:
                running.setdefault(job["name"], {})[job["action"]] = RUNNING
        rows = self.recordings.rows() if self.recordings else []
        for row in rows:
            if begun_ns := self._begun.get(row["name"]):
                row.setdefault("start_ns", begun_ns)
        known = [self._results.of(row["name"], (row["bytes"], row["modified_ns"])) for row in rows]
        return [
            row | self._of_bridge(row) | {"results": found | running.get(row["name"], {})}
            for row, found in zip(rows, known, strict=True)
        ]

    def _of_bridge(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return what the bridge knows of a recording: it needs no look at the file."""
        name = row["name"]
        if name == self._written:
            return {"recording": True, "read": True, "paused": self._is_paused}
        lasted_s = self._lasted.get(name)
        if lasted_s is None or (row["read"] and not row.get("recording")):
            return {}
        facts = {"recording": False, "closed": True, "problem": ""}
        # the time between its first and its last message is known when the file is read
        return facts if "duration_s" in row else facts | {"duration_s": lasted_s, "about": True}

    def places(self, name: str) -> dict[str, Any] | None:
        """Return what lies on the time line of a recording; None for an unknown one."""
        return self.recordings.places(name) if self.recordings else None

    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None:
        """Return numbers of a stream of a recording; None for an unknown one."""
        return self.recordings.plot(name, key, field) if self.recordings else None

    def curve(self, side: str, stream: str, field: str) -> dict[str, Any] | None:
        """Return the last minute of a number of a stream of the bridge; None without a bridge."""
        if not self._source:
            return None
        from igtl_gateway.addons.page.curves import Curves  # here: the page does not wait for what decodes

        with self._lock:
            curves = self._curves = self._curves or Curves(self._source.numbers)
        return curves.read(side, stream, field)

    def _take_result(self, job: Job) -> None:
        """Keep the result of a job, if its recording is as it was at the begin."""
        mark = self.recordings.mark(job.name) if self.recordings else None
        if mark and mark == job.mark and job.state != CANCELLED:
            self._results.add(job.name, mark, job.action, job.state)

    def lines(self, job: int) -> list[str]:
        """Return the last lines of a job."""
        return self.jobs.lines(job)

    def picture(self, side: str, stream: str) -> bytes:
        """Return the last picture of a stream as its message; empty if there is none."""
        return self._source.picture(side, stream) if self._source else b""

    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        """Do what was pressed; return whether it was possible, and a sentence for people."""
        try:
            return self._act(what, words)
        finally:
            with self._lock:
                self._made_ns = 0

    def _act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        if what in _BRIDGE:
            if self._source is None:
                return False, "there is no bridge: this page shows a folder"
            try:
                since_ns = self._clock.monotonic_ns() - ago_ns(words.get("ago_s", 0))
            except GatewayError as error:
                return False, str(error)
            return self._source.press(what, str(words.get("line", "")), since_ns)
        if what == "cancel":
            number = words.get("number")
            return self.jobs.cancel(number if isinstance(number, int) else 0)
        if what == "steer":
            return self.replay.steer(str(words.get("steer")), words.get("value"))
        if what not in ("job", "replay"):
            return False, f"found {what[:40]!r}, which the page cannot do"
        name = str(words.get("name", ""))
        path = self.recordings.path(name) if self.recordings else None
        if path is None:
            return False, f"found no recording {name[:80]!r} in the folder"
        if what == "replay":
            return self.replay.start(name, path, words)
        mark = self.recordings.mark(name) if self.recordings else None
        return self.jobs.start(str(words.get("action")), name, path, mark or (0, 0))

    def _take(self, found: dict[str, Any] | None) -> None:
        """Take what the bridge reports, None if it does not answer.  In the thread of the poller."""
        rows: dict[str, Any] | None = None
        if found and found.get("facts"):
            facts = found["facts"]
            path = (facts.get("recorder") or {}).get("path", "")
            if path != self._session:  # another session
                self._session, self._now = path, Now()
                self._growth.clear()
            rows = self._now.rows(facts, facts["at_ns"], self._clock.utc_ns(), found.get("types", {}))
            self._remember_names(rows["links"])
            rows |= {
                "version": facts["version"],
                "uptime_s": facts["uptime_s"],
                "relay": facts["relay"],
                "ros": facts["ros"],
                "refused": facts["refused"],
                "recording": self._recording(facts.get("recorder"), found.get("recording")),
                "notes": with_names(found.get("notes", []), self._names),
                "done": with_names(found.get("done", []), self._names),
                "pictures": found.get("pictures", []),
                "headline": headline(rows),
                "others": others(rows),
                "slowest": [] if wrong_things(rows) else slowest(rows),
            }
        shown = _json(rows)
        wrong = len(wrong_things(rows)) if rows else 0
        with self._lock:
            self._answers, self._shown, self._wrong, self._made_ns = found is not None, shown, wrong, 0

    def _remember_names(self, links: list[dict[str, Any]]) -> None:
        """Remember who has which address: a note of a loss has the address only."""
        for row in links:
            if row["name"]:
                self._names.pop(row["peer"], None)
                self._names[row["peer"]] = row["name"]
        keep_newest(self._names, _MAX_NAMES)

    def _recording(self, counters: dict[str, Any] | None, how: dict[str, Any] | None) -> dict[str, Any] | None:
        """Return what the view *Recording* shows; None without a recording."""
        if not counters or not how:
            return None
        whole, file = Path(how["path"]), counters["file"]
        path = self._path if self._path and not file else Path(file).absolute() if file and not how["split"] else whole
        self._path, self._is_paused = path, counters["paused"]
        disk = self._disk.look(path, whole.with_suffix(""))
        size, files = (
            (counters["saved_bytes"], counters["saved_files"]) if how["snapshot_s"] else (disk.size, disk.files)
        )
        now_ns = self._clock.monotonic_ns()
        growth = self._growth
        if (known := "" if counters["rests"] else str(path)) != self._file:
            if self._written and self.recordings:
                self.recordings.closed(self._written)
                self._lasted[self._written] = (now_ns - self._begun_ns) / NS_PER_S
                keep_newest(self._lasted, MAX_LISTED)
            self._file, self._begun_ns = known, now_ns
            growth.clear()
            recorded = whole.with_suffix("") if how["split"] else path
            self._written = recorded.name if known and not how["snapshot_s"] else ""
            self._last = self._written or self._last
            if known:
                self._begun[self._written] = self._clock.utc_ns()
                keep_newest(self._begun, MAX_LISTED)
        if counters["dropped_since_start"] > self._dropped and known:
            self._lost_ns = now_ns
        self._dropped = counters["dropped_since_start"]
        growth.append((now_ns, size))
        while len(growth) > 2 and now_ns - growth[1][0] >= _GROWTH_NS:
            growth.popleft()
        seconds = (now_ns - growth[0][0]) / NS_PER_S
        per_s = max(0, size - growth[0][1]) / seconds if seconds else 0.0
        free, left_s = disk.free, counters.get("disk_left_s")
        return {
            "name": path.name,
            "folder": _from_home(path.parent),
            "bytes": size,
            "files": files,
            "per_s": per_s,
            "free": free,
            "lasts_s": free / per_s if left_s is None and free is not None and per_s > 0 else left_s,
            "left_s": left_s,
            "last": self._last,
            "written": self._written,
            "paused": counters["paused"],
            "rests": counters["rests"],
            "lasted_s": (now_ns - self._begun_ns) / NS_PER_S if known else 0,
            "failure": counters["failure"],
            "taken_away": counters.get("taken_away", ""),
            "losing": bool(self._lost_ns) and now_ns - self._lost_ns < _LOSING_NS,
            "entries": counters["entries_since_start"],
            "dropped": self._dropped,
            "left_out": counters["left_out_since_start"],
            "queued": counters["queued_entries"],
            "stands": bool(counters["stalled_s"] or disk.silent_s),
            "snapshot_s": how["snapshot_s"],
            "triggers": how["triggers"],
            "split": how["split"],
            "sealed": how["sealed"],
            "phases": how["phases"],
        }

    def _facts(self) -> dict[str, Any]:
        return {
            "version": __version__,
            "has_bridge": self._source is not None,
            "answers": self._answers,
            "wrong": self._wrong,
            "folder": _from_home(self.recordings.folder) if self.recordings else "",
            "jobs": self.jobs.rows(),
            "replay": self.replay.facts(),
        }


def _json(facts: object) -> bytes:
    return json.dumps(facts, separators=(",", ":"), default=str).encode()


def _from_home(path: Path) -> str:
    """Return a path as people write it: that of the user's home is ``~``."""
    try:
        return str(Path("~") / path.absolute().relative_to(Path.home()))
    except (ValueError, RuntimeError):  # elsewhere, or a user without a home
        return str(path)


def serve(page: Page, settings: dict[str, Any]) -> PageServer:
    """Return the server of a page.  Raises ConfigError, Unavailable."""
    tls = settings["tls"]
    files = TlsFiles(Path(tls[0]), Path(tls[1]) if tls[1] else None) if tls else None
    return PageServer(settings["host"], settings["port"], page, settings["allow"], files)


def main() -> None:
    """The process."""
    ignore_endings()
    starters = Starters()
    stand_back(10)
    settings = json.loads(sys.stdin.readline() or "null")
    if not settings:
        return
    folder = Path(settings["folder"]) if settings["folder"] else None
    page = Page(folder, BridgeSource(settings["bridge"], settings["token"]), starters)
    try:
        server = serve(page, settings)
    except GatewayError as error:
        _print({"why": failure_text(error)})
        return
    _print({"link": server.link, "spectators": server.spectators})
    sys.stdin.read()  # until the bridge ends
    server.close()
    page.close()


def _print(facts: dict[str, Any]) -> None:
    os.write(1, json.dumps(facts).encode() + b"\n")


if __name__ == "__main__":
    main()
