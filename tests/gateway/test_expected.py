"""The sources that a configuration names, and those that are not there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from igtl_gateway.addons.upload.settings import SETTINGS as UPLOAD
from igtl_gateway.addons.zenoh.settings import SETTINGS as ZENOH
from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.config.settings import SETTINGS
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.expected import SOURCES, PresentSources, expected_sources, missing_sources
from tests.tables import table

CONFIG = Config(
    to_igtl=(ToIgtlRow(topic="/tol"), ToIgtlRow(topic="/camera/**"), ToIgtlRow(topic="/tol", type="STRING")),
    to_ros=(ToRosRow(device="Prob"), ToRosRow(device="Tool*"), ToRosRow(device="**")),
    tf_out=(TfOutRow(frames=("tip", "/elbow"), base="base"),),
    crtk=(ArmsRow(arms="/PSM1"), ArmsRow(arms="/MTM*")),
    profile="crtk",
)


def test_a_service_without_events_has_its_reason() -> None:
    (missing,) = missing_sources(expected_sources(Config(), ["/arm/enable/_service_event"]), PresentSources(topics=()))
    why = "no publisher: the service is not there, or its introspection is off"
    assert missing.text == f"topic /arm/enable/_service_event: {why} (--record-topics)"


def test_the_name_of_a_service_or_an_action_leads_to_its_topics() -> None:
    topics = ["/arm/enable/_service_event", "/fib/_action/status", "/fi"]
    found = missing_sources(expected_sources(Config(), ["/arm/enable", "/fib"]), PresentSources(topics=topics))
    assert [each.near for each in found] == ["/arm/enable/_service_event", "/fib/_action/**"]


def test_each_name_is_expected_and_a_pattern_of_everything_is_not() -> None:
    found = [
        (each.kind, each.name, each.setting)
        for each in expected_sources(CONFIG, ["/rosuot", "**"], connect=["10.0.0.5:18944"])
    ]
    assert found == [
        ("topic", "/tol", "to_igtl[0]"),
        ("topic", "/camera/**", "to_igtl[1]"),
        ("frame", "tip", "tf_out[0]"),
        ("frame", "elbow", "tf_out[0]"),
        ("frame", "base", "tf_out[0]"),
        ("arm", "/PSM1", "crtk[0]"),
        ("arm", "/MTM*", "crtk[1]"),
        ("device", "Prob", "to_ros[0]"),
        ("device", "Tool*", "to_ros[1]"),
        ("topic", "/rosuot", "--record-topics"),
        ("link", "10.0.0.5:18944", "connect"),
    ]


#: Settings, and fields of rows, that name no source that is there without this bridge.
NAME_NO_SOURCE = frozenset(
    # how it listens and what it calls itself; files; what a setting is worth
    """config listen relay allow tls tls_cert tls_key tls_ca deny_in deny_out cautious max_clients queue_mib
    queue_messages max_body_mib max_body max_messages stall_s min_rate_kib idle_s kinds max_age_s publish_tf base_frame
    ros_unit igtl_unit stamp check_crc max_streams keep_mib latched_mib max_behind_s command_timeout_s record overwrite
    file_mode record_all custom_data outputs compression flush_interval fsync record_wait split_size split_duration
    seal retention on_record_failure video_codec video_bit_rate video_key_interval realtime_priority lock_memory
    cpu_affinity diagnostics watch metrics faults fault_seed upload upload_rate patience ros site site_budget
    snapshot native no_native page page_address view allow_origin""".split()
)
ROW_FIELDS = {
    "to_igtl": ("device", "type", "metadata"),
    "to_ros": ("type", "topic", "frame_id", "child_frame_id", "kinds"),
    "tf_out": ("device", "type"),
    "peers": ("profile",),
}


def test_each_setting_names_a_source_or_none() -> None:
    """A new setting is a row of ``SOURCES``, or stands here."""
    named = {key.setting for key in SOURCES}
    names = {each.name for each in (*SETTINGS, *UPLOAD, *ZENOH)}
    assert names - named - NAME_NO_SOURCE == set() and not named & NAME_NO_SOURCE
    for setting, row in (("to_igtl", ToIgtlRow), ("to_ros", ToRosRow), ("tf_out", TfOutRow), ("peers", PeerRow)):
        known = {key.field for key in SOURCES if key.setting == setting}
        common = {"ros_unit", "igtl_unit", "stamp", "qos", "max_age_s"}
        fields = {field.name for field in dataclasses.fields(row)}
        assert fields == known | set(ROW_FIELDS[setting]) | (fields & common), setting


def test_what_is_selected_by_pattern_is_expected_where_it_is_asked_for() -> None:
    found = expected_sources(Config(), included=["IMAGE/*"], excluded=["/tf*", "Camera"], classed=["/video/**"])
    assert {(each.kind, each.name, each.setting, each.is_optional) for each in found} == {
        ("stream", "IMAGE/*", "--record-include", False),
        ("stream", "Camera", "--record-exclude", True),
        ("stream", "/video/**", "--site-class", False),
    }


OF_ROS = {"/tol", "/camera/**", "/PSM1", "/MTM*"}
ALL = {*OF_ROS, "tip", "elbow", "base", "Prob", "Tool*"}


@table(
    "present, missing",
    [
        (PresentSources(), set()),
        (PresentSources(topics=()), OF_ROS),
        (PresentSources(topics=("/tol", "/camera/a/b", "/PSM1/measured_cp", "/MTMR/measured_cp")), set()),
        (PresentSources(topics=("/tool", "/PSM1/spatial/measured_cp")), {"/tol", "/camera/**", "/MTM*"}),
        (PresentSources(frames=("tip", "base")), {"elbow"}),
        (PresentSources(devices=("Probe", "Tool1")), {"Prob"}),
        (PresentSources((), (), ()), ALL),
    ],
)
def test_what_is_not_there(present: PresentSources, missing: set[str]) -> None:
    assert {each.source.name for each in missing_sources(expected_sources(CONFIG), present)} == missing


def texts(config: Config, present: PresentSources, connect: Sequence[str] = ()) -> list[str]:
    return [each.text for each in missing_sources(expected_sources(config, connect=connect), present)]


def test_the_sentence_has_the_nearest_name() -> None:
    (one,) = missing_sources(expected_sources(Config(to_ros=CONFIG.to_ros[:1])), PresentSources(devices=("Probe", "X")))
    assert one.text == "device Prob: no peer sends it; did you mean 'Probe'? (to_ros[0])"
    note = one.note()
    assert (note.code, note.stream, note.data) == ("no_source", "Prob", {"kind": "device", "setting": "to_ros[0]"})
    config = Config(to_igtl=(ToIgtlRow(topic="/camera/imge"), ToIgtlRow(topic="/cam/points")))
    assert texts(config, PresentSources(("/camera/image", "/lidar/points"))) == [
        "topic /camera/imge: no publisher; did you mean '/camera/image'? (to_igtl[0])",
        "topic /cam/points: no publisher; did you mean '/lidar/points'? (to_igtl[1])",
    ]


@table(
    "row, types, why",
    [
        (ToIgtlRow(topic="/a"), [String.TYPE], ""),
        (ToIgtlRow(topic="/a", type="IMAGE"), [String.TYPE], f"{String.TYPE} has no conversion to IMAGE"),
        (ToIgtlRow(topic="/a", type="IMAGE"), ["sensor_msgs/msg/Image", String.TYPE], ""),
        (ToIgtlRow(topic="/a", type="VIDEO"), ["sensor_msgs/msg/Image"], ""),
        (ToIgtlRow(topic="/a"), ["x_msgs/msg/Y"], "x_msgs/msg/Y has no conversion"),
        (ToIgtlRow(topic="/a*"), ["x_msgs/msg/Y"], "x_msgs/msg/Y has no conversion"),
    ],
)
def test_a_topic_of_another_type(row: ToIgtlRow, types: list[str], why: str) -> None:
    found = texts(Config(to_igtl=(row,)), PresentSources({"/a": types}))
    assert found == [f"topic {row.topic}: {why} (to_igtl[0])"] * bool(why)


def test_what_is_there_and_does_not_fit() -> None:
    config = Config(
        to_ros=(ToRosRow(device="Probe", type="IMAGE"),),
        to_igtl=(ToIgtlRow(topic="/a"),),
        tf_out=(TfOutRow(frames=("tip",), base="base"),),
        peers=(PeerRow(at="127.0.0.1:18945", profile="plus"), PeerRow(at="10.0.0.*:*", profile="plus")),
    )
    present = PresentSources(
        {"/a": [PoseStamped.TYPE]},
        ["tip", "base"],
        {"Probe": ["TRANSFORM"]},
        peers=["127.0.0.1:18944"],
        connected=0,
        clashes={"/a": "the RELIABILITY of its publisher does not fit"},
        apart={"tip": "base"},
    )
    assert texts(config, present) == [
        "topic /a: the RELIABILITY of its publisher does not fit (to_igtl[0])",
        "frame tip: no transform connects it with base (tf_out[0])",
        "device Probe: it is TRANSFORM, expected IMAGE (to_ros[0])",
        "peer 127.0.0.1:18945: no such peer; did you mean '127.0.0.1:18944'? (peers[0])",
    ]
    everywhere = dataclasses.replace(present, peers=["0.0.0.0:18945", "10.0.0.7:50000"], connected=1)
    assert not [each for each in texts(config, everywhere) if each.startswith("peer")]


def test_without_a_peer_no_device_can_come() -> None:
    config = Config(to_ros=(ToRosRow(device="Probe"),))
    for connected, why in ((0, "no peer is connected"), (1, "no peer sends anything")):
        assert texts(config, PresentSources(devices={}, connected=connected)) == [f"device Probe: {why} (to_ros[0])"]
    assert texts(Config(), PresentSources(links=[]), connect=["h:1"]) == ["link h:1: no answer (connect)"]
