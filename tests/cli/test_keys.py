"""The keyboard of ``replay``, on a pseudo terminal."""

from __future__ import annotations

import os
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest

from igtl_gateway.cli.keys import (
    FASTER,
    NEXT,
    PAUSE,
    QUIT,
    SLOWER,
    LineInput,
    can_read_keys,
    keyboard,
    parse_keys,
    read_lines,
)

PATIENCE_S = 30.0
ARROWS = [NEXT, FASTER, SLOWER]


@contextmanager
def terminal() -> Iterator[tuple[int, IO[bytes]]]:
    """Where the user types, and the standard input that it arrives on."""
    user, ours = os.openpty()
    try:
        with open(ours, "rb", buffering=0) as stream:
            yield user, stream
    finally:
        os.close(user)


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        (b" ", [PAUSE]),
        (b"\x1b[C\x1b[A\x1b[B", ARROWS),
        (b"\x1bOC\x1bOA\x1bOB", ARROWS),
        (b"s\nq", [NEXT, NEXT, QUIT]),
        (b"xyz \x1b[Dx\x1b[5~ ", [PAUSE, PAUSE]),
    ],
)
def test_keys_mean_commands_and_others_nothing(typed: bytes, found: list[str]) -> None:
    assert parse_keys(typed) == (found, b"")


def test_a_key_may_arrive_in_pieces() -> None:
    found, rest = parse_keys(b" \x1b[")
    assert (found, rest) == ([PAUSE], b"\x1b[")
    assert parse_keys(rest + b"A") == ([FASTER], b"")


def test_keys_come_one_by_one_without_echo_and_the_terminal_is_left_as_it_was() -> None:
    found: list[str] = []
    enough = threading.Event()

    def on_command(command: str) -> None:
        found.append(command)
        if len(found) == 4:
            enough.set()

    with terminal() as (user, stream):
        before = termios.tcgetattr(stream.fileno())
        with pytest.raises(KeyError), keyboard(on_command, stream):
            os.write(user, b" \x1b[C\x1b[Aq")  # without a line's end
            assert enough.wait(PATIENCE_S)
            raise KeyError
        assert found == [PAUSE, NEXT, FASTER, QUIT]
        assert termios.tcgetattr(stream.fileno()) == before
        os.set_blocking(user, False)
        with pytest.raises(BlockingIOError):
            os.read(user, 100)


def test_only_a_terminal_of_ours_is_asked_for_keys() -> None:
    with terminal() as (_, stream):
        assert not can_read_keys(stream), "a terminal, but not the one that controls us"
    with open(os.devnull, "rb") as nothing:
        assert not can_read_keys(nothing)


@pytest.mark.parametrize("typed", [b"\n\nlast", b"a\nb\nc\n"])
def test_lines_are_counted_up_to_their_end(tmp_path: Path, typed: bytes) -> None:
    found, ended = list[str](), threading.Event()
    path = tmp_path / "lines"
    path.write_bytes(typed)
    with path.open("rb") as stream:
        read_lines(lambda: found.append("line"), ended.set, stream)
        assert ended.wait(PATIENCE_S)
    assert found == ["line"] * 3


@pytest.mark.parametrize(
    ("typed", "lines", "commands"),
    [
        ("mneedle\r ", ["needle"], [PAUSE]),
        (" ma m b\n\n", ["a m b"], [PAUSE, NEXT]),
        ("mnähtx\x7f: Stich\r", ["näht: Stich"], []),
        ("mwrong\x1b ", [], [PAUSE]),
        ("mwrong\x15right\r", ["right"], []),
        ("m  \r", [], []),
        ("m" + 5000 * "x" + "\r", [4400 * "x"], []),
    ],
)
def test_a_key_opens_a_line_of_text(typed: str, lines: list[str], commands: list[str]) -> None:
    found: list[tuple[str, int]] = []
    shown: list[str | None] = []
    begun_ns = time.monotonic_ns()
    keys: list[str] = []
    enough = threading.Event()

    def on_command(command: str) -> None:
        enough.set() if command == QUIT else keys.append(command)

    with (
        terminal() as (user, stream),
        keyboard(on_command, stream, LineInput(b"m", lambda *line: found.append(line), shown.append)),
    ):
        for byte in f"{typed}q".encode():  # as a person types; characters arrive in part
            os.write(user, bytes((byte,)))
        assert enough.wait(PATIENCE_S)
    assert ([text for text, _ in found], keys) == (lines, commands)
    assert all(0 < ago_ns < time.monotonic_ns() - begun_ns for _, ago_ns in found)  # since the key, not since Enter
    assert shown[0] == "" and shown[-1] is None
