"""Bad networks and killed processes around real bridges: who is undisturbed, who reconnects, what is lost and reported.

Everything here takes half a minute of waiting, so all scenes run at the same time, in threads, and each test checks
the observations of one scene.  The network is that of ``netns``; ``--log-cli-level=INFO`` shows which kind it is, and
the observations.  See docs/evidence/network-faults.md.  What a killed bridge leaves behind is in ``test_crash``, a peer
that never reads in ``test_hostile``.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main as command_line
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import PEERS
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.bridge import (
    HEADER_SIZE,
    SECOND_DOMAIN,
    TIMEOUT_S,
    Bridge,
    Event,
    Program,
    RawPeer,
    RosClient,
    children,
    environment,
    free_port,
    string,
)
from tests.integration.netns import NETEM, Lines, NotHereError, Weather, far_address
from tests.integration.talker import PERIOD_S, TICK, Server, Talker
from tests.places import ROOT

_log = logging.getLogger(__name__)

pytestmark = [pytest.mark.ros, pytest.mark.slow]

TEXT, OUT = "std_msgs/msg/String", f"/igtl/out/{TICK}"
TICK_S = 0.1
DOWN_S = 30.0
STOPPED_S = 10.0
#: Without a discovery server.  One that is back before those who knew it have missed it (20 s) does not know them.
ALONE_S = 21.0
SOME = 5
#: Half a message, and then nothing, ends a link after this: less than STOPPED_S.
STALL_S = 5.0

#: The lines of the network scene, and their weather.
DELAY, LOSS, REORDER, DOWN = range(4)
WEATHER = {
    DELAY: Weather(delay_s=0.05, jitter_s=0.01),
    LOSS: Weather(delay_s=0.005, loss=0.05),
    REORDER: Weather(delay_s=0.01, reorder=0.1),
    DOWN: Weather(down=True),
}


#: Held by who starts programs: that takes all of a small machine, and together they would take too long.
starting = threading.Lock()


class Ticking:
    """A ROS node that publishes numbers as strings, until the test stops it or the node ends.

    Attributes:
        sent: the last number that was published for certain; when the node is killed, there may be one more.
    """

    def __init__(self, ros: RosClient, first: int = 1) -> None:
        self.sent = first - 1
        self._ros = ros
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(TICK_S):
            try:
                self._ros.publish(OUT, {"data": str(self.sent + 1)})
            except (OSError, AssertionError):
                return
            self.sent += 1

    def stop(self) -> int:
        """The last number."""
        self._stop.set()
        self._thread.join()
        return self.sent


def wait_for(condition: Callable[[], bool], what: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, what()
        time.sleep(0.02)


def pause(seconds: float) -> None:
    """The time that a fault lasts."""
    threading.Event().wait(seconds)


def topic(device: str) -> str:
    return f"/igtl/in/{device}/string"


def numbers(ros: RosClient, device: str) -> list[int]:
    """The numbers of a talker that ROS has received."""
    return [int(message["data"]) for message in ros.received(topic(device))]


def wait_some(ros: RosClient, device: str) -> None:
    """Wait until ROS has received a few numbers of a talker."""
    wait_for(lambda: len(numbers(ros, device)) >= SOME, ros.said)


def wait_last(ros: RosClient, device: str, last: int) -> None:
    """Wait until this number is the last that ROS has received."""
    wait_for(lambda: numbers(ros, device)[-1:] == [last], lambda: f"{device}: {last}, {numbers(ros, device)[-3:]}")


def rows(found: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of each row of numbers without a gap: one of them, if nothing is missing, twice or astray."""
    cuts = [index for index in range(1, len(found)) if found[index] != found[index - 1] + 1]
    return [(found[begin], found[end - 1]) for begin, end in zip([0, *cuts], [*cuts, len(found)], strict=True)]


def told(bridge_events: Sequence[Event], code: str, peer: str) -> list[Event]:
    return [each for each in list(bridge_events) if each.get("code") == code and each["data"].get("peer") == peer]


