"""The side file after parts were deleted: it names what is left, and goes with the last part."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.record.retention.side_files import closed_part, update_side_file
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE
from tests.record import samples
from tests.record.test_parts import record, session


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A split recording."""
    folder = tmp_path_factory.mktemp("models")
    record(folder / "long.mcap", session(4), split_s=1.0)
    return folder / "long"


@pytest.fixture
def folder(model: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(model, tmp_path / "long"))


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def test_the_side_file_of_all_parts_is_that_of_the_recorder(folder: Path) -> None:
    before = (folder / SIDE_FILE).read_text()
    (folder / SIDE_FILE).write_text("rosbag2_bagfile_information:\n  version: 9\n")
    update_side_file(folder)
    assert (folder / SIDE_FILE).read_text() == before


def test_it_names_the_parts_that_are_left(folder: Path) -> None:
    first, *rest = parts(folder)
    first.unlink()
    update_side_file(folder)
    found = YAML(typ="safe").load((folder / SIDE_FILE).read_text("utf-8"))["rosbag2_bagfile_information"]
    assert found["relative_file_paths"] == [each.name for each in rest]
    with Reader(folder) as bag:  # an independent reader
        assert bag.message_count == sum(1 for _ in bag.messages())


def test_parts_are_in_the_order_of_their_numbers(folder: Path) -> None:
    last = parts(folder)[-1]
    last.rename(folder / "long_10.mcap")
    update_side_file(folder)
    text = (folder / SIDE_FILE).read_text()
    assert text.index("long_2.mcap") < text.index("long_10.mcap")


def test_it_goes_with_the_last_part_and_the_folder_too(folder: Path) -> None:
    for path in parts(folder):
        path.unlink()
    update_side_file(folder)
    assert not folder.exists()


def test_what_is_not_ours_stays(folder: Path) -> None:
    for path in parts(folder):
        path.unlink()
    (folder / "notes.txt").write_text("mine")
    update_side_file(folder)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("text", ["", "mine", "rosbag2_bagfile_informatio"])
def test_another_file_of_its_name_is_not_touched(folder: Path, text: str) -> None:
    (folder / SIDE_FILE).write_text(text)
    parts(folder)[0].unlink()
    update_side_file(folder)
    assert (folder / SIDE_FILE).read_text() == text
    for path in parts(folder):
        path.unlink()
    update_side_file(folder)
    assert (folder / SIDE_FILE).read_text() == text


def test_a_link_in_its_place_is_not_followed(folder: Path, tmp_path: Path) -> None:
    (folder / SIDE_FILE).rename(tmp_path / "elsewhere.yaml")
    (folder / SIDE_FILE).symlink_to(tmp_path / "elsewhere.yaml")
    before = (tmp_path / "elsewhere.yaml").read_text()
    parts(folder)[0].unlink()
    update_side_file(folder)
    assert (folder / SIDE_FILE).is_symlink() and (tmp_path / "elsewhere.yaml").read_text() == before


def test_a_folder_with_an_open_part_is_left_to_its_recorder(folder: Path) -> None:
    before = (folder / SIDE_FILE).read_text()
    first, second, *_ = parts(folder)
    second.write_bytes(second.read_bytes()[:-200])
    first.unlink()
    update_side_file(folder)
    assert (folder / SIDE_FILE).read_text() == before


def test_a_folder_that_is_not_there_is_no_error(tmp_path: Path) -> None:
    update_side_file(tmp_path / "gone")


def test_the_row_of_a_part(folder: Path) -> None:
    path = parts(folder)[1]
    row = closed_part(path)
    assert row is not None
    with SessionFile.open(path) as file:
        assert (row.entries, row.start_ns, row.end_ns) == (file.entry_count, file.start_ns, file.end_ns)
        counts = {(each.topic, each.type): each.count for each in row.topics}
        assert sum(counts.values()) == file.entry_count
    assert (row.path, row.size) == (path, path.stat().st_size)


def test_the_row_of_an_empty_part(tmp_path: Path) -> None:
    row = closed_part(samples.write(tmp_path / "a_0.mcap", []))
    assert row is not None and (row.start_ns, row.end_ns, row.entries) == (0, 0, 0)


def test_there_is_no_row_of_what_is_not_closed_or_not_a_file(folder: Path, tmp_path: Path) -> None:
    path = parts(folder)[0]
    path.write_bytes(path.read_bytes()[:-1])
    assert closed_part(path) is None
    for odd in (tmp_path, tmp_path / "gone"):
        with pytest.raises((OSError, GatewayError)):
            closed_part(odd)
