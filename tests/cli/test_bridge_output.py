"""What ``bridge`` prints first: the options that decide which peers are admitted."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.app import bridge_options
from igtl_gateway.app.passage import NATIVE_PASSAGE
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import bridge, bridge_output
from igtl_gateway.cli.settings import settled
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import listen_address, peer_address
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.reports import RecordingSummary


def parsed(*words: str) -> dict[str, Any]:
    parser = argparse.ArgumentParser()
    bridge.add_arguments(parser)
    return settled(parser.parse_args(words), {})


@pytest.mark.parametrize(
    ("words", "listen", "connect"),
    [
        ([], "bw", "d"),
        (["--tls"], "abw", "cd"),
        (["--tls-cert", "a.pem"], "abw", "d"),  # never in the clear by mistake
        (["--tls-ca", "ca.pem"], "bw", "d"),
    ],
)
def test_where_tls_is_spoken(words: list[str], listen: str, connect: str) -> None:
    ours = {"a": peer_address(":1"), "b": peer_address("tls://:2"), "-": peer_address("tcp://:3")}
    ours |= {"w": listen_address("wss://:7"), "+": listen_address("ws://:8")}
    servers = {"c": peer_address(":4"), "d": peer_address("tls://:5"), "-": peer_address("tcp://:6")}
    found = bridge_options.secured(parsed(*words), tuple(ours.values()), tuple(servers.values()))
    assert found == (frozenset(ours[name] for name in listen), frozenset(servers[name] for name in connect))


def test_files_for_no_address_are_a_mistake() -> None:
    with pytest.raises(ConfigError, match="found no address with TLS"):
        bridge_options.secured(parsed("--tls-ca", "ca.pem"), (), (peer_address(":1"),))
    with pytest.raises(ConfigError, match="--tls: found only addresses with tcp:// or ws://"):
        bridge_options.secured(parsed("--tls"), (listen_address("ws://:1"), peer_address("tcp://:2")), ())
    assert bridge_options.tls(parsed("--tls-key", "k")) == TlsFiles(None, Path("k"), None)


def test_an_address_that_is_given_twice_is_no_other_program() -> None:
    with pytest.raises(ConfigError, match=r"--listen: found 127\.0\.0\.1:1 twice, expected each port once"):
        bridge_options.addresses((":1", "ws://:1"), ())
    assert len(bridge_options.addresses((":0", "ws://:0"), ())[0]) == 2


def test_limits() -> None:
    words = "--max-body STRING=4 --max-body GET_*=0.5 --max-body-mib 1 --max-messages 9 --idle-s 60 --stall-s 1"
    words += " --min-rate-kib 2"
    bodies = (("STRING", 4 << 20), ("GET_*", 1 << 19))
    own = PeerLimits(idle_s=60, stall_s=1, min_rate=2048, max_body=1 << 20, bodies=bodies, messages_per_s=9)
    assert bridge_options.limits(parsed(*words.split())) == own


def test_what_is_denied_is_said_and_slips_are_seen() -> None:
    assert bridge_output.denied_lines(Config()) == []
    lines = bridge_output.denied_lines(Config(deny_in=("command", "TRANFORM"), deny_out=("*",)))
    slip = "TRANFORM (matches no known type; did you mean 'TRANSFORM'?)"
    assert lines == [f"denied       from peers: command, {slip}", "denied       to peers: *"]


def test_a_limit_of_an_unknown_type_is_seen() -> None:
    assert bridge_output.limit_lines((("STRING", 1), ("GET_*", 2))) == []
    (line,) = bridge_output.limit_lines((("STRNG", 1), ("GET_*", 2)))
    assert line == "max body     STRNG (matches no known type; did you mean 'STRING'?)"


@pytest.mark.parametrize(
    ("files", "where"),
    [
        (["out.mcap"], "out.mcap"),
        (["out_1.mcap"], "out_1.mcap"),  # the first one was taken away
        (["out.mcap", "out_1.mcap"], "2 files, the last one out_1.mcap"),
        ([], "out.mcap"),
        (["out.mcap/out_0.mcap", "out.mcap/out_1.mcap", "out.mcap/metadata.yaml"], "out.mcap"),
    ],
)
def test_the_last_line_names_the_files_that_are_there(
    files: list[str], where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = RecordingSummary(Path("out.mcap"), 2_000, 7, {}, {}, tuple(map(Path, files)))
    recording = SimpleNamespace(snapshot_s=0)
    bridge = SimpleNamespace(
        tcp=SimpleNamespace(refused=dict),
        summary=summary,
        options=SimpleNamespace(recording=recording),
        uploads=None,
        losses={},
    )
    watch: Any = SimpleNamespace(counts=Counter(), refused=0)
    output: Any = bridge_output.TextOutput(terminal=False)
    output.stopped(bridge, watch)
    assert f"recorded 7 entries to {where} (2.0 kB)\n" in capsys.readouterr().out


def test_the_end_repeats_the_words_of_faults_and_no_codes(capsys: pytest.CaptureFixture[str]) -> None:
    bridge: Any = SimpleNamespace(tcp=SimpleNamespace(refused=dict), summary=None, uploads=None, losses={})
    output: Any = bridge_output.TextOutput(terminal=False)

    def note(level: Level, code: str, text: str, stream: str, **data: object) -> None:
        output.events([SimpleNamespace(note=Note(level, code, text, stream, data), links=(), more=0)])

    for stream in ("P10", "P2"):
        for age in (2, 3):
            note(Level.ERROR, "stale", f"{stream} is stale: messages are {age} s old", stream)
            note(Level.INFO, "fresh", f"{stream} is recent again", stream)
    for way, is_native in (("fast", True), ("slower", False), ("fast", True)):
        note(Level.INFO, NATIVE_PASSAGE, f"P2 takes the {way} way", "P2", native=is_native)
    shown = capsys.readouterr().out
    assert shown.count("recent again") == 4 and shown.count("is stale") == 2
    assert [line for line in shown.splitlines() if "way" in line] == [
        "= P2 takes the slower way",
        "= P2 takes the fast way",
    ]
    for reason in ("A", "B", "B"):
        note(Level.WARN, "refused", f"refused: {reason}", "", reason=reason)
        note(Level.WARN, "connect_failed", f"no server at {reason}", "", peer=reason, reason="timed out")
    assert [line for line in capsys.readouterr().out.splitlines() if "refused" in line or "server" in line] == [
        "? refused: A",
        "? no server at A",
        "? refused: B",
        "? no server at B",
    ]
    output.stopped(bridge, SimpleNamespace(counts=Counter(), refused=0))
    assert [line for line in capsys.readouterr().out.splitlines() if "times" in line] == [
        "  2 times: P2 is stale: messages are 2 s old",
        "  2 times: P10 is stale: messages are 2 s old",
        "  2 times: no server at B",
        "  2 times: refused: B",
    ]
