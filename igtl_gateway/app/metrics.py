"""The status of a bridge over HTTP: ``/metrics`` for Prometheus, ``/status`` as JSON; ``POST /mark`` makes a mark.

The server (``edges.tcp.http_server``) returns the last sample (``app.status``), so neither the server nor the bridge
waits for the other.  A mark is all that it changes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.shape import anything, fields, text, unexpected
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.edges.tcp.http_server import DEADLINE_S, Handler, LocalServer
from igtl_gateway.gateway.log.marks import MarkNote, ago_ns

Facts = Mapping[str, Any]
#: Labels and value of one line of the text format.
Line = tuple[dict[str, str], float]


@dataclass(frozen=True, slots=True)
class Metric:
    """A row of the table: a metric of Prometheus, and the function that returns its lines."""

    name: str
    kind: str
    meaning: str
    lines: Callable[[Facts], Iterator[Line]]


def _one(*path: str) -> Callable[[Facts], Iterator[Line]]:
    """Return a function that yields one line with the number at this path of the facts, or no line without it."""

    def lines(facts: Facts) -> Iterator[Line]:
        found: Any = facts
        for name in path:
            found = found[name] if found is not None else None
        if found is not None:
            yield {}, float(found)

    return lines


def _entries(facts: Facts) -> Iterator[Line]:
    for kind, number in facts["entries"].items():
        yield {"kind": kind}, number


def _rates(facts: Facts) -> Iterator[Line]:
    for direction, rates in facts["rates"].items():
        if direction not in ("over_s", "entries"):
            for stream, rate in rates.items():
                yield {"direction": direction, "stream": stream}, rate


def _streams(facts: Facts) -> Iterator[Line]:
    for direction, books in facts["ledger"]["streams"].items():
        for stream, fates in books.items():
            for fate, number in fates.items():
                if fate != "dropped":
                    yield {"direction": direction, "stream": stream, "fate": fate}, number


def _stream_drops(facts: Facts) -> Iterator[Line]:
    for direction, books in facts["ledger"]["streams"].items():
        for stream, fates in books.items():
            for reason, number in fates.get("dropped", {}).items():
                yield {"direction": direction, "stream": stream, "reason": reason}, number


def _peers(facts: Facts) -> Iterator[Line]:
    for peer in facts["peers"]:
        yield {"link": str(peer["link"]), "peer": peer["peer"], "role": peer["role"]}, float(peer["connected"])


def _clocks(fields: Mapping[str, str], scale: float = 1.0) -> Callable[[Facts], Iterator[Line]]:
    """Return a function that yields the bounds of peers' clocks: bound → its field."""

    def lines(facts: Facts) -> Iterator[Line]:
        for peer in facts["peers"]:
            for bound, name in fields.items():
                if peer["clock"] and (found := peer["clock"][name]) is not None:
                    yield {"link": str(peer["link"]), "peer": peer["peer"], "bound": bound}, found / scale

    return lines


def _of_links(count: str) -> Callable[[Facts], Iterator[Line]]:
    def lines(facts: Facts) -> Iterator[Line]:
        for link, counts in facts["ledger"]["links"].items():
            yield {"link": link}, counts[count]

    return lines


def _link_drops(facts: Facts) -> Iterator[Line]:
    for link, counts in facts["ledger"]["links"].items():
        for reason in ("dropped", "ignored"):
            for stream, number in counts[reason].items():
                yield {"link": link, "stream": stream, "reason": reason}, number


def _refused(facts: Facts) -> Iterator[Line]:
    for reason, number in facts["ledger"].get("refused", {}).items():
        yield {"reason": reason}, number


def _link_faults(facts: Facts) -> Iterator[Line]:
    for code, number in facts["ledger"].get("link_faults", {}).items():
        yield {"code": code}, number


def _queues(what: str) -> Callable[[Facts], Iterator[Line]]:
    def lines(facts: Facts) -> Iterator[Line]:
        for link, queue in facts["queues"].items():
            yield {"link": link}, queue[what]

    return lines


def _ros(facts: Facts) -> Iterator[Line]:
    for topic, counts in facts["ledger"]["ros_topics"].items():
        for fate, number in counts.items():
            yield {"topic": topic, "fate": fate}, number


def _recording(facts: Facts) -> Iterator[Line]:
    recorder = facts["recorder"]
    if recorder:
        yield {"path": recorder["path"]}, float(not recorder["failure"] and not recorder["paused"])


_LINK_0 = "link 0: all closed links together"

