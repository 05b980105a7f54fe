"""The checks on synthetic sessions: the findings of each case, and none in a session without defects."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.config.configuration import Config
from igtl_gateway.doctor import Observer
from igtl_gateway.doctor.observer import ExpectedLinks
from igtl_gateway.doctor.rules import RULES, judge
from igtl_gateway.gateway import LINK_DOWN, LINK_UP
from igtl_gateway.gateway.dialogue.probing import PROBE, PROBE_DEVICE, REPLY, REPLY_DEVICE
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.metadata import FULL_NAME
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import TRACKING_DTYPE, TrackingData
from igtl_gateway.wire.transform import Position, Transform
from tests.places import FIXTURES
from tests.script import T0_NS
from tests.tables import table

PEER = "10.0.0.2:50000"


def pose(x: float = 200.0, diagonal: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Transform:
    a, b, c = diagonal
    return Transform((a, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, c, x, 2 * x, -x))


class Scene:
    """A synthetic session: each entry is 20 ms after the previous one, with a stamp 5 ms before its arrival."""

    def __init__(self, intent: ExpectedLinks | None = None, **config: Any) -> None:
        self.observed = Observer(Config(**config), intent)
        self.now_ns = T0_NS

    def add(self, kind: Kind, data: bytes, link: int = 1, channel: str = "", source_ns: int = 0) -> Scene:
        self.now_ns += 20 * NS_PER_MS
        self.observed.add(Entry(1, self.now_ns, kind, channel, "", (data,), (link,) if link else (), source_ns))
        return self

    def up(self, link: int = 1, role: str = "server", peer: str = PEER) -> Scene:
        return self.add(Kind.LINK, Note(Level.INFO, LINK_UP, "up", data={"peer": peer, "role": role}).pack(), link)

    def down(self, link: int = 1, reason: str = "closed by the peer", **data: Any) -> Scene:
        return self.add(Kind.LINK, Note(Level.INFO, LINK_DOWN, "down", data={"reason": reason, **data}).pack(), link)

    def note(self, code: str, link: int = 0, level: Level = Level.WARN, **data: Any) -> Scene:
        return self.add(Kind.EDGE_NOTE, Note(level, code, f"text of {code}", "", data).pack(), link)

    def receive(
        self, content: Body, device: str = "Probe", kind: str = "TRANSFORM", age_ns: int = 5 * NS_PER_MS, **more: Any
    ) -> Scene:
        stamp_ns = self.now_ns + 20 * NS_PER_MS - age_ns
        link = more.pop("link", 1)
        stamp_ns = more.pop("stamp_ns", stamp_ns)
        message = Message(kind, device, content, ns_to_ticks(stamp_ns), **more)
        return self.add(Kind.IGTL_IN, join(encode(message)), link, f"{kind}/{device}", stamp_ns)

    def send(self, version: int, link: int = 1) -> Scene:
        message = Message("STATUS", "", Status(1), header_version=version)
        return self.add(Kind.IGTL_OUT, join(encode(message)), link)

    def after(self, ns: int) -> Scene:
        self.now_ns += ns
        return self

    @property
    def found(self) -> list[str]:
        return [finding.rule.id.removeprefix("IGTL-") for finding in judge(self.observed)]


CLIENT, SERVER = ExpectedLinks("client", "10.0.0.2:18944"), ExpectedLinks("server", "127.0.0.1:18944")


def scene(intent: ExpectedLinks | None = None, **config: Any) -> Scene:
    return Scene(intent, **config).up(role=intent.role if intent else "server")


def poses(made: Scene, xs: Iterable[float], **more: Any) -> Scene:
    for x in xs:
        made.receive(pose(x), **more)
    return made


def whole_seconds(made: Scene, every_ns: int) -> Scene:
    for _ in range(40):
        made.after(every_ns - 20 * NS_PER_MS).receive(pose(), stamp_ns=made.now_ns // NS_PER_S * NS_PER_S)
    return made


def images(made: Scene, spacings: Iterable[float]) -> Scene:
    for one in spacings:
        made.receive(Image((1, 1, 1), 3, b"\0", wire_matrix=(one, 0, 0, 0, one, 0, 0, 0, one, 0, 0, 0)), kind="IMAGE")
    return made


def fractions(made: Scene, per_second: int, every_ns: int = 70 * NS_PER_MS, imported: bool = False) -> Scene:
    """60 stamps of the present, whose fractions count ``per_second``; imported ones arrive at their stamps."""
    made.now_ns += 100 * NS_PER_MS
    for step in range(60):
        now_ns = made.now_ns + every_ns
        ticks = now_ns // NS_PER_S << 32 | now_ns % NS_PER_S * per_second // NS_PER_S
        made.now_ns = (ticks_to_ns(ticks) if imported else now_ns) - 20 * NS_PER_MS
        data = join(encode(Message("TRANSFORM", "Probe", pose(100.0 + step), ticks)))
        made.add(Kind.IGTL_IN, data, 1, "TRANSFORM/Probe", ticks_to_ns(ticks))
        made.now_ns = now_ns
    return made


def low_words(made: Scene) -> Scene:
    """As clients in MATLAB send them: the seconds where the fraction belongs."""
    for step in range(30):
        ticks = (made.now_ns + 20 * NS_PER_MS) // NS_PER_S
        data = join(encode(Message("TRANSFORM", "Probe", pose(100.0 + step), ticks)))
        made.add(Kind.IGTL_IN, data, 1, "TRANSFORM/Probe", ticks_to_ns(ticks))
    return made


def by_rows() -> TrackingData:
    """A quarter turn about z and a translation, row by row."""
    elements = np.zeros(1, TRACKING_DTYPE)
    elements["name"], elements["matrix"][0] = b"Tool", (0, -1, 0, 100, 1, 0, 0, 20, 0, 0, 1, 30)
    return TrackingData(elements)


def tools(name: bytes) -> TrackingData:
    elements = np.zeros(1, TRACKING_DTYPE)
    elements["name"], elements["matrix"][:, [0, 4, 8]], elements["matrix"][:, 9] = name, 1.0, 100.0
    return TrackingData(elements)


STEPS = range(12)
FULL = (Item.of(FULL_NAME, "ReferenceFrameToStereoCamera"), Item.of(FULL_NAME, "ReferenceFrameToOther"))

#: Case → session, and the rules that apply, in their order.
CASES: dict[str, tuple[Callable[[], Scene], list[str]]] = {
    "healthy": (lambda: poses(scene(CLIENT), range(100, 130)).down(), []),
    "no server": (lambda: Scene(CLIENT).note("connect_failed", peer="10.0.0.2:18944"), ["E101"]),
    "no server, recorded": (lambda: Scene().note("connect_failed", peer="x"), ["E101", "I704"]),
    "port taken": (lambda: Scene(SERVER).note("listen_failed"), ["E104"]),
    "refused": (lambda: Scene(SERVER).note("refused", peer=PEER), ["E108"]),
    "silent, recorded": (lambda: scene().down(), ["I704"]),
    "another protocol after a change of role": (
        lambda: Scene(SERVER).up(role="client").note("truncated", 1, head=b"SSH-2.0-".hex()),
        ["E107"],
    ),
    "lost in the stream": (
        lambda: poses(scene(), [100]).note("too_large", 1, head=bytes(range(58)).hex()),
        ["E107"],
    ),
    "announces too much": (lambda: poses(scene(), [1e2]).note("too_large", 1, head="0001" + b"IMAGE".hex()), ["E110"]),
    "cut": (lambda: poses(scene(), [100]).note("truncated", 1, head="0001" + b"IMAGE".hex()), ["W109"]),
    "leaves at a version": (lambda: scene(CLIENT).send(2).down(received_bytes=1), ["E203"]),
    "leaves at a version, inside a later message": (
        lambda: poses(scene(CLIENT), [100]).send(2).note("truncated", 1, head="0001" + b"IMAGE".hex()).down(),
        ["E203", "W109"],
    ),
    "leaves inside its first message": (
        lambda: scene(CLIENT).send(2).note("truncated", 1, head="0001" + b"IMAGE".hex()).down(received_bytes=8),
        ["W109"],
    ),
    "speaks TLS": (
        lambda: scene(CLIENT).send(1).note("truncated", 1, head="160301").down(received_bytes=3),
        ["E107"],
    ),
    "left by chance": (lambda: poses(scene(), [100]).send(2).down(), []),
    "left later": (lambda: scene(CLIENT).send(2).after(2 * NS_PER_S).down(received_bytes=1), []),
    "comes and goes": (
        lambda: poses(scene(), [100]).down().up(2).down(2).up(3).down(3),
        ["W112"],
    ),
    "reads slowly": (lambda: poses(scene(), [100]).note("queue_drop", peer=PEER), ["W114"]),
    "follows the version that it receives": (
        lambda: poses(poses(scene(), [100]).send(1).send(2), [200, 300], header_version=2),
        [],
    ),
    "goes back": (
        lambda: poses(poses(poses(scene(), [100]).send(2), [200], header_version=2), [300]),
        ["W204"],
    ),
    "goes back and rises": (
        lambda: poses(poses(poses(scene().send(2), [100], header_version=2), [200]), [300], header_version=2),
        ["W204"],
    ),
    "both versions": (lambda: poses(poses(scene(), [100]), [200], header_version=2), ["W204"]),
    "type in small letters": (lambda: scene().receive(Raw(b""), kind="Transform"), ["W208"]),
    "malformed": (lambda: scene().receive(Raw(b"abc")), ["E210"]),
    "stamps do not change": (lambda: poses(scene(), STEPS, stamp_ns=T0_NS), ["W302"]),
    "stamps of whole seconds": (lambda: whole_seconds(scene(), every_ns=150 * NS_PER_MS), ["W302", "I508"]),
    "stamps of a second each": (lambda: whole_seconds(scene(), every_ns=NS_PER_S), ["I508"]),
    "stamps of a regular clockwork": (lambda: poses(scene(), range(100, 130), age_ns=0), []),
    "stamps in the future": (lambda: scene().receive(pose(), age_ns=-NS_PER_S), ["W303"]),
    "stamps decrease": (lambda: scene().receive(pose()).receive(pose(), age_ns=100 * NS_PER_MS), ["W304"]),
    "stamps since the start": (lambda: scene().receive(pose(), stamp_ns=77 * NS_PER_S), ["W305"]),
    "stamps old": (lambda: scene().receive(pose(), age_ns=3 * NS_PER_S), ["W306"]),
    "full name known": (lambda: scene().receive(pose(), "n" * 20, header_version=2, metadata=FULL[:1]), []),
    "two under one name": (
        lambda: scene().receive(pose(), "n" * 20, header_version=2, metadata=FULL[:1])
        .receive(pose(), "n" * 20, header_version=2, metadata=FULL[1:]),
        ["W402"],
    ),
    "two peers, one name": (lambda: poses(poses(scene().up(2), [100]), [100], link=2), ["W402"]),
    "a peer that came back": (lambda: poses(poses(scene(), [100]).down().after(NS_PER_S).up(2), [100], link=2), []),
    "no name": (lambda: scene().receive(pose(), ""), ["W403"]),
    "bytes behind a zero": (lambda: scene().receive(pose(), "Probe\0old"), ["W404"]),
    "a name in the body": (lambda: scene().receive(tools(b"t" * 20), kind="TDATA"), ["W405"]),
    "a name in the body that fits": (lambda: scene().receive(tools(b"t" * 19), kind="TDATA"), []),
    "one topic": (lambda: scene().receive(pose(), "US probe").receive(pose(), "US_probe"), ["W406"]),
    "metres": (lambda: poses(scene(), [0.1 + step / 100 for step in STEPS]), ["W501"]),
    "metres by configuration": (lambda: poses(scene(igtl_unit="m"), [0.1 + step / 100 for step in STEPS]), []),
    "as small in metres": (lambda: poses(scene(), [0.001 * step for step in STEPS]), []),
    "a still tool at the origin": (
        lambda: poses(scene(), [0.3 * (-1) ** (step // 2) for step in range(40)]),
        [],
    ),
    "an offset near zero that stays": (lambda: poses(scene(), [0.1] * 12), ["I508"]),
    "millimetres twice": (lambda: scene().receive(pose(200_000.0)), ["W502"]),
    "not a number": (lambda: scene().receive(Position((float("nan"), 0.0, 0.0)), kind="POSITION"), ["E503"]),
    "both infinities": (
        lambda: scene().receive(Position((float("inf"), float("-inf"), 0.0)), kind="POSITION"),
        ["E503"],
    ),
    "scaled": (lambda: scene().receive(pose(diagonal=(2.0, 2.0, 2.0))), ["W504"]),
    "quaternion of no length": (
        lambda: scene().receive(Position((1e2, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5)), kind="POSITION"),
        ["W509"],
    ),
    "left-handed": (lambda: scene().receive(pose(diagonal=(1.0, 1.0, -1.0))), ["W505"]),
    "spacing in metres": (
        lambda: scene().receive(Image((1, 1, 1), 3, b"\0", wire_matrix=(2e-4, 0, 0, 0, 2e-4, 0, 0, 0, 2e-4, 0, 0, 0)),
                             kind="IMAGE"),
        ["W506"],
    ),
    "no spacing, then one": (lambda: images(scene(), [0.0, 1.0, 1.0]), ["W506"]),
    "a spacing, then none": (lambda: images(scene(), [1.0, 1.0, 0.0]), ["W506"]),
    "fractions in ns": (lambda: fractions(scene(), NS_PER_S), ["W307"]),
    "fractions in us": (lambda: fractions(scene(), 1_000_000), ["W307"]),
    "fractions in ms": (lambda: fractions(scene(), 1_000), ["W307"]),
    "fractions of the protocol": (lambda: fractions(scene(), 2**32), []),
    "fractions in ns, imported": (lambda: fractions(scene(), NS_PER_S, imported=True), ["W307"]),
    "fractions in ms, imported": (lambda: fractions(scene(), 1_000, imported=True), ["W307"]),
    "fractions of the protocol, imported": (lambda: fractions(scene(), 2**32, imported=True), []),
    # once a second at one moment of it: all fractions are below 10^9, and right
    "a steady phase": (lambda: fractions(scene(), 2**32, every_ns=NS_PER_S), []),
    "seconds in the low word": (lambda: low_words(scene()), ["W305"]),
    "denormal": (lambda: scene().receive(pose(x=3e-45)), ["W510"]),
    "rows for columns": (lambda: scene().receive(by_rows(), kind="TDATA"), ["W504"]),
    "a pause": (lambda: poses(poses(scene(), range(100, 130)).after(3 * NS_PER_S), [100]), ["W507"]),
    "a note": (lambda: poses(scene(), [100]).note("out_of_memory", level=Level.ERROR), ["W801"]),
}  # fmt: skip


@table("name", CASES)
def test_the_findings_of_each_case(name: str) -> None:
    make, expected = CASES[name]
    assert make().found == expected


def test_the_text_has_the_found_values() -> None:
    made = poses(scene(CLIENT), [0.1 + step / 100 for step in STEPS], stamp_ns=0)
    texts = {finding.rule.id: finding.match.text for finding in judge(made.observed)}
    assert texts["IGTL-W501"].startswith("all 12 positions are within 0.514 mm of the origin")
    assert texts["IGTL-W301"] == "12 of 12 messages have the stamp 0 (unset)"


@pytest.mark.parametrize(
    ("made", "rule", "named"),
    [
        (lambda: fractions(scene(), NS_PER_S), "W307", "count ns, not 2^-32 s"),
        (lambda: fractions(scene(), 1_000), "W307", "count ms"),
        (lambda: low_words(scene()), "W305", "MATLAB"),
        (lambda: scene().receive(by_rows(), kind="TDATA"), "W504", "openigtlink-rust"),
        (lambda: images(scene(), [0.0, 1.0]), "W506", "spacing of 0 mm in 1 of 2 images: C++ senders"),
        (lambda: scene().receive(Position((1.0, 2.0, 3.0), (0.0,) * 4), kind="POSITION"), "W509", "pygtlink"),
        (
            lambda: scene().receive(Position((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 2.0)), kind="POSITION"),
            "W509",
            "of 2, not",
        ),
        (lambda: scene().receive(Raw(b"TRANSFORMSTRING"), kind="CAPABILITY"), "E210", "OpenIGTLink-Java"),
    ],
)
def test_the_text_names_the_senders_that_do_it(made: Callable[[], Scene], rule: str, named: str) -> None:
    texts = {finding.rule.id: finding.match.text for finding in judge(made().observed)}
    assert named in texts[f"IGTL-{rule}"]


def test_what_deviates_and_is_read_is_a_warning_and_an_error_where_it_was_refused() -> None:
    plain = join(encode(Message("TRANSFORM", "Probe", pose(), ns_to_ticks(T0_NS))))
    for version, code in ((2, "E202"), (3, "E201")):
        data = bytes([0, version]) + plain[2:]
        assert scene().note("deviation_read", 1).add(Kind.IGTL_IN, data, source_ns=T0_NS).found == ["W209"]
        assert code in scene(reading=0).add(Kind.IGTL_IN, data).found
    texts = {finding.rule.id: finding.match.text for finding in judge(scene().add(Kind.IGTL_IN, data).observed)}
    assert (
        texts["IGTL-W209"].startswith("1 message with no extended header")
        and "openigtlink-rust 0.4.1" in texts["IGTL-W209"]
    )


def test_each_server_that_is_not_there() -> None:
    made = Scene()
    for server in ("a:1", "b:1", "a:1"):
        made.note("connect_failed", peer=server, reason="refused")
    texts = [finding.match.text for finding in judge(made.observed) if finding.rule.id == "IGTL-E101"]
    assert texts == ["no server at a:1: refused", "no server at b:1: refused"]


def test_each_reason_of_refusals_and_the_own_note_of_each_peer() -> None:
    made = Scene(SERVER)
    for reason in ("not in the allow-list", "page of a foreign origin", "page of a foreign origin"):
        made.note("refused", peer=PEER, reason=reason)
    for link in (1, 2):
        text, head = f"end of {link}", "0001" + b"IMAGE".hex()
        made.up(link=link).add(Kind.EDGE_NOTE, Note(Level.WARN, "truncated", text, "", {"head": head}).pack(), link)
    found = [(finding.rule.id, finding.match.text, finding.match.data) for finding in judge(made.observed)]
    refusals = [data for rule, _, data in found if rule == "IGTL-E108"]
    assert [one["reason"] for one in refusals] == ["not in the allow-list", "page of a foreign origin"]
    assert [one["count"] for one in refusals] == [1, 2]
    assert [text for rule, text, _ in found if rule == "IGTL-W109"] == ["end of 1", "end of 2"]


def test_milliseconds_that_the_session_has_read_are_said_to_be() -> None:
    made = fractions(scene(), 1_000)
    assert "they are read so" not in judge(made.observed)[0].match.text
    for stream in made.observed.streams.values():
        stream.milliseconds = 1
    texts = {finding.rule.id: finding.match.text for finding in judge(made.observed)}
    assert texts["IGTL-W307"].endswith("; they are read so")


def test_the_advice_names_the_senders_that_do_it() -> None:
    advice = {rule.id: rule.advice for rule in RULES}
    assert "OpenIGTLink4J" in advice["IGTL-W307"]
    assert "MATLAB" in advice["IGTL-E206"] and "pyIGTLink" in advice["IGTL-E210"]


def test_the_ledger_and_the_damage_of_a_recording() -> None:
    made = poses(scene(), [100])
    made.observed.damage, made.observed.losses = "cut off", {"dropped on the way to link 1": 3}
    assert made.found == ["E701", "W703"]


def test_a_recording_that_goes_on_is_not_damaged() -> None:
    made = poses(scene(), [100])
    made.observed.growing = "is being recorded"
    assert made.found == ["I705"]


def test_what_is_configured_may_be_in_what_cannot_be_read() -> None:
    made = scene()
    made.observed = Observer(Config.from_dict({"to_ros": [{"device": "Planner"}]}))
    made.observed.sources.is_recording = True
    assert "W607" in made.found
    made.observed.damage = "cut off"
    assert "W607" not in made.found


def test_streams_beyond_the_limit_are_not_observed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.doctor.observer.MAX_STREAMS", 3)
    made = scene()
    for number in range(5):
        made.receive(pose(), f"Probe{number}")
    assert (made.found, len(made.observed.streams)) == (["W702"], 3)


def test_the_fixtures_have_no_findings() -> None:
    """every-type has an invalid message of each kind, crtk commands that the guard refuses."""
    for path in sorted(FIXTURES.glob("*.mcap")):
        if path.stem not in {"every-type", "crtk", "lego"}:  # the last one for its size
            seen = Observer(Config())
            with SessionFile.open(path) as file:
                for entry in file.entries():
                    seen.add(entry)
            assert [one.rule.id for one in judge(seen) if one.rule.id not in {"IGTL-W301", "IGTL-W402"}] == [], path


def test_the_rules_are_a_table() -> None:
    assert all(rule.title and rule.advice and rule.section for rule in RULES)
    assert [finding for rule in RULES for finding in rule.check(Observer(Config(), CLIENT))] == []


def test_any_bytes_of_a_message_are_observed_without_error() -> None:
    data = bytearray(join(encode(Message("STRING", "a", String.of("b"), header_version=2))))
    for place in range(len(data)):
        for value in (0, 1, 255):
            made, bent = scene(), bytes(data[:place] + bytes([value]) + data[place + 1 :])
            made.add(Kind.IGTL_IN, bent)
            judge(made.observed)
            assert sum(peer.messages + bool(peer.head) for peer in made.observed.peers.values()) == 1


def test_a_server_that_closes_at_once_is_not_silent() -> None:
    scene = Scene(CLIENT).up(role="client").down()
    assert scene.found == ["E116"]
    assert Scene().up(role="client").down().found == ["I704"]  # a recording: it might have been a port scan


@pytest.mark.parametrize("reason", ["stopped", "closed by the peer"])
def test_a_server_that_stays_silent_is_silent(reason: str) -> None:
    scene = Scene(CLIENT).up(role="client").after(3 * NS_PER_S).down(reason=reason)
    assert scene.found == ["E106"]


@pytest.mark.parametrize("number", [9, 10, 104])
def test_poses_that_do_not_change(number: int) -> None:
    scene = Scene().up()
    for _ in range(number):
        scene.receive(pose())
    assert scene.found == (["I508"] if number >= 10 else [])
    assert scene.receive(pose(200.001)).found == []


def test_poses_that_only_turn_do_change() -> None:
    scene = Scene().up()
    for step in range(20):
        c, s = np.cos(0.1 * step), np.sin(0.1 * step)
        scene.receive(Transform((c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, 200.0, 10.0, 0.0)))
    assert scene.found == []


def test_one_of_several_tools_that_moves() -> None:
    def tools(x: float) -> TrackingData:
        elements = np.zeros(2, TRACKING_DTYPE)
        elements["name"] = [b"A", b"B"]
        elements["matrix"] = [(1, 0, 0, 0, 1, 0, 0, 0, 1, 300, 400, 500), (1, 0, 0, 0, 1, 0, 0, 0, 1, x, 400, 500)]
        return TrackingData(elements)

    scene = Scene().up()
    for _ in range(20):
        scene.receive(tools(300.0), kind="TDATA")
    assert scene.found == ["I508"]
    assert scene.receive(tools(301.0), kind="TDATA").found == []


def test_the_probe_of_another_doctor_is_no_traffic() -> None:
    assert Scene().up().receive(PROBE, PROBE_DEVICE, "STATUS", stamp_ns=0).found == ["I704"]


def test_a_gateway_is_recognised_by_its_reply() -> None:
    scene = Scene(CLIENT).up(role="client").receive(REPLY, REPLY_DEVICE, "STATUS").after(3 * NS_PER_S)
    assert scene.found == ["I117"]
