"""What the gateway keeps of images and of ROS messages has a limit in bytes, and depends on the inputs only."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import LISTENED, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import EmptyQuery
from tests.gateway.fastpath.test_passage_streams import check_recording, scene, wait_for
from tests.script import Script

#: Of a picture, of which two are within 1 MiB, beside the newest.
SIDE = 700


def whole(device: str, value: int = 1, side: int = SIDE) -> Message:
    return Message("IMAGE", device, Image((side, side, 1), 3, bytes([value]) * (side * side)))


def part(device: str, value: int = 9, side: int = SIDE) -> Message:
    return Message("IMAGE", device, Image((side, side, 1), 3, bytes([value]), subvol_size=(1, 1, 1)))


def picture(side: int = SIDE) -> rosmsg.Image:
    return rosmsg.Image(Header(1, "base"), side, side, "mono8", 0, side, bytes(side * side))


def looked(script: Script) -> None:
    """What happens once a second."""
    script.session.collect()
    script.tick()


def with_four_devices(config: Config) -> Script:
    script = Script(config)
    for device in "ABCD":
        script.igtl(whole(device))
    script.igtl(whole("A"))  # B is the one that was used least recently
    looked(script)
    return script


def again(config: Config, log: list[Entry]) -> list[bytes]:
    """The outputs that the inputs of a log cause in another session, on the full path."""
    session = Session(Gateway(config, fast_path=False))
    return [output.data() for entry in log if entry.kind.is_input for output in session.recorded(entry)]


def test_a_part_of_an_image_that_was_forgotten_is_refused_with_its_reason() -> None:
    script = with_four_devices(config := Config(keep_mib=1))
    assert script.igtl(part("B")) == ["note conversion"]
    (note,) = script.notes
    assert "IMAGE 'B': found a part of an image that is not kept" in note.text and "1 MiB (keep_mib)" in note.text
    assert script.gateway.ledger.to_dict()["igtl_in"]["IMAGE/B"]["dropped"] == {"no_base": 1}
    assert [script.igtl(part(device)) for device in "AC"] == [["ros /igtl/in/A/image"], ["ros /igtl/in/C/image"]]
    script.igtl(whole("B"))
    assert script.igtl(part("B")) == ["ros /igtl/in/B/image"], "a whole image begins again"
    assert again(config, script.log) == [entry.data() for entry in script.log if not entry.kind.is_input]


def test_an_image_that_was_forgotten_stays_so_while_others_are() -> None:
    """The first part was refused, and once more was forgotten, those after the next tick began a volume of parts."""
    script = with_four_devices(Config(keep_mib=1))
    for device in "EFG":
        script.igtl(whole(device))
    looked(script)
    assert script.igtl(part("B")) == ["note conversion"]


def test_recordings_without_the_setting_forget_nothing() -> None:
    script = with_four_devices(Config())
    assert [script.igtl(part(device)) for device in "ABCD"] == [[f"ros /igtl/in/{device}/image"] for device in "ABCD"]
    script.session.collect()
    assert script.gateway.due_ns is None


def test_a_query_for_what_was_forgotten_has_its_own_reason() -> None:
    script = Script(config := Config(keep_mib=1))
    script.up(1)
    for topic in ("one", "two", "three", "four"):
        script.ros(f"/igtl/out/{topic}", picture())
    looked(script)
    answered = [script.igtl(Message("GET_IMAGE", device, EmptyQuery())) for device in ("one", "two", "three")]
    assert ["igtl IMAGE/two v1 to 1" in answered[1], "igtl IMAGE/three v1 to 1" in answered[2]] == [True, True]
    assert answered[0][-1] == "note query_unanswered"
    texts = [note.text for note in _notes(script) if "GET_IMAGE of one" in note.text]
    assert texts and "is not kept: messages of all topics exceed keep_mib" in texts[0]
    script.ros("/igtl/out/one", picture())
    assert "igtl IMAGE/one v1 to 1" in script.igtl(Message("GET_IMAGE", "one", EmptyQuery()))
    assert again(config, script.log) == [entry.data() for entry in script.log if not entry.kind.is_input]


def _notes(script: Script) -> list[Note]:
    return [Note.unpack(entry.data()) for entry in script.log if entry.kind is Kind.NOTE]


def test_latched_messages_and_the_newest_are_kept_whatever_their_size() -> None:
    """A scan that a late joiner, or its parts, need is larger than the limit of what comes in numbers."""
    rows = tuple(ToIgtlRow(topic=f"/igtl/out/{name}", qos=Qos(latched=True)) for name in ("scan", "mask"))
    script = Script(Config(keep_mib=1, to_igtl=(*rows, ToIgtlRow())))
    for topic in ("scan", "mask", "picture"):
        script.ros(f"/igtl/out/{topic}", picture(1_100))
    script.igtl(whole("Scan", side=1_100))
    looked(script)
    sent = script.up(1)
    assert {"igtl IMAGE/scan v1 to 1", "igtl IMAGE/mask v1 to 1"} <= set(sent)
    assert script.igtl(part("Scan", side=1_100)) == ["ros /igtl/in/Scan/image"]
    assert "igtl IMAGE/picture v1 to 1" in script.igtl(Message("GET_IMAGE", "picture", EmptyQuery()))


@pytest.mark.parametrize(("size", "stays"), [(64 << 10, True), ((64 << 10) + 1, False)])
def test_messages_of_64_kib_are_kept_whatever_their_number(size: int, stays: bool) -> None:
    """The poses and states of any number of robots are there for a query."""

    def row(width: int) -> rosmsg.Image:
        return rosmsg.Image(Header(1, "base"), 1, width, "mono8", 0, width, bytes(width))

    message = row(size - len(row(0).pack()))
    assert len(message.pack()) == size
    script = Script(Config(keep_mib=1))
    script.up(1)
    for number in range(20):
        script.ros(f"/igtl/out/p{number}", message)
    looked(script)
    sent = script.igtl(Message("GET_IMAGE", "p0", EmptyQuery()))
    assert ("igtl IMAGE/p0 v1 to 1" in sent) is stays


def with_three_latched(config: Config) -> Script:
    script = Script(config)
    for topic, side in (("plan", 300), ("scan", 1_100), ("mask", 900)):
        script.ros(f"/igtl/out/{topic}", picture(side))
    looked(script)
    return script


def forgotten(script: Script) -> list[Note]:
    return [note for note in _notes(script) if note.code == "latched_forgotten"]


LATCHED = (ToIgtlRow(topic="/igtl/out/*", qos=Qos(latched=True)),)


def test_the_largest_latched_messages_are_forgotten_beyond_their_limit() -> None:
    """40 volumes of 256 MiB stayed for the life of the bridge: 10 GB."""
    script = with_three_latched(config := Config(latched_mib=1, to_igtl=LATCHED))
    (note,) = forgotten(script)
    assert note.stream == "/igtl/out/scan"
    assert note.text == (
        "/igtl/out/scan: 1.2 MiB of latched messages are forgotten, who joins gets none before the next: those of all "
        "topics exceed 1 MiB (latched_mib)"
    )
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/scan"]["latched_forgotten"] == 1
    sent = script.up(1)
    assert [one for one in sent if one.startswith("igtl")] == ["igtl IMAGE/plan v1 to 1", "igtl IMAGE/mask v1 to 1"]
    script.igtl(Message("GET_IMAGE", "scan", EmptyQuery()))
    assert any("messages of all topics exceed latched_mib" in note.text for note in _notes(script))
    assert script.ros("/igtl/out/scan", picture(1_100)) == ["igtl IMAGE/scan v1 to 1"], "live messages pass"
    looked(script)
    assert len(forgotten(script)) == 1, "noted once for each topic"
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/scan"]["latched_forgotten"] == 2
    assert again(config, script.log) == [entry.data() for entry in script.log if not entry.kind.is_input]


def test_recordings_without_the_limit_forget_no_latched_message() -> None:
    script = with_three_latched(Config(keep_mib=1, to_igtl=LATCHED))
    assert not forgotten(script)
    assert len([one for one in script.up(1) if one.startswith("igtl")]) == 3


def test_messages_that_wait_for_a_first_subscriber_have_the_same_limit() -> None:
    """They kept the message and the image that it became: 1,560 MB for 40 volumes of 20 MB."""
    script = Script(Config(latched_mib=1))
    script.gateway.has_subscriber = lambda *_: False
    volumes = {device: Image((side, side, 2), 3, bytes(2 * side * side)) for device, side in (("A", 500), ("B", 600))}
    for device, volume in volumes.items():
        script.igtl(Message("IMAGE", device, volume))
    looked(script)
    (note,) = forgotten(script)
    assert note.stream == "/igtl/in/B/volume"
    assert script.gateway.ledger.to_dict()["ros_out"]["/igtl/in/B/volume"] == {"latched_forgotten": 1}
    for device, built in (("A", ["ros /igtl/in/A/volume"]), ("B", [])):
        assert listened(script, f"/igtl/in/{device}/volume") == built


def listened(script: Script, topic: str) -> list[str]:
    """What the first subscriber of a topic causes."""
    return script.feed(Kind.EDGE_NOTE, (Note(Level.INFO, LISTENED, "", topic).pack(),))


def test_a_live_session_that_forgets_is_verified(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Streams pass natively, in any order; what is forgotten follows from the recorded inputs all the same."""
    path, config = tmp_path / "session.mcap", Config(keep_mib=1).watched()
    with scene(monkeypatch, config, path) as here:
        peer, sent, refused = here.connect(), 0, 0
        until = time.monotonic() + 6
        while time.monotonic() < until and refused < 2:
            for device in "ABC" * 6:
                sent += 1
                peer.send(join(encode(whole(device, sent % 200, 400))))
                here.send_ros(picture(400), f"/igtl/out/{device}")
            for device in "DEA":
                sent += 2
                peer.send(join(encode(whole(device))))
                peer.send(join(encode(part(device))))
                here.send_ros(picture(), f"/igtl/out/{device}")
            wait_for(lambda sent=sent: here.received("igtl_in") == sent)
            here.bridge.hub.tick()
            for device in "ABCDE":
                sent += 2
                side = SIDE if device in "ADE" else 400
                peer.send(join(encode(part(device, side=side))))
                peer.send(join(encode(Message("GET_IMAGE", device, EmptyQuery()))))
            wait_for(lambda sent=sent: here.received("igtl_in") == sent)
            streams = here.bridge.ledger()["streams"]["igtl_in"]
            refused = sum(one.get("dropped", {}).get("no_base", 0) for one in streams.values())
        assert refused >= 2
    check_recording(path, config, here.bridge.losses)


@pytest.mark.parametrize(
    ("name", "answer"), [("GET_TRANS", "TRANSFORM"), ("GET_POSITION", "POSITION"), ("GET_QTRANS", "POSITION")]
)
def test_a_message_that_cannot_be_converted_is_no_answer(name: str, answer: str) -> None:
    """It was reported when it came; the query is answered, with the reason that there is none."""
    script = Script()
    script.up(1)
    broken = rosmsg.TransformStamped(Header(1, "base"), "tool", (0.1, 0.2, 0.3), (math.nan, 0.0, 0.0, 1.0))
    assert script.ros("/igtl/out/Tool", broken) == ["note conversion"]
    lines = script.igtl(Message(name, "Tool", EmptyQuery()))
    assert "note query_unanswered" in lines and "note internal_error" not in lines
    whole = rosmsg.TransformStamped(Header(1, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    script.ros("/igtl/out/Tool", whole)
    lines = script.igtl(Message(name, "Tool", EmptyQuery()))
    assert "note query_unanswered" not in lines and f"igtl {answer}/Tool v1 to 1" in lines
