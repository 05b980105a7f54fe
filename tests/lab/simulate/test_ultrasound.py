"""The sweep goes through the real gateway, and what was swept stacks up to the phantom."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.wire import Message, decode
from igtl_gateway.wire.text import String
from igtl_gateway_lab.simulate import ultrasound
from igtl_gateway_lab.simulate.actor import Actor, Received, RosReceived, RosSent, Sent
from igtl_gateway_lab.simulate.stage import play_offline
from igtl_gateway_lab.simulate.ultrasound import Navigator, Scanner

PICTURES = 16


def played(actors: tuple[Actor, ...], limit_s: float = 10.0) -> list[Entry]:
    return list(play_offline(actors, ultrasound.CONFIG, limit_s=limit_s))


@pytest.fixture(scope="module")
def sweep() -> tuple[Scanner, Navigator, list[Entry]]:
    scanner, navigator = Scanner(PICTURES), Navigator()
    return scanner, navigator, played((scanner, navigator))


def test_both_are_content(sweep: tuple[Scanner, Navigator, list[Entry]]) -> None:
    scanner, navigator, _ = sweep
    assert scanner.done and navigator.done
    assert scanner.report().good and navigator.report().good, (scanner.report(), navigator.report())


def test_the_slices_stack_up_to_the_phantom(sweep: tuple[Scanner, Navigator, list[Entry]]) -> None:
    judged, found = sweep[0].report().facts, sweep[1].report().facts
    assert judged["bone_points"] == found["bone_points"] > 10 * PICTURES
    assert judged["bone_rms_mm"] < 0.3
    assert judged["wall_points"] > 20 * PICTURES and judged["wall_rms_mm"] < 0.3
    assert judged["needle_off_mm"] < 0.3
    assert found["swept_mm"] == pytest.approx(60, abs=2) and found["path_mm"] > found["swept_mm"]


def test_pictures_and_poses_are_paired_by_stamp(sweep: tuple[Scanner, Navigator, list[Entry]]) -> None:
    _, navigator, log = sweep
    facts = navigator.report().facts
    assert (facts["pictures"], facts["paired"]) == (PICTURES, PICTURES - 1), "one had no reference"
    stamps = {
        topic: [message.unpack(entry.data()).header.stamp_ns for entry in log if entry.channel == topic]
        for topic, message in (
            ("/igtl/in/Image_Probe/volume", Volume),
            ("/igtl/in/ProbeToTracker/transform", TransformStamped),
        )
    }
    pictures, poses = stamps.values()
    assert pictures == poses and len(set(pictures)) == PICTURES
    assert set(np.diff(pictures)) == {ultrasound.FRAME_NS}


def test_tf_leads_from_the_pictures_to_the_tracker(sweep: tuple[Scanner, Navigator, list[Entry]]) -> None:
    log = sweep[2]
    frames = Counter(
        (frame.header.frame_id, frame.child_frame_id)
        for entry in log
        if entry.channel == "/tf"
        for frame in TFMessage.unpack(entry.data()).transforms
    )
    assert frames == {("Tracker", "Probe"): PICTURES, ("Tracker", "Reference"): PICTURES - 1}
    picture = next(Volume.unpack(entry.data()) for entry in log if entry.type == Volume.TYPE)
    assert picture.header.frame_id == "Probe"
    assert picture.spacing[:2] == pytest.approx((0.000125, 0.000125))


class Wrong(Navigator):
    """A navigator that receives the poses of the probe with a small offset."""

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        if isinstance(heard, RosReceived) and heard.topic.startswith("/igtl/in/ProbeToTracker"):
            pose = TransformStamped.unpack(heard.cdr)
            x, y, z = pose.translation
            heard = replace(heard, cdr=replace(pose, translation=(x + 0.001, y, z - 0.001)).pack())
        return super().receive(now_ns, heard)


def test_a_millimetre_is_seen_in_the_report() -> None:
    scanner, navigator = Scanner(PICTURES), Wrong()
    played((scanner, navigator))
    assert scanner.done and not scanner.report().good
    assert scanner.report().facts["needle_off_mm"] > ultrasound.GOOD_MM


class Lossy(Navigator):
    """A navigator that does not get its last picture."""

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        if isinstance(heard, RosReceived) and heard.type == Volume.TYPE and len(self._found) == PICTURES - 1:
            return ()
        return super().receive(now_ns, heard)


def test_what_does_not_come_is_not_waited_for() -> None:
    scanner, navigator = Scanner(PICTURES), Lossy()
    played((scanner, navigator))
    assert scanner.done and navigator.done
    facts = navigator.report().facts
    assert facts["pictures"] == PICTURES - 1 and facts["announced"] == PICTURES
    assert f"received {PICTURES - 1} pictures of {PICTURES}" in navigator.report().lines


def test_an_empty_sweep_is_answered_with_an_error() -> None:
    navigator = Navigator()
    navigator.begin(0)
    finished = RosString("finished: 0 pictures").pack()
    said = list(navigator.receive(5, RosReceived("/igtl/in/Sweep/string", "std_msgs/msg/String", finished)))
    assert [words.topic for words in said if isinstance(words, RosSent)] == ["/ultrasound/status"]
    assert navigator.done and not navigator.report().good


def test_the_scanner_begins_when_it_is_asked_to() -> None:
    scanner = Scanner(PICTURES)
    scanner.begin(0)
    waits = scanner.due_ns is None
    assert waits and not scanner.done and not scanner.report().good
    scanner.receive(1000, Message("STRING", "Request", String.of("StartSweep")))
    assert scanner.due_ns is not None
    first = [message for message in scanner.act(scanner.due_ns) if isinstance(message, Message)]
    assert [message.device_name for message in first] == ["ReferenceToTracker", "ProbeToTracker", "Image_Probe"]
    assert len({message.ticks for message in first}) == 1


def test_the_duration_is_that_of_the_sweep() -> None:
    scanner, _ = ultrasound.actors(0.75)
    scanner.begin(0)
    scanner.receive(0, Message("STRING", "Request", String.of("StartSweep")))
    sent = 0
    while scanner.due_ns is not None and scanner.due_ns < 750_000_000:
        sent += any(isinstance(said, Message) and said.type == "IMAGE" for said in scanner.act(scanner.due_ns))
    assert sent == 15


def test_the_answer_goes_out_as_openigtlink(sweep: tuple[Scanner, Navigator, list[Entry]]) -> None:
    out = {entry.channel: decode(entry.data()) for entry in sweep[2] if entry.kind is Kind.IGTL_OUT}
    assert set(out) == {
        "STRING/Request",
        "POLYDATA/BoneSurface",
        "POLYDATA/VesselWall",
        "TRANSFORM/NeedleToReference",
        "STATUS/Navigator",
    }
