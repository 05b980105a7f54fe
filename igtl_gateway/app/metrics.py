"""The status of a bridge over HTTP: ``/metrics`` for Prometheus, ``/status`` as JSON.

It is read-only and has a thread of its own, which takes one question at a time and gives each a few seconds; what it
tells is the last sample (``app.status``), so that nothing here waits for the bridge, or the bridge for it.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.edges.tcp.sockets import AllowList, address_text, listening_socket

#: Longest that one question may take from its first byte to the last of the answer: others wait for it.
DEADLINE_S = 5.0

#: How soon `MetricsServer.close` is heard.
_LOOK_S = 0.1

Facts = Mapping[str, Any]
#: Labels and value of one line.
Line = tuple[dict[str, str], float]


@dataclass(frozen=True, slots=True)
class Metric:
    """A row of the table: a metric of Prometheus and where its lines come from."""

    name: str
    kind: str
    meaning: str
    lines: Callable[[Facts], Iterator[Line]]


def _one(*path: str) -> Callable[[Facts], Iterator[Line]]:
    """The number at that place; none where there is none."""

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
    Metric("recording", "gauge", "1: recording; 0: paused or failed", _recording),
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
)

PREFIX = "igtl_gateway_"


def prometheus(facts: Facts) -> str:
    """The facts in the text format of Prometheus, version 0.0.4."""
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
        url: of the metrics.

    Args:
        host, port: where; port 0 chooses a free one.
        status: of what.
        allow: networks (CIDR) that may ask beside this host.
        deadline_s: see ``DEADLINE_S``.

    Raises ConfigError and Unavailable as ``TcpEdge.listen`` does.
    """

    def __init__(
        self, host: str, port: int, status: BridgeStatus, allow: Sequence[str] = (), deadline_s: float = DEADLINE_S
    ) -> None:
        self._server = _Server(host, port, status, AllowList(allow), deadline_s)
        self.url = f"http://{address_text(self._server.server_address)}/metrics"
        serve = partial(self._server.serve_forever, _LOOK_S)
        self._thread = threading.Thread(target=serve, name="igtl-metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(HTTPServer):
    def __init__(self, host: str, port: int, status: BridgeStatus, allow: AllowList, deadline_s: float) -> None:
        listener = listening_socket(host, port, allow)
        super().__init__(listener.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()  # that of the library: ours says what is wrong where it cannot be bound
        self.socket = listener
        self.status = status
        self.deadline_s = deadline_s
        self._allow = allow

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return client_address[0] in self._allow

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Whoever asked has gone, or was cut off: that is their affair."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def setup(self) -> None:
        super().setup()
        self._deadline = threading.Timer(self.server.deadline_s, self._cut_off)
        self._deadline.daemon = True
        self._deadline.start()

    def finish(self) -> None:
        self._deadline.cancel()
        super().finish()

    def _cut_off(self) -> None:
        try:
            self.connection.shutdown(2)  # both directions: whoever waits for it goes on at once
        except OSError:  # gone already
            return

    def do_GET(self) -> None:
        facts = self.server.status.facts
        match self.path.partition("?")[0]:
            case "/metrics":
                self._answer(200, "text/plain; version=0.0.4; charset=utf-8", prometheus(facts))
            case "/status":
                self._answer(200, "application/json", json.dumps(facts, ensure_ascii=False, default=str))
            case _:
                self._answer(404, "text/plain; charset=utf-8", "here are /metrics and /status\n")

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, code: int, kind: str, text: str) -> None:
        data = text.encode("utf-8", "backslashreplace")
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Questions are no events of the session."""
