"""The native passage of a bridge: what it needs of the edges and of the recorder."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway import Gateway
from igtl_gateway.gateway.core import is_kept
from igtl_gateway.gateway.fastpath.passage_streams import SURFACE, OnPassed, PassageStreams
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.fates import CONVERTED
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.session import Core
from igtl_gateway.native.passage import Link, Lock, Passage, Publisher, Subscription, is_compiled
from igtl_gateway.wire.query import is_dialogue

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder

#: A publisher for bridges without ROS.
_NOWHERE = 0


#: Where the time of messages goes.  ``middleware``: from the source stamp of a ROS message until the passage has it, so
#: DDS and the scheduler.  ``sequence``: until it has the sequence lock.  ``conversion``: until it has its number, with
#: the recorder's lock and the guard.  ``output``: until it is sent or published.  ``recording``: until it is in the
#: recorder's memory.
PHASES = ("middleware", "sequence", "conversion", "output", "recording")
DIRECTIONS = ("igtl_to_ros", "ros_to_igtl")

#: Code of the notes of `StreamReports`.
NATIVE_PASSAGE = "native_passage"
#: Looks, a second apart: after its start a publisher waits three seconds for subscribers.
_LOOKS_BEFORE_PYTHON = 6
#: Messages after which a stream should be compiled.
_MESSAGES_BEFORE_PYTHON = 16
#: Streams: a peer that invents names must not flood the terminal.
_MOST_REPORTED = 200
_DIRECTIONS_IN = ("igtl_in", "ros_in")
#: OpenIGTLink type → why it has no compiled stream; queries, commands and states are too rare for a report.
_NOT_COMPILED = {"POLYDATA": SURFACE}

_SHARES = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999, "max_us": 1.0}


def percentiles(counts: Sequence[tuple[int, int]]) -> dict[str, float]:
    """Return percentiles (microseconds, at most a fifth too high) of (upper bound in ns, messages) in rising order."""
    total = sum(number for _, number in counts)
    found = {}
    for name, share in _SHARES.items():
        below = 0
        for above_ns, number in counts:
            below += number
            if below >= share * total:
                found[name] = above_ns / 1_000
                break
    return found


def times_of(rows: Sequence[Sequence[tuple[int, int]]]) -> dict[str, dict[str, dict[str, float]]]:
    """Return direction → phase → percentiles, for phases that messages had, from the times of a passage."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for number, row in enumerate(rows):
        if row:
            direction, phase = DIRECTIONS[number // len(PHASES)], PHASES[number % len(PHASES)]
            found.setdefault(direction, {})[phase] = percentiles(row)
    return found


def why_not_native(clock: Clock, causes: Mapping[str, bool]) -> str:
    """Return why a bridge has no native passage, the first of the causes that apply; "": it can have one."""
    own = {
        "installed without a C compiler": not is_compiled(),
        "another clock than the system's": not isinstance(clock, SystemClock),
    }
    return next((cause for cause, applies in {**own, **causes}.items() if applies), "")


class StreamReports:
    """Which streams pass natively, in a note for each: at once if it does, else after some looks.

    These notes are of this host: the recording does not have them.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._looks: dict[tuple[str, str], int] = {}
        self._native: dict[tuple[str, str], bool] = {}  # what was reported

    def look(self, states: Mapping[tuple[str, str], str]) -> list[Note]:
        """Return what is to be reported now; the caller has the sequence lock.

        Args:
            states: (direction, stream) → "" or why Python passes it, of compiled streams.
        """
        found = {
            (direction, stream): _NOT_COMPILED.get(stream.partition("/")[0], "its type or profile has no fast one")
            for direction in _DIRECTIONS_IN
            for stream in self._ledger.streams(direction)
            if (direction, stream) not in self._native
            and self._ledger.counter(direction, stream).get(CONVERTED, 0) >= _MESSAGES_BEFORE_PYTHON
            and not is_dialogue(stream.partition("/")[0])
        }
        notes = []
        for key, why in sorted((found | dict(states)).items()):
            if key not in self._looks and len(self._looks) >= _MOST_REPORTED:
                continue
            looks = self._looks[key] = self._looks.get(key, 0) + 1
            if self._native.get(key) if not why else key in self._native or looks < _LOOKS_BEFORE_PYTHON:
                continue
            self._native[key] = not why
            way = f"the slower way: {why}" if why else "the fast way"
            notes.append(Note(Level.INFO, NATIVE_PASSAGE, f"{key[1]} takes {way}", key[1], {"native": not why}))
        return notes


class BridgePassage:
    """Connects a passage with a gateway, its edges and its recorder.

    Args:
        on_passed: see ``OnPassed``.

    Attributes:
        recorder_lock: guards the queue of the recorder.
    """

    def __init__(self, passage: Passage, gateway: Core, tcp: TcpEdge, ros: RosSide | None, on_passed: OnPassed) -> None:
        passage.builds_all = gateway.has_subscriber is None
        self._passage = passage
        self._tcp = tcp
        self._ros = ros
        self._recorder: Recorder | None = None
        self._attendant: threading.Thread | None = None
        self._is_stopping = False
        self.recorder_lock = Lock()
        self._nowhere = Publisher(_NOWHERE)
        self.streams = PassageStreams(passage, self, self._number_of, on_passed, is_kept)
        if isinstance(gateway, Gateway):
            gateway.fast_path.native = self.streams
        self._reports = StreamReports(gateway.ledger)

    def record_into(self, recorder: Recorder) -> None:
        """Record what passes; to be called before the first message."""
        self._recorder = recorder
        self._passage.record_into(recorder.queue.memory, self.recorder_lock)
        self._attendant = threading.Thread(target=self._attend, args=(recorder,), name="igtl-recorder", daemon=True)
        self._attendant.start()

    def _attend(self, recorder: Recorder) -> None:
        """Do what the recorder's queue needs of Python, so that no message has to go there for it."""
        while not self._is_stopping:
            if room := self._passage.wait_recorder():
                recorder.attend(room)

    def collect(self) -> None:
        """Take over what was counted natively, in slices: messages pass in between."""
        with self._passage:
            self.streams.collect_removed()
            slices = self.streams.slices()
        for keys in slices:
            with self._passage:
                self.streams.collect_some(keys)
        if self._ros:
            self._ros.sync()

    def times(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return where the time of messages went; see ``times_of``."""
        with self._passage:
            rows = self._passage.times()
        return times_of(rows)

    def look(self) -> list[Note]:
        """Copy the streams whose publisher has become ready; return notes as `StreamReports`.  Once a second."""
        with self._passage:
            self.streams.retry()
            return self._reports.look(self.streams.states())

    def show(self, kind: Kind, channel: str) -> None:
        """Have Python pass the next message of a stream."""
        if keys := self.streams.keys_with(kind, channel):
            with self._passage:
                self.streams.pass_once(keys)

    def stop(self) -> None:
        """Leave all messages to Python."""
        with self._passage:
            self._passage.closed = True
            self.streams.drop_all()
        if self._attendant:
            self._is_stopping = True
            self._passage.wake()
            self._attendant.join()

    # -- what the streams need (NativeEdges) --------------------------------------------------------------------

    def link(self, number: int) -> Link | None:
        return self._tcp.native_link(number)

    def ignore(self, channel: str, messages: int) -> None:
        self._tcp.ignore(channel, messages)

    def max_body(self, igtl_type: str) -> int:
        return self._tcp.max_body(igtl_type)

    def publisher(self, topic: str, ros_type: str) -> Publisher | None:
        return self._ros.native_publisher(topic, ros_type) if self._ros else self._nowhere

    def subscription(self, topic: str, ros_type: str) -> Subscription | None:
        return self._ros.native_subscription(topic, ros_type) if self._ros else None

    def _number_of(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int | None:
        if self._recorder is None:
            return 0
        with self.recorder_lock:
            number = self._recorder.queue.stream_number(kind, channel, type_name, links)
        return number if number >= 0 else None
