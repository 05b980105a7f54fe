"""A bridge between OpenIGTLink and ROS 2 inside a program, with the settings of ``igtl-gateway bridge``."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from types import TracebackType
from typing import Any

from igtl_gateway.api.keywords import checked, of_a_bridge, ros_arguments
from igtl_gateway.app.bridge import Bridge as RunningBridge
from igtl_gateway.app.bridge_options import bridge_options, zenoh_endpoint
from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.recording import pause, resume, snapshot, start, stop
from igtl_gateway.app.setting_values import declared, settled
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import NoReply, RecordingError
from igtl_gateway.base.versions import Self
from igtl_gateway.config.settings import all_settings
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.tcp import LinkInfo
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import BEGIN, END, MarkNote, ago_ns
from igtl_gateway.gateway.log.note import Level, Note

_NOTES = 100


@dataclass(frozen=True, slots=True)
class BridgeCounts:
    """The traffic of a bridge so far.

    Attributes:
        entries: entries of the session log by kind, such as ``igtl_in`` and ``ros_out``.
        errors: number of notes with the level error.
        streams: direction → stream → fate → number of messages, as in the loss ledger.
        links: number of the connection → its counts; ``"0"``: all connections that have ended.
    """

    entries: dict[str, int]
    errors: int
    streams: dict[str, Any]
    links: dict[str, Any]


@dataclass(frozen=True, slots=True)
class RecordingResult:
    """How the recording of a bridge ended.

    Attributes:
        path: the file; the folder of a split recording; the name that snapshots are called after.
        files: the files that were written.
        entries: number of entries in them.
        bytes: size of all files.
        dropped: entries that are missing because the recorder was too slow or failed, by stream.
        failure: why the recording ended early, or "".
    """

    path: Path
    files: tuple[Path, ...]
    entries: int
    bytes: int
    dropped: dict[str, int]
    failure: str


class Bridge:
    """A bridge between OpenIGTLink and ROS 2; a context manager that starts and stops it.

    The keyword arguments are the settings: the options of ``igtl-gateway bridge`` and the keys of its configuration
    file, with underscores, such as ``listen``, ``record``, ``deny_in``.  A setting has the value of its argument, else
    of the parameter in ``ros_args``, else that of the configuration file, else its default.  The node has all settings
    as parameters.

    Args:
        config: configuration file (TOML); None: the defaults.
        ros: join the ROS graph; False: OpenIGTLink only, for recordings of peers.  A string is the setting ``ros``:
            ``"zenoh:tcp/localhost:7447"`` joins the graph over Zenoh, without ROS.
        node_name: name of the ROS node.
        ros_args: arguments of ROS for the node, such as ``["-r", "__ns:=/or1", "-p", "max_age_s:=0.5"]``.
        on_note: called with each note (connections, refused and invalid messages, drops).  It must return quickly: the
            bridge waits for it.
        settings: name → value.  Lists of messages (``to_igtl``, ``to_ros``, ``tf_out``, ``peers``) take strings as
            their options do, or dicts as in a configuration file.

    Raises:
        ConfigError: an unknown setting, or a value that is out of range; parameters in ``ros_args`` are checked by
            `start`.

    Examples:
        >>> with Bridge(listen=["127.0.0.1:0"], ros=False) as bridge:
        ...     host, port = bridge.addresses[0]
        >>> host
        '127.0.0.1'
    """

    def __init__(
        self,
        *,
        config: str | PathLike[str] | None = None,
        ros: bool | str = True,
        node_name: str = "igtl_gateway",
        ros_args: Sequence[str] = (),
        on_note: Callable[[Note], None] | None = None,
        **settings: Any,
    ) -> None:
        self._ours = checked(settings | ({"ros": ros} if isinstance(ros, str) else {}), all_settings())
        if config is not None:
            self._ours["config"] = fspath(config)
        self._node_name = node_name
        self._on_note = on_note
        self._notes: deque[Note] = deque(maxlen=_NOTES)
        self._watch = EntryWatch()
        self._host: NodeHost | None = None
        with of_a_bridge():
            values = settled(self._ours, {})
            self._ros = bool(ros) and not values["relay"]
            has_node = self._ros and zenoh_endpoint(values) is None
            without = f"ros={values['ros']!r}" if self._ros else "relay=True" if ros else "ros=False"
            arguments = ros_arguments(ros_args, ros=has_node, without=without)
            if has_node:
                self._host = NodeHost(node_name, arguments=arguments)
            self._bridge = self._make(values)

    def __repr__(self) -> str:
        listens = ", ".join(f"{host}:{port}" for host, port in self.addresses)
        peers = sum(peer.connected for peer in self.peers)
        return f"<Bridge: {f'listens on {listens}' if listens else 'does not listen'}, {peers} peers>"

    def start(self) -> None:
        """Open the ports, join the ROS graph and begin the recording; the context manager calls it.

        Raises:
            Unavailable: a port is in use, or a permission is missing.
            RosError: ROS 2 is not installed.
            RecordingError: the recording cannot be written.
            ConfigError: wrong arguments or parameters of ROS.
        """
        try:
            with of_a_bridge():
                if self._host:
                    self._start_node(self._host)
                self._bridge.start()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Close all connections, and the recording; the context manager calls it.  A second call does nothing."""
        self._bridge.stop()
        if self._host:
            self._host.stop()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def addresses(self) -> tuple[tuple[str, int], ...]:
        """The addresses that it listens on, with the port that the system chose for port 0."""
        return tuple(self._bridge.addresses)

    @property
    def peers(self) -> tuple[LinkInfo, ...]:
        """The OpenIGTLink peers, and the servers that are not connected."""
        return tuple(self._bridge.tcp.links())

    @property
    def counts(self) -> BridgeCounts:
        """The counts so far."""
        ledger = self._bridge.ledger()
        entries = {kind.value: self._watch.counts[kind] for kind in Kind}
        return BridgeCounts(entries, self._watch.refused, ledger["streams"], ledger["links"])

    @property
    def notes(self) -> tuple[Note, ...]:
        """The last 100 notes."""
        return tuple(self._notes)

    @property
    def recording(self) -> RecordingResult | None:
        """How the recording ended; None before the end, and without a recording."""
        summary = self._bridge.summary
        if summary is None:
            return None
        return RecordingResult(
            summary.path, summary.files, summary.entries, summary.size, dict(summary.dropped), summary.failure
        )

    def wait_peers(self, count: int = 1, timeout_s: float | None = 5.0) -> None:
        """Wait for ``count`` connected peers.  Raises NoReply."""
        if not self._bridge.tcp.wait_links(count, timeout_s):
            raise NoReply(f"bridge: found fewer peers within {timeout_s:g} s, expected {count}")

    # ── while it runs ─────────────────────────────────────────────────────────────────────────────────────────

    def change(self, **changes: object) -> None:
        """Change settings while the bridge runs: ``deny_in``, ``deny_out``, ``max_age_s``, ``kinds``, ``active``.

        The change is an entry of the session, so that a recording can be verified.  The parameters of the node change
        with it.

        Raises:
            ConfigError: another setting, or a wrong value; nothing has changed.
        """
        self._bridge.change(changes)

    def mark(self, label: str, text: str = "", *, who: str = "", phase: str = "", ago_s: float = 0) -> None:
        """Mark this moment of the session; see docs/how-to/marks.md.

        Args:
            label: what it is called, such as ``"suture-3"``: up to 64 characters, without ``:``.
            text: more words, up to 1,000 characters.
            who: who made it, up to 64 characters.
            phase: ``"begin"`` or ``"end"`` of the phase of this label; "": a moment.
            ago_s: how long ago the moment was, at most since the session began.

        Raises:
            ConfigError: a field has another value, the phase is open already, or it is not open.
            Unavailable: the bridge does not run.
        """
        self._bridge.mark(MarkNote(label, text, who, phase, ago_ns(ago_s)))

    @contextmanager
    def phase(self, label: str, text: str = "", *, who: str = "") -> Iterator[None]:
        """Context manager: a phase from here to the end of the ``with`` block; see `mark`."""
        self.mark(label, text, who=who, phase=BEGIN)
        try:
            yield
        finally:
            self.mark(label, who=who, phase=END)

    def start_recording(self) -> None:
        """Begin the next file, after a stop or with the setting ``record_wait``.  Raises RecordingError."""
        self._control(start)

    def stop_recording(self) -> None:
        """Close the file; the bridge goes on.  Raises RecordingError if none is written."""
        self._control(stop)

    def pause_recording(self) -> None:
        """Pause the recording.  Raises RecordingError if there is none, or it has failed."""
        self._control(pause)

    def resume_recording(self) -> None:
        """Continue the recording.  Raises RecordingError if there is none, or it has failed."""
        self._control(resume)

    def save_snapshot(self) -> Path:
        """Write the last seconds of a bridge with the setting ``snapshot``, and return the file.

        Raises:
            RecordingError: the bridge has no such buffer, or the file cannot be written.
        """
        recorder = self._bridge.recorder
        if recorder is None or not recorder.options.snapshot_s:
            raise RecordingError("snapshot: found no buffer for it, expected the settings record and snapshot")
        return Path(self._control(snapshot))

    def _start_node(self, host: NodeHost) -> None:
        """Join the graph, and take the parameters that the node was started with."""
        prepare_environment()
        host.start(self._on_callback_error)
        if overrides := host.overrides():
            self._bridge.stop()
            values = settled(self._ours, overrides)
            self._bridge = self._make(values)
        else:
            values = settled(self._ours, {})
        host.declare(declared(values, self._bridge.gateway.config))

    def _make(self, values: Mapping[str, Any]) -> RunningBridge:
        """Return the bridge for the values of all settings; it does not run."""
        session, options = bridge_options(values, ros=self._ros, node_name=self._node_name, given=self._ours)
        return RunningBridge(
            session, options, SystemClock(), self._on_entry, on_passed=self._watch.add, host=self._host
        )

    def _on_callback_error(self, error: Exception) -> None:
        self._bridge.hub.note(Note(Level.ERROR, "internal_error", f"callback: {type(error).__name__}: {error}"))

    def _control(self, action: Callable[[Any], tuple[bool, str]]) -> str:
        if self._bridge.recorder is None:
            raise RecordingError("recording: found none, expected the setting record")
        done, text = action(self._bridge.recorder)
        if not done:
            raise RecordingError(text)
        return text

    def _on_entry(self, entry: Entry) -> None:
        self._watch(entry)
        for event in self._watch.take():
            self._notes.append(event.note)
            if self._on_note:
                self._on_note(event.note)
