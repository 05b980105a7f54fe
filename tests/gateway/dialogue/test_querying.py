"""What peers ask for: scripted scenarios on manual time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import FrameTransform, MultiArrayLayout, TFMessage
from igtl_gateway.convert.igtl_msgs import MetadataItem, PointList, Query, TrackedTool, TrackingData
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.profiles import PROFILES
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import outcome, streams
from igtl_gateway.gateway.dialogue.answers import MAX_TRACKED
from igtl_gateway.gateway.peers import MAX_STREAM_REQUESTS
from igtl_gateway.gateway.to_igtl import trackdata
from igtl_gateway.gateway.to_igtl import tracking as tracking_room
from igtl_gateway.wire import Message, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import QUERIES, EmptyQuery, QueryReply, StartTracking, StartVideo
from igtl_gateway.wire.text import Status
from tests.script import T0_NS, Script
from tests.tables import table

POSE = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)


def tool(name: str = "tool", x: float = 0.1) -> rosmsg.TransformStamped:
    return rosmsg.TransformStamped(Header(T0_NS, "base"), name, (x, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))


def tracking(*names: str) -> TrackingData:
    return TrackingData(Header(T0_NS, "base"), tuple(TrackedTool(name, 2, POSE) for name in names))


def query(name: str, device: str = "", content: object = None) -> Message:
    return Message(name, device, content or QUERIES[name].unpack(memoryview(b"")))  # type: ignore[arg-type]


def test_a_status_query_is_answered_at_once() -> None:
    script = Script()
    script.up(1)
    lines = script.igtl(query("GET_STATUS", "Gateway"))
    assert "igtl STATUS/Gateway v1 to 1" in lines
    (answer,) = script.sent()
    assert answer.content == Status(1)


def test_a_query_for_a_type_that_no_header_can_name_is_answered_by_a_status() -> None:
    script = Script()
    script.up(1)
    # each invalid byte becomes three: more than the twelve of a type; found by tools/fuzz_gateway.py
    lines = script.igtl(Message("GET_" + b"POI\xff\xfe\xfd\xff\xfe".decode("utf-8", "surrogateescape"), "", Raw(b"?")))
    assert "note query_unanswered" in lines and "note internal_error" not in lines
    (answer,) = script.sent()
    assert isinstance(answer.content, Status) and answer.content.code == 4


def test_the_capabilities_are_the_types_that_are_read() -> None:
    script = Script()
    script.up(1)
    script.igtl(query("GET_CAPABIL"))
    (answer,) = script.sent()
    assert answer.type == "CAPABILITY" and isinstance(answer.content, Capability)
    assert {"TRANSFORM", "TDATA", "VIDEO", "GET_STATUS", "STT_TDATA"} <= set(answer.content.types)
    assert "QTRANS" not in answer.content.types


def test_the_latest_state_answers_only_who_asked() -> None:
    script = Script()
    script.ros("/igtl/out/Tool", tool(x=0.1))
    script.ros("/igtl/out/Tool", tool(x=0.4))
    script.up(1)
    script.up(2)
    lines = script.igtl(query("GET_TRANS", "Tool"), link=2)
    assert "igtl TRANSFORM/Tool v1 to 2" in lines and "ros /igtl/in/Tool/query" in lines
    (answer,) = script.sent()
    assert answer.content.describe()["matrix"][0][3] == 400.0


def test_a_state_answers_as_any_type_that_it_converts_to() -> None:
    script = Script()
    script.ros("/igtl/out/Tool", tool())
    script.up(1)
    assert "igtl POSITION/Tool v1 to 1" in script.igtl(query("GET_POSITION", "Tool"))


def test_without_a_device_all_are_told() -> None:
    script = Script()
    for name in ("A", "B"):
        script.ros(f"/igtl/out/{name}", tool())
    script.up(1)
    lines = script.igtl(query("GET_TRANS"))
    assert {"igtl TRANSFORM/A v1 to 1", "igtl TRANSFORM/B v1 to 1"} <= set(lines)


def test_what_is_not_there_is_a_message_without_content() -> None:
    """If every reader survives that; otherwise the answer is a STATUS with the reason."""
    script = Script()
    script.up(1)
    lines = script.igtl(query("GET_IMAGE", "CT"))
    assert "igtl STATUS/CT v1 to 1" in lines and "note query_unanswered" in lines
    (answer,) = script.sent()
    assert isinstance(answer.content, Status) and answer.content.code == 4
    script.igtl(query("GET_POINT", "Targets"))
    assert script.sent()[0].type == "POINT" and not script.sent()[0].content.pack()
    script.igtl(Message("GET_IMAGE", "CT", EmptyQuery(), 0, 2))
    assert (script.sent()[0].type, script.sent()[0].content) == ("IMAGE", Raw(b""))


def test_images_that_go_out_are_listed() -> None:
    script = Script()
    picture = rosmsg.Image(Header(T0_NS, "camera"), 4, 6, "mono16", 0, 12, bytes(48))
    script.ros("/igtl/out/Camera", picture)
    script.up(1)
    script.igtl(query("GET_IMGMETA"))
    (answer,) = script.sent()
    (element,) = answer.content.describe()["elements"]
    assert element["device_name"] == "Camera" and element["size"] == [6, 4, 1] and element["scalar_type"] == 5


# -- streams --------------------------------------------------------------------------------------------------------


def test_tracking_is_paced_for_who_asked_for_it() -> None:
    script = Script()
    script.up(1)
    script.up(2)
    lines = script.igtl(query("STT_TDATA", "Polaris", StartTracking(50)), link=1)
    assert "igtl RTS_TDATA/Polaris v1 to 1" in lines and "note stream_started" in lines
    assert script.sent()[0].content == QueryReply(0)
    got: dict[int, int] = {1: 0, 2: 0}
    for _ in range(200):  # a millisecond each
        script.ros("/igtl/out/Polaris", tracking("probe"))
        for entry in script.last:
            if entry.type == "TDATA":
                for link in entry.links:
                    got[link] += 1
    assert got == {1: 4, 2: 200}
    lines = script.igtl(query("STP_TDATA", "Polaris"), link=1)
    assert "igtl RTS_TDATA/Polaris v1 to 1" in lines
    assert script.ros("/igtl/out/Polaris", tracking("probe")) == ["igtl TDATA/Polaris v1 to 2"]


def test_tracking_is_put_together_from_single_poses() -> None:
    script = Script()
    script.up(1)
    script.igtl(query("STT_TDATA", "", StartTracking(0)))
    script.ros("/igtl/out/Probe", tool(x=0.1))
    assert script.ros("/igtl/out/Needle", tool(x=0.5)) == [
        "igtl TRANSFORM/Needle v1 to 1",
        "igtl TDATA/Tracking v1 to 1",
    ]
    elements = script.sent()[1].content.describe()["elements"]
    assert [(one["name"], one["type"], one["matrix"][0][3]) for one in elements] == [
        ("Probe", 2, 100.0),
        ("Needle", 2, 500.0),
    ]


def test_a_frame_that_nobody_knows_is_refused() -> None:
    script = Script()
    script.up(1)
    lines = script.igtl(query("STT_TDATA", "Polaris", StartTracking(50, "Patient")))
    assert "note stream_refused" in lines and script.sent()[0].content == QueryReply(1)
    script.ros("/igtl/out/Polaris", tracking("probe"))
    script.igtl(query("STT_TDATA", "Polaris", StartTracking(50, "base")))
    assert script.sent()[0].content == QueryReply(0)


@pytest.mark.parametrize("name", ["TDATA", "QTDATA"])
def test_tracking_is_told_in_the_frame_asked_for(name: str) -> None:
    quarter = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
    place = FrameTransform(Header(0, "world"), "base", (1.0, 2.0, 3.0, *quarter))
    row = ToIgtlRow(topic="/polaris", device="Polaris", type=name)
    script = Script(Config(to_igtl=(row,), tf_out=(TfOutRow(frames=("base",), base="world"),)))
    script.up(1)
    script.up(2)
    script.ros("/tf_static", TFMessage((place,)))
    script.igtl(query(f"STT_{name}", "Polaris", StartTracking(0, "world")))
    assert script.sent()[0].content == QueryReply(0)
    lines = script.ros("/polaris", tracking("probe"))
    assert lines == [f"igtl {name}/Polaris v1 to 1", f"igtl {name}/Polaris v1 to 2"]
    there, here = (message.content.describe()["elements"][0] for message in script.sent())
    if name == "TDATA":
        assert [row[3] for row in there["matrix"]] == pytest.approx([800, 2100, 3300, 1], abs=1e-3)
        assert [row[0] for row in there["matrix"]] == pytest.approx([0, 1, 0, 0], abs=1e-6)
        assert [row[3] for row in here["matrix"]] == pytest.approx([100, 200, 300, 1], abs=1e-3)
    else:
        assert there["position"] == pytest.approx([800, 2100, 3300], abs=1e-3)
        assert there["quaternion"] == pytest.approx(quarter, abs=1e-6)
        assert here["position"] == pytest.approx([100, 200, 300], abs=1e-3)


def test_pictures_can_be_paced_and_stopped() -> None:
    script = Script()
    script.up(1)
    picture = rosmsg.Image(Header(T0_NS, "camera"), 1, 1, "mono8", 0, 1, b"x")
    script.igtl(query("STP_IMAGE", "Camera"))
    assert script.ros("/igtl/out/Camera", picture) == []
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Camera"]["dropped"] == {"not_wanted": 1}
    script.igtl(query("STT_IMAGE", "Camera"))
    assert script.ros("/igtl/out/Camera", picture) == ["igtl IMAGE/Camera v1 to 1"]


def test_a_peer_that_invents_streams_is_refused_in_the_end() -> None:
    script = Script()
    script.up(1)
    for index in range(MAX_STREAM_REQUESTS):
        script.igtl(query("STT_IMAGE", f"I{index}"))
    assert "note stream_refused" in script.igtl(query("STT_IMAGE", "One more"))
    script.igtl(query("STP_IMAGE", ""))
    assert "note stream_started" in script.igtl(query("STT_IMAGE", "One more"))


def test_tracking_data_by_many_names_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Found beside tools/fuzz_gateway.py: 256 small messages of a peer made every pose from then on take long."""
    script = Script()
    script.up(1)
    for index in range(MAX_TRACKED):
        assert "note stream_started" in script.igtl(query("STT_TDATA", f"T{index}", StartTracking(1)))
    assert "note stream_refused" in script.igtl(query("STT_QTDATA", "One more", StartTracking(1)))
    assert "note stream_started" in script.igtl(query("STT_TDATA", "T0", StartTracking(0))), "one that it has"
    made = []
    tracking = trackdata.tracking_moments

    def counted(*args: Any, **options: Any) -> object:
        made.append(args)
        return tracking(*args, **options)

    monkeypatch.setattr(tracking_room, "tracking_moments", counted)
    lines = script.ros("/igtl/out/Tool", tool())
    assert [f"igtl TDATA/T{index} v1 to 1" in lines for index in range(MAX_TRACKED)] == [True] * MAX_TRACKED
    assert len(made) == 1
    script.igtl(query("STP_TDATA", ""))
    assert "note stream_started" in script.igtl(query("STT_QTDATA", "One more", StartTracking(1)))


