"""The gateway in a Python that lacks what Windows lacks: ``docs/how-to/systems.md`` has what that imitates."""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import zenoh

from igtl_gateway.addons.zenoh import names
from igtl_gateway.addons.zenoh.names import Kind, Node
from igtl_gateway.addons.zenoh.own_node import TypeHashes
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.entry import Kind as EntryKind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.addons.zenoh.routers import client, router
from tests.addons.zenoh.test_edge import until
from tests.integration.bridge import Bridge, RawPeer, environment, free_port, gateway, string
from tests.places import ROOT

AS_WINDOWS = Path(__file__).parent / "as_windows"
PYTHONPATH = os.pathsep.join([str(AS_WINDOWS), str(ROOT)])
#: More verbs, of a larger session: 20 s.
ALL = bool(os.environ.get("IGTL_GATEWAY_ALL_AS_WINDOWS"))
SMALL, STAR = "acquisition.mcap", "star.mcap"
#: Exit codes of verbs that take longer.
MORE: dict[tuple[str, ...], int] = {
    ("doctor", "every.mcap"): 0,
    ("export", "every.mcap", "--to", "csv", "-o", "all tables"): 0,
    ("export", "every.mcap", "--to", "rosbag2", "-o", "whole bag"): 0,
    ("import", "whole bag", "-o", "whole import.mcap"): 0,
    ("deidentify", "every.mcap", "-o", "clean.mcap"): 0,
    ("merge", "a=every.mcap", "b=part.mcap", "-o", "all.mcap", "--offset", "b=0"): 0,
    ("review", "every.mcap"): 1,
    ("sync", "every.mcap"): 1,
}
DOMAIN = 23
HASH = TypeHashes().of(String.TYPE)
#: More than a socket takes at once.
LARGE = "x" * 60_000
#: Steps of the clocks that Windows has without our help.
STEP_NS = 15_625_000


def run_verbs(*commands: Sequence[str | Path], cwd: Path) -> list[tuple[Any, str, str]]:
    """Run the verbs in one program; return exit code (or the trace of an exception), output and errors of each."""
    lines = "".join(json.dumps([str(word) for word in command]) + "\n" for command in commands)
    ran = subprocess.run(
        [sys.executable, "-X", "warn_default_encoding", AS_WINDOWS / "verbs.py"],
        input=lines,
        capture_output=True,
        text=True,
        timeout=120,
        cwd=cwd,
        env=environment(PYTHONPATH=PYTHONPATH, PYTHONIOENCODING="cp1252"),
        check=False,
    )
    found = [tuple(json.loads(line)) for line in ran.stdout.splitlines()]
    assert len(found) == len(commands), ran.stderr
    assert "EncodingWarning" not in ran.stderr
    return found


def declared(session: Any, node: Node, kind: Kind, number: int, topic: str) -> Any:
    token = node.entity_token(number, kind, topic, String.TYPE, HASH, Qos(10))
    return session.liveliness().declare_token(token)


