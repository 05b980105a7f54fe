"""Names in what is exported: of transforms, of files; both sides of a session, and several peers."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pyarrow import ipc, parquet

from igtl_gateway.addons.exchange.sequence_names import another_name, name_in_file
from igtl_gateway.base.distinct import distinct_names
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, TfOutRow
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.gateway.log.interleaving import Interleaving, is_mixed
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from tests.addons.exchange import plus
from tests.script import Script

SLICE = Image((2, 2, 1), 3, bytes(4))
#: Names that become one where only letters and digits stay, or where case does not count.
TOOLS = (
    "Tool A",
    "ToolA",
    "Tool-A",
    "toola",
    "TOOLA",
    "ToolA2",
    "Tool A 2",
    "",
    "Unnamed",
    "+",
    "ÄTool A",
    "A To B",
    "AToB",
    "A2ToB",
)


def saved(script: Script, path: Path, config: Config | None = None) -> Path:
    writer = SessionWriter(path, {"config": json.dumps((config or Config()).to_dict())})
    for entry in script.log:
        writer.write(entry)
    writer.close({})
    return path


def ticks(script: Script) -> int:
    """The stamp of the next message: the time of the script."""
    return ((script.now_ns + 1_000_000) << 32) // 10**9


def pose(x: float) -> Transform:
    return Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0))


def exported(path: Path, *streams: str) -> tuple[int, plus.Read]:
    out = path.with_suffix(".igs.mha")
    chosen = [word for stream in streams for word in ("--streams", stream)]
    code = main(["export", str(path), "--to", "igs.mha", "-o", str(out), *chosen])
    return code, plus.read(out)


def places(found: plus.Read, name: str) -> set[float]:
    """x of a transform in the frames in which it is OK."""
    key = f"{name}Transform"
    return {float(each[key].split()[3]) for each in found.frames.values() if each[f"{key}Status"] == "OK"}


@pytest.mark.parametrize("order", [1, -1])
def test_each_written_name_is_of_one_and_an_exact_one_of_its_own(order: int) -> None:
    found = distinct_names({name: name for name in TOOLS[::order]}, name_in_file, other=another_name)
    assert len({name.casefold() for name in found.values()}) == len(TOOLS) == len(found)
    assert all(re.fullmatch("[A-Za-z0-9]+", name) for name in found.values())
    exact = [name for name in TOOLS if name_in_file(name) == name]
    folded = [name.casefold() for name in exact]
    assert [found[name] for name in exact if folded.count(name.casefold()) == 1] == [
        "ToolA2",
        "Unnamed",
        "AToB",
        "A2ToB",
    ]
    assert found["A To B"] == "A3ToB", "the number is of the tool, not of its reference"


def test_each_transform_has_the_pose_of_its_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = Script()
    script.up(1)
    for _ in range(5):
        for number, tool in enumerate(TOOLS):
            script.igtl(Message("TRANSFORM", tool, pose(number), ticks(script)))
    code, found = exported(saved(script, tmp_path / "s.mcap"))
    said = capsys.readouterr().out
    names = [key.removesuffix("Transform") for key in found.frames[3] if key.endswith("Transform")]
    assert code == 0 and len(names) == len(TOOLS)
    for name in names:
        (x,) = places(found, name)
        device = TOOLS[int(x)]
        assert device == name or f"{name}Transform, of in:TRANSFORM/{device}: OK" in said, (name, device)


def test_pictures_of_a_peer_get_the_poses_of_ros(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = Config(tf_out=(TfOutRow(frames=("tool",), base="base", device="ToolToBase"),))
    script = Script(config)
    script.up(1)
    for number in range(6):
        at = RosHeader(script.now_ns + 1_000_000, "base")
        script.ros("/tf", TFMessage((FrameTransform(at, "tool", (0.001 * number, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),)))
        script.igtl(Message("IMAGE", "Scan", SLICE, ticks(script)))
    path = saved(script, tmp_path / "s.mcap", config)
    code, found = exported(path)
    found_mm = sorted(places(found, "ToolToBase"))
    assert code == 0 and found_mm == pytest.approx([0.5, 1.5, 2.5, 3.5, 4.5], abs=1e-5)  # stamps of 32 bits
    assert "ToolToBaseTransform: OK in 5 of 6 frames" in capsys.readouterr().out


def test_of_one_name_on_both_sides_the_received_one_is_taken_and_streams_decides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Config(tf_out=(TfOutRow(frames=("tool",), base="base", device="Tool"),))
    script = Script(config)
    script.up(1)
    for _ in range(5):
        script.igtl(Message("TRANSFORM", "Tool", pose(700), ticks(script)))
        at = RosHeader(script.now_ns + 1_000_000, "base")
        script.ros("/tf", TFMessage((FrameTransform(at, "tool", (0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),)))
        script.igtl(Message("IMAGE", "Scan", SLICE, ticks(script)))
        script.ros("/igtl/out/Camera/image", RosImage(RosHeader(script.now_ns, ""), 2, 2, "mono8", False, 2, bytes(4)))
    path = saved(script, tmp_path / "s.mcap", config)
    code, found = exported(path)
    said = capsys.readouterr().out
    assert code == 0 and places(found, "Tool") == {700.0}
    assert "--streams out:TRANSFORM/Tool selects this one" in said
    assert "in:IMAGE/Scan has the pictures; --streams out:IMAGE/Camera selects these" in said
    path.with_suffix(".igs.mha").unlink()
    code, found = exported(path, "out:TRANSFORM/Tool", "in:IMAGE/Scan")
    assert code == 0 and places(found, "Tool") == {900.0}
    path.with_suffix(".igs.mha").unlink()
    code, found = exported(path, "Tool", "out:IMAGE/*")
    assert code == 0 and len(found.frames) == 5


def test_two_peers_with_one_device_are_two_transforms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = Script()
    for link in (1, 2):
        script.up(link)
    for number in range(10):
        script.igtl(Message("TRANSFORM", "Tool", pose(100 * (number % 2 + 1)), ticks(script)), link=number % 2 + 1)
    path = saved(script, tmp_path / "s.mcap")
    _, found = exported(path)
    names = [key.removesuffix("Transform") for key in found.frames[3] if key.endswith("Transform")]
    assert [places(found, name) for name in names] == [{100.0}, {200.0}]
    assert "of in:TRANSFORM/Tool@1" in capsys.readouterr().out
    path.with_suffix(".igs.mha").unlink()
    _, found = exported(path, "TRANSFORM/Tool@2")
    assert places(found, "Tool") == {200.0} and len(found.frames) == 5


@pytest.mark.parametrize("to", ["csv", "parquet", "arrow", "rosbag2"])
def test_tables_of_two_peers_with_one_device_have_its_link(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script()
    for link in (1, 2):
        script.up(link)
    for number in range(10):
        script.igtl(Message("TRANSFORM", "Tool", pose(100 * (number % 2 + 1)), ticks(script)), link=number % 2 + 1)
        script.igtl(Message("TRANSFORM", "Other", pose(7), ticks(script)), link=1)
    path, out = saved(script, tmp_path / "s.mcap"), tmp_path / "out"
    assert main(["export", str(path), "--to", to, "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "links 1 and 2 in turn" in said and "/igtl/in/Tool/transform" in said and "TRANSFORM/Other has" not in said
    if to == "rosbag2":
        return
    rows = _rows(out / f"igtl_in.TRANSFORM_Tool.{to}")
    places = {(row["link"] if row["link"] not in ("", None) else 1, float(row["x_mm"])) for row in rows}
    assert {(int(link), x) for link, x in places} == {(1, 100.0), (2, 200.0)} and len(rows) == 10
    assert "link" not in _rows(out / f"igtl_in.TRANSFORM_Other.{to}")[0]
    one = tmp_path / "one"
    assert main(["export", str(path), "--to", to, "-o", str(one), "--streams", "in:TRANSFORM/Tool@2"]) == 0
    assert "in turn" not in capsys.readouterr().out
    assert {float(row["x_mm"]) for row in _rows(one / f"igtl_in.TRANSFORM_Tool.{to}")} == {200.0}


def _rows(file: Path) -> list[dict[str, Any]]:
    if file.suffix == ".csv":
        return list(csv.DictReader(file.read_text().splitlines()))
    table = parquet.read_table(file) if file.suffix == ".parquet" else ipc.open_file(file).read_all()
    return list(table.to_pylist())


def test_pictures_of_two_peers_are_no_sequence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = Script()
    for link in (1, 2):
        script.up(link)
    for number in range(6):
        script.igtl(Message("IMAGE", "Scan", SLICE, ticks(script)), link=number % 2 + 1)
    path = saved(script, tmp_path / "s.mcap")
    assert main(["export", str(path), "--to", "igs.mha", "-o", str(tmp_path / "o.igs.mha")]) == 2
    assert "found IMAGE/Scan@1, IMAGE/Scan@2, expected one IMAGE" in capsys.readouterr().err
    code, found = exported(path, "in:IMAGE/Scan@1")
    assert code == 0 and len(found.frames) == 3


@pytest.mark.parametrize(
    ("links", "mixed"), [((), False), ((1,), False), ((1, 1, 2, 2), False), ((1, 2, 1), True), ((3, 3, 1, 2, 3), True)]
)
def test_a_peer_that_returns_is_no_second_one(links: Sequence[int], mixed: bool) -> None:
    import numpy as np

    one = Interleaving()
    for link in links:
        one.add((link,))
    assert one.is_mixed == is_mixed(np.array(links)) == mixed
    assert one.links == set(links)


def test_a_device_that_is_named_as_the_place_of_images_keeps_its_pose(tmp_path: Path) -> None:
    script = Script()
    script.up(1)
    for number in range(4):
        script.igtl(Message("TRANSFORM", "ImageToRas", pose(700), ticks(script)))
        matrix = (1, 0, 0, 0, 1, 0, 0, 0, 1, number, 0, 0)
        script.igtl(Message("IMAGE", "Scan", Image((2, 2, 1), 3, bytes(4), wire_matrix=matrix), ticks(script)))
    _, found = exported(saved(script, tmp_path / "s.mcap"))
    assert places(found, "ImageToRas") == {700.0} and len(places(found, "Image2ToRas")) == 4


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("to", ["csv", "parquet", "nrrd"])
def test_each_file_has_the_stream_of_its_name(
    to: str, order: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script()
    script.up(1)
    tools = ("Tool A", "Tool_A", "Tool.A", "tool_a", "A/B", "A_B", "ä", "ö", "x" * 20)
    for number, tool in list(enumerate(tools))[::order]:
        matrix = (1, 0, 0, 0, 1, 0, 0, 0, 1, number, 0, 0)
        content = Image((2, 2, 1), 3, bytes([number] * 4), wire_matrix=matrix) if to == "nrrd" else Transform(matrix)
        script.igtl(Message("IMAGE" if to == "nrrd" else "TRANSFORM", tool, content, ticks(script)))
    path, out = saved(script, tmp_path / "s.mcap"), tmp_path / "out"
    assert main(["export", str(path), "--to", to, "-o", str(out), "--streams", "in:**"]) == 0
    told = dict(re.findall(r"note: igtl_in\.(\S+?)(?:\.\*)?\.\w+ has \w+/(.*)", capsys.readouterr().out))
    files = sorted(out.iterdir())
    assert len(files) == len(tools) == len({file.name.lower() for file in files})
    seen = set()
    for file in files:
        token = file.name.split(".")[1]
        number = _number(file, to)
        device = told.get(token) or token.partition("_")[2]
        assert device == tools[number], (file.name, device, tools[number])
        seen.add(number)
    assert len(seen) == len(tools)
    assert any("_A_B." in file.name and tools[_number(file, to)] == "A_B" for file in files), (
        "who has the name keeps it"
    )


def _number(file: Path, to: str) -> int:
    """The number that a file of a tool has."""
    if to == "csv":
        return round(float(next(csv.DictReader(file.read_text().splitlines()))["x_mm"]))
    if to == "parquet":
        return round(parquet.read_table(file)["x_mm"][0].as_py())
    return file.read_bytes()[-1]