def test_devices_that_commands_name_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "MAX_NAMES", 3)
    names = streams.Streams(Config())
    assert [names.device(f"A device with a long name {index}") for index in range(9)] == [
        names.device(f"A device with a long name {index}") for index in range(9)
    ]
    assert names.device("B") == "B" and len(names._devices) == 3


@table("name", sorted(QUERIES))
def test_every_query_is_published_and_leaves_the_peer_well(name: str) -> None:
    script = Script()
    script.up(1)
    content = StartVideo("H264", 40) if name == "STT_VIDEO" else None
    lines = script.igtl(query(name, "Device", content))
    assert "ros /igtl/in/Device/query" in lines
    assert not [line for line in lines if line.startswith("note ") and "stream" not in line and "query" not in line]
    assert script.ros("/igtl/out/Other", tool())[0] == "igtl TRANSFORM/Other v1 to 1"


# -- what a peer must not be sent ------------------------------------------------------------------------------------


@table("name", sorted(QUERIES))
def test_no_query_and_no_reply_that_would_crash_slicer(name: str) -> None:
    script = Script(Config(profile="slicer"))
    script.up(1)
    script.igtl(query(name, "Device", StartVideo("H264", 40) if name == "STT_VIDEO" else None))
    prefixes = {message.type.partition("_")[0] for message in script.sent() if message.type != "RTS_TDATA"}
    assert not prefixes & {"GET", "STT", "STP", "RTS"}
    asked = Query(Header(), Query.GET, "IMAGE", "CT")
    assert script.ros("/igtl/out/CT/query", asked) == ["note not_for_peer"]


