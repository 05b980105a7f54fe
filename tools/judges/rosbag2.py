"""rosbag2 at the gateway: it records the graph of a bridge, and plays a recording of the bridge.

``python tools/judges/rosbag2.py --prefix DIR …``: folders with ``lib``, ``share`` and the Python modules of
rosbag2_transport, its storages and zstd, as an installed ROS 2 has.  Writes
docs/evidence/real-programs/rosbag2.jsonl; exit code 1 if anything differs.

Strategy: the messages are those of ``ros_types``.  Three records of the same traffic are compared topic by topic, each
byte: rosbag2's, what the gateway imports of it, and the gateway's own.  Then rosbag2 plays the inputs of the gateway's
own recording to another bridge, whose recording must have the same inputs and the same outputs.  The same is done with
a service and an action of rclpy; what two nodes send at once may have another order there.  Last, rosbag2 sends the
requests of its own bag, which the gateway has imported and exported, to a service and an action.
"""

from __future__ import annotations

import argparse
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path

from mcap.reader import make_reader
from rclpy.action import ActionClient

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.convert.exchanges import action_of, service_of
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.bridge import TIMEOUT_S, Bridge, Program, RawPeer, RosClient, environment
from tests.integration.test_ros_types import SEC, rows_of_the_command_line
from tests.places import ROOT
from tools.judges import cpp, results, ros_types
from tools.judges.results import BOTH, EXACT, FAILS, TO_IGTL, Row

Messages = dict[str, list[bytes]]
#: What the gateway does not record: logs and parameters of each node, and what it publishes of itself.
NOT_OURS = ("/rosout", "/parameter_events", "/events/write_split", "/diagnostics")
#: Events of services; feedback and states of actions, which are hidden topics.  Jazzy does not know the second.
EXCHANGES = ("record.all_services:=true", "record.all_actions:=true", "record.include_hidden_topics:=true")
#: Form of a bag → parameters of its recorder, which overrule those before.
SQLITE, UNBOUNDED = "storage.storage_id:=sqlite3", "record.compression_queue_size:=0"
ZSTD = ("record.compression_format:=zstd", UNBOUNDED, "record.compression_mode:=message")
ZSTD_FILE = (*ZSTD[:-1], "record.compression_mode:=file")
FORMS: dict[str, tuple[str, ...]] = {
    "MCAP": (),
    "MCAP, zstd_small": ("storage.storage_preset_profile:=zstd_small",),
    "MCAP, messages compressed": ZSTD,
    "MCAP, file compressed": ZSTD_FILE,
    "SQLite": (SQLITE,),
    "SQLite, messages compressed": (SQLITE, *ZSTD),
    "SQLite, file compressed": (SQLITE, *ZSTD_FILE),
}
#: A service and an action of rclpy: with clients, and without.
WORLD, SERVER = ROOT / "tests/integration/services_world.py", cpp.PROGRAMS / "exchange_server.py"
#: For the discovery of the player's topics, and for the last message.
DELAY_S, AFTER_S = 5, 3
PLAYED = ("storage.storage_id:=mcap", f"play.delay.sec:={DELAY_S}", "play.disable_keyboard_controls:=true")
#: It sends the requests that clients sent.
AS_CLIENT = (
    "play.publish_service_request:=true",
    "play.send_actions_as_client:=true",
    "play.service_requests_source:=CLIENT_INTROSPECTION",
)
#: Where a message of OpenIGTLink has its stamp, and the first half of it that the tables of ``ros_types`` ask for.
STAMP, SECONDS = slice(34, 42), struct.pack(">I", SEC)


@contextmanager
def program(name: str, prefixes: Sequence[Path], *parameters: str) -> Iterator[Program]:
    """The recorder or the player, ended by Ctrl-C."""
    words = [word for each in parameters for word in ("-p", each)]
    command = [str(cpp.executable("rosbag2_transport", name, prefixes)), "--ros-args", *words]
    running = Program(command, environment(**cpp.environment(prefixes)))
    try:
        yield running
        running.end(signal.SIGINT)
    finally:
        running.close()


@contextmanager
def recorder(bag: Path, prefixes: Sequence[Path], *parameters: str) -> Iterator[Program]:
    """Records all topics, also those without a publisher yet."""
    with program(
        "recorder",
        prefixes,
        f"storage.uri:={bag}",
        "storage.storage_id:=mcap",
        "record.all_topics:=true",
        "record.include_unpublished_topics:=true",
        "record.disable_keyboard_controls:=true",
        *parameters,
    ) as running:
        yield running


