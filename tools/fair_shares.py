"""What a good peer gets beside attackers: its round trips, a newcomer's first answer, and a pose from ROS.

    python tools/fair_shares.py                         every attack, one attacker and 20, without ROS
    python tools/fair_shares.py --ros --record          the same with a ROS stream of 1 kHz, recorded
    python tools/fair_shares.py --ros --record --elsewhere      what of it the attackers' own programs cost
    python tools/fair_shares.py --ros --record --control        the attackers also at a program that only reads
    python tools/fair_shares.py --ros --record --control --table        the table of docs/evidence/hostile.md
    python tools/fair_shares.py --costly --page                  the most expensive messages, into that page
    python tools/fair_shares.py --costly --page --ros --record   the same with ROS and the recorder
    python tools/fair_shares.py --attack GET_STATUS --attack COMMAND --rate 12500

Every program is a process of its own (``attacks`` for the attackers).  The good peer sends a GET_STATUS, waits for the
answer, does the same at a server that only echoes, and pauses for some ms: the echo shows what the machine itself costs
at that moment.  Each row is measured against an idle phase directly before it; with ``--control`` also against a phase
in which the attackers send to a sink, and the bridge has only its good programs: the floor that the cores give.  The
last line states whether the bound held: p99 below 3 × idle + 5 ms, a newcomer below 1 s, ROS below 2 × idle + what the
echo lost.  ``<<<`` marks where it does not, ``<`` where it holds with the control in place of idle.

``--page`` measures the rows that miss the bound again, twice at most, within ``--minutes``, and prints those that miss
it in the end.  A phase in which this program was stopped is measured again.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from igtl_gateway.edges.reserved import BACKLOG  # noqa: E402 (of this checkout)
from tests import domains  # noqa: E402
from tools import attacks, pages  # noqa: E402

_REST_S = 0.002
_LOST_S = 10.0
_NEW_EVERY_S = 0.2
_MANY = 20
_TOPIC, _DEVICE = "/igtl/out/fair", "Fair"
_EPOCH_FRACTION = 1 << 32
_QUERY = attacks.message("GET_STATUS", b"", device="Good")
_HEADER = 58
#: The page of ``--page``, and its headings without and with ROS.
_PAGE = "docs/evidence/hostile.md"
_HEADINGS = ("### The most expensive valid message", "#### With ROS and the recorder")
#: A phase is watched in such steps; one that takes so much longer was stopped from outside.
_STEP_S, _STOPPED_S = 0.1, 1.0
_MOST_AGAIN = 2

Figures = dict[str, list[float]]


# ── the programs ──────────────────────────────────────────────────────────────────────────────────────────────────


def echo() -> None:
    """A server that sends back what it gets."""
    server = socket.create_server(("127.0.0.1", 0))
    _say(server.getsockname()[1])
    sock, _ = server.accept()
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with suppress(ConnectionError):
        while data := sock.recv(1 << 16):
            sock.sendall(data)


def sink() -> None:
    """A server that reads all that any peer sends, and does nothing with it."""
    server = socket.create_server(("127.0.0.1", 0), backlog=BACKLOG)  # else connections wait for a second
    _say(server.getsockname()[1])
    peers = selectors.DefaultSelector()
    peers.register(server, selectors.EVENT_READ)
    while True:
        for key, _ in peers.select():
            if key.fileobj is server:
                peers.register(server.accept()[0], selectors.EVENT_READ)
                continue
            assert isinstance(key.fileobj, socket.socket)
            with suppress(OSError):
                if key.fileobj.recv(1 << 16):
                    continue
            peers.unregister(key.fileobj)
            key.fileobj.close()


def good(port: int, echo_port: int) -> None:
    """Round trips without end; each line of input ends a phase, whose times (ms) are printed."""
    bridge, mirror = (socket.create_connection(("127.0.0.1", each), _LOST_S) for each in (port, echo_port))
    for sock in (bridge, mirror):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    figures: Figures = {"trip": [], "echo": []}
    for phase in _phases(figures):
        del phase
        for name, sock in (("echo", mirror), ("trip", bridge)):
            begun = time.perf_counter()
            sock.sendall(_QUERY)
            if name == "echo":
                _exactly(sock, len(_QUERY))
            else:
                while _next_type(sock)[0] != "STATUS":
                    pass
            figures[name].append(1000 * (time.perf_counter() - begun))
        time.sleep(_REST_S)


def newcomer(port: int) -> None:
    """A new peer again and again: the time until its first answer."""
    figures: Figures = {"new": []}
    for phase in _phases(figures):
        del phase
        begun = time.perf_counter()
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), _LOST_S) as sock:
            sock.sendall(_QUERY)
            while _next_type(sock)[0] != "STATUS":
                pass
        figures["new"].append(1000 * (time.perf_counter() - begun))
        time.sleep(_NEW_EVERY_S)


def listener(port: int) -> None:
    """A peer that receives the poses of ROS: their age (ms)."""
    sock = socket.create_connection(("127.0.0.1", port))
    figures: Figures = {"ros": []}
    for phase in _phases(figures):
        del phase
        if not select.select([sock], [], [], 0.05)[0]:
            continue
        igtl_type, ticks = _next_type(sock)
        if igtl_type == "TRANSFORM":
            figures["ros"].append(1000 * (time.time() - ticks / _EPOCH_FRACTION))


def source() -> None:
    """A ROS node that publishes a pose at 1 kHz."""
    import rclpy
    from geometry_msgs.msg import PoseStamped

    rclpy.init()
    node = rclpy.create_node("fair_source")
    publisher = node.create_publisher(PoseStamped, _TOPIC, 10)
    pose = PoseStamped()
    pose.header.frame_id = "base"
    _say("ready")
    due = time.monotonic()
    while True:
        now_ns = time.time_ns()
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(now_ns, 1_000_000_000)
        publisher.publish(pose)
        due = max(due + 0.001, time.monotonic() - 0.02)
        time.sleep(max(0.0, due - time.monotonic()))


def _phases(figures: Figures) -> Iterator[None]:
    """One step after the other; at each line of input, the figures are printed and begin again."""
    _say("ready")
    while True:
        if select.select([sys.stdin], [], [], 0)[0]:
            if not sys.stdin.readline():
                return
            _say(figures)
            for row in figures.values():
                row.clear()
        yield


def _exactly(sock: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        part = sock.recv(size - len(data))
        if not part:
            raise ConnectionError
        data += part
    return bytes(data)


def _next_type(sock: socket.socket) -> tuple[str, int]:
    """Type and time stamp of the next message."""
    head = _exactly(sock, _HEADER)
    _exactly(sock, int.from_bytes(head[42:50], "big"))
    return head[2:14].rstrip(b"\0").decode("ascii", "replace"), int.from_bytes(head[34:42], "big")


def _say(value: object) -> None:
    print(json.dumps(value), flush=True)


# ── the measurement ───────────────────────────────────────────────────────────────────────────────────────────────


class _Role:
    """One of the programs above."""

    def __init__(self, name: str, *arguments: object) -> None:
        command = [sys.executable, __file__, "--role", name, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.first = self._line()

    def ask(self) -> Any:
        """End a phase; return its figures."""
        assert self.process.stdin
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self._line()

    def _line(self) -> Any:
        assert self.process.stdout
        return json.loads(self.process.stdout.readline())

    def __enter__(self) -> _Role:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def _bridge(words: Sequence[str], log: Path) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """The bridge, with its output in a file; yields the port."""
    command = [sys.executable, "-m", "igtl_gateway", "bridge", "--json", "--listen", "127.0.0.1:0", *words]
    with log.open("wb") as out, subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT) as process:
        try:
            end = time.monotonic() + 120
            while not (line := next((one for one in log.read_text().splitlines() if '"started"' in one), "")):
                if time.monotonic() > end or process.poll() is not None:
                    raise SystemExit(f"the bridge did not start: {log.read_text()[-2000:]}")
                time.sleep(0.05)
            yield json.loads(line)["listen"][0]["port"], process
        finally:
            process.kill()


def _p(times: Sequence[float], share: float) -> float:
    return sorted(times)[min(len(times) - 1, int(share * len(times)))] if times else float("nan")


class Stopped(Exception):
    """The machine did not run in a phase: a signal stopped this program, or the machine slept."""


def _phase(roles: dict[str, _Role], seconds: float) -> Figures:
    """Return the figures of a phase.  Raises Stopped."""
    for role in roles.values():
        role.ask()
    begun = last = time.monotonic()
    longest = 0.0
    while (left := begun + seconds - last) > 0:
        time.sleep(min(left, _STEP_S))
        now = time.monotonic()
        last, longest = now, max(longest, now - last)
    found: Figures = {}
    for role in roles.values():
        found |= role.ask()
    if longest > _STOPPED_S:
        raise Stopped
    return found


def _row(name: str, links: int, phases: Sequence[Figures], sent: float, log_mb: float) -> tuple[str, bool]:
    """Cells of the phases (idle, with the control, beside the attackers), and whether the bound held."""
    beside, whats = phases[-1], [what for what in ("trip", "echo", "ros") if what in phases[-1]]
    cells = [f"{name:26}", f"{links:3}", f"{sent:9,.0f}"]
    cells += [f"{_p(figures[what], share):7.2f}" for what in whats for figures in phases for share in (0.5, 0.99)]
    cells.append(f"{max(beside['new'], default=float('nan')):8.1f}")
    held = [_is_held(before, beside) for before in phases[:-1]]
    cells += [f"{log_mb:6.2f}", "" if held[0] else "<" if held[-1] else "<<<"]
    return " ".join(cells), held[0]


_TABLE_TITLES = (
    "| Attacker | good peer beside one | beside 20 | ROS beside one | beside 20 | a new peer | bound |",
    "| --- | --- | --- | --- | --- | --- | --- |",
)


def _table_row(name: str, of_links: Sequence[Sequence[Figures]]) -> str:
    """One row of the page: for each number of attackers p99 idle, with the control → beside, and the verdict."""

    def cell(phases: Sequence[Figures], what: str) -> str:
        *before, beside = (f"{_p(figures.get(what, []), 0.99):.1f}" for figures in phases)
        return f"{', '.join(before)} → {beside}"

    def verdict(phases: Sequence[Figures]) -> str:
        held = [_is_held(before, phases[-1]) for before in phases[:-1]]
        return "yes" if held[0] else "control" if held[-1] else "**no**"

    new = (f"{max(phases[-1]['new'], default=float('nan')):.0f}" for phases in of_links)
    cells = [cell(phases, what) for what in ("trip", "ros") for phases in of_links]
    return f"| {' | '.join([name, *cells, ', '.join(new), ', '.join(map(verdict, of_links))])} |"


def _is_held(before: Figures, beside: Figures) -> bool:
    """Whether the bound holds, compared with another phase."""

    def p99(figures: Figures, what: str) -> float:
        return _p(figures.get(what, [0.0]), 0.99)

    machine = max(0.0, p99(beside, "echo") - p99(before, "echo"))
    return (
        p99(beside, "trip") < 3 * p99(before, "trip") + 5 + machine
        and max(beside["new"], default=0) < 1000
        and ("ros" not in beside or p99(beside, "ros") < 2 * p99(before, "ros") + machine)
    )


def _titles(ros: bool, control: bool) -> str:
    each = "   idle50   idle99" + ("   ctl50   ctl99" if control else "") + "    p50     p99"
    return (
        f"{'attacker':26} {'n':>3} {'msgs/s':>9} trip:{each} echo:{each}"
        + (f" ros:{each}" if ros else "")
        + "  new max  log MB"
    )


def _attacked(
    roles: dict[str, _Role], options: argparse.Namespace, name: str, port: int, links: int
) -> tuple[Figures, float]:
    """Attack a port for a phase; return its figures and the number of messages a second that were sent."""
    rate = options.rate * (links if options.each else 1)
    words = [str(ROOT / "tools/attacks.py"), name, port, links, rate, options.seconds + 0.5]
    command = [*(["chrt", "--idle", "0"] if options.elsewhere else []), sys.executable, *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as attacker:
        assert attacker.stdout
        attacker.stdout.readline()
        time.sleep(0.4)
        beside = _phase(roles, options.seconds)
        return beside, float(attacker.stdout.readline() or 0) / (options.seconds + 0.5)


def _phases_of(options: argparse.Namespace, folder: Path, name: str, links: int) -> tuple[list[Figures], float, float]:
    """Return the figures idle, with the control and beside the attackers; messages a second, and MB of log.

    Phases in which this program was stopped are measured again, with all others of the row.
    """
    while True:
        with suppress(Stopped):
            return _measured(options, folder, name, links)


def _measured(options: argparse.Namespace, folder: Path, name: str, links: int) -> tuple[list[Figures], float, float]:
    words = ["--deny-in", "DENIED"]
    words += ["--send", f"{_TOPIC}={_DEVICE}:TRANSFORM"] if options.ros else ["--no-ros"]
    words += ["--record", str(folder / "fair.mcap")] if options.record else []
    words += options.bridge
    log = folder / "bridge.log"
    try:
        with _bridge(words, log) as (port, _), ExitStack() as stack:
            mirror = stack.enter_context(_Role("echo"))
            roles = {"new": _Role("newcomer", port), "good": _Role("good", port, mirror.first)}
            if options.ros:
                stack.enter_context(_Role("source"))
                roles["ros"] = _Role("listener", port)
            for role in roles.values():
                stack.enter_context(role)
            time.sleep(1.0)
            idle, before = _phase(roles, options.seconds), log.stat().st_size
            phases = [idle]
            if options.control:
                with _Role("sink") as target:
                    phases.append(_attacked(roles, options, name, target.first, links)[0])
            beside, sent = _attacked(roles, options, name, port, links)
            return [*phases, beside], sent, (log.stat().st_size - before) / 1e6
    finally:
        for path in folder.glob("fair*.mcap*"):
            path.unlink()


def measure(options: argparse.Namespace, folder: Path) -> bool:
    """Print a row for each attack; return whether the bound held for all."""
    held = []
    print(*(_TABLE_TITLES if options.table else [_titles(options.ros, options.control)]), sep="\n", flush=True)
    for name in _attackers(options):
        of_links: list[list[Figures]] = []
        for links in options.links:
            phases, sent, log_mb = _phases_of(options, folder, name, links)
            row, fine = _row(name, links, phases, sent, log_mb)
            held.append(fine)
            of_links.append(phases)
            if not options.table:
                print(row, flush=True)
        if options.table:
            print(_table_row(name, of_links), flush=True)
    print(f"the bound held in {sum(held)} of {len(held)} rows")
    return all(held)


def _attackers(options: argparse.Namespace) -> list[str]:
    return options.attack or (attacks.costly() if options.costly else attacks.names())


# ── the page ──────────────────────────────────────────────────────────────────────────────────────────────────────


def write_page(options: argparse.Namespace, folder: Path) -> bool:
    """Measure each attack beside a good peer, and those that miss the bound again; write the table into its page.

    Return whether the bound held for all, at the last time.
    """
    end = time.monotonic() + 60 * options.minutes
    load, first = pages.Load(), pages.go_first()
    rows: dict[str, list[list[Figures]]] = {}
    left = _attackers(options)
    for again in range(1 + _MOST_AGAIN):
        if again:
            left = [name for name, runs in rows.items() if not _is_held(runs[-1][0], runs[-1][-1])]
        for name in left:
            if time.monotonic() > end:
                break
            phases, _, _ = _phases_of(options, folder, name, options.links[0])
            load.look()
            rows.setdefault(name, []).append(phases)
            print(_page_row(name, rows[name], options.ros), flush=True)
    note = f"{options.seconds:g} s a phase, {load}" + ", at a priority above other sessions" * first
    titles = ("| Attacker | good peer |", "| a new peer | bound |")
    table = [f"{titles[0]} ROS {titles[1]}" if options.ros else titles[0] + titles[1][1:]]
    table.append(f"| --- | --- |{' --- |' * options.ros} ---: | --- |")
    table += [_page_row(name, runs, options.ros) for name, runs in rows.items()]
    pages.write(_PAGE, _HEADINGS[options.ros], "tools/fair_shares.py", note, table)
    missed = [name for name, runs in rows.items() if not _is_held(runs[-1][0], runs[-1][-1])]
    unmeasured = [name for name in _attackers(options) if name not in rows]
    print(f"the bound held in {len(rows) - len(missed)} of {len(rows)} rows")
    for name in missed:
        print(f"missed: {_page_row(name, rows[name], options.ros)}")
    for name in unmeasured:
        print(f"not measured in {options.minutes:g} min: {name}")
    return not missed and not unmeasured


def _page_row(name: str, runs: Sequence[Sequence[Figures]], ros: bool) -> str:
    """One row: of the last run p99 idle, with the control → beside, and a new peer; the verdict of each run."""

    def cell(what: str) -> str:
        *before, beside = (f"{_p(figures.get(what, []), 0.99):.1f}" for figures in runs[-1])
        return f"{', '.join(before)} → {beside}"

    def verdict(phases: Sequence[Figures]) -> str:
        idle, *controls = (_is_held(before, phases[-1]) for before in phases[:-1])
        return "yes" if idle else "control" if any(controls) else "no"

    new = f"{max(runs[-1][-1]['new'], default=float('nan')):.0f}"
    cells = [name.removeprefix("most: "), cell("trip"), *([cell("ros")] if ros else []), new]
    return f"| {' | '.join(cells)} | {', '.join(map(verdict, runs))} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--role", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--attack", action="append", help="one of: " + ", ".join(attacks.names()))
    parser.add_argument("--costly", action="store_true", help="the most expensive valid message of each type")
    parser.add_argument("--links", type=int, action="append", help="number of attackers (default: 1 and 20)")
    parser.add_argument("--rate", type=float, default=0, help="messages per second of all; 0: as fast as they can")
    parser.add_argument("--each", action="store_true", help="the rate is that of each attacker")
    parser.add_argument("--seconds", type=float, help="of each phase (default: 4, with --page 2)")
    parser.add_argument("--ros", action="store_true", help="with ROS, and a pose at 1 kHz to the peers")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--elsewhere", action="store_true", help="attackers take only CPU time that nothing else wants")
    parser.add_argument("--control", action="store_true", help="the attackers at a sink as well, beside an idle bridge")
    parser.add_argument("--table", action="store_true", help="with --ros: print the table of docs/evidence/hostile.md")
    parser.add_argument(
        "--page", action="store_true", help="with --costly: write the table of docs/evidence/hostile.md"
    )
    parser.add_argument("--minutes", type=float, default=14.0, help="with --page: no row begins later")
    parser.add_argument("--bridge", action="append", default=[], help="a further word for the bridge")
    options = parser.parse_args()
    if options.role:
        name, *arguments = options.role
        roles: dict[str, Callable[..., None]] = {
            "echo": echo,
            "sink": sink,
            "good": good,
            "newcomer": newcomer,
            "listener": listener,
            "source": source,
        }
        roles[name](*map(int, arguments))
        return 0
    options.links = options.links or ([1] if options.page else [1, _MANY])
    options.seconds = options.seconds or (2.0 if options.page else 4.0)
    if options.page and (not options.costly or len(options.links) > 1):
        parser.error("--page: expected --costly, and one number of attackers")
    options.control = options.control or options.page
    if options.table and not options.ros:
        parser.error("--table: found no --ros, expected it: the table has columns for ROS")
    os.environ["ROS_DOMAIN_ID"] = str(domains.reserve())
    with tempfile.TemporaryDirectory() as folder:
        held = write_page(options, Path(folder)) if options.page else measure(options, Path(folder))
    return 0 if held else 1


if __name__ == "__main__":
    raise SystemExit(main())