def test_plus_is_sent_nothing_that_its_factory_does_not_name() -> None:
    script = Script(Config(peers=(PeerRow("127.0.0.1:*", "plus"),)))
    script.up(1, peer="127.0.0.1:18945", role="client")
    script.up(2, peer="10.0.0.1:1234", role="server", local="0.0.0.0:18944")
    values = rosmsg.String("x")
    assert script.ros("/igtl/out/Text", values) == ["igtl STRING/Text v1 to 2", "igtl STRING/Text v2 to 1"]
    numbers = _float_array()
    assert script.ros("/igtl/out/Numbers", numbers) == ["igtl NDARRAY/Numbers v1 to 2", "note not_for_peer"]
    assert script.ros("/igtl/out/Numbers", numbers) == ["igtl NDARRAY/Numbers v1 to 2"], "reported once"


def _float_array() -> rosmsg.RosMessage:
    return MULTI_ARRAYS["f8"](MultiArrayLayout(), np.arange(3.0))


def test_plus_is_pinged_when_nothing_else_is_said() -> None:
    script = Script(Config(profile="plus"))
    script.up(1)
    assert script.tick(0.1) == []
    assert script.tick(0.2) == ["igtl GET_STATUS/ v2 to 1"]
    assert isinstance(script.sent()[0].content, EmptyQuery)
    assert script.tick(0.1) == []
    script.ros("/igtl/out/Tool", tool())
    assert script.tick(0.2) == [], "a message is as good as a ping"
    assert script.tick(0.1) == ["igtl GET_STATUS/ v2 to 1"]
    script.down(1)
    assert script.gateway.due_ns is None