def moment(event: Event) -> float:
    """UTC seconds."""
    return datetime.fromisoformat(event["time"][:26] + "+00:00").timestamp()


@dataclass
class Ended:
    """A bridge that was stopped by Ctrl-C, and its recording."""

    code: int
    stderr: str
    events: list[Event]
    entries: list[Entry]
    ledger: dict[str, Any]
    verified: int

    def closes(self) -> None:
        """It ended in order, its ledger has no gap, its recording is whole and proven."""
        assert (self.code, self.stderr) == (0, "")
        assert self.events[-1]["event"] == "stopped"
        assert self.ledger["gaps"] == []
        assert "cut_off" not in self.ledger
        assert self.ledger["recorder"]["dropped_entries"] == 0
        assert rows([entry.seq for entry in self.entries]) == [(1, len(self.entries))]
        assert self.verified == 0

    def numbers(self, stream: str, kind: Kind) -> list[int]:
        return numbers_in(self.entries, stream, kind)


def numbers_in(entries: Sequence[Entry], stream: str, kind: Kind) -> list[int]:
    """The recorded numbers of a talker, or of our ticks."""
    texts = [entry.data()[HEADER_SIZE + 2 :] for entry in entries if entry.kind is kind and entry.channel == stream]
    return [int(text[2 : 2 + int.from_bytes(text[:2], "big")]) for text in texts]


def ended(bridge: Bridge, path: Path) -> Ended:
    result = bridge.end()
    entries, ledger = read(path)
    return Ended(result.code, result.err, bridge.events, entries, ledger, command_line(["verify", str(path)]))


def read(path: Path) -> tuple[list[Entry], dict[str, Any]]:
    with SessionFile.open(path) as file:
        assert file.ledger is not None
        return list(file.entries()), file.ledger


# ── the network ────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Network:
    """What the scene of the network has seen.

    Attributes:
        how: kind of the lines.
        talkers: by device, ``C`` for the client and ``S`` for the server at each line; the latest last.
        received: the numbers of each device that ROS received.
        spoilt, early: packets that the weather changed, as the lines and as TCP at the far end report.
        rtt_s: as TCP at the far end of each line reports.
        down_at, up_at: of line ``DOWN``, UTC seconds.
        silent: of the other bridge, which has one peer at the far end of that line: a silent one.
    """

    how: str
    ended: Ended
    last_tick: int
    talkers: dict[str, list[Talker]]
    sent: dict[str, int]
    received: dict[str, list[int]]
    spoilt: list[int]
    early: int
    rtt_s: list[float]
    down_at: float
    up_at: float
    silent: list[Event]


