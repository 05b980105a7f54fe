"""The way back: each value of a set leads to messages of the recording, and to bytes that the mcap library has, too."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.reader import make_reader
from pyarrow import parquet

from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.tracing import Traced, trace
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from tests.addons.lerobot.sessions import Sent, arm, bars, joints, write_session
from tests.tables import table

RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "{version}"
measure_lags = false
[episodes]
by = "ranges"
[[episodes.range]]
start = 0
end = 0.55
[[episodes.range]]
start = 0.55
end = 2
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "observation.joints"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "observation.images.view"
stream = "IMAGE/View"
[[feature]]
name = "observation.text"
stream = "STRING/Note"
rule = "none"
[[feature]]
name = "action"
next_of = "observation.state"
"""
FOREIGN = """\
[dataset]
fps = 10
task = "sew"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "action"
next_of = "observation.state"
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose poses are between the frames, a set of it, and the same of a bag of its topics."""
    folder = tmp_path_factory.mktemp("made")
    messages: list[Sent] = [(0.04 * n + 0.013, "TRANSFORM/ArmToBase", arm(0.04 * n, 0)) for n in range(40)]
    messages += [(0.05 * n, "/joint_states", joints(0.05 * n)) for n in range(32)]
    messages += [(0.1 * n, "IMAGE/View", Image((64, 48, 1), 3, bars(n).tobytes())) for n in range(16)]
    messages += [(at, "STRING/Note", String(text.encode())) for at, text in ((0.31, "one"), (0.33, "two"), (0.9, "x"))]
    path = write_session(folder / "s.mcap", sorted(messages, key=lambda each: each[0]))
    recipe = folder / "recipe.toml"
    recipe.write_text(RECIPE.format(version="v3.0"), "utf-8")
    export_lerobot(path, recipe, folder / "set")
    with SessionFile.open(path) as file:
        export_to("rosbag2", file, folder / "bag", ())
    recipe.write_text(FOREIGN, "utf-8")
    export_lerobot(next((folder / "bag").glob("*.mcap")), recipe, folder / "foreign")
    return folder


def messages_of(path: Path) -> dict[tuple[str, int, int], bytes]:
    """Topic, sequence and log_time → data, by the mcap library."""
    with path.open("rb") as stream:
        return {
            (channel.topic, message.sequence, message.log_time): message.data
            for _, channel, message in make_reader(stream).iter_messages()
        }


def check_bytes(traced: Traced, known: dict[tuple[str, int, int], bytes]) -> int:
    """Compare each record with what the library has; return their number."""
    count = 0
    for each in (message for row in traced.rows for message in row.messages):
        place = each.place
        assert place is not None, each
        stored = place.path.read_bytes()[place.data_at : place.data_at + place.data_length]
        unpack = {"": bytes, "lz4": lz4.frame.decompress, "zstd": zstandard.ZstdDecompressor().decompress}
        data = unpack[place.compression](stored)
        record = data[place.offset : place.offset + place.length]
        assert struct.unpack_from("<BQ", record) == (5, len(record) - 9)
        assert record[31:] == known[place.topic, place.sequence, place.time_ns]
        assert each.entry == place.sequence or not each.entry
        count += 1
    return count


def test_every_frame_leads_to_the_messages_of_its_provenance(made: Path) -> None:
    rows = parquet.read_table(made / "set/meta/provenance.parquet").to_pylist()
    known, count, ends = messages_of(made / "s.mcap"), 0, 0
    for number, expected in enumerate(rows):
        found = trace(made / "set", None, number, "", [made / "s.mcap"])
        assert (found.episode, found.frame) == (expected["episode_index"], expected["frame_index"])
        assert (found.index, found.time_ns) == (number, expected["time_ns"])
        for row in found.rows:
            is_last = number + 1 == len(rows) or rows[number + 1]["frame_index"] == 0
            if row.next_frame and is_last:
                ends += 1  # made again of the recording
                assert [each.stamp_ns - found.time_ns > 60_000_000 for each in row.messages] == [True, True]
                continue
            own = rows[number + row.next_frame]
            entries = [own[f"{row.row}.{key}"] for key in ("entry", "entry_after")]
            assert [each.entry for each in row.messages] == list(dict.fromkeys(each for each in entries if each))
            assert row.share == own[f"{row.row}.share"] and row.offset_ns == own[f"{row.row}.offset_ns"]
        count += check_bytes(found, known)
    assert count > 5 * len(rows) and ends == 2


def test_a_string_of_several_in_one_frame_has_its_first_and_its_last_message(made: Path) -> None:
    [row] = trace(made / "set", 0, 3, "observation.text", []).rows
    assert [each.stamp_ns % 10**9 for each in row.messages] == [310_000_000, 330_000_000]
    [row] = trace(made / "set", 0, 1, "observation.text", []).rows
    assert row.messages == ()