more = pytest.mark.skipif(not ALL, reason="IGTL_GATEWAY_ALL_AS_WINDOWS=1 asks for it")


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, id="Ctrl-C"), pytest.param(signal.SIGQUIT, id="Ctrl-Break", marks=more)]
)
def test_a_session_over_zenoh_is_recorded_and_verifies(tmp_path: Path, number: signal.Signals) -> None:
    path, port = tmp_path / "out.mcap", free_port()
    heard: queue.Queue[Any] = queue.Queue()
    with router(port), client(port) as plain:
        node = Node(DOMAIN, str(plain.info.zid()), 0, "plain")
        held = [
            plain.declare_subscriber(names.data_key(DOMAIN, "/igtl/in/Said/string", String.TYPE, HASH), heard.put),
            declared(plain, node, Kind.SUBSCRIPTION, 1, "/igtl/in/Said/string"),
            declared(plain, node, Kind.PUBLISHER, 2, "/igtl/out/string/Told"),
        ]
        bridge = Bridge(
            *("--ros", f"zenoh:tcp/127.0.0.1:{port}", "--record", str(path)),
            PYTHONPATH=PYTHONPATH,
            ROS_DOMAIN_ID=str(DOMAIN),
        )
        try:
            with RawPeer(bridge.port) as peer:
                bridge.wait_code("link_up")
                for word in ("one", "two", LARGE):
                    peer.send(string(word, "Said"))
                got = [String.unpack(heard.get(timeout=30).payload.to_bytes()).data for _ in range(3)]
                bridge.wait_code("ros_subscribed")
                key = names.data_key(DOMAIN, "/igtl/out/string/Told", String.TYPE, HASH)
                # by default, Zenoh drops what a busy router does not take at once
                publisher = plain.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
                until(lambda: bool(publisher.matching_status.matching), 30)
                for count in range(3):
                    data = String(str(count) + LARGE).pack()
                    publisher.put(data, attachment=names.attachment(count + 1, 1, bytes(range(16))))
                answers = [peer.receive(type_name="STRING") for _ in range(3)]
            told = bridge.end(number)
        finally:
            bridge.close()
        del held
    assert (told.code, told.err) == (0, "")
    assert got == ["one", "two", LARGE]
    assert [answer.body[4:5] for answer in answers] == [b"0", b"1", b"2"] and all(each.crc_ok for each in answers)
    with SessionFile.open(path) as file:
        assert file.ledger and "cut_off" not in file.ledger
        stamps = [entry.stamp_ns for entry in file.entries()]
        kinds = {entry.kind for entry in file.entries()}
    assert {EntryKind.IGTL_IN, EntryKind.IGTL_OUT, EntryKind.ROS_IN, EntryKind.ROS_OUT} <= kinds
    assert sum(stamp % STEP_NS == 0 for stamp in stamps) < 2, "the clock is that with steps"
    assert run_verbs(["verify", path], cwd=tmp_path)[0][0] == 0


@pytest.mark.slow
def test_the_verbs_work(tmp_path: Path) -> None:
    session = "every.mcap"
    shutil.copy(ROOT / "fixtures" / (STAR if ALL else SMALL), tmp_path / session)
    wanted: dict[tuple[str, ...], int] = {
        ("verify", session): 0,
        ("info", session): 0,
        ("diff", session, session): 0,
        ("slice", session, "-o", "part.mcap", "--start", "1", "--end", "3"): 0,
        ("verify", "part.mcap"): 0,
        ("slice", session, "-o", "part.mcap", "--end", "2", "--overwrite"): 0,
        ("seal", "keys", "new", "own.key"): 0,
        ("seal", "part.mcap", "--key", "own.key", "-o", "sealed.mcap"): 0,
        ("verify", "--seal", "sealed.mcap", "--trust", "own.key.pub"): 0,
        ("recover", "part.mcap", "-o", "again.mcap"): 0,
        ("export", "part.mcap", "--to", "csv", "-o", "tables"): 0,
        ("export", "part.mcap", "--to", "rosbag2", "-o", "bag"): 0,
        ("import", "bag", "-o", "imported.mcap"): 0,
        ("decode", "nothing.igtl"): 2,
        ("keep", ".", "--retention", "1 d"): 0,  # deletes the one that is old
        ("doctor", "--host"): 1,
        ("doctor", "127.0.0.1:1", "--seconds", "0.1"): 1,
        ("info", "no such file"): 2,
    }
    (tmp_path / "nothing.igtl").write_bytes(b"")
    shutil.copy(tmp_path / session, tmp_path / "old.mcap")
    os.utime(tmp_path / "old.mcap", (1_750_000_000, 1_750_000_000))
    wanted |= MORE if ALL else {}
    results = run_verbs(*wanted, cwd=tmp_path)
    assert {words: code for words, (code, _, _) in zip(wanted, results, strict=True)} == wanted, results
    assert not (tmp_path / "old.mcap").exists() and (tmp_path / session).exists()


@more
def test_a_replay_sends_the_recorded_bytes(tmp_path: Path) -> None:
    path, port = ROOT / "fixtures" / SMALL, free_port()
    with SessionFile.open(path) as file:
        sent = b"".join(entry.data() for entry in file.entries() if entry.kind is EntryKind.IGTL_OUT)
    arguments = ("replay", str(path), "--to", "igtl", "--listen", f"127.0.0.1:{port}", "--as-fast-as-possible")
    program = gateway(*arguments, PYTHONPATH=PYTHONPATH)
    try:
        program.wait_until(lambda: any(str(port) in line for line in program.lines), "port")
        with RawPeer(port) as peer:
            assert peer.everything() == sent
        assert program.end(None).code == 0
    finally:
        program.close()