def network(folder: Path) -> Network:
    """A bridge that serves a client and is client of a server over each line, with ROS on its own side."""
    with ExitStack() as stack:
        begun = stack.enter_context(ExitStack())
        begun.callback(starting.release)  # the longest scene begins first: ``scenes`` has it locked
        lines = stack.enter_context(Lines(len(WEATHER)))
        devices = [f"{side}{line}" for line in WEATHER for side in "CS"]
        strings = dict.fromkeys(map(topic, devices), TEXT)
        ros = stack.enter_context(RosClient("beside", subscribe=strings, advertise={OUT: TEXT}, within=lines.near))
        path = folder / "network.mcap"
        options = ["--listen", "0.0.0.0:0", "--allow", "10.77.0.0/16"]
        servers = [Server(lines.serve(line), f"S{line}") for line in WEATHER]
        for line, server in enumerate(servers):
            options += ["--connect", f"{far_address(line)}:{server.port}"]
            stack.callback(server.close)
        silent = Bridge("--no-ros", *options[:4], listen=False, within=lines.near)
        stack.callback(silent.close)
        silent_peer = stack.enter_context(lines.connect(DOWN, port_of(silent)))
        bridge = Bridge(*options, "--record", str(path), listen=False, within=lines.near)
        stack.callback(bridge.close)
        talkers = {}
        for line, server in enumerate(servers):
            talkers[f"C{line}"] = [Talker(lines.connect(line, port_of(bridge)), f"C{line}")]
            talkers[f"S{line}"] = server.talkers
        stack.callback(lambda: hang_up(talkers))
        begun.close()
        bridge.wait_code("link_up", len(devices))
        silent.wait_code("link_up")
        ros.wait_readers(OUT)
        ticking = Ticking(ros)
        stack.callback(ticking.stop)
        for device in devices:
            talkers[device][0].wait_some()
            wait_some(ros, device)

        for line, weather in WEATHER.items():
            lines.shape(line, weather)
        down_at = time.time()
        pause(DOWN_S)
        rtt_s = [rtt(talkers[f"C{line}"][0].socket) for line in WEATHER]
        lines.shape(DOWN, Weather())
        up_at = time.time()
        again = talkers[f"C{DOWN}"][0].hush() + 1
        talkers[f"C{DOWN}"].append(Talker(lines.connect(DOWN, port_of(bridge)), f"C{DOWN}", first=again))
        servers[DOWN].wait_talkers(2)
        for side in "CS":
            talker = talkers[f"{side}{DOWN}"][1]
            talker.wait_some()

        last = ticking.stop()
        said = {device: talkers[device][-1].hush() for device in devices}
        for device in devices:
            talkers[device][-1].wait_received(last)
            wait_last(ros, device, said[device])
        heard = {device: numbers(ros, device) for device in devices}
        spoilt, early = [lines.spoilt(line) for line in WEATHER], lines.kernel_counter("TCPOFOQueue")
        silent_peer.close()
        finished = ended(bridge, path)
        events = silent.events
        return Network(lines.how, finished, last, talkers, said, heard, spoilt, early, rtt_s, down_at, up_at, events)


def hang_up(talkers: dict[str, list[Talker]]) -> None:
    for each in talkers.values():
        for talker in each:
            talker.close()


def port_of(bridge: Bridge) -> int:
    port: int = bridge.events[0]["listen"][0]["port"]
    return port


def rtt(sock: socket.socket) -> float:
    """There and back again, as TCP measures it; in seconds."""
    (microseconds,) = struct.unpack_from("=I", sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 72), 68)
    return float(microseconds) / 1e6


# ── processes ──────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Graph:
    """What the scene of peers and ROS nodes that come and go has seen.

    Attributes:
        good: a peer that nothing happens to.
        frozen: what a node received that was stopped for a while, and how much of it by the time it continued.
        alone_from, alone_until: how far the ticks and the good peer were in ROS, when the discovery server was killed,
            and how far that peer a while later.
        before: the last tick of the first ROS node.
        first_after: the first tick of the next one, which found the bridge by a discovery server that was new, too.
        last: the last.
        received: the numbers of the good peer that each of the two nodes received.
    """

    ended: Ended
    good: Talker
    frozen: list[int]
    frozen_until: int
    victim: str
    alone_from: tuple[int, int]
    alone_until: int
    before: int
    first_after: int
    last: int
    received: list[list[int]]
    served: list[list[int]]
    server: str


