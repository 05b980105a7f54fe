"""What each listener of a replay gets: by its profile, by what it has shown, and exactly."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.app.player import Player
from igtl_gateway.app.replay_listeners import Listeners
from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.convert.profiles import BY_NAME
from igtl_gateway.convert.substitutes import SLICER_READS
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Header, Item, Message, Raw, decode, encode
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import Attribute, PolyData
from igtl_gateway.wire.query import split_query
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import Status, String
from tests.peers.plus_like import PlusReceiver, client_info
from tests.places import ROOT

EVERY_TYPE = ROOT / "fixtures" / "every-type.mcap"
HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item.of("dummy", "dummy"),))
RGBA = 4


def entry(content: object, igtl_type: str, version: int = 1) -> Entry:
    items = (Item.of("key", "value"),) if version > 1 else ()
    parts = encode(Message(igtl_type, "D", content, 0, version, 0, items))  # type: ignore[arg-type]
    return Entry(1, 1, Kind.IGTL_OUT, f"{igtl_type}/D", igtl_type, tuple(parts))


def listeners(*said: Message, **settings: bool | str) -> Listeners:
    made = Listeners(**settings)  # type: ignore[arg-type]
    made.on_link(1, True, Note(Level.INFO, "link_up", "up", data={"peer": "127.0.0.1:5000", "role": "server"}))
    for message in said:
        made.on_frame(1, join(encode(message)))
    return made


def got(made: Listeners, one: Entry) -> bytes | None:
    admitted = made.admit(one, [1])
    return None if admitted is None else join(admitted.payload)


def test_a_checksum_that_the_session_did_not_check_is_right_for_listeners() -> None:
    one = entry(Status(1), "STATUS")
    damaged = replace(one, payload=(join(one.payload)[:50] + bytes(8) + join(one.payload)[58:],))
    unchecked = {"acceptance": Acceptance(check_crc=False)}
    made = listeners(**unchecked)  # type: ignore[arg-type]
    assert got(made, damaged) == join(one.payload)
    made.fit(damaged, [1])
    assert sum(made.adapted.values()) == 2
    assert got(listeners(**unchecked, exact=True), damaged) == join(damaged.payload)  # type: ignore[arg-type]
    assert got(listeners(), damaged) == join(damaged.payload), "a message that the session rejected stays as it is"
    cut = replace(one, payload=(join(one.payload)[:-1],))
    assert got(listeners(**unchecked), cut) == join(cut.payload)  # type: ignore[arg-type]


def sent_of_every_type() -> list[Entry]:
    with SessionFile.open(EVERY_TYPE) as file:
        return [one for one in file.entries_of_kinds({Kind.IGTL_OUT}) if one.kind is Kind.IGTL_OUT]


def forms(made: Listeners, one: Entry) -> list[Message]:
    """What the listener gets for an entry, decoded."""
    admitted = made.admit(one, [1])
    return [decode(join(parts)) for parts, _ in made.fit(admitted, [1])] if admitted else []


def test_slicer_gets_no_query_and_no_reply_that_crashes_it() -> None:
    made = listeners(HELLO)
    for one in sent_of_every_type():
        if one.type == "RTS_COMMAND" or (split_query(one.type) is not None and one.type != "RTS_TDATA"):
            assert got(made, one) is None, one.type
    assert made.left_out["127.0.0.1:5000", "slicer", "GET_STATUS"]


def test_slicer_gets_no_recorded_reply_to_a_command() -> None:
    """It has not asked: its log would have a warning for each."""
    replies = [one for one in sent_of_every_type() if one.type == "RTS_COMMAND"]
    assert replies and not [one for one in replies if got(listeners(HELLO), one)]
    assert all(got(listeners(), one) for one in replies)


@pytest.mark.parametrize("sent, profile", [((HELLO,), "auto"), ((), "slicer")], ids=["recognised", "named"])
def test_slicer_gets_no_type_that_it_does_not_read_but_what_shows_the_same(
    sent: tuple[Message, ...], profile: str
) -> None:
    made = listeners(*sent, profile=profile)
    types: dict[str, set[str]] = {}
    for one in sent_of_every_type():
        types.setdefault(one.type, set()).update(message.type for message in forms(made, one))
    reads = {*SLICER_READS, "RTS_TDATA"}
    assert set().union(*types.values()) <= reads
    assert all(types[name] == {name} for name in reads & types.keys())
    assert types["TRAJ"] == {"POLYDATA"} and types["QTDATA"] == {"TRANSFORM"} and types["POSITION"] == {"TRANSFORM"}
    assert not types["SENSOR"] and not types["NDARRAY"] and not types["MYTYPE"]
    assert made.left_out["127.0.0.1:5000", "slicer", "SENSOR"] and made.adapted["127.0.0.1:5000", "slicer", "TRAJ"]


def test_a_substitute_has_its_stamp_its_metadata_and_no_name_of_another_stream() -> None:
    made = listeners(HELLO)
    position = BODIES["POSITION"].unpack(memoryview(np.array([1, 2, 3, 0, 0, 0, 1], ">f4").tobytes()))
    one = entry(position, "POSITION", version=2)
    (message,) = forms(made, one)
    assert (message.type, message.device_name, message.ticks) == ("TRANSFORM", "D", decode(join(one.payload)).ticks)
    assert [item.key for item in message.metadata] == ["key"]
    forms(made, entry(BODIES["TRANSFORM"].unpack(memoryview(bytes(48))), "TRANSFORM"))
    (message,) = forms(made, one)
    assert message.device_name.startswith("D_"), "TRANSFORM/D is another stream"


def test_who_reads_all_gets_the_message_beside_slicer() -> None:
    made = listeners(HELLO)
    made.on_link(2, True, Note(Level.INFO, "link_up", "up", data={"peer": "127.0.0.1:5001", "role": "server"}))
    made.on_frame(2, join(encode(Message("STATUS", "", Status(1), header_version=2))))
    position = BODIES["POSITION"].unpack(memoryview(np.array([1, 2, 3, 0, 0, 0, 1], ">f4").tobytes()))
    one = entry(position, "POSITION")
    assert [(decode(join(parts)).type, to) for parts, to in made.fit(one, [1, 2])] == [
        ("POSITION", [2]),
        ("TRANSFORM", [1]),
    ]


def test_slicer_gets_pixels_and_attributes_that_it_reads() -> None:
    made = listeners(HELLO)
    pixels = np.array([1, 2, 3, 4], "<u4")
    image = decode(got(made, entry(Image((2, 2, 1), 7, pixels.tobytes()), "IMAGE")) or b"").content
    assert isinstance(image, Image) and image.scalar_type == 10
    assert image.array.reshape(-1).tolist() == [1.0, 2.0, 3.0, 4.0]
    colours = Attribute(RGBA, "c", 4, np.arange(8, dtype=">f4"))
    surface = decode(got(made, entry(PolyData(np.zeros((2, 3), ">f4"), attributes=(colours,)), "POLYDATA")) or b"")
    assert isinstance(surface.content, PolyData) and surface.content.attributes[0].components == 9
    assert made.adapted == {("127.0.0.1:5000", "slicer", "IMAGE"): 1, ("127.0.0.1:5000", "slicer", "POLYDATA"): 1}


def test_a_listener_that_is_silent_gets_what_every_program_skips() -> None:
    made, plus = listeners(), PlusReceiver()
    for one in sent_of_every_type():
        if (data := got(made, one)) is not None:
            assert Header.unpack(data).version == 1 and not (split_query(one.type) and one.type != "RTS_TDATA")
            plus.receive([data])
    assert not plus.lost and len(set(plus.read)) > 10


@pytest.mark.parametrize("recorded", [1, 2])
def test_a_message_without_content_is_for_who_does_not_wait_for_it(recorded: int) -> None:
    """The C++ library waits for its default size, and pyigtl ends; 3D Slicer takes it for the answer "none"."""
    nothing = entry(Raw(b""), "TRANSFORM", recorded)
    assert got(listeners(), nothing) is None and got(listeners(profile="legacy-v1"), nothing) is None
    for profile in ("slicer", "plus", "default"):
        answer = got(listeners(profile=profile), nothing)
        assert (answer is None) == (profile == "plus" and recorded == 1)
    assert got(listeners(), entry(Status(1), "STATUS", recorded)) is not None


def test_a_listener_gets_what_it_has_shown_to_know() -> None:
    made = listeners(Message("NDARRAY", "A", Raw(b"")), Message("STATUS", "", Status(1), header_version=2))
    for one in sent_of_every_type():
        if split_query(one.type) is not None and one.type != "RTS_TDATA":
            assert got(made, one) is None
        elif one.type != "POLYDATA":  # may have attributes of nine components
            assert got(made, one) == join(one.payload)


def test_version_1_loses_the_metadata_and_nothing_else() -> None:
    one = entry(String.of("x"), "STRING", version=2)
    data = got(listeners(), one) or b""
    message, before = decode(data), decode(join(one.payload))
    assert (message.header_version, message.metadata, message.content) == (1, (), before.content)
    assert got(listeners(profile="holoscan"), entry(Status(1), "STATUS")) == join(
        encode(Message("STATUS", "D", Status(1), header_version=2))
    )


@pytest.mark.parametrize("settings", [{"exact": True}, {"profile": "default"}, {"relay": True}], ids=str)
def test_exact_is_every_byte(settings: dict[str, bool | str]) -> None:
    made = listeners(**settings)
    assert all(got(made, one) == join(one.payload) for one in sent_of_every_type())
    assert not made.left_out and not made.adapted


def test_a_relay_too_spares_a_listener_that_is_recognised() -> None:
    asked = entry(Raw(b""), "GET_STATUS")
    assert got(listeners(relay=True), asked) is not None
    assert got(listeners(HELLO, relay=True), asked) is None


def test_plus_is_recognised_and_keeps_its_stream() -> None:
    made, plus = listeners(Message("CLIENTINFO", "", ClientInfo.of(client_info('TDATAResolution="0"')))), PlusReceiver()
    plus.receive(data for one in sent_of_every_type() if (data := got(made, one)))
    assert not plus.lost and len(set(plus.read)) > 10


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_what_was_adapted_is_not_adapted_again(name: str) -> None:
    made = listeners(profile=name)
    for one in sent_of_every_type():
        if first := made.admit(one, [1]):
            found = made.fit(first, [1])
            if made._peers[1].may_send(first.type) or made.profile == "auto":  # else it gets others in its place
                assert [form[0] for form in found] == [first.payload]


def test_two_listeners_get_each_its_own() -> None:
    made = listeners(HELLO)
    made.on_link(2, True, Note(Level.INFO, "link_up", "up", data={"peer": "127.0.0.1:5001", "role": "server"}))
    made.on_frame(2, join(encode(Message("STATUS", "", Status(1), header_version=2))))
    one = entry(Image((1, 1, 1), 7, b"\1\0\0\0"), "IMAGE")
    assert made.admit(one, [1, 2]) is one
    forms = made.fit(one, [1, 2])
    assert [members for _, members in forms] == [[1], [2]] and forms[1][0] is one.payload
    asked = entry(Raw(b""), "GET_FOO")
    assert made.admit(asked, [1, 2]) is None and made.left_out.total() == 2


def test_damaged_bytes_are_sent_as_they_are() -> None:
    damaged = bytearray(join(entry(Image((1, 1, 1), 7, b"\1\0\0\0"), "IMAGE").payload))
    damaged[58:60] = b"\xff\xff"
    one = Entry(1, 1, Kind.IGTL_OUT, "IMAGE/D", "IMAGE", (bytes(damaged),))
    assert got(listeners(HELLO), one) == bytes(damaged)


@pytest.mark.parametrize("many", [False, True])
def test_the_player_counts_what_is_left_out(many: bool) -> None:
    made, sent = listeners(HELLO), list[Buffer]()
    entries = sent_of_every_type()

    def send(batch: list[Entry]) -> bool:
        sent.extend(join(one.payload) for one in batch)
        return True

    player = Player(
        lambda _start_ns: entries,
        lambda one: send([one]),
        SystemClock(),
        threading.Event(),
        rate=None,
        admit=lambda one: made.admit(one, [1]),
        send_all=(lambda batch: send(list(batch))) if many else None,
    )
    played = player.run()
    assert played.left_out == made.left_out.total() > 0
    assert played.messages == len(sent) == len(entries) - played.left_out
    assert Counter(Header.unpack(data).type for data in sent)["GET_STATUS"] == 0


@pytest.mark.parametrize("profile", ["auto", *sorted(BY_NAME)])
@pytest.mark.parametrize("exact", [False, True])
def test_what_is_known_of_a_type_changes_nothing(profile: str, exact: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches take a short way for what all listeners get as recorded; message by message each has its forms."""
    entries = sent_of_every_type() * 3
    heard = {len(entries) // 3: HELLO, len(entries) // 2: Message("CLIENTINFO", "", ClientInfo.of(client_info("")))}

    def played() -> tuple[list[tuple[bytes, int, str]], Counter[tuple[str, str, str]], set[str]]:
        made = listeners(profile=profile, exact=exact)
        made.on_link(2, True, Note(Level.INFO, "link_up", "up", data={"peer": "127.0.0.1:5001", "role": "server"}))
        found = []
        for at, one in enumerate(entries):
            if message := heard.get(at):
                made.on_frame(1, join(encode(message)))
            for payload, links, stream in made.fit_all(made.admit_all([one], [1, 2]), [1, 2]):
                found += [(bytes(join(payload)), link, stream) for link in links]
        return sorted(found), made.left_out + made.adapted, made._sent

    quick = played()
    monkeypatch.setattr(Listeners, "_as_recorded", lambda *_: False)
    assert quick == played()
