"""``replay``, much of it as a process, with plain sockets as peers: the same bytes in the same order at every rate."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from igtl_gateway.app.faulty import FaultyFeed
from igtl_gateway.base.extras import missing
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.cli import main
from igtl_gateway.config.faults import Faults
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.latched import STATE_TYPES
from igtl_gateway.replay.source import first_form_only, select_entries
from tests.places import FIXTURES, PEMS
from tests.several import outcomes

STAR, TYPES = FIXTURES / "star.mcap", FIXTURES / "paper-types.mcap"
PATIENCE_S = 60.0
#: The command line with standard input for its controlling terminal.
IN_FRONT = """
import fcntl, sys, termios
from igtl_gateway.cli import main
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.exit(main())
"""


@contextmanager
def replay(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """``igtl-gateway replay`` as a process."""
    command = [sys.executable, "-m", "igtl_gateway", "replay", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
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
    """What a server receives from a replay that connects to it, and the result that the replay reports."""
    data, (told,) = received_lines(*arguments)
    return data, told


def received_lines(*arguments: str) -> tuple[bytes, list[dict[str, Any]]]:
    """What a server receives from a replay that connects to it, and all lines that the replay prints.

    The replay runs in this process, whose start takes longer than most of them.
    """

    def serve() -> bytes:
        peer, _ = listener.accept()
        with peer:
            return everything(peer)

    with server() as listener, ThreadPoolExecutor(1) as pool, redirect_stdout(StringIO()) as out:
        data = pool.submit(serve)
        with redirect_stderr(StringIO()) as err:
            code = main(["replay", *arguments, "--to", "igtl", "--connect", target(listener), "--json"])
        assert code == 0, err.getvalue()
        return data.result(), [json.loads(line) for line in out.getvalue().splitlines()]


def recorded(path: Path, *streams: str) -> bytes:
    with SessionFile.open(path) as file:
        return b"".join(
            e.data() for e in select_entries(first_form_only(file.entries()), frozenset({Kind.IGTL_OUT}), streams)
        )


def test_two_rates_deliver_identical_bytes_in_identical_order() -> None:
    wanted = recorded(STAR)
    assert len(wanted) > 5_000_000
    slow, told = received(str(STAR), "--rate", "8")
    fast, _ = received(str(STAR), "--as-fast-as-possible")
    assert slow == fast == wanted
    assert told["sha256"] == hashlib.sha256(wanted).hexdigest()
    assert told["bytes"] == len(wanted)


def test_over_a_bad_line_the_same_seed_does_the_same_at_every_rate() -> None:
    faults = "delay=30ms,jitter=10ms,loss=5%,reorder=5%,corrupt=2%,clock-step=-1h@2s"
    arguments = (str(STAR), "--streams", "TRANSFORM/*", "--fault", faults, "--seed", "7")
    with SessionFile.open(STAR) as file:
        outputs = list(select_entries(first_form_only(file.entries()), frozenset({Kind.IGTL_OUT}), ["TRANSFORM/*"]))
    feed = FaultyFeed(Faults.parse(faults), 7)
    wanted = b"".join(entry.data() for entry in feed(outputs))
    assert feed.counts["loss"] > 10 < feed.counts["corrupt"]
    slow, told = received_lines(*arguments, "--rate", "20")
    fast, _ = received_lines(*arguments, "--as-fast-as-possible")
    assert slow == fast == wanted
    assert told[-1]["faults"] == {"fault": faults, "seed": 7, "counts": feed.counts}
    assert told[-1]["sha256"] == hashlib.sha256(wanted).hexdigest()
    assert sum("corrupt" in line.get("faults", {}) for line in told[:-1]) == feed.counts["corrupt"]


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [
        (("--fault", "los=1%"), "--fault: found 'los'"),
        (("--fault", "loss=1%", "--to", "ros"), "--fault: found --to ros, expected --to igtl"),
        (("--fault", "clock-step=1h", "--restamp", "now"), "--fault: clock-step: found --restamp now"),
    ],
)
def test_faults_that_cannot_be_are_refused(
    arguments: tuple[str, ...], wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(("replay", str(STAR), "--to", "igtl", *arguments)) == 2
    assert wrong in capsys.readouterr().err


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


def test_a_client_with_tls_and_a_server_that_wants_its_certificate() -> None:
    serves = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    serves.load_cert_chain(PEMS / "server.pem")
    serves.load_verify_locations(PEMS / "ca.pem")
    serves.verify_mode = ssl.CERT_REQUIRED
    with server() as listener:
        to = ("--to", "igtl", "--connect", f"tls://{target(listener)}", "--as-fast-as-possible")
        files = ("--tls-cert", str(PEMS / "viewer.pem"), "--tls-ca", str(PEMS / "ca.pem"))
        with replay(str(TYPES), *to, *files) as process:
            peer, _ = listener.accept()
            with serves.wrap_socket(peer, server_side=True) as peer:
                assert everything(peer) == recorded(TYPES)
            process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


def test_a_server_with_tls() -> None:
    using = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    using.load_verify_locations(PEMS / "ca.pem")
    to = ("--to", "igtl", "--listen", "127.0.0.1:0", "--as-fast-as-possible", "--tls-cert", str(PEMS / "server.pem"))
    with replay(str(TYPES), *to, "--json") as process:
        assert process.stderr
        line = next(line for line in process.stderr if "server on" in line)
        host, _, port = line.split()[-1].rpartition(":")
        with socket.create_connection((host, int(port))) as raw, using.wrap_socket(raw, server_hostname=host) as peer:
            assert everything(peer) == recorded(TYPES)


@pytest.mark.parametrize(
    ("arguments", "wrong"),
    [
        (("--to", "igtl", "--listen", "0.0.0.0:0"), "none may connect"),
        (("--to", "igtl", "--listen", "tls://127.0.0.1:0"), "expected --tls-cert FILE"),
        (("--to", "igtl", "--tls-ca", "ca.pem"), "found no address with TLS"),
        (("--to", "ros", "--tls-ca", "ca.pem"), "found --to ros, expected --to igtl"),
    ],
)
def test_addresses_that_cannot_be_are_refused(
    arguments: tuple[str, ...], wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(("replay", str(TYPES), *arguments)) == 2
    assert wrong in capsys.readouterr().err


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
    sent, played, unsent, all_recorded = (
        int(each.replace(",", ""))
        for each in re.findall(r"sent ([\d,]+) of the ([\d,]+) message.*?not sent: ([\d,]+) of ([\d,]+)", out, re.S)[0]
    )
    assert sent < played and sent + unsent == all_recorded, out
    _, told = received(str(TYPES), "--as-fast-as-possible")
    assert told["without_peer"] == told["unheard"] == 0


def test_only_what_was_left_out_is_an_error() -> None:
    """A program that can read none of the messages gets nothing, so exit code 0 would be wrong."""
    with server() as listener, ThreadPoolExecutor(1) as pool:
        peer = pool.submit(lambda: everything(listener.accept()[0]))
        to = ("--to", "igtl", "--connect", target(listener), "--profile", "holoscan", "--as-fast-as-possible")
        with redirect_stderr(StringIO()) as err:
            assert main(["replay", str(FIXTURES / "every-type.mcap"), *to, "--streams", "BIND/*"]) == 1
        assert peer.result() == b""
    assert "no connected peer can read the" in err.getvalue() and "--exact" in err.getvalue()


def test_a_part_without_options_has_nothing_outside_of_start_and_end(tmp_path: Path) -> None:
    """A part begins with the state before it, and without a window."""
    with SessionFile.open(STAR) as file:
        half = file.start_ns + (file.end_ns - file.start_ns) // 2
    assert main(["slice", str(STAR), "--start", f"{half / 1e9:.6f}", "-o", str(tmp_path / "part.mcap")]) == 0
    _, told = received(str(tmp_path / "part.mcap"), "--as-fast-as-possible")
    account: Any = told["account"]
    assert "outside" not in account["not_sent"]


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
    with TYPES.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary
    at = summary.chunk_indexes[-1].chunk_start_offset + 200
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data[:at] + bytes(byte ^ 0xFF for byte in data[at : at + 100]) + data[at + 100 :])
    with server() as listener, replay(str(path), "--to", "igtl", "--connect", target(listener)) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert err.count("\n") == 1 and str(path) in err


def test_impossible_options_are_usage() -> None:
    wrong = [("--rate", "0"), ("--rate", "-2"), ("--wait-peers", "-1")]
    found = outcomes([["replay", str(TYPES), "--to", "igtl", *arguments] for arguments in wrong])
    for arguments, outcome in zip(wrong, found, strict=True):
        assert outcome.code == 2, arguments
        assert arguments[0] in outcome.err.splitlines()[-1]


def messages(data: bytes) -> list[bytes]:
    """A byte stream, cut into its messages."""
    found = []
    while data:
        size = 58 + int.from_bytes(data[42:50], "big")
        found.append(data[:size])
        data = data[size:]
    return found


def sent(path: Path) -> tuple[int, list[tuple[float, Entry]]]:
    """The beginning of a recording in UTC ns, and with its second each message that a replay sends to OpenIGTLink."""
    with SessionFile.open(path) as file:
        entries = select_entries(first_form_only(file.entries()), frozenset({Kind.IGTL_OUT}))
        return file.start_ns, [((entry.stamp_ns - file.start_ns) / 1e9, entry) for entry in entries]


def test_a_part_has_what_lies_in_it_and_before_it_the_state() -> None:
    _, all_sent = sent(STAR)
    data, _ = received(str(STAR), "--as-fast-as-possible", "--start", "6", "--duration", "0.5")
    inside = [entry for second, entry in all_sent if 6 <= second <= 6.5]
    found = messages(data)
    state = found[: -len(inside)]
    assert found[-len(inside) :] == [entry.data() for entry in inside]
    before = [entry for second, entry in all_sent if second < 6]
    last = {entry.channel: entry for entry in before if entry.type in STATE_TYPES}
    assert last and {entry.data() for entry in last.values()} <= set(state)
    assert len(state) < len(before) / 10
    again, _ = received(str(STAR), "--speed-of-light", "--start", "6", "--end", "6.5")
    assert again == data


def test_every_rate_delivers_the_same_bytes() -> None:
    part = (str(STAR), "--start", "3", "--duration", "0.4")
    digests = {
        hashlib.sha256(received(*part, *pace)[0]).hexdigest()
        for pace in (["--rate", "0.5"], ["--rate", "50"], ["--as-fast-as-possible"], ["--speed-of-light"])
    }
    assert len(digests) == 1


def test_a_loop_jumps_to_the_start_and_says_so() -> None:
    part = (str(TYPES), "--streams", "STRING/*", "--streams", "TRANSFORM/*", "--as-fast-as-possible", "--loop")
    once_through = recorded(TYPES, "STRING/*", "TRANSFORM/*")
    with server() as listener, replay(*part, "--to", "igtl", "--connect", target(listener), "--json") as process:
        peer, _ = listener.accept()
        with peer:
            peer.settimeout(PATIENCE_S)
            data = bytearray()
            while len(data) < 3 * len(once_through):
                data += peer.recv(1 << 16)
            process.send_signal(signal.SIGINT)
            everything(peer)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert data[: 3 * len(once_through)] == 3 * once_through
    *jumps, outcome = map(json.loads, out.splitlines())
    assert {(jump["event"], jump["why"], jump["to_ns"]) for jump in jumps} == {("jump", "loop", sent(TYPES)[0])}
    assert not outcome["complete"]


def test_new_stamps_are_of_today_and_nothing_else_changes() -> None:
    before = time.time()
    now, _ = received(str(TYPES), "--as-fast-as-possible", "--restamp", "now")
    shifted, _ = received(str(TYPES), "--as-fast-as-possible", "--restamp", "shift")
    after = time.time()
    old = messages(recorded(TYPES))
    for new in (messages(now), messages(shifted)):
        assert [m[:34] + m[42:] for m in new] == [m[:34] + m[42:] for m in old]
    seconds = [int.from_bytes(m[34:38], "big") for m in messages(now)]
    assert all(before - 1 <= second <= after for second in seconds)

    def ns(message: bytes) -> int:
        return ticks_to_ns(int.from_bytes(message[34:42], "big"))

    assert len({ns(new) - ns(m) for new, m in zip(messages(shifted), old, strict=True) if ns(m)}) == 1


def test_steps_by_lines_and_their_end() -> None:
    with server() as listener:
        command = [sys.executable, "-m", "igtl_gateway", "replay", str(TYPES), "--to", "igtl", "--step"]
        with subprocess.Popen(
            [*command, "--connect", target(listener)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            peer, _ = listener.accept()
            with peer:
                out, _ = process.communicate("\n\n\n", timeout=PATIENCE_S)
                data = everything(peer)
    assert messages(data) == messages(recorded(TYPES))[:3]
    assert "stopped after 3 messages" in out


def test_a_stop_does_not_wait_for_a_line() -> None:
    with server() as listener:
        command = [sys.executable, "-m", "igtl_gateway", "replay", str(TYPES), "--to", "igtl", "--step"]
        with subprocess.Popen(
            [*command, "--connect", target(listener)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            peer, _ = listener.accept()
            with peer:
                assert process.stdin and process.stdout and process.stderr
                process.stdin.write("\n")
                process.stdin.flush()
                assert peer.recv(1)
                process.send_signal(signal.SIGINT)
                everything(peer)
            assert process.wait(PATIENCE_S) == 1
            assert "stopped after 1 message," in process.stdout.read()
            assert process.stderr.read() == ""


def test_keys_of_a_terminal() -> None:
    user, ours = os.openpty()
    try:
        with server() as listener:
            arguments = ["replay", str(TYPES), "--to", "igtl", "--start-paused", "--rate", "1000"]
            process = subprocess.Popen(
                [sys.executable, "-c", IN_FRONT, *arguments, "--connect", target(listener)],
                stdin=ours,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
            peer, _ = listener.accept()
            with process, peer:
                peer.settimeout(PATIENCE_S)
                assert process.stdout
                next(line for line in process.stdout if line.startswith("keys:"))
                first, *_ = messages(recorded(TYPES))
                os.write(user, b"\x1b[C")
                data = bytearray()
                while len(data) < len(first):
                    data += peer.recv(len(first) - len(data))
                assert data == first
                os.write(user, b"\x1b[A")
                assert next(process.stdout) == "rate 1.1e+03\n"
                os.write(user, b" ")
                assert first + everything(peer) == recorded(TYPES)
                assert process.wait(PATIENCE_S) == 0
    finally:
        os.close(user)
        os.close(ours)


def test_what_cannot_be_is_said_before_anything_is_sent() -> None:
    wrong = {
        ("--start", "soon"): "--start: found 'soon'",
        ("--start", "9999"): "--start: found +9999.000 s",
        ("--start", "1", "--end", "0.5"): "--end",
        ("--duration", "0"): "--duration",
        ("--duration", "1e308"): "--duration: found 1e+308, expected more than 0 and less than 31622400",
        ("--delay", "1e300"): "--delay: found 1e+300, expected 0 to 31622400",
        ("--start", "1e400"): "--start: found '1e400', expected a time from 1970 to 2262",
        ("--start", "99999999999999999999"): "--start: found '99999999999999999999', expected a time from 1970",
        ("--start", "0001-01-01T00:00:00Z"): "--start: found '0001-01-01T00:00:00Z', expected a time from 1970",
        ("--end", "1e999999"): "--end: found '1e999999', expected a time from 1970",
        ("--rate", "1e-320"): "--rate: found 1e-320, expected a number above 0",
        ("--rate", "1e308"): "--rate: found 1e+308, expected a number above 0",
        ("--through-gateway", "--config", "/dev/zero"): "/dev/zero: cannot be read: found a device, expected a file",
        ("--start", "\x1b[2J"): "--start: found '\\x1b[2J', expected seconds",
        ("--delay", "-1"): "--delay",
        ("--clock",): "--clock: found --to igtl",
        ("--tls-key", "a.pem"): "--tls-key: found no --tls-cert FILE, expected it",
        ("--start-paused",): "found no terminal",
    }
    found = outcomes([["replay", str(TYPES), "--to", "igtl", "--listen", ":0", *arguments] for arguments in wrong])
    for (arguments, named), outcome in zip(wrong.items(), found, strict=True):
        assert outcome.code == 2, arguments
        assert named in outcome.err.splitlines()[-1]


def test_the_outcome_accounts_for_all_that_is_recorded(capfd: pytest.CaptureFixture[str]) -> None:
    data, told = received(str(STAR), "--as-fast-as-possible", "--streams", "TRANSFORM/*", "--start", "1", "--end", "2")
    account: Any = told["account"]
    with SessionFile.open(STAR) as file:
        assert account["recorded"] == file.entry_count
    assert account["sent"] == told["messages"] == len(messages(data))
    assert account["recorded"] == account["sent"] + sum(account["not_sent"].values())
    assert set(account["not_sent"]) == {"notes", "igtl_in", "ros_in", "ros_out", "not_chosen", "outside"}


def test_what_waits_for_a_peer_that_leaves_is_not_sent() -> None:
    """The queue of a peer that reads nothing is full long before the end."""
    with server() as listener:
        to = ("--to", "igtl", "--connect", target(listener), "--json", "--as-fast-as-possible")
        with replay(str(STAR), *to) as process:
            peer, _ = listener.accept()
            peer.recv(1)
            peer.close()
            listener.close()
            out, err = process.communicate(timeout=PATIENCE_S)
    told = json.loads(out.splitlines()[-1])
    account = told["account"]
    assert account["recorded"] == account["sent"] + sum(account["not_sent"].values())
    assert account["not_sent"]["no_peer"] == told["without_peer"] > 0, err
    assert account["sent"] < told["messages"]


WITHOUT_ROS = "import sys; sys.modules['rclpy'] = None; from igtl_gateway.cli import main; sys.exit(main(sys.argv[1:]))"


def test_that_ros_is_missing_is_said_before_a_peer_is_waited_for() -> None:
    command = [sys.executable, "-c", WITHOUT_ROS, "replay", str(TYPES), "--to", "both", "--listen", "127.0.0.1:0"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert ended.stderr == f"igtl-gateway replay: {missing('rclpy')}\n"
    assert ended.returncode == 1
    assert "waiting for" not in ended.stdout