def graph(folder: Path) -> Graph:
    """Peers and the ROS side of a bridge are stopped, killed and started again; the graph has a discovery server."""
    command = shutil.which("fast-discovery-server", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if not command:
        raise NotHereError("no fast-discovery-server")
    with ExitStack() as stack:
        port = free_udp_port()
        discovery = stack.enter_context(Discovery(command, port))
        # the bridge looks for topics by their names: that takes a client to which the server reports everything
        ros_env = {"ROS_DISCOVERY_SERVER": f"127.0.0.1:{port}", "ROS_SUPER_CLIENT": "TRUE"}

        def node(name: str) -> RosClient:
            return stack.enter_context(
                RosClient(name, subscribe={topic("Good"): TEXT}, advertise={OUT: TEXT}, domain=SECOND_DOMAIN, **ros_env)
            )

        def program(*arguments: object) -> Program:
            return started(stack, *arguments)

        served = [program(0, "Served")]
        served[0].wait_until(lambda: bool(served[0].lines), "port")
        server_port = served[0].lines[0].split()[1]
        path = folder / "graph.mcap"
        options = ["--connect", f"127.0.0.1:{server_port}", "--record", str(path)]
        with starting:
            bridge = Bridge(*options, listen=True, within=(), ROS_DOMAIN_ID=str(SECOND_DOMAIN), **ros_env)
            stack.callback(bridge.close)
            nodes = [node("first")]
        good = Talker(socket.create_connection(("127.0.0.1", bridge.port)), "Good")
        stack.callback(good.close)
        frozen, victim = program(bridge.port, "Frozen"), program(bridge.port, "Victim")
        bridge.wait_code("link_up", 4)
        nodes[0].wait_readers(OUT)
        ticking = Ticking(nodes[0])
        stack.callback(ticking.stop)
        good.wait_some()
        for each in (frozen, victim, served[0]):
            wait_ticks(each)
        wait_some(nodes[0], "Good")

        frozen.process.send_signal(signal.SIGSTOP)
        stopped_at = time.monotonic()
        discovery.kill()
        alone_at, alone_from = time.monotonic(), (ticking.sent, numbers(nodes[0], "Good")[-1])
        # a client dies inside a message, a server dies and is there again
        assert victim.process.stdin is not None
        victim.process.stdin.write(b"half\n")
        victim.process.stdin.flush()
        victim.wait_until(lambda: victim.lines[-1] == "half", "half a message")
        victim.process.kill()
        (truncated,) = bridge.wait_events(lambda event: event.get("code") == "truncated", "note about half a message")
        served[0].process.kill()
        server = f"127.0.0.1:{server_port}"
        wait_for(lambda: bool(told(bridge.events, "link_down", server)), bridge.said)
        served.append(program(0, "Served", server_port))
        wait_ticks(served[1])
        pause(stopped_at + STOPPED_S - time.monotonic())
        until = ticks(frozen)[-1]
        frozen.process.send_signal(signal.SIGCONT)
        # who has found the bridge needs no discovery server; who comes while there is none finds it later
        pause(alone_at + ALONE_S - 6.0 - time.monotonic())
        alone_until = numbers(nodes[0], "Good")[-1]
        nodes[0].process.kill()
        before = ticking.stop()
        with starting:
            nodes.append(node("second"))
        pause(alone_at + ALONE_S - time.monotonic())
        discovery.start()
        nodes[1].wait_readers(OUT)
        ticking = Ticking(nodes[1], first=before + 2)
        stack.callback(ticking.stop)
        wait_some(nodes[1], "Good")
        good.wait_received(before + 10)

        last, said = ticking.stop(), good.hush()
        good.wait_received(last)
        for each in (frozen, served[1]):
            wait_ticks(each, last)
        wait_last(nodes[1], "Good", said)
        finished = ended(bridge, path)
        return Graph(
            finished,
            good,
            ticks(frozen),
            until,
            truncated["data"]["peer"],
            alone_from,
            alone_until,
            before,
            next(number for number in good.received if number > before + 1),
            last,
            [numbers(each, "Good") for each in nodes],
            [ticks(each) for each in served],
            server,
        )


def started(stack: ExitStack, *arguments: object) -> Program:
    """A talker as a program of its own."""
    command = [sys.executable, str(ROOT / "tests/integration/talker.py"), *map(str, arguments)]
    program = Program(command, stdin=subprocess.PIPE)
    stack.callback(program.close)
    return program


def ticks(talker: Program) -> list[int]:
    return [int(line.split()[1]) for line in list(talker.lines) if line.startswith("received")]


def wait_ticks(talker: Program, last: int = 0) -> None:
    """Wait until it has received a few, or the last one."""
    talker.wait_until(lambda: ticks(talker)[-1:] == [last] if last else len(ticks(talker)) >= SOME, f"tick {last}")


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


class Discovery:
    """The discovery server of Fast DDS, to be killed and started again."""

    def __init__(self, command: str, port: int) -> None:
        self._command = [command, "-i", "0", "-l", "127.0.0.1", "-p", str(port)]
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, env=environment())

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Discovery:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Returning:
    """A client that comes back as soon as it can."""

    def __init__(self, port: int, device: str) -> None:
        self.talkers: list[Talker] = []
        self._address = ("127.0.0.1", port)
        self._device = device
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        first = 1
        while not self._over.wait(0.02):
            try:
                sock = socket.create_connection(self._address)
            except OSError:
                continue
            if sock.getsockname() == sock.getpeername():  # a free port can be connected to itself
                sock.close()
                continue
            talker = Talker(sock, self._device, first=first)
            self.talkers.append(talker)
            talker.wait_end()
            first = talker.hush() + 1

    def close(self) -> None:
        self._over.set()
        for talker in self.talkers:
            talker.close()
        self._thread.join()


