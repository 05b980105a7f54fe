"""A file with nothing that can be read: each verb reports it in one line, leaves no file, and does not end with 0.

Verbs whose answer is about the file itself answer: what `info` lists, what `verify` has to compare.
"""

from __future__ import annotations

from pathlib import Path

import mcap.writer
import pytest

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tests.tables import table

#: Verb → how the line ends, of a session without a message; `replay` would wait for a receiver.
_EMPTY = "found no messages, expected at least one"
#: The same, of a file of another program whose messages have an encoding that is not read.
_UNREAD = "found no messages that can be read (/data: 3 messages, found encoding 'json', expected 'cdr')"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a session without a message, ``empty.mcap``, and a file of another program, ``json.mcap``."""
    folder = tmp_path_factory.mktemp("nothing")
    SessionWriter(folder / "empty.mcap", {}).close({})
    with (folder / "json.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile="")
        channel = writer.register_channel("/data", "json", writer.register_schema("x.Data", "jsonschema", b"{}"))
        for number in range(3):
            writer.add_message(channel, 10**18 + number, b'{"a": 1}', 10**18 + number)
        writer.finish()  # type: ignore[no-untyped-call]
    return folder


@table(
    ("call", "words"),
    [
        ("import {in}/json.mcap -o {out}/a.mcap", "json.mcap: found no message to import (/data: encoding 'json', not"),
        ("view {in}/json.mcap -o {out}/a.rrd", _UNREAD),
        ("view {in}/empty.mcap -o {out}/a.rrd", _EMPTY),
        ("view {in}/empty.mcap -o {out}/a.png", _EMPTY),
        ("slice {in}/empty.mcap -o {out}/a.mcap", _EMPTY),
        ("export {in}/empty.mcap --to mcap -o {out}/a.mcap", "found no messages for mcap"),
        ("export {in}/empty.mcap --to csv -o {out}/a", "found no messages for csv"),
        ("export {in}/json.mcap --to parquet -o {out}/a", "found no messages for parquet"),
        ("replay {in}/empty.mcap --to igtl --listen 127.0.0.1:0", _EMPTY),
        ("doctor {in}/json.mcap", _UNREAD),
        ("diff {in}/json.mcap {in}/empty.mcap", _UNREAD),
        ("review {in}/json.mcap", "found no point cloud"),
        ("merge a={in}/empty.mcap b={in}/json.mcap -o {out}/a.mcap", "found an MCAP file of another program"),
        ("deidentify {in}/json.mcap -o {out}/a.mcap", "found an MCAP file of another program"),
        ("verify {in}/json.mcap", "found an MCAP file of another program"),
    ],
    gate=lambda call, words: call.startswith(("import", "view", "slice")) and "png" not in call,
)
def test_nothing_readable_is_no_success(
    call: str, words: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(call.format(**{"in": files, "out": tmp_path}).split()) in (1, 2)
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert not said.out
    assert not list(tmp_path.iterdir())


def test_a_window_without_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "slice",
        str(FIXTURES / "paper-types.mcap"),
        "--start",
        "0.001",
        "--end",
        "0.001001",
        "--streams",
        "STRING/*",
    ]
    assert main([*words, "-o", str(tmp_path / "a.mcap")]) == 1
    assert "found no message of STRING/* from 0.001 s to 0.001 s, expected at least one" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
