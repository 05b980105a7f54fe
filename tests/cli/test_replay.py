"""``replay`` as a process, with plain sockets as peers: the same bytes in the same order at every rate."""

from __future__ import annotations

import hashlib
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.replay.source import once, select
from igtl_gateway.session.entry import Kind

FIXTURES = Path(__file__).parents[2] / "fixtures"
STAR, TYPES = FIXTURES / "star.mcap", FIXTURES / "paper-types.mcap"
PATIENCE_S = 60.0


@contextmanager
def replay(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """``igtl-gateway replay`` as a process."""
    command = [sys.executable, "-m", "igtl_gateway", "replay", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        yield listener


def target(listener: socket.socket) -> str:
    return f"127.0.0.1:{listener.getsockname()[1]}"


def everything(peer: socket.socket) -> bytes:
    peer.settimeout(PATIENCE_S)
    data = bytearray()
    while part := peer.recv(1 << 20):
        data += part
    return bytes(data)


def received(*arguments: str) -> tuple[bytes, dict[str, object]]:
    """What a server receives from a replay that connects to it, and what the replay says of itself."""
    with server() as listener, replay(*arguments, "--to", "igtl", "--connect", target(listener), "--json") as process:
        peer, _ = listener.accept()
        with peer:
            data = everything(peer)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, err
        return data, json.loads(out)


def recorded(path: Path, *streams: str) -> bytes:
    with SessionFile.open(path) as file:
        return b"".join(e.data() for e in select(once(file.entries()), frozenset({Kind.IGTL_OUT}), streams))


def test_two_rates_deliver_identical_bytes_in_identical_order() -> None:
    wanted = recorded(STAR)
    assert len(wanted) > 5_000_000
    slow, told = received(str(STAR), "--rate", "8")
    fast, _ = received(str(STAR), "--as-fast-as-possible")
    assert slow == fast == wanted
    assert told["sha256"] == hashlib.sha256(wanted).hexdigest()
    assert told["bytes"] == len(wanted)


def test_through_todays_gateway_comes_the_same() -> None:
    data, _ = received(str(TYPES), "--as-fast-as-possible", "--through-gateway")
    assert data == recorded(TYPES)


def test_chosen_streams_only() -> None:
    data, told = received(str(TYPES), "--as-fast-as-possible", "--streams", "Mono*", "--streams", "STRING/*")
    assert data == recorded(TYPES, "Mono*", "STRING/*")
    assert set(told["streams"]) == {"IMAGE/Mono8", "IMAGE/Mono16", "STRING/Greeting"}  # type: ignore[call-overload]


def test_a_server_waits_for_as_many_clients_as_asked_and_serves_each_the_whole() -> None:
    arguments = (str(TYPES), "--to", "igtl", "--listen", "127.0.0.1:0", "--wait-peers", "2", "--as-fast-as-possible")
    with replay(*arguments, "--json") as process:
        assert process.stderr
        line = next(line for line in process.stderr if "server on" in line)
        host, _, port = line.split()[-1].rpartition(":")
        with socket.create_connection((host, int(port))) as one, socket.create_connection((host, int(port))) as two:
            assert everything(one) == everything(two) == recorded(TYPES)


def test_a_slow_reader_slows_the_replay_and_loses_nothing() -> None:
    with server() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        arguments = (str(STAR), "--to", "igtl", "--connect", target(listener), "--as-fast-as-possible", "--json")
        with replay(*arguments) as process:
            peer, _ = listener.accept()
            digest = hashlib.sha256()
            with peer:
                peer.settimeout(PATIENCE_S)
                while part := peer.recv(3000):
                    digest.update(part)
            out, _ = process.communicate(timeout=PATIENCE_S)
    assert json.loads(out)["sha256"] == digest.hexdigest() == hashlib.sha256(recorded(STAR)).hexdigest()


def test_ctrl_c_ends_a_replay_with_a_summary() -> None:
    with server() as listener:
        with replay(str(STAR), "--to", "igtl", "--connect", target(listener), "--rate", "0.01") as process:
            peer, _ = listener.accept()
            with peer:
                assert peer.recv(1)
                process.send_signal(signal.SIGINT)
                everything(peer)
            out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "stopped after" in out and "Traceback" not in err


def test_what_no_peer_was_there_for_is_said() -> None:
    with replay(str(TYPES), "--to", "igtl", "--listen", ":0", "--wait-peers", "0", "--rate", "1000") as process:
        out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "of them while no peer was connected" in out
    _, told = received(str(TYPES), "--as-fast-as-possible")
    assert told["unheard"] == 0


def test_an_output_that_nobody_reads_ends_without_a_traceback() -> None:
    with server() as listener:
        with replay(str(TYPES), "--to", "igtl", "--connect", target(listener), "--as-fast-as-possible") as process:
            assert process.stdout and process.stderr
            assert process.stdout.readline()
            process.stdout.close()
            peer, _ = listener.accept()
            with peer:
                assert everything(peer) == recorded(TYPES)
            assert process.wait(PATIENCE_S) == 1
            assert process.stderr.read() == ""


def test_damage_in_the_middle_ends_a_replay_with_one_line(tmp_path: Path) -> None:
    data = TYPES.read_bytes()
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data[:3000] + bytes(byte ^ 0xFF for byte in data[3000:3100]) + data[3100:])
    with server() as listener, replay(str(path), "--to", "igtl", "--connect", target(listener)) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert err.count("\n") == 1 and str(path) in err


@pytest.mark.parametrize("arguments", [("--rate", "0"), ("--rate", "-2"), ("--wait-peers", "-1")])
def test_impossible_options_are_usage(arguments: tuple[str, str]) -> None:
    with replay(str(TYPES), "--to", "igtl", *arguments) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert err.count("\n") == 1 and arguments[0] in err