@dataclass
class Killed:
    """What the scene of a bridge that is stopped, killed and started again has seen.

    Attributes:
        entries: of the recording of the one that was killed.
        stopped_ns, continued_ns: when it was stopped.
        events: the events that it reported.
        late: the name of a peer that was inside a message then, and sent the rest meanwhile.
        ended: the next one, at the same port.
        sent: by each connection of a client that comes back: first number, last number.
        back_s: from the kill until that client was there again.
        orphan: whether the recorder of the first one was still there in the end.
        left: shared memory of the first one that is still there.
    """

    entries: list[Entry]
    ledger: dict[str, Any]
    verified: int
    stopped_ns: int
    continued_ns: int
    events: list[Event]
    late: str
    ended: Ended
    sent: list[tuple[int, int]]
    back_s: float
    started_s: float
    orphan: bool
    left: list[str]


def killed(folder: Path) -> Killed:
    """A bridge is stopped for a while, then killed, and started again at the same port."""
    with ExitStack() as stack:
        port = free_port()
        paths = [folder / "killed.mcap", folder / "next.mcap"]

        def start(path: Path) -> Bridge:
            options = ["--listen", f"127.0.0.1:{port}", "--stall-s", f"{STALL_S:g}", "--record", str(path)]
            bridge = Bridge(*options, listen=False, ROS_DOMAIN_ID=os.environ["ROS_DOMAIN_ID"])
            stack.callback(bridge.close)
            return bridge

        with starting:
            bridge = start(paths[0])
        (recorder,) = children(bridge.process.pid)
        client = Returning(port, "Back")
        stack.callback(client.close)
        bridge.wait_code("stream", stream="STRING/Back")
        late = stack.enter_context(RawPeer(port))
        bridge.wait_until(lambda: bool(told(bridge.events, "link_up", late.name)), "link of the late peer")
        text = string("1", device="Late")
        late.send(text[:HEADER_SIZE])
        sent = client.talkers[0].sent  # half a message lasts for STALL_S only, so few numbers have to do
        wait_for(lambda: client.talkers[0].sent >= sent + 2, lambda: client.talkers)

        bridge.process.send_signal(signal.SIGSTOP)
        stopped_ns = time.time_ns()
        late.send(text[HEADER_SIZE:])
        pause(STOPPED_S)
        continued_ns = time.time_ns()
        bridge.process.send_signal(signal.SIGCONT)
        bridge.wait_code("stream", stream="STRING/Late")
        said = client.talkers[0].sent
        pause(1.5 * STALL_S / 4)  # it checks for silent peers at this interval
        wait_for(lambda: client.talkers[0].sent >= said + 10, lambda: client.talkers)

        memory = shared_memory(bridge.process.pid)
        assert memory or not Path("/dev/shm").is_dir()
        with starting:
            killed_at = time.monotonic()
            bridge.process.kill()
            bridge.process.wait()
            again = start(paths[1])
            started_s = time.monotonic() - killed_at
        again.wait_code("stream", stream="STRING/Back")
        wait_for(lambda: len(client.talkers) > 1 and client.talkers[1].sent > client.talkers[0].sent + 5, bridge.said)
        back_s = client.talkers[1].began - killed_at
        client.close()
        again.wait_code("link_down")
        finished = ended(again, paths[1])
        orphan = not ends(recorder)
        entries, ledger = read(paths[0])
        return Killed(
            entries,
            ledger,
            command_line(["verify", str(paths[0])]),
            stopped_ns,
            continued_ns,
            bridge.events,
            late.name,
            finished,
            [(talker.first, talker.sent) for talker in client.talkers],
            back_s,
            started_s,
            orphan,
            [name for name in memory if Path(name).exists()],
        )


