"""Definitions of message types: from memory, and from the files of an installation."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.schemas import RosTypes

#: Type hashes as an installed ROS 2 Jazzy has them.
JAZZY_HASHES = {
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}


@pytest.mark.parametrize("ros_type", JAZZY_HASHES)
def test_type_hashes_are_those_of_ros(ros_type: str) -> None:
    definition = RosTypes().find(ros_type)
    assert definition is not None
    assert definition.type_hash == JAZZY_HASHES[ros_type]


def test_a_type_of_the_installation_is_found_with_all_it_needs(tmp_path: Path) -> None:
    for name, text in {
        "suture_msgs/msg/Stitch": "Point entry\nsuture_msgs/Point exit\nstd_msgs/Header header\nuint8 DONE=1\n",
        "suture_msgs/msg/Point": "geometry_msgs/Point point\nstring<=5[<=3] names\nfloat64[3] weights\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.msg").write_text(text)
    types = RosTypes([tmp_path / "elsewhere", tmp_path])
    definition = types.find("suture_msgs/msg/Stitch")
    assert definition is not None
    assert definition == types.find("suture_msgs/msg/Stitch")  # the second time from memory
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition.text("suture_msgs/msg/Stitch"), "suture_msgs/msg/Stitch"))
    assert {"suture_msgs/msg/Point", "geometry_msgs/msg/Point", "std_msgs/msg/Header"} <= store.fielddefs.keys()
    assert store.hash_rihs01("suture_msgs/msg/Stitch") == definition.type_hash


def test_the_feedback_of_an_action(tmp_path: Path) -> None:
    """Its type is in no file: it has the goal's id and what stands last in the ``.action`` file."""
    (tmp_path / "p" / "action").mkdir(parents=True)
    (tmp_path / "p/action/Sew.action").write_text("int32 goal\n---\nint32 result\n---\n# how far\nfloat64[] done\n")
    definition = RosTypes([tmp_path]).find("p/action/Sew_FeedbackMessage")
    assert definition is not None
    text = definition.data.decode()
    assert "unique_identifier_msgs/UUID goal_id\n" in text and "# how far\nfloat64[] done" in text
    assert "int32" not in text
    assert RosTypes([tmp_path]).find("p/action/Sew_Goal") is None


@pytest.mark.parametrize(
    ("files", "ros_type"),
    [
        ({}, "suture_msgs/msg/Missing"),
        ({}, "../../etc/msg/passwd"),
        ({}, "suture_msgs/action/Sew_FeedbackMessage"),
        ({"p/msg/A": b"p/B other"}, "p/msg/A"),
        ({"p/msg/A": b"this is {no definition"}, "p/msg/A"),
    ],
    ids=["missing", "path", "action", "dependency missing", "not a definition"],
)
def test_a_type_without_definition(tmp_path: Path, files: dict[str, bytes], ros_type: str) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.msg").write_bytes(content)
    assert RosTypes([tmp_path]).find(ros_type) is None


@pytest.mark.parametrize("ros_type", ["igtl_msgs/msg/TrackingData", "foxglove_msgs/msg/CompressedVideo"])
def test_types_that_we_bring_are_found_without_ros(ros_type: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr("sys.prefix", "/nowhere")
    assert RosTypes().find(ros_type) is not None


def test_installed_types_are_found_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "overlay" / "share" / "p" / "msg" / "A.msg"
    path.parent.mkdir(parents=True)
    path.write_text("int32 a\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(["", str(tmp_path / "none"), str(tmp_path / "overlay")]))
    definition = RosTypes().find("p/msg/A")
    assert isinstance(definition, Definition)
    assert definition.data == b"int32 a\n"