def test_a_ros_node_asks_the_peers() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(topic="/ask"),)))
    script.up(1)
    script.up(2)
    wanted = Query(Header(), Query.START, "TDATA", "Polaris", resolution=20, link=2)
    assert script.ros("/ask", wanted) == ["igtl STT_TDATA/Polaris v1 to 2"]
    assert script.sent()[0].content == StartTracking(20)
    assert script.ros("/ask", Query(Header(), Query.GET, "IMAGE", "CT", link=7)) == ["note conversion"]


def test_slicer_gets_pixels_and_axes_that_it_reads() -> None:
    script = Script(Config(profile="slicer", to_igtl=(ToIgtlRow(topic="/ct", device="CT"),)))
    script.up(1)
    pixels = np.array([1, 2, 3, 1 << 24], "<i4").tobytes()
    picture = rosmsg.Image(Header(T0_NS, "camera"), 2, 2, "32SC1", 0, 8, pixels)
    assert script.ros("/ct", picture) == ["igtl IMAGE/CT v1 to 1"]
    image = script.sent()[0].content
    assert isinstance(image, Image) and image.scalar_type == 10
    assert image.array.reshape(-1).tolist() == [1.0, 2.0, 3.0, float(1 << 24)]


OTHERS = {"brainlab", "holoscan", "legacy-v1", "openigtlink4j", "openigtlink-rust"}


def test_profiles_have_a_source_for_each_fact() -> None:
    assert {one.name for one in PROFILES} == {"default", "slicer", "plus", "plus-v1", *OTHERS}
    for profile in PROFILES:
        assert profile.facts and all(fact and source for fact, source in profile.facts)