def ends(process: int) -> bool:
    """Wait until a process has ended; False if it does not."""
    deadline = time.monotonic() + TIMEOUT_S
    while is_there := Path(f"/proc/{process}").exists():
        if time.monotonic() > deadline:
            break
        time.sleep(0.02)
    return not is_there


def shared_memory(process: int) -> list[str]:
    """What it owns; of the ports beside that, each is everybody's."""
    return sorted(set(re.findall(r"/dev/shm/fastrtps_[0-9a-f]{16}", Path(f"/proc/{process}/maps").read_text())))


@dataclass
class Recorder:
    """What the scene of a recorder that is stopped has seen: how far the peer was then, and in the end."""

    ended: Ended
    stopped: int
    continued: int
    sent: int


def recorder(folder: Path) -> Recorder:
    """The process that writes is stopped for a while."""
    with ExitStack() as stack:
        path = folder / "recorder.mcap"
        with starting:
            bridge = Bridge("--no-ros", "--record", str(path))
        stack.callback(bridge.close)
        talker = Talker(socket.create_connection(("127.0.0.1", bridge.port)), "Count", period_s=0.005)
        stack.callback(talker.close)
        bridge.wait_code("stream")
        (process,) = children(bridge.process.pid)
        os.kill(process, signal.SIGSTOP)
        try:
            stopped = talker.sent
            pause(STOPPED_S)
            continued = talker.sent
        finally:
            os.kill(process, signal.SIGCONT)
        said = talker.hush()
        talker.close()
        bridge.wait_code("link_down")
        return Recorder(ended(bridge, path), stopped, continued, said)


SCENES: tuple[Callable[[Path], Any], ...] = (network, graph, killed, recorder)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[Any]]]:
    folder = tmp_path_factory.mktemp("faults")
    starting.acquire()
    with ThreadPoolExecutor(len(SCENES)) as pool:
        yield {scene.__name__: pool.submit(scene, folder) for scene in SCENES}


# ── what they have seen ────────────────────────────────────────────────────────────────────────────────────────────


def outcome(scene: Future[Any]) -> Any:
    """Return its observations, or raise its error: a new one for each test, so that no traceback grows.

    Scenes start their programs one after another, and each step has a limit of its own.  On a busy machine all of them
    together take longer than the limit of one test, which would end the test run.
    """
    faulthandler.cancel_dump_traceback_later()
    error = scene.exception()
    if isinstance(error, NotHereError):
        pytest.skip(f"{error}")
    if error:
        raise AssertionError("".join(traceback.format_exception(error)))
    return scene.result()


@pytest.fixture
def net(scenes: dict[str, Future[Any]], record_property: Callable[[str, object], None]) -> Network:
    seen: Network = outcome(scenes["network"])
    record_property("lines", seen.how)
    return seen


def test_the_network_is_a_bad_one(net: Network) -> None:
    _log.info("lines: %s; packets spoilt %s, early %s; round trips %s s", net.how, net.spoilt, net.early, net.rtt_s)
    assert net.rtt_s[DELAY] > 0.08
    assert net.spoilt[LOSS] > 0 and net.spoilt[DOWN] > 0
    assert net.spoilt[REORDER] > 0 or net.how == NETEM  # which does not count them
    assert net.early > 0


@pytest.mark.parametrize("line", [DELAY, LOSS, REORDER], ids=["delay", "loss", "reordering"])
def test_over_a_bad_line_everything_arrives_once_and_in_order(net: Network, line: int) -> None:
    for device in (f"C{line}", f"S{line}"):
        (talker,) = net.talkers[device]
        assert rows(talker.received) == [(1, net.last_tick)]
        assert rows(net.received[device]) == [(1, net.sent[device])]
        assert rows(net.ended.numbers(f"STRING/{device}", Kind.IGTL_IN)) == [(1, net.sent[device])]
    assert rows(net.ended.numbers(f"STRING/{TICK}", Kind.IGTL_OUT)) == [(1, net.last_tick)]


