"""Steps between versions, on versions that never were; and that every version that was is still read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout, migrations
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter

OLD = Path(__file__).parent / "old"


def _renamed(old: str, new: str) -> migrations.Step:
    """A step as a later version may need it: a key and the topics have other names."""

    def session(given: dict[str, str]) -> dict[str, str]:
        return {new if key == old else key: value for key, value in given.items()}

    def entries(given: Iterator[Entry]) -> Iterator[Entry]:
        return (replace(entry, channel=entry.channel.replace(old, new)) for entry in given)

    return migrations.Step(session, entries)


STEPS = {3: _renamed("a", "b"), 4: _renamed("b", "c")}
LOG = [Entry(1, 10, Kind.ROS_IN, "/a"), Entry(2, 11, Kind.ROS_OUT, "/b"), Entry(3, 12, Kind.ROS_OUT, "/x")]


@pytest.mark.parametrize(
    ("version", "key", "channels"),
    [(3, "c", ["/c", "/c", "/x"]), (4, "a", ["/a", "/c", "/x"]), (5, "a", ["/a", "/b", "/x"])],
)
def test_every_step_from_the_file_s_version_on_is_taken_in_order(version: int, key: str, channels: list[str]) -> None:
    assert migrations.session(version, {"a": "1"}, to=5, steps=STEPS) == {key: "1"}
    moved = list(migrations.entries(version, iter(LOG), to=5, steps=STEPS))
    assert [entry.channel for entry in moved] == channels
    assert [replace(entry, channel="") for entry in moved] == [replace(entry, channel="") for entry in LOG]


@pytest.mark.parametrize("version", [0, 2, 6])
def test_versions_without_a_way_to_today_s_are_refused(version: int) -> None:
    for refuse in (
        lambda: migrations.session(version, {}, to=5, steps=STEPS),
        lambda: migrations.entries(version, iter(LOG), to=5, steps=STEPS),
    ):
        with pytest.raises(UnsupportedRecording, match=f"found format version {version}, expected 3 to 5"):
            refuse()


def test_there_is_a_way_from_every_version_since_the_first() -> None:
    assert sorted(migrations.STEPS) == list(range(1, layout.FORMAT_VERSION))


def test_there_is_an_old_file_of_every_version() -> None:
    versions = set()
    for path in OLD.glob("*.mcap"):
        with SessionFile.open(path) as file:
            versions.add(file.format_version)
            assert path.name.startswith(f"v{file.format_version}-")
    assert versions == set(range(1, layout.FORMAT_VERSION + 1))


def test_the_first_version_is_still_read() -> None:
    with SessionFile.open(OLD / "v1-paper-types.mcap") as file:
        entries = list(file.entries())
        assert file.session["scenario"] == "paper-types"
        assert file.ledger is not None and file.ledger["streams"]
    assert len(entries) == file.entry_count > 100
    assert {entry.kind for entry in entries} >= {Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN, Kind.ROS_OUT, Kind.LINK}


def bare(entry: Entry) -> Entry:
    """With the payload as bytes."""
    return replace(entry, payload=(entry.data(),))


def test_channels_with_single_underscores_are_still_read(tmp_path: Path) -> None:
    """The topic of an OpenIGTLink channel once had another rule than in ROS; readers take the names of the messages."""
    path = OLD / "v1-single-underscores.mcap"
    with SessionFile.open(path) as file:
        entries = list(file.entries())
        writer = SessionWriter(tmp_path / "new.mcap", dict(file.session))
    for entry in entries:
        writer.write(entry)
    writer.close({"streams": {}})
    topic, again = b"/transform/A_probe_with_a_8980", b"/transform/A_probe_with_a__8980"
    assert topic in path.read_bytes() and again in (tmp_path / "new.mcap").read_bytes()
    with SessionFile.open(tmp_path / "new.mcap") as file:
        assert [bare(entry) for entry in file.entries()] == [bare(entry) for entry in entries]
    assert "TRANSFORM/A probe with a _8980" in {entry.channel for entry in entries}
