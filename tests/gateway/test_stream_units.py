"""The unit of lengths in each stream: rows, arms, and outputs as the streams that they are made of."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recorded_config import recorded_units
from tests.gateway.to_igtl.test_composer import TIP, measured, script
from tests.places import FIXTURES, PACKAGE

POSE = "geometry_msgs/msg/PoseStamped"


def test_inputs_have_the_unit_of_their_row() -> None:
    units = StreamUnits(Config(ros_unit="cm", to_ros=(ToRosRow(device="CT*", igtl_unit="m", ros_unit="dm"),)))
    assert units.of(Kind.IGTL_IN, "IMAGE/CT1", "IMAGE") == "m"
    assert units.of(Kind.IGTL_IN, "IMAGE/MR", "IMAGE") == "mm"
    assert units.of(Kind.ROS_IN, "/unbridged", POSE) == "cm"
    assert units.of(Kind.ROS_OUT, "/igtl/in/CT1/volume", "igtl_msgs/msg/Volume") == "dm"
    assert units.of(Kind.ROS_OUT, "/tf", "tf2_msgs/msg/TFMessage") == "cm"


def test_outputs_have_the_unit_of_what_they_are_made_of() -> None:
    rows = (ToIgtlRow(topic="/tool/pose", device="Tool", igtl_unit="um", ros_unit="mm"),)
    config = Config(to_igtl=rows, tf_out=(TfOutRow(frames=("tip",), base="map", device="Tip", igtl_unit="cm"),))
    units = StreamUnits(config)
    assert units.of(Kind.IGTL_OUT, "TRANSFORM/Tool", "TRANSFORM") == "mm"  # not known yet
    assert units.of(Kind.ROS_IN, "/tool/pose", POSE) == "mm"
    assert units.of(Kind.IGTL_OUT, "TRANSFORM/Tool", "TRANSFORM") == "um"
    assert units.of(Kind.IGTL_OUT, "TRANSFORM/Tip", "TRANSFORM") == "cm"
    assert StreamUnits(config, [(Kind.ROS_IN, "/tool/pose", POSE)]).of(Kind.IGTL_OUT, "TRANSFORM/Tool", "") == "um"


def test_robots_of_crtk_have_metres() -> None:
    with SessionFile.open(FIXTURES / "crtk.mcap") as file:
        units = recorded_units(file)
        found = {each.stream: units.of(each.kind, each.stream, each.entry_type) for each in file.channels}
    poses = {stream: unit for stream, unit in found.items() if stream.startswith("TRANSFORM/")}
    assert "TRANSFORM/PSM1/local/meas_3d53" in poses and "TRANSFORM/PSM1/servo_cp" in poses
    assert set(poses.values()) == {"m"}


def test_only_the_table_of_units_knows_how_long_they_are() -> None:
    code = {path: path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
    pattern = re.compile(r"\bUNITS\[|\bUNITS\.(get|items|values)\(")
    found = {path.name for path, text in code.items() if pattern.search(text) and "convert.units" in text}
    assert found == set()


def test_a_part_alone_knows_the_units_of_peers_that_came_before_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The note about the unit of a peer is in an earlier part; its first message is in the prologue of this one."""
    made = script()
    measured(made)
    before = [entry for entry in made.log if entry.kind.is_input]
    after = len(made.log)
    measured(made)
    facts = {"config": json.dumps(made.gateway.config.to_dict())}
    writer = SessionWriter(tmp_path / "part.mcap", facts, prologue=before)
    for entry in made.log[after:]:
        writer.write(entry)
    writer.close({})
    with SessionFile.open(tmp_path / "part.mcap") as file:
        units = recorded_units(file)
        found = {
            entry.links: units.of(entry.kind, entry.channel, entry.type, entry.links)
            for entry in file.entries()
            if entry.channel == "TRANSFORM/PSM1/measured_cp"
        }
    assert found == {(1,): "mm", (2,): "m"}
    with igtl_gateway.open(tmp_path / "part.mcap") as recording:
        slicer, saw = (recording[f"TRANSFORM/PSM1/measured_cp@{link}"].poses().in_unit("mm") for link in (1, 2))
    assert np.abs(slicer.positions[0] - 1000 * np.array(TIP)).max() < 1e-3
    assert np.abs(saw.positions[0] - 1000 * np.array(TIP)).max() < 1e-3
    assert main(["info", str(tmp_path / "part.mcap")]) == 0
    told = capsys.readouterr().out
    assert "lengths in m, mm (link 1)" in told
    assert "units     m and mm in OpenIGTLink" in told
    assert main(["info", str(tmp_path / "part.mcap"), "--json"]) == 0
    (stream,) = [
        each for each in json.loads(capsys.readouterr().out)["streams"] if each["stream"].startswith("TRANSFORM/PSM1")
    ]
    assert (stream["unit"], stream["link_units"]) == ("m", {"1": "mm"})
