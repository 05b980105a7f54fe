"""A bridge with 100 streams of 10 Hz, without and with the page: for ``bench --against``, so that both are in one run.

    igtl-gateway bench --case transform --direction igtl-to-ros --rate 500 --duration 8 --no-floor \\
        --against "python -m tools.evidence.page_load none {port}" \\
        --against "python -m tools.evidence.page_load open {port} page.txt"

``none``: without the page; ``open``: one browser; ``twenty``: 20, and one that never reads; ``killed``: its process is
killed after ten seconds.  ``one_elsewhere``, ``twenty_elsewhere``: without the page, 1 and 20 browsers ask a program
that only sends as many bytes: what they cost themselves; ``computes_elsewhere``: it also computes for 7 ms each second,
with the page's priority.  A browser here asks for the state twice a second, as the page
does.  Load and browsers are processes of their own: what they cost must not delay the load.  The third word is a file
for the share of a core that the process of the page has used.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from igtl_gateway.addon.igtl import Message, Transform, encode, ns_to_ticks
from igtl_gateway.base.systems.processes import stand_back
from tests.integration.bridge import RawPeer

_STREAMS, _HZ = 100, 10
#: Kind → browsers, and whether there is a page.
_BROWSERS = {"open": (1, True), "twenty": (20, True), "killed": (1, True), "none": (0, False)}
_BROWSERS |= {"one_elsewhere": (1, False), "twenty_elsewhere": (20, False), "computes_elsewhere": (1, False)}
#: Of the state with 100 streams after ten seconds.
_PAGE_BYTES = 85_000
_COMPUTING_S = 0.007
_POSE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0)


def main(words: list[str]) -> int:
    """Run until the end of the bridge."""
    kind, port, *log = words
    if kind in _ROLES:
        threading.Thread(target=_end_with_input, daemon=True).start()
        _ROLES[kind](port, *log)
        return 0
    command = [sys.executable, "-m", "igtl_gateway", "bridge", "--json", "--listen", f"127.0.0.1:{port}"]
    number, has_page = _BROWSERS[kind]
    bridge = subprocess.Popen([*command, *(["--page"] if has_page else [])], stdout=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, lambda *_: bridge.send_signal(signal.SIGINT))
    signal.signal(signal.SIGTERM, lambda *_: bridge.send_signal(signal.SIGINT))
    assert bridge.stdout
    events = map(json.loads, bridge.stdout)
    next(event for event in events if event["event"] == "started")
    roles = [_role("load", port)]
    if number and not has_page:
        place = _free_port()
        if kind == "computes_elsewhere":
            roles.append(_role("computes", ""))
        roles += [_role("serves", place), _role("browsers", f"http://127.0.0.1:{place}/?t=none", str(number))]
    if has_page:
        link = next(event["link"] for event in events if event["event"] == "page")
        page = _page_of(bridge.pid)
        roles.append(_role("browsers", link, str(number)))
        if kind == "twenty":
            roles.append(_role("never_reads", link))
        threading.Thread(target=_watch, args=(kind, page, log), daemon=True).start()
    for _ in events:
        pass
    for role in roles:
        role.kill()
        role.wait()
    return bridge.wait()


def _role(*words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "tools.evidence.page_load", *words], stdin=subprocess.PIPE)


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


def _load(port: str) -> None:
    with RawPeer(int(port)) as peer:
        poses = [
            b"".join(encode(Message("TRANSFORM", f"Load{n:03}", Transform(_POSE), 0, 1, 0, ()))) for n in range(100)
        ]
        due = time.monotonic()
        while True:
            for number in range(_STREAMS):
                ticks = ns_to_ticks(time.time_ns())
                pose = poses[number]
                peer.send(pose[:34] + ticks.to_bytes(8, "big") + pose[42:])
                due += 1 / _STREAMS / _HZ
                time.sleep(max(0.0, due - time.monotonic()))


def _page_of(bridge: int) -> int:
    for task in Path(f"/proc/{bridge}/task").iterdir():
        for number in (task / "children").read_text().split():
            if b"addons.page" in Path(f"/proc/{number}/cmdline").read_bytes():
                return int(number)
    raise AssertionError("found no process of the page")


def _free_port() -> str:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        return str(sock.getsockname()[1])


def _computes(_: str) -> None:
    """As the process of the page does, in a session of its own."""
    os.setsid()
    stand_back(10)
    while True:
        time.sleep(1)
        end = time.thread_time() + _COMPUTING_S
        while time.thread_time() < end:
            sum(range(100))


def _serves(port: str) -> None:
    head = f"HTTP/1.1 200 OK\r\nPage-Version: 1\r\nContent-Length: {_PAGE_BYTES}\r\n\r\n"
    with socket.create_server(("127.0.0.1", int(port))) as server:
        while True:
            sock, _ = server.accept()
            with sock:
                sock.recv(1 << 16)
                sock.sendall(head.encode() + bytes(_PAGE_BYTES))


def _browsers(link: str, number: str) -> None:
    for _ in range(int(number)):
        threading.Thread(target=_browse, args=(link,), daemon=True).start()
    threading.Event().wait()


def _request(link: str, path: str) -> bytes:
    place = urlsplit(link)
    cookie = f"Cookie: igtl_page_{place.port}={place.query.partition('=')[2]}"
    return f"GET {path} HTTP/1.1\r\nHost: {place.netloc}\r\n{cookie}\r\n\r\n".encode()


def _browse(link: str) -> None:
    place = urlsplit(link)
    assert place.port
    known = ""
    while True:
        try:
            with socket.create_connection((place.hostname, place.port), 5) as sock:
                sock.sendall(_request(link, f"/api/state?known={known}"))
                head = sock.recv(1 << 18)
                while sock.recv(1 << 18):
                    pass
                known = head.partition(b"Page-Version: ")[2].partition(b"\r")[0].decode() or known
        except OSError:
            pass
        time.sleep(0.5)


def _never_reads(link: str) -> None:
    place = urlsplit(link)
    assert place.port
    sock = socket.create_connection((place.hostname, place.port), 5)
    sock.sendall(_request(link, "/api/state"))
    threading.Event().wait()
    sock.close()


_ROLES: dict[str, Callable[..., None]] = {
    "load": _load,
    "browsers": _browsers,
    "never_reads": _never_reads,
    "serves": _serves,
    "computes": _computes,
}


def _watch(kind: str, page: int, log: list[str]) -> None:
    """Write the share of a core of the page's process over each five seconds."""
    while True:
        before = _cpu_s(page)
        time.sleep(5)
        for name in log:
            with open(name, "a", encoding="utf-8") as out:
                out.write(f"{kind}: {(_cpu_s(page) - before) / 5 * 100:.1f} % of a core\n")
        if kind == "killed":
            time.sleep(5)
            os.kill(page, signal.SIGKILL)
            return


def _cpu_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
