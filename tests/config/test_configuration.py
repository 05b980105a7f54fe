"""Configuration: what is right is kept, what is wrong is named with its path."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow, ToRosRow, device_of_topic
from tests.tables import table

EXAMPLE = """
[gateway]
base_frame = "world"
igtl_unit = "cm"
check_crc = false

[[to_igtl]]
topic = "/camera/image_raw"
device = "Camera"
type = "IMAGE"
qos = { depth = 3, reliable = false }

[[to_igtl]]
topic = "/igtl/out/**"
ros_unit = "mm"

[[to_ros]]
device = "Probe*"
topic = "/probe/{device}/{kind}"
frame_id = "tracker"
stamp = "receive"
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    path = tmp_path / "gateway.toml"
    path.write_text(EXAMPLE, "utf-8")
    return Config.from_toml(path)


def test_example(config: Config) -> None:
    assert (config.base_frame, config.igtl_unit, config.check_crc) == ("world", "cm", False)
    assert config.to_igtl[0] == ToIgtlRow(
        topic="/camera/image_raw", device="Camera", type="IMAGE", qos=Qos(3, reliable=False)
    )
    assert config.to_ros == (
        ToRosRow(device="Probe*", topic="/probe/{device}/{kind}", frame_id="tracker", stamp="receive"),
    )


def test_the_recording_keeps_it_all(config: Config) -> None:
    for one in (config, Config()):
        assert Config.from_dict(json.loads(json.dumps(one.to_dict()))) == one


def test_who_is_live_is_watched_unless_told_otherwise() -> None:
    assert [Config(watch=watch).watched().watch for watch in (None, False, True)] == [True, False, True]
    assert Config.from_dict({"watch": None}) == Config(naming=0, fitting=0, reading=0)  # as it is stored
    assert Config.of_values({}) == Config()
    assert (Config().watched().cautious, Config(cautious=False).watched().cautious) == (True, False)


def test_a_recording_that_is_older_than_a_setting_is_not_judged_by_it() -> None:
    assert not Config().knows_peers and Config(cautious=False).knows_peers
    assert {"cautious", "keep_mib"}.isdisjoint(Config().to_dict())
    assert Config.from_dict(Config(cautious=True).to_dict()).cautious is True
    assert Config().as_live_as(Config(watch=True)) == Config(watch=True)
    assert Config(cautious=False).as_live_as(Config(cautious=True)).cautious is False


def test_first_row_that_matches(config: Config) -> None:
    assert config.row_to_igtl("/camera/image_raw") is config.to_igtl[0]
    assert config.row_to_igtl("/igtl/out/a/b") is config.to_igtl[1]
    assert config.row_to_igtl("/elsewhere") is None
    assert config.row_to_ros("TRANSFORM", "Probe1") is config.to_ros[0]
    assert config.row_to_ros("TRANSFORM", "Other") == ToRosRow()


def test_without_rows_what_is_below_igtl_out_goes_out() -> None:
    assert Config().row_to_igtl("/igtl/out/Tool") == ToIgtlRow()
    assert Config().row_to_igtl("/tf") is None


def test_rows_override_units_and_stamp(config: Config) -> None:
    plain, row = ToIgtlRow(), config.to_igtl[1]
    assert (config.lengths(plain).ros, config.lengths(plain).igtl) == ("m", "cm")
    assert (config.lengths(row).ros, config.lengths(row).igtl) == ("mm", "cm")
    assert config.pick_stamp(plain, 5, 9) == 5
    assert config.pick_stamp(config.to_ros[0], 5, 9) == 9


@pytest.mark.parametrize("source_ns", [0, -1])
def test_a_message_is_always_stamped(source_ns: int) -> None:
    assert Config().pick_stamp(ToIgtlRow(), source_ns, 9) == 9


