"""``decode``: the contract for scripts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.cli import main
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

MESSAGES = [
    Message("TRANSFORM", "Tool", Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 10.0, 20.0, 30.0)), 1 << 32 | 1 << 31),
    Message("STRING", "Text", String.of("hé"), 0, 2, 7, (Item.of("key", "value"),)),
    Message("MYSTERY", "Box", Raw(b"\x01\x02")),
    Message("GET_STATUS", "", Raw(b"")),
]
STREAM = b"".join(join(encode(message)) for message in MESSAGES)


def decoded(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[dict[str, object]], str]:
    code = main(("decode", *arguments))
    told = capsys.readouterr()
    return code, [json.loads(line) for line in told.out.splitlines()], told.err


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    path = tmp_path / "stream.igtl"
    path.write_bytes(STREAM)
    return path


def test_one_json_object_per_message(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told, err = decoded(capsys, str(stream))
    assert (code, err) == (0, "")
    assert [one["type"] for one in told] == [message.type for message in MESSAGES]
    assert told[0]["timestamp"] == {"sec": 1, "frac": 1 << 31, "nanosec": 500_000_000}
    assert told[0]["content"] == {"matrix": [[1, 0, 0, 10], [0, 1, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]}
    assert told[1]["ext"] == {"ext_header_size": 12, "metadata_header_size": 10, "metadata_size": 8, "message_id": 7}
    assert told[1]["metadata"] == [{"key": "key", "encoding": 3, "value": "value"}]
    assert told[1]["content"] == {"encoding": 106, "string": "hé", "string_hex": "68c3a9"}
    assert all(one["crc_ok"] for one in told)
    assert [one["offset"] for one in told] == [0, 106, 106 + 58 + 12 + 7 + 18, 106 + 95 + 60]


def test_reencoding_gives_the_same_bytes(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "again.igtl"
    code, _, _ = decoded(capsys, str(stream), "-o", str(out))
    assert code == 0
    assert out.read_bytes() == STREAM


def test_standard_input_is_a_file_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], stream: Path
) -> None:
    class Stdin:
        def fileno(self) -> int:
            return self.file.fileno()

        file = stream.open("rb")

    monkeypatch.setattr("sys.stdin", Stdin())
    assert len(decoded(capsys, "-")[1]) == len(MESSAGES)


def test_damage_is_told_and_the_rest_decoded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = bytearray(STREAM)
    bad[60] ^= 1
    path = tmp_path / "bad.igtl"
    path.write_bytes(bad)
    out = tmp_path / "again.igtl"
    code, told, _ = decoded(capsys, str(path), "-o", str(out))
    assert code == 1
    assert [one["crc_ok"] for one in told] == [False, True, True, True]
    assert out.read_bytes() == bytes(bad), "what cannot be trusted stays as it was"


@pytest.mark.parametrize("cut", [1, 57, 58, 105, 107])
def test_a_stream_that_ends_inside_a_message(cut: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cut.igtl"
    path.write_bytes(STREAM[:cut])
    code, told, err = decoded(capsys, str(path))
    assert code == 1
    assert len(told) == cut // 106
    assert err.count("\n") == 1 and "ends inside" in err


def test_a_header_that_announces_too_much(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "huge.igtl"
    path.write_bytes(STREAM[:106] + STREAM[:42] + b"\x40" + bytes(15))
    code, told, err = decoded(capsys, str(path))
    assert (code, len(told)) == (1, 1)
    assert err.startswith("igtl-gateway decode: offset 106: ") and "4611686018427387904" in err


def test_nothing_is_no_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "empty.igtl"
    path.touch()
    code, told, err = decoded(capsys, str(path), "-o", str(tmp_path / "out.igtl"))
    assert (code, told) == (2, [])
    assert err == f"igtl-gateway decode: {path}: found no bytes, expected OpenIGTLink bytes\n"
    assert not (tmp_path / "out.igtl").exists()


def test_a_missing_file_is_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = decoded(capsys, str(tmp_path / "none.igtl"))
    assert code == 2
    assert "No such file" in err


def test_a_wrong_crc_is_an_error_with_both_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = bytearray(STREAM)
    bad[57] ^= 0xFF  # the last byte of the CRC in the first header
    path = tmp_path / "bad.igtl"
    path.write_bytes(bad)
    _, told, _ = decoded(capsys, str(path))
    right = crc64(STREAM[58:106])
    assert told[0]["error"] == {
        "code": "bad_crc",
        "text": f"TRANSFORM header, CRC-64 of the body: found {right ^ 0xFF:016x}, expected {right:016x}",
        "place": "TRANSFORM header, CRC-64 of the body",
        "found": f"{right ^ 0xFF:016x}",
        "expected": f"{right:016x}",
    }
    assert told[0]["crc"] == f"{right ^ 0xFF:016x}" and "content" in told[0]
    assert all("error" not in one for one in told[1:])


def test_a_wrong_crc_and_a_body_of_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = join(encode(Message("TRANSFORM", "Tool", Raw(bytes(5)))))
    path = tmp_path / "bad.igtl"
    path.write_bytes(bad[:57] + bytes([bad[57] ^ 1]) + bad[58:])
    (told,) = decoded(capsys, str(path))[1]
    error = told["error"]
    assert isinstance(error, dict) and error["code"] == "bad_crc" and "5 bytes" in error["text"]
    assert "content" not in told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "code", "said"),
    [
        ('cat "$1" > fifo & "$0" -m igtl_gateway decode fifo', 0, ""),
        ('cat "$1" | "$0" -m igtl_gateway decode -', 0, ""),
        ('"$0" -m igtl_gateway decode - <&-', 2, "-: standard input is closed, expected a stream of messages"),
    ],
)
def test_sources_that_are_no_files(shell: str, code: int, said: str, stream: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    command = ["sh", "-c", shell, sys.executable, str(stream)]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert ended.returncode == code, ended.stderr
    assert said in ended.stderr and ended.stderr.count("\n") == bool(said)
    assert len(ended.stdout.splitlines()) == (0 if code else len(MESSAGES))


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["/tmp"], 2, "/tmp: Is a directory"),
        (["/dev/zero"], 1, "offset 57942: found 1,000 messages in a row of an unknown header version"),
        (["{stream}", "-o", "{stream}"], 2, "which is the input, expected another file"),
        (["{stream}", "-o", "none/out"], 1, "cannot write to none/out: there is no folder none"),
        (["{stream}", "-o", "{stream.parent}/there"], 2, "exists already, expected a new file or --overwrite"),
        (["{stream}", "--overwrite", "-o", "/tmp"], 1, "cannot write to /tmp: it is a folder"),
        (
            ["{stream}", "--overwrite", "-o", "/dev/full"],
            1,
            "cannot write to /dev/full: it is a device",
        ),
    ],
)
def test_what_cannot_be_read_or_written(
    arguments: list[str], code: int, said: str, stream: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (stream.parent / "there").touch()
    assert main(["decode", *(word.format(stream=stream) for word in arguments)]) == code
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert stream.read_bytes() == STREAM


def test_nothing_of_a_message_reaches_the_terminal_raw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "escapes.igtl"
    evil = "\x1b[2J\r\n\u202eforged\x9b1m\x7f"
    said = Message(evil[:10], evil[:18], String.of(evil), 0, 2, 7, (Item.of(evil, evil),))
    path.write_bytes(join(encode(said)) + join(encode(Message("STRING", evil[:18], String.of(evil)))))
    assert main(("decode", str(path))) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 2 and out.replace("\n", "").isprintable()
    assert json.loads(out.splitlines()[1])["content"]["string"] == evil


@pytest.mark.parametrize(
    ("start", "name"),
    [
        (b"\x89MCAP0\r\n", "rosbag2"),
        (b"#ROSBAG V2.0\n", "rosbag1"),
        (b"SQLite format 3\0", "rosbag2"),
        (b"NRRD0004\n", "sequence"),
    ],
)
def test_a_file_of_another_format_is_named(
    start: bytes, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x"
    path.write_bytes(start + bytes(300))
    code, told, err = decoded(capsys, str(path))
    assert (code, told) == (2, [])
    assert f"found a file of the format {name} (" in err and "expected OpenIGTLink bytes" in err


def test_a_text_is_no_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"root:x:0:0:root:/root:/bin/sh\n" * 9)
    code, told, err = decoded(capsys, str(path))
    assert (code, told) == (2, [])
    assert "found 72 6f 6f 74 3a 78 3a 30 at its start, expected OpenIGTLink bytes" in err
