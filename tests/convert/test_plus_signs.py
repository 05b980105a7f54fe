"""The signs of PLUS: single messages, and frames of equal stamps in an equal order."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.plus_signs import (
    MAX_SEARCHED,
    TrackedFrames,
    frame_of_picture,
    is_any_plus,
    is_recent_plus,
    may_show_plus,
    whole_tool_names,
)
from igtl_gateway.wire import Message, decode
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import TrackingData
from igtl_gateway.wire.transform import Position, Transform
from tests.peers.plus_like import PLACE, client_info, failed_reply
from tests.tables import table

PICTURE = Image((2, 2, 1), 3, bytes(4))
REPLY = '<CommandReply Name="A" Status="SUCCESS" />'


def tools(count: int) -> TrackingData:
    return TrackingData(np.zeros(count, TrackingData.DTYPE))


@table(
    ("message", "recent", "any_plus"),
    [
        (Message("CLIENTINFO", "", ClientInfo.of(client_info('TDATAResolution="0"'))), True, True),
        (Message("CLIENTINFO", "", ClientInfo.of(client_info())), False, True),
        (Message("STRING", "ACK_7", String.of(client_info('TDATAResolution="0"'))), False, False),
        (decode(failed_reply(1, "no")), True, False),
        (Message("COMMAND", "Plus", Command(1, "A", REPLY.encode())), False, False),
        (Message("RTS_COMMAND", "Plus", Command(1, "A", b"<CommandReply />")), False, False),
        (Message("RTS_COMMAND", "Plus", Command(1, "A", REPLY.encode("utf-16-be"), 1013)), True, False),
        (Message("TDATA", "TDATA_2Elem", tools(2)), True, False),
        (Message("TDATA", "TDATA_3Elem", tools(2)), False, False),
        (Message("TDATA", "Tools", tools(2)), False, False),
        (Message("STRING", "ACK_7", String.of(REPLY)), False, True),
        (Message("STRING", "ACK_12345678901", String.of(REPLY)), False, False),
        (Message("STRING", "ACK_", String.of(REPLY)), False, False),
        (Message("STRING", "ACK_7", String.of("ready")), False, False),
        (Message("STATUS", "ACK_7", Status(1)), False, False),
    ],
)
def test_single_messages(message: Message, recent: bool, any_plus: bool) -> None:
    assert (is_recent_plus(message), is_any_plus(message)) == (recent, any_plus)


def test_which_streams_may_still_show_plus() -> None:
    assert may_show_plus(Message("STRING", "ACK_7", String.of("ready")))
    assert not may_show_plus(Message("STRING", "Text", String.of(REPLY)))
    assert not may_show_plus(Message("STATUS", "ACK_7", Status(1)))


@table(
    ("device", "frame"),
    [
        ("Image_Tracker", "Tracker"), ("US_Image_Tracker", "Tracker"), ("Image_2", ""), ("_Tracker", ""), ("Image", ""),
        ("Image_", ""), ("", ""), ("Image_2nd", ""), ("Image_T2", "T2"), ("__", ""),
    ],
)  # fmt: skip
def test_frames_of_pictures(device: str, frame: str) -> None:
    assert frame_of_picture(device) == frame_of_picture(device, ["ProbeToTrackerTransform"], naming=1) == frame


@table(
    ("device", "keys", "frame"),
    [
        ("Image_Track er", [], "Track_er"),
        ("Image_3DTracker", [], "3DTracker"),
        ("Image_Ref_Frame", [], "Frame"),
        ("Image_Ref_Frame", ["ProbeToRef_FrameTransform"], "Ref_Frame"),
        ("Image_Ref_Frame", ["Ref_FrameToTrackerTransformStatus"], "Ref_Frame"),
        ("Image_Ref_Frame", ["ProbeToFrameTransform", "Timestamp"], "Frame"),
        ("Image_A_2", ["ATo2Transform"], "2"),
    ],
)
def test_frames_of_pictures_as_plus_names_them(device: str, keys: list[str], frame: str) -> None:
    assert frame_of_picture(device, keys) == frame


@table(
    ("names", "items", "whole"),
    [
        (["NeedleBaseToReferenc"], {"NeedleBaseToReferenceIndex": "0"}, ["NeedleBaseToReference"]),
        (["Probe", "NeedleBaseToReferenc"], {"NeedleBaseToReferenceIndex": "1"}, ["Probe", "NeedleBaseToReference"]),
        (["NeedleBaseToReferenc"], {"NeedleBaseToReferenceIndex": "1"}, ["NeedleBaseToReferenc"]),
        (["NeedleBaseToReferenc"], {"NeedleBaseToReferenceIndex": "9" * 5000}, ["NeedleBaseToReferenc"]),
        (["NeedleBaseToReferenc"], {"StylusBaseToReferenceIndex": "0"}, ["NeedleBaseToReferenc"]),
        (["ProbeToTracker"], {"ProbeToTrackerIndex": "0"}, ["ProbeToTracker"]),
        ([], {"Index": "0", "": "0"}, []),
    ],
)
def test_names_of_tools_that_plus_has_cut(names: list[str], items: dict[str, str], whole: list[str]) -> None:
    assert whole_tool_names(names, items.items()) == whole


def pose(device: str, ticks: int, version: int = 1, kind: str = "TRANSFORM") -> Message:
    content = Transform(PLACE) if kind == "TRANSFORM" else Position((0.0, 0.0, 0.0))
    return Message(kind, device, content, ticks, version)


def picture(device: str, ticks: int) -> Message:
    return Message("IMAGE", device, PICTURE, ticks)


def found_at(messages: Iterable[Message], *, streams: bool = True) -> int:
    """Number of messages until PLUS is found; -1: it is not."""
    search = TrackedFrames(streams)
    return next((number for number, each in enumerate(messages, 1) if search.follow(each)), -1)


def frames(count: int, *names: str, step: int = 5) -> list[Message]:
    return [pose(name, 1000 + step * number) for number in range(count) for name in names]


@pytest.mark.parametrize("streams", [True, False])
def test_a_second_frame_of_several_poses_shows_plus(streams: bool) -> None:
    assert found_at(frames(2, "AToB", "CToB"), streams=streams) == 4
    assert found_at(frames(2, "AToB", "CToB", "DToB"), streams=streams) == 6


def test_a_server_that_sends_frames_of_one_pose_shows_itself_with_the_ninth() -> None:
    assert found_at(frames(20, "AToB")) == 9
    assert found_at(frames(20, "AToB"), streams=False) == -1


def test_frames_of_pictures_and_poses_of_both_types() -> None:
    one = [picture("Image_Tracker", 1000), pose("AToB", 1000, kind="POSITION")]
    two = [picture("Image_Tracker", 1005), pose("AToB", 1005, kind="POSITION")]
    assert found_at([*one, *two]) == 4
    # a transform of the same name is another message
    assert found_at([*one, picture("Image_Tracker", 1005), pose("AToB", 1005)]) == -1


@table(
    "messages",
    [
        frames(20, "Tool", "Probe"),  # names of another form
        frames(20, "aToB", "CToB"),
        frames(20, "AToB", "CToB", step=0),  # one stamp for all
        frames(20, "AToB", step=-5),  # stamps that go back
        [pose("AToB", 0), *frames(20, "AToB", "CToB")],  # PLUS stamps all poses
        [pose("AToB", 1000, version=2), *frames(20, "AToB", "CToB")],
        [pose("Tool", 1000), *frames(20, "AToB", "CToB")],  # and names all of them
        [each for number in range(9) for each in frames(2 + number, "AToB", "CToB")[-1 - number % 2 :]],
    ],
    ids=["names", "small letter", "one stamp", "backwards", "no stamp", "version 2", "one other name", "other orders"],
)
def test_what_plus_does_not_send(messages: list[Message]) -> None:
    assert found_at(messages) == -1


def test_the_order_of_a_frame_must_be_the_same() -> None:
    swapped = [pose("AToB", 1000), pose("CToB", 1000), pose("CToB", 1005), pose("AToB", 1005)]
    assert found_at(swapped) == -1


def test_a_picture_of_another_name_is_passed_over_and_other_types_are_not_looked_at() -> None:
    others = [Message("STRING", "Text", String.of("x")), Message("UNHEARDOF", "A", Raw(b"x"))]
    one, two = frames(2, "AToB", "CToB")[:2], frames(2, "AToB", "CToB")[2:]
    assert found_at([*one, picture("Camera", 7), *others, *two]) == 7


def test_the_search_ends() -> None:
    search = TrackedFrames(True)
    pictures = [picture("Image_A", number + 1) for number in range(MAX_SEARCHED)]
    assert not any(search.follow(each) for each in pictures[:8]) and not search.is_over
    other, searched = TrackedFrames(True), []
    for each in [picture("Camera", 1)] * MAX_SEARCHED:
        searched.append((not other.is_over, other.must_see(pose("AToB", 1))))
        other.follow(each)
    assert searched == [(True, True)] * MAX_SEARCHED
    assert other.is_over and not other.must_see(pose("AToB", 1))
    assert not any(other.follow(each) for each in frames(5, "AToB", "CToB"))


def test_a_client_of_one_pose_is_not_searched_for_long() -> None:
    search, over = TrackedFrames(False), []
    for each in frames(4, "AToB"):
        search.follow(each)
        over.append(search.is_over)
    assert over == [False, False, False, True]


def test_which_messages_must_be_seen_one_by_one() -> None:
    search = TrackedFrames(True)
    assert search.must_see(pose("anything", 0)) and search.must_see(pose("A", 0, kind="POSITION"))
    assert search.must_see(picture("Image_A", 0)) and not search.must_see(picture("Camera", 0))
    assert not search.must_see(Message("STRING", "ACK_1", String.of("")))


@given(st.integers(0, MAX_SEARCHED + 3), st.integers(0, MAX_SEARCHED + 3))
def test_pictures_that_are_only_counted_count_as_those_that_are_followed(first: int, more: int) -> None:
    counted, followed = TrackedFrames(True), TrackedFrames(True)
    counted.passed_over(first)
    counted.passed_over(more)
    for _ in range(first + more):
        followed.follow(picture("Camera", 5))
    assert counted == followed
