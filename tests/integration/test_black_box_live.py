"""The black box of a real bridge: what its files have of their windows, to the last nanosecond.

A snapshot at the end has the whole session, and so what each window has to have.  Peers send poses, which pass
natively, and pictures; marks come at once and late, some within a millisecond of the end of a window; the recorder's
process is stopped for a while now and then.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.integration.bridge import Bridge, children
from tests.integration.load import image

SECONDS = float(os.environ.get("IGTL_GATEWAY_BLACK_BOX_S", "8"))
SEED = int(os.environ.get("IGTL_GATEWAY_BLACK_BOX_SEED", "1"))
#: Label → seconds before and after.
RULES = {"a": (2.0, 1.0), "b": (0.5, 0.3), "c": (0.0, 0.0), "d": (1.0, 2.5), "e": (0.3, 0.05)}


def _pose(number: int) -> bytes:
    pose = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, number % 1_000, 0, 0))
    return join(encode(Message("TRANSFORM", "Tool", pose, ticks=ns_to_ticks(time.time_ns()))))


def _send(port: int, make: Callable[[int], bytes], hz: float, stop: threading.Event) -> None:
    with socket.create_connection(("127.0.0.1", port)) as peer:
        number = 0
        while not stop.wait(1 / hz):
            number += 1
            peer.sendall(make(number))


def _mark(bridge: Bridge, peer: socket.socket, chosen: random.Random, label: str, ago_s: float) -> None:
    """Make a mark, as a peer or over HTTP."""
    if chosen.random() < 0.4:
        ticks = ns_to_ticks(time.time_ns() - round(ago_s * NS_PER_S))
        peer.sendall(join(encode(Message("STRING", "Marker", String.of(label), ticks=ticks))))
        return
    url = bridge.events[0]["metrics"].replace("/metrics", "/mark")
    body = json.dumps({"label": label, "ago_s": ago_s}).encode()
    urllib.request.urlopen(urllib.request.Request(url, body, {"Content-Type": "application/json"})).close()


def _play(bridge: Bridge, chosen: random.Random) -> None:
    """Make marks, and stop the recorder's process for up to half a second."""
    (recorder,) = children(bridge.process.pid)
    begin = time.monotonic()
    ends = [begin]
    with socket.create_connection(("127.0.0.1", bridge.port)) as peer:
        while time.monotonic() < begin + SECONDS:
            match chosen.randrange(4):
                case 0:  # at the end of a window
                    wait_s = chosen.choice(ends[-3:]) + chosen.uniform(-1e-3, 1e-3) - time.monotonic()
                case 1:  # a burst
                    wait_s = chosen.uniform(0, 2e-3)
                case _:
                    wait_s = chosen.uniform(0, 1.5)
            time.sleep(max(0.0, wait_s))
            label = chosen.choice(list(RULES))
            ago_s = chosen.choice((0.0, chosen.uniform(0, time.monotonic() - begin)))
            _mark(bridge, peer, chosen, label, ago_s)
            ends.append(time.monotonic() - ago_s + RULES[label][1])
            if chosen.random() < 0.2:
                os.kill(recorder, signal.SIGSTOP)
                time.sleep(chosen.uniform(0, 0.5))
                os.kill(recorder, signal.SIGCONT)
        time.sleep(max(after for _, after in RULES.values()))


def _content(path: Path) -> tuple[list[Entry], list[dict[str, object]]]:
    with SessionFile.open(path) as file:
        rows: list[dict[str, object]] = (file.ledger or {}).get("triggers", [])
        return list(file.entries()), rows


def test_each_window_of_a_real_bridge_is_complete_to_its_end(tmp_path: Path) -> None:
    rules = [word for label, (before, after) in RULES.items() for word in _rule(label, before, after)]
    path, stop = tmp_path / "box.mcap", threading.Event()
    options = ["--record", str(path), "--snapshot", str(SECONDS + 60), *rules, "--mark-from", "Marker"]
    bridge = Bridge("--no-ros", *options, "--metrics", "0")
    senders = [
        threading.Thread(target=_send, args=(bridge.port, make, hz, stop))
        for make, hz in ((_pose, 200), (_pose, 200), (image, 20))
    ]
    try:
        for sender in senders:
            sender.start()
        _play(bridge, random.Random(SEED))
        bridge.process.send_signal(signal.SIGUSR1)
        whole = Path(bridge.wait_code("record_snapshot")["data"]["path"])
        stop.set()
        for sender in senders:
            sender.join()
        assert bridge.end().code == 0
    finally:
        stop.set()
        bridge.close()
    session, _ = _content(whole)
    files = [_content(each) for each in tmp_path.glob("*.mcap") if each != whole]
    marks = [mark for entry in session if (mark := _marked(entry))]
    assert len(marks) > 3
    for label, at_ns, seq in marks:
        before, after = (round(each * NS_PER_S) for each in RULES[label])
        window = {entry.seq for entry in session if at_ns - before <= entry.stamp_ns <= at_ns + after}
        lacking = [
            window - {entry.seq for entry in entries}
            for entries, rows in files
            if any(row["rule"] == f"mark {label}" and _is_in(at_ns, row) and not row["missing"] for row in rows)
            and any(entry.seq == seq for entry in entries)
        ]
        assert lacking and not min(lacking, key=len), (label, at_ns, seq, [sorted(each)[:3] for each in lacking])


def _rule(label: str, before: float, after: float) -> tuple[str, str]:
    return "--trigger", f"mark={label},before={before},after={after}"


def _marked(entry: Entry) -> tuple[str, int, int] | None:
    """Label and moment of the mark in an entry, and its number."""
    if entry.kind is not Kind.EDGE_NOTE:
        return None
    mark = MarkNote.of(Note.of(entry.data()))
    return (mark.label, entry.stamp_ns - mark.ago_ns, entry.seq) if mark else None


def _is_in(at_ns: int, row: dict[str, object]) -> bool:
    first, last = row["at_ns"], row["last_ns"]
    assert isinstance(first, int) and isinstance(last, int)
    return first <= at_ns <= last