def of_bag(bag: Path) -> Messages:
    """Topic → messages of the files of a bag, by the library of MCAP."""
    found: Messages = defaultdict(list)
    for path in sorted(bag.glob("*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                found[channel.topic].append(message.data)
    return found


def of_session(path: Path, *kinds: Kind) -> Messages:
    """Channel → messages of a recording of the gateway."""
    found: Messages = defaultdict(list)
    with SessionFile.open(path) as file:
        for entry in file.entries_of_kinds(kinds):
            if entry.kind in kinds:
                found[entry.channel].append(entry.data())
    return found


def padded(data: bytes) -> bytes:
    """With the zeros up to a multiple of four bytes that RTPS adds to CDR."""
    return data + bytes(-len(data) % 4)


def compared(
    what: str, direction: str, found: Mapping[str, list[bytes]], wanted: Mapping[str, list[bytes]]
) -> list[Row]:
    """One row for all equal channels, and one for each that differs."""
    found, wanted = ({channel: [*map(padded, each)] for channel, each in which.items()} for which in (found, wanted))
    equal = [channel for channel, messages in wanted.items() if found.get(channel) == messages]
    rows = [Row(what, direction, EXACT, sum(len(wanted[each]) for each in equal))] if equal else []
    for channel in wanted.keys() - equal:
        messages = found.get(channel, [])
        same = sum(a == b for a, b in zip(messages, wanted[channel], strict=False))
        text = f"{channel}: {len(messages)} messages, {same} equal, expected {len(wanted[channel])}"
        rows.append(Row(what, direction, FAILS, 1, text))
    return rows


def record(folder: Path, prefixes: Sequence[Path]) -> list[Row]:
    """Everything of the tables, recorded by both."""
    bag, session, imported = folder / "bag", folder / "session.mcap", folder / "imported.mcap"
    node = RosClient("judge")
    with recorder(bag, prefixes):
        failed = [row for row in ros_types.judge(node, "--record", str(session), readers=2) if row.result != EXACT]
        time.sleep(1)
    command = [sys.executable, "-m", "igtl_gateway", "import", str(bag), "-o", str(imported)]
    subprocess.run(command, check=True, capture_output=True, timeout=10 * TIMEOUT_S)
    bagged = {topic: messages for topic, messages in of_bag(bag).items() if topic not in NOT_OURS}
    ours = {
        topic: messages
        for topic, messages in of_session(session, Kind.ROS_IN, Kind.ROS_OUT).items()
        if topic in bagged or topic.startswith("/igtl/")
    }
    rows = compared("recorded by rosbag2 as by the gateway", BOTH, bagged, ours)
    rows += compared("its bag, imported", BOTH, of_session(imported, Kind.ROS_IN), bagged)
    return [*rows, *failed]


def play(folder: Path, prefixes: Sequence[Path]) -> list[Row]:
    """The inputs of the recording, played to another bridge."""
    session, again = folder / "session.mcap", folder / "again.mcap"
    inputs = of_session(session, Kind.ROS_IN)
    bridge = Bridge("--no-cautious", *rows_of_the_command_line(), "--record", str(again))
    with RawPeer(bridge.port), SessionFile.open(session) as file:
        bridge.wait_code("link_up")
        topics = ", ".join(sorted(inputs))
        with program("player", prefixes, f"storage.uri:={session}", f"play.topics_to_filter:=[{topics}]", *PLAYED):
            time.sleep(DELAY_S + (file.end_ns - file.start_ns) / 1e9 + AFTER_S)
        bridge.end()
        bridge.close()
    what = "played by rosbag2 to another bridge"
    rows = compared(f"{what}: what that receives", TO_IGTL, of_session(again, Kind.ROS_IN), inputs)
    first, second = map(to_silent_peer, (session, again))
    return [*rows, *compared(f"{what}: what its peer receives", TO_IGTL, second, first)]


def exchanges(folder: Path, prefixes: Sequence[Path]) -> list[Row]:
    """A service and an action, recorded by both; the gateway's recording, exported, played to another bridge."""
    session, again = folder / "calls.mcap", folder / "calls-again.mcap"
    exported, returned = folder / "calls-exported", folder / "calls-returned"
    bags = {form: folder / f"calls-{number}" for number, form in enumerate(FORMS)}
    imported = {form: bag.with_suffix(".mcap") for form, bag in bags.items()}
    with ExitStack() as stack:
        for form, bag in bags.items():
            stack.enter_context(recorder(bag, prefixes, *EXCHANGES, *FORMS[form]))
        stack.enter_context(recording_bridge(session))
        world = Program([sys.executable, str(WORLD), str(len(bags) + 1)])
        world.wait_until(lambda: "end" in world.lines, "end of the goals")
        time.sleep(AFTER_S)
        world.close()
    for words in (
        *(("import", bag, "-o", imported[form]) for form, bag in bags.items()),
        ("export", imported["MCAP"], "--to", "rosbag2", "-o", returned),
        ("export", session, "--to", "rosbag2", "-o", exported),
    ):
        command = [sys.executable, "-m", "igtl_gateway", *map(str, words)]
        subprocess.run(command, check=True, capture_output=True, timeout=10 * TIMEOUT_S)
    with recording_bridge(again):
        with program("player", prefixes, f"storage.uri:={exported}", *PLAYED), SessionFile.open(session) as file:
            time.sleep(DELAY_S + (file.end_ns - file.start_ns) / 1e9 + AFTER_S)
    ours = of_exchanges(of_session(session, Kind.ROS_IN))
    what = "services and actions: "
    rows = compared(f"{what}recorded by rosbag2 as by the gateway", BOTH, of_exchanges(of_bag(bags["MCAP"])), ours)
    for form, path in imported.items():
        found = of_exchanges(of_session(path, Kind.ROS_IN))
        rows += compared(f"{what}its bag ({form}), imported", BOTH, found, ours)
    rows += compared(f"{what}its bag, imported and exported", BOTH, of_exchanges(of_bag(returned)), ours)
    rows += compared(f"{what}exported", BOTH, of_exchanges(of_bag(exported)), ours)
    played = of_exchanges(of_session(again, Kind.ROS_IN))
    rows += compared(f"{what}the export, played by rosbag2 to another bridge", BOTH, played, ours)
    return [*rows, requests(returned, prefixes, f"{what}requests of its bag, imported and exported, sent by rosbag2")]


def requests(bag: Path, prefixes: Sequence[Path], what: str) -> Row:
    """rosbag2 as the client of a bag's services, and since Kilted of its actions."""
    wanted = [f"call {data}" for data in (False, True) * 2]
    if hasattr(ActionClient, "configure_introspection"):
        wanted += ["goal 3", "goal 9", "goal 5", "cancel 5"]
    server = Program([sys.executable, str(SERVER)])
    try:
        with program("player", prefixes, f"storage.uri:={bag}", *PLAYED, *AS_CLIENT), suppress(AssertionError):
            server.wait_until(lambda: len(server.lines) >= len(wanted), "end of the requests")
        time.sleep(AFTER_S)
        found = [*server.lines]
    finally:
        server.close()
    same = sorted(found) == sorted(wanted)
    return Row(what, BOTH, EXACT if same else FAILS, len(wanted), "" if same else f"{found}, expected {wanted}")


@contextmanager
def recording_bridge(path: Path) -> Iterator[Bridge]:
    """A bridge without peers that records all topics, services and actions."""
    bridge = Bridge("--record", str(path), "--record-all")
    try:
        yield bridge
        bridge.end()
    finally:
        bridge.close()


def of_exchanges(found: Mapping[str, list[bytes]]) -> Messages:
    """The topics of services and actions, each with its messages in the order of their bytes."""
    return {topic: sorted(map(bytes, each)) for topic, each in found.items() if service_of(topic) or action_of(topic)}


def to_silent_peer(path: Path) -> Messages:
    """What went to the peer that sends nothing: it gets every type.  Without stamps that are the time of receipt."""
    found: dict[int, Messages] = defaultdict(lambda: defaultdict(list))
    with SessionFile.open(path) as file:
        for entry in file.entries_of_kinds([Kind.IGTL_OUT]):
            data = bytes(entry.data())
            stamped = data[STAMP].startswith(SECONDS)
            for link in entry.links if entry.kind is Kind.IGTL_OUT else ():
                found[link][entry.channel].append(data if stamped else data[: STAMP.start] + data[STAMP.stop :])
    its = max(found.values(), key=len)
    return {channel: [*dict.fromkeys(messages)] for channel, messages in its.items()}  # answers repeat what was sent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prefix", type=Path, action="append", required=True, help="folder of packages (repeatable)")
    parser.add_argument("--name", default="rosbag2", help="of the file with the results (default: %(default)s)")
    options = parser.parse_args()
    prefixes = options.prefix
    with tempfile.TemporaryDirectory() as name:
        rows = [*record(Path(name), prefixes), *play(Path(name), prefixes), *exchanges(Path(name), prefixes)]
    program, version = f"rosbag2 with rclpy {metadata.version('rclpy')}", cpp.version_of("rosbag2_transport", prefixes)
    return results.write(options.name, program, version, "recorder and player", rows)


if __name__ == "__main__":
    sys.exit(main())
