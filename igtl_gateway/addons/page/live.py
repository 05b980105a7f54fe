"""The page beside a bridge: the interface that its process reads, and that process.

The interface is a server on loopback with a token that only the process knows.  It sends a sample of the bridge each
second and after each note, as a line each, and takes what a person has pressed.  Browsers never reach it, so whatever
they do, the bridge has one reader.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from hmac import compare_digest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import parse_qs, urlsplit

from igtl_gateway.addon import NS_PER_S, GatewayError, SystemClock, WireError, python_command
from igtl_gateway.addon.live import RECORDING_ACTIONS, Handler, LocalServer
from igtl_gateway.addon.processes import Child
from igtl_gateway.addon.reading import Entry, Kind, Level, MarkNote, Note
from igtl_gateway.addon.settings import Acceptance
from igtl_gateway.addon.terminal import duration_text
from igtl_gateway.addons.page.live_numbers import LiveNumbers
from igtl_gateway.addons.page.sample import sample_of

if TYPE_CHECKING:
    from igtl_gateway.addon.live import Bridge, NoteEvent

_COMMAND = python_command("igtl_gateway.addons.page.process")
#: Code of the notes about the page: what was pressed, and that its process has ended.
PAGE = "page"
#: Who makes the marks of the page.
_WHO = "page"
_NOTES = 60
#: Notes of what was done, beside PAGE: they stay in a list of their own, whatever else happens.
_DONE = frozenset(
    "mark record_started record_stopped record_paused record_resumed record_snapshot record_failed trigger "
    "trigger_saved trigger_incomplete".split()
) | {PAGE}
#: Streams whose types are known.
_MAX_TYPES = 4_000
#: A press may write a snapshot of half a gigabyte.
_DEADLINE_S = 90.0
#: Longest time between two samples, also if the bridge has none: the page waits no longer.
_STILL_S = 2.0
#: Least time between two samples without a note, ns: of the calls of `update` each second one.
_SAMPLE_NS = 3 * NS_PER_S // 4
#: Counts that the bridge has collected this long ago are collected again, ns: its terminal may hold it up.
_COLLECTED_NS = NS_PER_S
#: Pictures are copied for this time after the page has asked for them, and at most once in the second time.
_LOOKED_NS, _PICTURE_NS = 3 * NS_PER_S, NS_PER_S
_MAX_PICTURES, _MAX_PICTURE = 16, 32 << 20
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_IGTL = (Kind.IGTL_IN, Kind.IGTL_OUT)
_END_S = 2.0


class Refusals(Protocol):
    """Counts the messages that were refused."""

    @property
    def refused(self) -> int: ...


class RunningSession(Protocol):
    """What the page shows of a bridge."""

    @property
    def bridge(self) -> Bridge: ...

    @property
    def watch(self) -> Refusals: ...


class Pictures:
    """A sink that keeps the last picture of each stream, once a second while the page asks.

    Pictures that pass natively are not seen here: the next one is asked for once a browser has the last one.
    """

    def __init__(self) -> None:
        self._clock = SystemClock()
        self._until_ns = 0
        self._kept: dict[tuple[str, str], tuple[int, bytes]] = {}
        self._fetched: dict[tuple[str, str], int] = {}  # the version that a browser has
        self._large: set[tuple[str, str]] = set()  # streams without small pictures
        #: Topic → its type: the first message of each passes here.
        self.types: dict[str, str] = {}
        self.numbers = LiveNumbers(self.types)

    def __call__(self, entry: Entry) -> Callable[[], None] | None:
        """Return the copy of a picture, to be made without the lock; None for what is not kept."""
        if entry.kind in _ROS and entry.channel not in self.types and len(self.types) < _MAX_TYPES:
            self.types[entry.channel] = entry.type
        if copy := self.numbers(entry):
            return copy
        if not self._until_ns or not entry.channel.startswith("IMAGE/"):
            return None
        now_ns = self._clock.monotonic_ns()
        if now_ns > self._until_ns:
            self._until_ns = 0
            self._kept.clear()
            self._fetched.clear()
            return None
        key = entry.kind.value, entry.channel
        kept = self._kept.get(key)
        if kept is None and len(self._kept) >= _MAX_PICTURES:
            return None
        if entry.size > _MAX_PICTURE:
            if len(self._large) < _MAX_PICTURES:
                self._large.add(key)
            return None
        if kept and now_ns - kept[0] < _PICTURE_NS:
            return None
        return partial(self._keep, key, now_ns, entry)

    def names(self) -> list[tuple[str, str, int]]:
        """Return side, stream and version of each picture; pictures are kept for some seconds from now on."""
        self._until_ns = self._clock.monotonic_ns() + _LOOKED_NS
        return [(*key, version) for key, (version, _) in list(self._kept.items())]

    def wanted(self, totals: Mapping[str, Iterable[str]]) -> list[tuple[Kind, str]]:
        """Return the streams of pictures of which the next one is to be shown.

        Args:
            totals: side → its streams.
        """
        now_ns, is_full = self._clock.monotonic_ns(), len(self._kept) >= _MAX_PICTURES
        found = []
        for kind in _IGTL:
            for stream in totals.get(kind.value, ()):
                key = kind.value, stream
                if not stream.startswith("IMAGE/") or key in self._large:
                    continue
                version = self._kept.get(key, (0, b""))[0]
                is_old = self._fetched.get(key) == version and now_ns - version >= _PICTURE_NS
                if is_old if version else not is_full:
                    found.append((kind, stream))
        return found[:_MAX_PICTURES]

    def get(self, side: str, stream: str) -> bytes:
        """Return the message of the last picture, for a browser; empty if there is none."""
        version, data = self._kept.get((side, stream), (0, b""))
        if version:
            self._fetched[side, stream] = version
        return data

    def _keep(self, key: tuple[str, str], now_ns: int, entry: Entry) -> None:
        self._kept[key] = now_ns, entry.data()


class BridgePage:
    """The page of the sessions of a bridge, which run one after the other.

    Args:
        place: where browsers connect to.
        allow: networks (CIDR) whose browsers may connect in addition to those of this host.
        tls: certificate and key as PEM files; None: without TLS.
        recording: file of the recording, whose folder the page lists; None: there is none.
        on_stop: called when the bridge is to stop.
        on_links: called with the link for a person, and the one for spectators, once the page is served.
    """

    def __init__(
        self,
        place: tuple[str, int],
        allow: Sequence[str],
        tls: tuple[str, str] | None,
        recording: Path | None,
        on_stop: Callable[[], None],
        on_links: Callable[[str, str], None],
    ) -> None:
        self.pictures = Pictures()
        self._clock = SystemClock()
        self._session: RunningSession | None = None
        self._begun_ns = self._at_ns = 0  # of the session, and of its last `collect`; monotonic
        self._sampled_ns = 0  # when the last sample was due
        self._on_stop = on_stop
        self._on_links = on_links
        self._notes: deque[dict[str, Any]] = deque(maxlen=_NOTES)
        self._done: deque[dict[str, Any]] = deque(maxlen=_NOTES)
        self._number = 0
        self._closing = False
        self._has_ended = threading.Event()
        self._links: tuple[str, str] | None = None
        self._why = ""
        self._changed, self._version = threading.Condition(), 0
        self._token = os.urandom(24).hex()
        handler = type("_LiveHandler", (_Handler,), {"page": self, "secret": f"Bearer {self._token}"})
        self._server = LocalServer("127.0.0.1", 0, handler, name="igtl-page", deadline_s=_DEADLINE_S)
        path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
        self._child = Child(
            "page",
            _COMMAND,
            on_line=self._on_line,
            on_end=self._has_ended.set,
            env={**os.environ, "PYTHONPATH": path},
        )
        settings = {
            "host": place[0],
            "port": place[1],
            "allow": list(allow),
            "tls": tls,
            "folder": str(recording.absolute().parent) if recording else "",
            "bridge": f"http://{self._server.address}",
            "token": self._token,
        }
        self._child.write(json.dumps(settings) + "\n")

    def picture(self, side: str, stream: str) -> bytes:
        """Return the message of the last picture; empty if there is none, or if the session rejects it."""
        data, session = self.pictures.get(side, stream), self._session
        if data and session:
            try:
                Acceptance.of(session.bridge.gateway.config).message(data)
            except WireError:
                return b""
        return data

    def numbers(self, side: str, stream: str) -> dict[str, Any]:
        """Return the messages of a stream since the last call; see ``LiveNumbers.take``."""
        session = self._session
        if not session:
            return {"messages": [], "problem": "no session runs"}
        return self.pictures.numbers.take(session.bridge, side, stream)

    def update(self, session: RunningSession | None, events: Sequence[NoteEvent] = ()) -> None:
        """Take the session that runs now, and its notes since the last call.  Twice a second, after its ``collect``."""
        self._at_ns = now_ns = self._clock.monotonic_ns()
        is_due = bool(events) or now_ns - self._sampled_ns >= _SAMPLE_NS
        if session is not self._session:
            self._session, self._begun_ns, is_due = session, now_ns, True
        for event in events:
            note = event.note
            self._number += 1
            row = {
                "number": self._number,
                "time_ns": event.stamp_ns,
                "level": note.level.name,
                "code": note.code,
                "text": note.text,
                "more": event.more,
            }
            self._notes.append(row)
            if note.code in _DONE:
                self._done.append(row)
        if self._links:
            links, self._links = self._links, None
            self._on_links(*links)
        if self._has_ended.is_set() and not self._closing and session:
            self._closing = True
            why = self._why or self._child.exit_reason() or "its process was ended"
            session.bridge.hub.note(Note(Level.WARN, PAGE, f"the page has ended: {why}; the bridge goes on"))
            self._server.close()
        if is_due:
            self._sampled_ns = now_ns
            self._change()

    def close(self) -> None:
        """End the process."""
        if not self._closing:
            self._closing = True
            self._server.close()
        self._child.close_input()
        self._child.wait(_END_S)
        self._child.kill()

    def wait(self, known: int) -> int:
        """Wait for another version of the facts than a known one, for some time; return it."""
        with self._changed:
            self._changed.wait_for(lambda: self._version != known, _STILL_S)
            return self._version

    def _change(self) -> None:
        with self._changed:
            self._version += 1
            self._changed.notify_all()

    def facts(self) -> dict[str, Any]:
        """Return what the page shows."""
        session = self._session
        facts = self._facts_of(session) if session else None
        pictures = self.pictures.names()
        if session and facts:
            for kind, stream in self.pictures.wanted(facts["totals"]):
                session.bridge.show(kind, stream)
        return {
            "facts": facts,
            "recording": _recording(session.bridge) if session else None,
            "notes": list(self._notes),
            "done": list(self._done),
            "types": dict(self.pictures.types),
            "pictures": pictures,
        }

    def _facts_of(self, session: RunningSession) -> dict[str, Any]:
        if self._clock.monotonic_ns() - self._at_ns > _COLLECTED_NS:
            session.bridge.collect()
            self._at_ns = self._clock.monotonic_ns()
        at_ns = self._at_ns
        more = {"at_ns": at_ns, "uptime_s": (at_ns - self._begun_ns) / NS_PER_S, "refused": session.watch.refused}
        return sample_of(session.bridge) | more

    def act(self, what: str, line: str, since_ns: int = 0) -> tuple[bool, str]:
        """Do what was pressed; return whether it was possible, and a sentence for people.

        Args:
            since_ns: the moment that is marked, monotonic; 0: now.
        """
        try:
            return self._act(what, line, since_ns)
        finally:
            self._change()

    def _act(self, what: str, line: str, since_ns: int) -> tuple[bool, str]:
        session = self._session
        if session is None:
            return False, "no session runs"
        bridge = session.bridge
        if what == "mark":
            if bridge.recorder and bridge.recorder.rests:
                return False, "nothing is recorded; start the recording first"
            try:
                ago_ns = max(0, self._clock.monotonic_ns() - since_ns) if since_ns else 0
                mark = MarkNote.parse(line, _WHO, ago_ns)
                bridge.mark(mark)
            except GatewayError as error:
                return False, str(error)
            ago = f", {duration_text(mark.ago_ns)} ago" if mark.ago_ns > NS_PER_S else ""
            return True, (f"the phase {mark.label} {mark.phase}s" if mark.phase else "the mark is set") + ago
        if what == "end":
            bridge.hub.note(Note(Level.INFO, PAGE, "the end of the bridge was pressed on the page"))
            self._on_stop()
            return True, "the bridge ends and closes the recording"
        action = RECORDING_ACTIONS.get(what)
        if action is None:
            return False, f"found {what[:40]!r}, expected one of mark, end, {', '.join(RECORDING_ACTIONS)}"
        if bridge.recorder is None:
            return False, "there is no recording; start the bridge with --record FILE"
        bridge.hub.note(Note(Level.INFO, PAGE, f"{what} was pressed on the page"))
        return action(bridge.recorder)

    def _on_line(self, line: str) -> None:
        try:
            found = json.loads(line)
            if "link" in found:
                self._links = str(found["link"]), str(found["spectators"])
            self._why = str(found.get("why", self._why))
        except (ValueError, KeyError, TypeError, AttributeError):
            return  # a line that was cut off


def _recording(bridge: Bridge) -> dict[str, Any] | None:
    """Return what can be done with the recording; None: there is none."""
    recorder, how = bridge.recorder, bridge.options.recording
    if recorder is None or bridge.options.record is None:
        return None
    return {
        "snapshot_s": how.snapshot_s,
        "triggers": [str(rule) for rule in how.triggers],
        "split": how.has_parts,
        "sealed": how.seal is not None,
        "path": str(bridge.options.record.absolute()),
        "phases": bridge.gateway.phases.labels,
    }


class _Handler(Handler):
    page: BridgePage
    secret: str

    def get(self, path: str) -> None:
        if not self._is_the_page():
            return
        if path == "/facts":
            self._follow()
        elif path == "/picture":
            words = parse_qs(urlsplit(self.path).query)
            data = self.page.picture(*(words.get(name, [""])[0] for name in ("side", "stream")))
            self.begin(200, "application/octet-stream", len(data))
            self.wfile.write(data)
        elif path == "/numbers":
            words = parse_qs(urlsplit(self.path).query)
            found = self.page.numbers(*(words.get(name, [""])[0] for name in ("side", "stream")))
            self.answer(200, "application/json", json.dumps(found, separators=(",", ":")))
        else:
            self.answer(404, "text/plain; charset=utf-8", "not found\n")

    def post(self, path: str, body: bytes) -> None:
        if not self._is_the_page():
            return
        found = json.loads(body)
        done, text = self.page.act(str(found.get("do")), str(found.get("line", "")), int(found.get("since_ns", 0)))
        self.answer(200, "application/json", json.dumps({"done": done, "text": text}))

    def _follow(self) -> None:
        """Send the facts whenever they change, until the page leaves or the deadline of the server has come.

        What is as it was in the line before is left out: most notes and types.
        """
        self.begin(200, "application/x-ndjson", None)
        known, before = 0, dict[str, Any]()
        while True:
            facts = self.page.facts()
            new = {name: found for name, found in facts.items() if name not in before or found != before[name]}
            self.wfile.write(json.dumps(new, separators=(",", ":")).encode() + b"\n")
            before = facts
            known = self.page.wait(known)

    def _is_the_page(self) -> bool:
        given = self.headers.get("Authorization", "")
        known = compare_digest(given.encode("utf-8", "replace"), self.secret.encode())
        if not known:
            self.answer(403, "text/plain; charset=utf-8", "found another token, expected that of the page\n")
        return known
