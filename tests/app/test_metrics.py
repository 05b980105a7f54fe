"""The status over HTTP: its content, the clients that it answers, and that no client can block it."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.metrics import METRICS, PREFIX, MetricsServer, prometheus
from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.tcp.http_server import MAX_CONNECTIONS, KnownHosts
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from tests.places import ROOT
from tests.timing import WAIT_S

HELLO = join(encode(Message("STRING", 'A "quoted" name', String.of("hello"), 7 << 32)))
#: A line of a metric: name, labels, number.
LINE = re.compile(r'([a-z_0-9]+)(\{(?:[a-z]+="(?:[^"\\\n]|\\.)*",?)*\})? ([-+0-9.e]+)')


@contextmanager
def bridge(tmp_path: Path, refused: threading.Event) -> Iterator[tuple[Bridge, BridgeStatus]]:
    """A real one, without ROS, that records; ``refused`` is set when it has refused something."""
    watch, clock = EntryWatch(), SystemClock()

    def look(entry: Entry) -> None:
        watch(entry)
        if watch.refused:
            refused.set()

    options = BridgeOptions(listen=(("127.0.0.1", 0),), ros=False, record=tmp_path / "out.mcap")
    one = Bridge(Config(), options, clock, look)
    one.start()
    try:
        yield one, BridgeStatus(one, watch, clock)
    finally:
        one.stop()


def port_of(server: MetricsServer) -> int:
    return int(server.url.rpartition(":")[2].partition("/")[0])


def ask(server: MetricsServer, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
    with closing(HTTPConnection("127.0.0.1", port_of(server), timeout=WAIT_S)) as connection:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def values(page: str) -> dict[str, float]:
    lines = [LINE.fullmatch(line) for line in page.splitlines() if not line.startswith("#")]
    assert all(lines), page
    return {found[1] + (found[2] or ""): float(found[3]) for found in lines if found}


def test_a_bridge_is_scraped(tmp_path: Path) -> None:
    refused = threading.Event()
    with bridge(tmp_path, refused) as (one, status), closing(MetricsServer("127.0.0.1", 0, status, one.mark)) as server:
        with socket.create_connection(one.addresses[0]) as peer:
            peer.sendall(3 * HELLO + HELLO[:50] + bytes(8) + HELLO[58:])
            assert refused.wait(WAIT_S)
            status.sample()
            code, page = ask(server, "/metrics")
            facts = json.loads(ask(server, "/status")[1])
    assert code == 200
    told = values(page)
    stream = r'direction="igtl_in",stream="STRING/A \"quoted\" name"'
    assert told[f'{PREFIX}stream_messages_total{{{stream},fate="received"}}'] == 4
    assert told[f'{PREFIX}stream_dropped_total{{{stream},reason="bad_crc"}}'] == 1
    assert told[f'{PREFIX}link_received_bytes_total{{link="1"}}'] == 4 * len(HELLO)
    assert told[f'{PREFIX}entries_total{{kind="igtl_in"}}'] == 4
    assert told[f"{PREFIX}refused_total"] == 1
    assert told[f'{PREFIX}recording{{path="{tmp_path / "out.mcap"}"}}'] == 1
    assert told[f'{PREFIX}link_queue_messages{{link="1"}}'] == 0
    assert told[f"{PREFIX}uptime_seconds"] > 0
    assert facts["ledger"]["streams"]["igtl_in"]['STRING/A "quoted" name']["received"] == 4
    assert facts["peers"][0]["connected"]
    assert facts["recorder"]["failure"] == ""


def test_every_metric_says_what_it_is_and_is_told_without_a_recording() -> None:
    facts: dict[str, Any] = {
        "version": "1",
        "uptime_s": 1.0,
        "refused": 0,
        "entries": {"igtl_in": 1},
        "rates": {"over_s": 5.0, "entries": {"igtl_in": 1.0}, "igtl_in": {"a\\b\n": 2.5}},
        "ledger": {
            "streams": {},
            "links": {},
            "ros_topics": {"/tf": {"published": 3}},
            "refused": {"not_allowed": 2},
            "link_faults": {"stalled": 3},
        },
        "peers": [],
        "queues": {},
        "recorder": None,
        "upload": None,
    }
    page = prometheus(facts)
    assert values(page)[PREFIX + r'stream_rate{direction="igtl_in",stream="a\\b\n"}'] == 2.5
    assert values(page)[PREFIX + 'peers_refused_total{reason="not_allowed"}'] == 2
    assert values(page)[PREFIX + 'link_faults_total{code="stalled"}'] == 3
    assert "recorder" not in page
    assert len({metric.name for metric in METRICS}) == len(METRICS)
    assert all(metric.kind == "counter" for metric in METRICS if metric.name.endswith("_total"))


def test_the_document_has_every_metric() -> None:
    page = (ROOT / "docs" / "how-to" / "metrics.md").read_text("utf-8")
    for metric in METRICS:
        assert f"| `{metric.name}` | {metric.kind} | {metric.meaning} |" in page


class Nothing(BridgeStatus):
    """Of no bridge."""

    def __init__(self) -> None:
        self.facts = {"version": "1"}


def _no_marks(_mark: MarkNote) -> None:
    raise ConfigError("mark: found none")


def _post(server: MetricsServer, body: bytes, path: str = "/mark", **headers: str) -> tuple[int, str]:
    connection = HTTPConnection("127.0.0.1", port_of(server), timeout=WAIT_S)
    given = {"Content-Type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
    with closing(connection):
        connection.request("POST", path, body, given)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def test_a_mark_by_http() -> None:
    made: list[MarkNote] = []
    with closing(MetricsServer("127.0.0.1", 0, Nothing(), made.append)) as server:
        own = f"http://127.0.0.1:{port_of(server)}"
        assert _post(server, b'{"label": "slip"}') == (200, '{"label": "slip"}')
        whole = json.dumps({"label": "suture", "text": "first", "who": "Kim", "phase": "begin"})
        assert _post(server, whole.encode(), Origin=own)[0] == 200
        assert _post(server, b'{"label": "late", "ago_s": 1.5}')[0] == 200
        assert made == [
            MarkNote("slip", "", "http"),
            MarkNote("suture", "first", "Kim", "begin"),
            MarkNote("late", "", "http", "", 1_500_000_000),
        ]
        for body, why in (
            (b'{"label": "a:b"}', "mark: found label 'a:b'"),
            (b'{"text": "a"}', "body"),
            (b'{"label": "a", "x": 1}', "body"),
            (b'{"label": "a", "ago_s": -1}', "mark: found -1 s ago, expected the seconds since then"),
            (b"[", "body: found invalid JSON"),
            (b"\xff", "body"),
        ):
            code, text = _post(server, body)
            assert code == 400 and why in json.loads(text)["error"]
        assert len(made) == 3
        assert "405" in str(_post(server, b"{}", "/metrics"))


def test_a_page_of_a_foreign_site_makes_no_mark() -> None:
    """A browser sends such requests without asking the server first, or names the origin."""
    made: list[MarkNote] = []
    body = b'{"label": "slip"}'
    with closing(MetricsServer("127.0.0.1", 0, Nothing(), made.append)) as server:
        for code, headers in (
            (403, {"Origin": "http://evil.example"}),
            (403, {"Origin": "null"}),
            (403, {"Host": "evil.example"}),
            (415, {"Content_Type": "text/plain"}),
            (415, {"Content_Type": "application/x-www-form-urlencoded"}),
            (411, {"Content_Length": "-1"}),
            (413, {"Content_Length": "100000"}),
        ):
            assert _post(server, body, **headers)[0] == code, headers
        assert ask(server, "/mark", "OPTIONS")[0] == 501
    assert not made


def test_other_questions_are_refused() -> None:
    with closing(MetricsServer("127.0.0.1", 0, Nothing(), _no_marks)) as server:
        assert ask(server, "/")[0] == 404
        assert ask(server, "/status?x=1") == (200, '{"version": "1"}')
        assert ask(server, "/status", "HEAD") == (200, "")
        assert ask(server, "/status", "PUT")[0] == 501


def test_whoever_asks_slowly_is_cut_off_and_the_next_is_answered() -> None:
    with closing(MetricsServer("127.0.0.1", 0, Nothing(), _no_marks, deadline_s=0.05)) as server:
        with socket.create_connection(("127.0.0.1", port_of(server)), WAIT_S) as slow:
            slow.sendall(b"GET /metr")
            assert slow.recv(1) == b""
        assert ask(server, "/status")[0] == 200


def test_silent_clients_and_slow_readers_do_not_delay_a_scrape() -> None:
    """More of them than connections are served at a time, each until a deadline that does not come."""
    status = Nothing()
    status.facts = {"version": "x" * (8 << 20)}  # more than the socket takes
    with closing(MetricsServer("127.0.0.1", 0, status, _no_marks, deadline_s=600.0)) as server, ExitStack() as clients:
        for number in range(2 * MAX_CONNECTIONS + 6):
            client = clients.enter_context(socket.create_connection(("127.0.0.1", port_of(server)), WAIT_S))
            client.sendall((b"", b"GET /metr", b"GET /status HTTP/1.0\r\n\r\n")[number % 3])
        assert ask(server, "/status")[0] == 200
        until = time.monotonic() + WAIT_S
        while len([one for one in threading.enumerate() if one.name == "igtl-http"]) > MAX_CONNECTIONS:
            assert time.monotonic() < until, "connections that were cut off keep their threads"
            time.sleep(0.01)


def test_a_request_through_the_name_of_a_foreign_site_is_refused() -> None:
    with closing(MetricsServer("127.0.0.1", 0, Nothing(), _no_marks)) as server:
        port = port_of(server)
        for host in ("localhost", f"LOCALHOST.:{port}", f"127.0.0.1:{port}", "127.0.0.1", "[::1]:1", "127.9.9.9"):
            assert ask(server, "/status", Host=host)[0] == 200, host
        strange = ("rebind.example", f"rebind.example:{port}", "localhost.rebind.example", "10.0.0.1", "[", "")
        for host in (*strange, f"127.0.0.1:{port}@rebind.example", "localhost:65536", "[::1]x"):
            code, text = ask(server, "/status", Host=host)
            assert code == 403 and "version" not in text, host
        with socket.create_connection(("127.0.0.1", port), WAIT_S) as old:
            old.sendall(b"GET /status HTTP/1.0\r\n\r\n")  # a program, not a browser
            assert old.recv(100).startswith(b"HTTP/1.0 200 ")


def test_on_all_networks_addresses_and_the_own_name_are_known() -> None:
    own = socket.gethostname().lower()
    known = KnownHosts("0.0.0.0", "0.0.0.0")
    for host in ("192.168.1.7:9464", "[fe80::1%eth0]:9464", "localhost", own, f"{own.partition('.')[0]}.local:9464"):
        assert host in known, host
    assert "rebind.example" not in known
    assert "bridge.lan:9464" in KnownHosts("Bridge.lan", "192.168.1.7")
    assert "192.168.1.8" not in KnownHosts("192.168.1.7", "192.168.1.7")


def test_other_hosts_need_an_allowance_and_a_taken_port_is_named() -> None:
    with pytest.raises(ConfigError, match="open to other hosts, but none may connect"):
        MetricsServer("0.0.0.0", 0, Nothing(), _no_marks)
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(Unavailable, match="in use by another program"):
        MetricsServer("127.0.0.1", taken.getsockname()[1], Nothing(), _no_marks)


def test_the_clocks_of_peers_have_their_bounds() -> None:
    metrics = {metric.name: metric for metric in METRICS}
    known = {"low_ns": -1_500_000, "high_ns": 2_000_000, "drift_low_ppm": -3.5, "drift_high_ppm": 4.0}
    one_way = {"low_ns": 7, "high_ns": None, "drift_low_ppm": None, "drift_high_ppm": None}
    peers = [{"link": number, "peer": "a:5", "clock": clock} for number, clock in enumerate((known, one_way, None), 1)]
    offsets, drifts = (
        [(labels["link"], labels["bound"], value) for labels, value in metrics[name].lines({"peers": peers})]
        for name in ("peer_clock_offset_seconds", "peer_clock_drift_ppm")
    )
    assert offsets == [("1", "low", -0.0015), ("1", "high", 0.002), ("2", "low", 7e-9)]
    assert drifts == [("1", "low", -3.5), ("1", "high", 4.0)]