def test_only_the_line_that_was_down_has_lost_links(net: Network) -> None:
    ups = [event for event in net.ended.events if event.get("code") == "link_up"]
    assert len(ups) == 2 * len(WEATHER) + 2
    lost = [event for event in net.ended.events if event.get("code") == "link_down" and moment(event) < net.up_at]
    assert {event["data"]["reason"] for event in lost} == {"unreachable"}
    assert {event["data"]["peer"] for event in lost} == {each[0].name for each in down(net)}


def down(net: Network) -> list[list[Talker]]:
    """The talkers of that line: each the one before and the one after."""
    return [net.talkers[f"C{DOWN}"], net.talkers[f"S{DOWN}"]]


@pytest.mark.parametrize("side", [0, 1], ids=["we are the server", "we are the client"])
def test_a_line_that_is_down_is_found_out_and_the_peer_is_served_again(net: Network, side: int) -> None:
    before, after = down(net)[side]
    (found_out,) = told(net.ended.events, "unreachable", before.name)
    assert net.down_at < moment(found_out) < net.up_at
    # to each of both connections without a gap, and nothing twice
    assert rows(before.received)[0][0] == 1 and len(rows(before.received)) == 1
    assert rows(after.received) == [(after.received[0], net.last_tick)]
    assert after.received[0] > before.received[-1]
    # and from each of them
    heard = rows(net.received[before.device])
    assert len(heard) == 2 and heard[0][0] == 1
    assert heard[1] == (after.first, after.sent)


@pytest.mark.parametrize("side", [0, 1], ids=["we are the server", "we are the client"])
def test_what_was_lost_with_a_link_is_told(net: Network, side: int) -> None:
    before, _ = down(net)[side]
    # under load a connection of the same peer may have ended before the line went down
    ended = next(event for event in told(net.ended.events, "link_down", before.name) if moment(event) > net.down_at)
    data = ended["data"]
    lost = data["sent_bytes"] - before.bytes_received
    # of what arrived at last, the confirmation may not have
    assert 0 < lost <= data["unconfirmed_bytes"] < lost + 1000
    assert data["sent_messages"] - len(before.received) > DOWN_S / TICK_S / 4
    link = net.ended.ledger["streams"][PEERS][f"{ended['links'][0]} {before.name}"]
    # what came when the link was about to close is neither forgotten nor counted as delivered
    late = link.get("dropped", {})
    assert link["delivered"] == data["sent_messages"] and set(late) <= {"link_closed"}
    assert link["sent"] == link["delivered"] + sum(late.values())


def test_a_silent_peer_behind_a_dead_line_is_found_out_by_keepalive(net: Network) -> None:
    (gone,) = [event for event in net.silent if event.get("code") == "link_down"]
    assert net.down_at < moment(gone) < net.up_at
    assert gone["data"]["reason"] in ("unreachable", "receiving failed: Connection timed out")


def test_after_a_bad_network_the_ledger_closes_and_the_recording_is_whole(net: Network) -> None:
    net.ended.closes()


@pytest.fixture
def seen(scenes: dict[str, Future[Any]]) -> Graph:
    found: Graph = outcome(scenes["graph"])
    return found


def test_a_peer_that_was_stopped_gets_all_of_it_and_nobody_else_waits(seen: Graph) -> None:
    assert seen.frozen_until < seen.before < seen.frozen[-1] == seen.last
    # the ROS node was killed meanwhile: its last tick may or may not have come
    assert rows(seen.frozen) == rows(seen.good.received)
    assert rows(seen.good.received)[0][0] == 1 and seen.good.received[-1] == seen.last