@table(
    ("values", "place"),
    [
        ({"unknown": 1}, "gateway.unknown"),
        ({"base_frame": 1}, "gateway.base_frame"),
        ({"check_crc": 1}, "gateway.check_crc"),
        ({"check_crc": "yes"}, "gateway.check_crc"),
        ({"max_streams": True}, "gateway.max_streams"),
        ({"max_streams": 0}, "gateway.max_streams"),
        ({"watch": 1}, "gateway.watch"),
        ({"to_ros": [{"max_age_s": -1}]}, "to_ros[0].max_age_s"),
        ({"to_igtl": [{}, {"max_age_s": float("nan")}]}, "to_igtl[1].max_age_s"),
        ({"ros_unit": "inch"}, "gateway.ros_unit"),
        ({"igtl_unit": ""}, "gateway.igtl_unit"),
        ({"stamp": "later"}, "gateway.stamp"),
        ({"to_igtl": 1}, "to_igtl"),
        ({"to_igtl": [1]}, "to_igtl[0]"),
        ({"to_igtl": [{}, {"topik": "/a"}]}, "to_igtl[1].topik"),
        ({"to_igtl": [{"topic": 1}]}, "to_igtl[0].topic"),
        ({"to_igtl": [{"ros_unit": "inch"}]}, "to_igtl[0].ros_unit"),
        ({"to_igtl": [{"qos": 3}]}, "to_igtl[0].qos"),
        ({"to_igtl": [{"qos": {"deep": 3}}]}, "to_igtl[0].qos.deep"),
        ({"to_igtl": [{"qos": {"depth": "3"}}]}, "to_igtl[0].qos.depth"),
        ({"to_igtl": [{"qos": {"depth": 0}}]}, "to_igtl[0].qos.depth"),
        ({"to_ros": [{"qos": {"depth": 10**9}}]}, "to_ros[0].qos.depth"),
        ({"to_igtl": [{"topic": "camera"}]}, "to_igtl[0].topic"),
        ({"to_igtl": [{"type": "IMGE"}]}, "to_igtl[0].type"),
        ({"to_ros": [{"topic": "probe/{device}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/a probe"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{device"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{name}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{device.upper}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{device[0]}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{device!r}"}]}, "to_ros[0].topic"),
        ({"to_ros": [{"topic": "/{device:>9999999999}"}]}, "to_ros[0].topic"),
    ],
)
def test_errors_name_the_setting(values: dict[str, Any], place: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.from_dict(values)
    assert str(caught.value).startswith(f"{place}: ")


@pytest.mark.parametrize(
    "text", ["not toml", "gateway = 3", "[other]\n", b"\xff\xfe", "[gateway]\nstamp = 1", "[[gateway]]\n"]
)
def test_errors_of_a_file_name_it(tmp_path: Path, text: str | bytes) -> None:
    path = tmp_path / "wrong.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=r"wrong\.toml"):
        Config.from_toml(path)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        Config.from_toml(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        Config.from_toml(tmp_path)


@table(
    ("glob", "name", "fits"),
    [
        ("/a/*", "/a/b", True),
        ("/a/*", "/a/b/c", False),
        ("/a/**", "/a/b/c", True),
        ("/a/**", "/a", False),
        ("**/c", "/a/b/c", True),
        ("Probe?", "Probe1", True),
        ("Probe?", "Probe", False),
        ("a.b", "axb", False),
        ("a[1]", "a[1]", True),
        ("**", "line\nbreak", True),
    ],
)
def test_patterns(glob: str, name: str, fits: bool) -> None:
    assert matches(glob, name) is fits


@pytest.mark.parametrize(
    ("topic", "kind", "device"),
    [
        ("/igtl/out/Tool", "", "Tool"),
        ("/igtl/out/Tool/transform", "transform", "Tool"),
        ("/igtl/out/transform", "transform", "transform"),
        ("/igtl/out/a/b", "transform", "a_b"),
        ("/camera/image", "", "camera_image"),
        ("/camera/image", "image", "camera"),
    ],
)
def test_device_of_topic(topic: str, kind: str, device: str) -> None:
    assert device_of_topic(topic, kind) == device


def test_what_is_written_as_toml_is_read_as_the_same(config: Config, tmp_path: Path) -> None:
    odd = Config(
        stamp="now",
        command_timeout_s=1.5,
        relay=True,
        watch=False,
        to_igtl=(ToIgtlRow(topic='/a"b', metadata=(("who", "Zoë \\ \n"), ("a key", "")), qos=Qos(3, False, True)),),
        to_ros=(ToRosRow(device="*", kinds=("+slices", "image")),),
        tf_out=(TfOutRow(frames=("Tool", "Probe"), base="Base"),),
        peers=(PeerRow("10.0.0.*", "slicer"),),
    )
    for index, one in enumerate((Config(), config, odd)):
        path = tmp_path / f"{index}.toml"
        path.write_text(one.to_toml(), "utf-8")
        assert Config.from_toml(path) == one
    assert Config().to_toml() == "[gateway]\n"