def test_what_cannot_be_sent_is_no_answer_and_costs_the_others_nothing() -> None:
    script = Script()
    script.up(1)
    script.igtl(Message("STATUS", "", Status(1), 0, 2))  # a peer of header version 2, which has metadata
    huge = PointList(Header(T0_NS, "base"), (), (MetadataItem("key", 0, "x" * 100_000),))
    assert script.ros("/igtl/out/Huge", huge) == ["note conversion"]
    lines = script.igtl(query("GET_POINT"))
    assert lines == ["ros /igtl/in/unnamed/query", "note conversion", "igtl POINT/ v2 to 1", "note query_unanswered"]
    script.ros("/igtl/out/Good", PointList(Header(T0_NS, "base"), ()))
    assert script.igtl(query("GET_POINT"))[1:] == ["note conversion", "igtl POINT/Good v2 to 1"]
    counts = script.gateway.ledger.to_dict()["igtl_in"]["GET_POINT/"]
    assert (counts["received"], counts["converted"], "dropped" in counts) == (2, 2, False)


def test_a_peer_that_invents_names_fills_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome, "MAX_NOTED", 3)
    script = Script()
    script.up(1)
    lines = [line for name in "abcde" for line in script.igtl(query("GET_TRANS", name))]
    assert lines.count("note query_unanswered") == 3
    assert sum(line.startswith("igtl STATUS") for line in lines) == 5, "each is answered all the same"
    script.up(2)
    assert "note query_unanswered" in script.igtl(query("GET_TRANS", "f"), 2), "and others are reported"


LIVE = Config().watched()


def a_frame(step: int = 0) -> TFMessage:
    return TFMessage(
        (FrameTransform(Header(T0_NS + step, "base"), "tool", (0.1 + step, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)),)
    )


@pytest.mark.parametrize("source", ["topic", "tf", "list"])
@pytest.mark.parametrize("name", ["TDATA", "QTDATA"])
def test_the_clients_of_the_library_get_what_they_ask_for(name: str, source: str) -> None:
    """TrackingDataClient and QuaternionTrackingDataClient: their own name as the device, and the frame "Patient"."""
    rows = (TfOutRow(frames=("tool",), base="base"),) if source == "tf" else ()
    script = Script(Config(tf_out=rows).watched())
    script.up(1)
    lines = script.igtl(query(f"STT_{name}", f"{name}Client", StartTracking(0, "Patient")))
    assert script.sent()[0].content == QueryReply(0) and "note stream_started" in lines
    assert "'Patient' is not known" in next(note.text for note in script.notes if note.code == "stream_started")
    for step in (1, 2):
        if source == "topic":
            lines = script.ros("/igtl/out/Tool", tool(x=0.1 + step))
        elif source == "tf":
            lines = script.ros("/tf", a_frame(step))
        else:
            lines = script.ros("/igtl/out/Polaris", tracking("tool"))
        device = "Polaris" if (source, name) == ("list", "TDATA") else f"{name}Client"
        assert f"igtl {name}/{device} v1 to 1" in lines
    elements = next(one for one in script.sent() if one.type == name).content.elements  # type: ignore[attr-defined]
    place = elements["matrix"][0][9:] if name == "TDATA" else elements["position"][0]
    assert place.tolist()[1:] == pytest.approx([200.0, 300.0])


@pytest.mark.parametrize(
    "asked, reason",
    [
        (("STT_TDATA", "Polaris", StartTracking(0, "Femur")), "the frame 'Femur' is not known"),
        (("STT_STRING", "Text", Raw(b"")), "streams of STRING cannot be requested"),
    ],
)
def test_a_refused_stream_has_its_reason(asked: tuple[str, str, object], reason: str) -> None:
    script = Script(LIVE)
    script.up(1)
    script.igtl(query(*asked))
    (note,) = (note for note in script.notes if note.code == "stream_refused")
    assert reason in note.text


def test_a_query_with_the_name_of_the_client_gets_the_only_one_of_the_type() -> None:
    script = Script(LIVE)
    script.up(1)
    script.ros("/igtl/out/Tool", tool())
    assert "igtl TRANSFORM/Tool v1 to 1" in script.igtl(query("GET_TRANS", "Client"))
    script.ros("/igtl/out/Probe", tool("probe"))
    lines = script.igtl(query("GET_TRANS", "Client"))
    assert not any(line.startswith("igtl TRANSFORM") for line in lines), "which of the two is not known"