def test_a_peer_that_is_killed_inside_a_message_costs_that_message(seen: Graph) -> None:
    assert told(seen.ended.events, "link_down", seen.victim)
    assert not any(entry.data()[HEADER_SIZE + 4 :] == b"half of it arrives" for entry in seen.ended.entries)


def test_a_server_that_is_killed_and_started_again_is_connected_to_again(seen: Graph) -> None:
    assert len(told(seen.ended.events, "link_up", seen.server)) == 2
    assert all(len(rows(heard)) <= 2 for heard in seen.served)
    assert seen.served[1][-1] == seen.last


def test_who_has_been_found_needs_no_discovery_server(seen: Graph) -> None:
    ticked, good = seen.alone_from
    assert seen.before > ticked + (ALONE_S - 6) / TICK_S / 10
    assert seen.alone_until > good + (ALONE_S - 6) / PERIOD_S / 10


def test_a_ros_node_that_is_killed_is_found_again_with_a_new_discovery_server(seen: Graph) -> None:
    first, second = seen.received
    assert rows(first) == [(first[0], first[-1])] and rows(second) == [(second[0], seen.good.sent)]
    assert second[0] > first[-1]
    # the gateway received also what had no subscriber in ROS
    assert rows(seen.ended.numbers("STRING/Good", Kind.IGTL_IN)) == [(1, seen.good.sent)]
    ticked = rows(seen.ended.numbers(f"STRING/{TICK}", Kind.IGTL_OUT))
    assert ticked == rows(seen.good.received)
    assert ticked[0][0] == 1 and ticked[0][1] in (seen.before, seen.before + 1)


def test_after_all_that_the_ledger_closes_and_the_recording_is_whole(seen: Graph) -> None:
    seen.ended.closes()


@pytest.fixture
def dead(scenes: dict[str, Future[Any]]) -> Killed:
    found: Killed = outcome(scenes["killed"])
    return found


def test_a_bridge_that_was_stopped_goes_on_where_it_was(dead: Killed) -> None:
    codes = [event.get("code") for event in dead.events]
    assert "stalled" not in codes and "link_down" not in codes
    assert numbers_in(dead.entries, "STRING/Late", Kind.IGTL_IN) == [1]
    # meanwhile the client sent all its numbers, too
    assert rows(numbers_in(dead.entries, "STRING/Back", Kind.IGTL_IN))[0][0] == 1


def test_stamps_after_a_stop_are_of_the_time_of_arrival_and_nothing_bursts(dead: Killed) -> None:
    stamps = [entry.stamp_ns for entry in dead.entries]
    assert stamps == sorted(stamps)
    margin_ns = 200_000_000
    assert not [each for each in stamps if dead.stopped_ns + margin_ns < each < dead.continued_ns]
    notes = [Note.unpack(entry.data()).code for entry in dead.entries if entry.kind is Kind.EDGE_NOTE]
    assert len(notes) < 10, notes


def test_after_kill_9_of_a_bridge_the_next_one_serves_the_same_peers_at_the_same_port(dead: Killed) -> None:
    _log.info("killed, started again after %.2f s, the peer back after %.2f s", dead.started_s, dead.back_s)
    assert dead.verified == 0 and dead.ledger["cut_off"]
    assert len(dead.sent) == 2
    assert rows(numbers_in(dead.entries, "STRING/Back", Kind.IGTL_IN))[0][0] == 1
    assert rows(dead.ended.numbers("STRING/Back", Kind.IGTL_IN)) == [dead.sent[1]]
    dead.ended.closes()


def test_kill_9_of_a_bridge_leaves_neither_a_recorder_nor_shared_memory_when_the_next_one_has_started(
    dead: Killed,
) -> None:
    assert not dead.orphan
    assert dead.left == []


def test_a_recorder_that_was_stopped_loses_nothing(scenes: dict[str, Future[Any]]) -> None:
    writes: Recorder = outcome(scenes["recorder"])
    assert writes.continued - writes.stopped > STOPPED_S / 0.005 / 10
    assert rows(writes.ended.numbers("STRING/Count", Kind.IGTL_IN)) == [(1, writes.sent)]
    writes.ended.closes()