def test_messages_of_other_programs_are_found_by_topic_and_time(made: Path) -> None:
    bag = next((made / "bag").glob("*.mcap"))
    known, count = messages_of(bag), 0
    for frame in range(5):
        found = trace(made / "foreign", None, frame, "", [bag])
        assert all(not each.entry for row in found.rows for each in row.messages)
        assert all(each.stamp_ns for row in found.rows for each in row.messages)
        count += check_bytes(found, known)
    assert count == 10


def test_a_set_that_was_edited_is_traced_by_what_it_was(made: Path, tmp_path: Path) -> None:
    """LeRobot deletes episode 0: frame 0 of the set is now frame 0 of what was episode 1."""
    root = shutil.copytree(made / "set", tmp_path / "set")
    expected = trace(root, 1, 0, "", [])
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    found = parquet.read_table(path)
    parquet.write_table(found.slice(1), path)
    traced = trace(root, None, 0, "", [])
    assert (traced.episode, traced.index) == (0, 0) and traced.rows == expected.rows
    assert traced.time_ns == expected.time_ns


def test_episodes_of_another_program_have_no_messages(made: Path, tmp_path: Path) -> None:
    """A set of LeRobot to which the session was added: its episodes come first, and are in no provenance."""
    root = shutil.copytree(made / "set", tmp_path / "set")
    path = root / "meta/sessions.json"
    listed = json.loads(path.read_text("utf-8"))
    listed["others"], listed["sessions"][0]["episodes"] = 1, 1
    path.write_text(json.dumps(listed), "utf-8")
    provenance = root / "meta/provenance.parquet"
    parquet.write_table(parquet.read_table(provenance, filters=[("episode_index", "=", 1)]), provenance)
    with pytest.raises(ConfigError, match=r"found episode 0, which is of no session of meta/sessions.json"):
        trace(root, 0, 0, "", [])
    assert trace(root, 1, 2, "", []).rows == trace(made / "set", 1, 2, "", []).rows


def test_what_the_verb_prints(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["export", str(made / "s.mcap"), "--to", "lerobot", "--trace", str(made / "set"), "--frame", "1:2"]
    assert main([*words, "--feature", "action", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["episode"], found["frame_index"], found["session"]["name"]) == (1, 2, "s.mcap")
    [row] = found["rows"]
    assert row["feature"] == "action" and row["row"] == "observation.state[0]" and row["next_frame"]
    first = row["messages"][0]
    assert first["place"]["sequence"] == first["entry"] and first["place"]["path"].endswith("s.mcap")
    assert main([*words, "--feature", "action"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"frame {found['frame']}: episode 1, frame 2, time_ns {found['time_ns']}")
    assert lines[3].startswith("action: observation.state[0] of the next frame, TRANSFORM/ArmToBase, 0.")
    assert lines[4] == f"  entry {first['entry']}, stamp_ns {first['stamp_ns']}"
    assert lines[5].startswith(
        f"    {first['place']['length']} bytes of s.mcap at {first['place']['offset']:,} of the lz4"
    )
    assert main(["export", "--to", "lerobot", "--trace", str(made / "set"), "--frame", "2"]) == 0
    assert "lz4" not in capsys.readouterr().out


def damage(name: str) -> Any:
    def change(root: Path) -> None:
        (root / "meta" / name).write_bytes(b"PAR1")

    return change


@table(
    ("words", "change", "text"),
    [
        (["--frame", "99"], None, "--frame: found 99, expected one of 14 frames, from 0 on"),
        (["--frame", "2:0"], None, "--frame: found episode 2, expected one of 2 episodes, from 0 on"),
        (["--frame", "0:99"], None, "--frame: found 0:99, expected one of"),
        (["--frame", "-1"], None, "--frame: found -1, expected a number such as 17, or of an episode such as 2:17"),
        ([], None, "--frame: found none, expected a number"),
        (["--frame", "1", "--feature", "acton"], None, "did you mean 'action'?"),
        (
            ["--frame", "1"],
            lambda root: (root / "meta/sessions.json").unlink(),
            "found no meta/sessions.json, expected",
        ),
        (["--frame", "1"], damage("provenance.parquet"), "provenance.parquet: is not valid Parquet"),
        (["--frame", "1", "BAG"], None, "found no recording with the SHA-256"),
    ],
)
def test_what_cannot_be_traced_is_one_line(
    words: list[str], change: Any, text: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = shutil.copytree(made / "set", tmp_path / "set")
    if change:
        change(root)
    bag = str(next((made / "bag").glob("*.mcap")))
    files = [bag] if "BAG" in words else []
    rest = [each for each in words if each != "BAG"]
    assert main(["export", *files, "--to", "lerobot", "--trace", str(root), *rest]) != 0
    told = capsys.readouterr().err
    assert text in told and "Traceback" not in told, told
