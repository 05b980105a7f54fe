"""Names of files made of foreign names, and folders that are never half full."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.folder import FileNames, file_name, new_folder
from igtl_gateway.base.errors import ConfigError, GatewayError, UnsupportedRecording
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.whole_files import written_folder
from tests.tables import table

NAMES = [
    "../../x",
    "/etc/passwd",
    "..",
    ".",
    "",
    "a/b\\c",
    "CON",
    "nul.txt",
    "x" * 500,
    "a\0b",
    "a\nb",
    "\x1b[2J",
    "ähm",
    "~",
    "-rf",
    " ",
]


def entry(channel: str, kind: Kind = Kind.IGTL_IN) -> Entry:
    return Entry(1, 1, kind, channel, channel.partition("/")[0])


@table("device", NAMES)
def test_a_name_stays_in_its_folder(tmp_path: Path, device: str) -> None:
    for kind, channel in (
        (Kind.IGTL_IN, f"STRING/{device}"),
        (Kind.IGTL_OUT, f"{device}/{device}"),
        (Kind.ROS_IN, device),
    ):
        name = f"{file_name(kind, channel)}.csv"
        assert (tmp_path / name).resolve().parent == tmp_path.resolve()
        assert name.isascii()
        assert name.isprintable()
        assert len(name) < 200
        assert name.startswith(("igtl_in.", "igtl_out.", "ros_in."))


def test_every_stream_has_a_file_of_its_own() -> None:
    names = FileNames()
    channels = ["A/x", "A_x", "a/X", "A x", "A_x_2", *(f"{'y' * 200}{number}" for number in range(500))]
    made = [names.of(entry(channel)) for channel in channels]
    assert len({name.lower() for name in made}) == len(channels)
    assert [names.of(entry(channel)) for channel in channels] == made


def test_after_an_error_the_folder_is_as_before(tmp_path: Path) -> None:
    def fail(path: Path) -> None:
        with new_folder(path, ExportAccount()) as folder:
            folder.create("one").close()
            raise GatewayError("halfway")

    (tmp_path / "empty").mkdir()
    for name in ("new", "empty"):
        with pytest.raises(GatewayError, match="halfway"):
            fail(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
    assert not list((tmp_path / "empty").iterdir())


def test_an_export_without_messages_leaves_nothing(tmp_path: Path) -> None:
    with new_folder(tmp_path / "new", ExportAccount()) as folder:
        folder.create("metadata.yaml").close()
    assert not (tmp_path / "new").exists()


def test_what_is_there_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with (
        pytest.raises(UnsupportedRecording, match="found a directory with files"),
        new_folder(tmp_path, ExportAccount()),
    ):
        pass
    with pytest.raises(GatewayError, match="cannot write"), new_folder(tmp_path / "mine", ExportAccount()):
        pass
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(GatewayError, match="cannot write"), new_folder(tmp_path / "link", ExportAccount()):
        pass
    (tmp_path / "two").mkdir()
    with pytest.raises(ConfigError, match="exists already"), written_folder(tmp_path / "two") as place:
        (tmp_path / "two" / "theirs").write_text("theirs")  # another program, at the same time
        (place / "theirs").write_text("ours")
    assert (tmp_path / "two" / "theirs").read_text() == "theirs"
    assert (tmp_path / "mine").read_text() == "mine"