METRICS = (
    Metric("uptime_seconds", "gauge", "time since the start of the bridge", _one("uptime_s")),
    Metric("entries_total", "counter", "entries of the session log, by kind", _entries),
    Metric("refused_total", "counter", "notes of level error, for example for a wrong CRC", _one("refused")),
    Metric("stream_messages_total", "counter", "messages by stream and fate (loss ledger)", _streams),
    Metric("stream_dropped_total", "counter", "dropped messages by stream and reason (loss ledger)", _stream_drops),
    Metric("stream_rate", "gauge", "messages per second, mean of the last 5 s", _rates),
    Metric("peer_connected", "gauge", "1: connected; 0: connection attempts", _peers),
    Metric(
        "peer_clock_offset_seconds",
        "gauge",
        "how far the clock of a peer is ahead of gateway time: at least (bound low), at most (bound high)",
        _clocks({"low": "low_ns", "high": "high_ns"}, NS_PER_S),
    ),
    Metric(
        "peer_clock_drift_ppm",
        "gauge",
        "how much faster than gateway time it runs, in millionths: at least (bound low), at most (bound high)",
        _clocks({"low": "drift_low_ppm", "high": "drift_high_ppm"}),
    ),
    Metric("peers_refused_total", "counter", "refused connections by reason", _refused),
    Metric("link_faults_total", "counter", "links that ended with a fault or inside a message", _link_faults),
    Metric(
        "link_sent_messages_total", "counter", f"messages passed to the kernel; {_LINK_0}", _of_links("sent_messages")
    ),
    Metric("link_sent_bytes_total", "counter", f"bytes passed to the kernel; {_LINK_0}", _of_links("sent_bytes")),
    Metric(
        "link_received_messages_total",
        "counter",
        f"complete messages received; {_LINK_0}",
        _of_links("received_messages"),
    ),
    Metric("link_received_bytes_total", "counter", f"bytes received; {_LINK_0}", _of_links("received_bytes")),
    Metric(
        "link_dropped_total",
        "counter",
        "messages dropped because the send queue was full, or ignored because the link was closed",
        _link_drops,
    ),
    Metric("link_queue_messages", "gauge", "messages in the send queue", _queues("messages")),
    Metric("link_queue_bytes", "gauge", "bytes in the send queue", _queues("bytes")),
    Metric("ros_messages", "gauge", "messages of a ROS topic by fate, and number of held messages", _ros),
    Metric("recording", "gauge", "1: recording; 0: paused, stopped or failed", _recording),
    Metric("recorder_entries_total", "counter", "entries written", _one("recorder", "written_entries")),
    Metric("recorder_dropped_total", "counter", "entries dropped by the recorder", _one("recorder", "dropped_entries")),
    Metric(
        "recorder_left_out_total",
        "counter",
        "entries not recorded because of the user's selection",
        _one("recorder", "left_out_entries"),
    ),
    Metric("recorder_queue_entries", "gauge", "entries in the recorder's queue", _one("recorder", "queued_entries")),
    Metric("recorder_queue_bytes", "gauge", "bytes in the recorder's queue", _one("recorder", "queued_bytes")),
    Metric("upload_waiting_files", "gauge", "closed files that the store has not confirmed", _one("upload", "waiting")),
    Metric("upload_waiting_bytes", "gauge", "their size", _one("upload", "waiting_bytes")),
    Metric("upload_sent_bytes_total", "counter", "bytes sent to the store", _one("upload", "sent_bytes")),
    Metric("upload_confirmed_total", "counter", "files that the store has confirmed", _one("upload", "confirmed")),
    Metric(
        "upload_last_confirmed_seconds",
        "gauge",
        "UTC time of the last one; 0: none",
        _one("upload", "last_confirmed_s"),
    ),
)

PREFIX = "igtl_gateway_"

_MARK = fields(
    {**dict.fromkeys(("label", "text", "who", "phase"), text), "ago_s": anything},  # checked where it is converted
    needed=("label",),
    other=unexpected,
)


def prometheus(facts: Facts) -> str:
    """Return the facts in the text format of Prometheus, version 0.0.4."""
    output = [f"# HELP {PREFIX}info version", f"# TYPE {PREFIX}info gauge"]
    output.append(f"{PREFIX}info{_labels({'version': facts['version']})} 1")
    for metric in METRICS:
        name = PREFIX + metric.name
        lines = [f"{name}{_labels(labels)} {value:.17g}" for labels, value in metric.lines(facts)]
        if lines:
            output += [f"# HELP {name} {metric.meaning}", f"# TYPE {name} {metric.kind}", *lines]
    return "\n".join(output) + "\n"


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items()) + "}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


class MetricsServer:
    """Serves a `BridgeStatus` until closed.

    Attributes:
        url: address of the metrics.

    Args:
        host, port: address to listen on; port 0 chooses a free port.
        status: the status to serve.
        mark: makes a mark, see ``Bridge.mark``.
        allow: networks (CIDR) whose clients may connect in addition to those of this host.
        deadline_s: longest duration of a request, in seconds; see ``DEADLINE_S``.

    Raises ConfigError and Unavailable as ``TcpEdge.listen`` does.
    """

    def __init__(
        self,
        host: str,
        port: int,
        status: BridgeStatus,
        mark: Callable[[MarkNote], None],
        allow: Sequence[str] = (),
        deadline_s: float = DEADLINE_S,
    ) -> None:
        handler = type("_StatusHandler", (_Handler,), {"status": status, "mark": staticmethod(mark)})
        self._server = LocalServer(host, port, handler, name="igtl-metrics", allow=allow, deadline_s=deadline_s)
        self.url = f"http://{self._server.address}/metrics"

    def close(self) -> None:
        """Stop the server and close its socket."""
        self._server.close()


class _Handler(Handler):
    status: BridgeStatus
    mark: Callable[[MarkNote], None]

    def get(self, path: str) -> None:
        facts = self.status.facts
        match path:
            case "/metrics":
                self.answer(200, "text/plain; version=0.0.4; charset=utf-8", prometheus(facts))
            case "/status":
                self.answer(200, "application/json", json.dumps(facts, ensure_ascii=False, default=str))
            case _:
                self.answer(404, "text/plain; charset=utf-8", "not found; available: /metrics and /status\n")

    def post(self, path: str, body: bytes) -> None:
        if path != "/mark":
            super().post(path, body)
            return
        try:
            mark = _mark_of(body)
            self.mark(mark)
        except GatewayError as error:
            self.answer(400, "application/json", json.dumps({"error": str(error)}))
        else:
            self.answer(200, "application/json", json.dumps({"label": mark.label}))


def _mark_of(body: bytes) -> MarkNote:
    """Return the mark in a request: an object with ``label`` and, if wanted, ``text``, ``who``, ``phase``, ``ago_s``.

    Raises GatewayError.
    """
    found = parse_json(body.decode("utf-8", "replace"), "body")
    _MARK(found, "body")
    return MarkNote(ago_ns=ago_ns(found.pop("ago_s", 0)), **{"who": "http", **found})
