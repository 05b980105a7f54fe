"""No input makes the gateway stumble over itself: whatever comes, it answers with messages or with reasons."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.buffers import join
from igtl_gateway.config import Config, ToIgtlRow
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, IgtlRow
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import Status
from tests import strategies

# A number too large for float32 is a fact about the message; numpy must not print it on the user's console.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

OWN: tuple[type[RosMessage], ...] = (LinkStatusList, Metadata, RawMessage, CommandReply)
MESSAGES = (*(row.message for row in TO_ROS), *(row.message for row in TO_IGTL), *OWN)
CLASSES = {message.TYPE: message for message in MESSAGES}
NOW_NS = 1_700_000_000_000_000_000


def opened(config: Config) -> Session:
    """A session with one link of each header version."""
    session = Session(Gateway(config))
    session.input(NOW_NS, Kind.LINK, (Note(Level.INFO, LINK_UP, "up").pack(),), links=(1, 2))
    newer = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))
    session.input(NOW_NS, Kind.IGTL_IN, (newer,), links=(2,))
    return session


def check(entries: list[Entry]) -> None:
    """No defect, only outputs that can be read again."""
    for entry in entries:
        if entry.kind is Kind.NOTE:
            note = Note.unpack(entry.data())
            assert note.code != "internal_error", note.text
        elif entry.kind is Kind.IGTL_OUT:
            message = decode(entry.data())
            assert message.ticks != 0  # outgoing messages are always stamped
        elif entry.kind is Kind.ROS_OUT:
            CLASSES[entry.type].unpack(entry.data())


@given(st.lists(strategies.wire_bytes() | strategies.damaged_wire_bytes, min_size=1, max_size=4), st.booleans())
def test_igtl_in(inputs: list[bytes], check_crc: bool) -> None:
    session = opened(Config(check_crc=check_crc))
    for data in inputs:
        if len(data) >= 58:  # what the framer guarantees
            check(session.input(NOW_NS, Kind.IGTL_IN, (data,), links=(1,)))


@pytest.mark.parametrize("row", TO_IGTL, ids=lambda row: f"{row.message.__name__}-{row.igtl_type}")
def test_ros_in(row: IgtlRow) -> None:
    kind = row.message.TYPE
    config = Config(to_igtl=(ToIgtlRow(topic="/t", device="Name with a length above 20", type=row.igtl_type),))

    @given(st.lists(strategies.packed(kind), min_size=1, max_size=3))
    def run(inputs: list[bytes]) -> None:
        session = opened(config)
        for data in inputs:
            entries = session.input(NOW_NS, Kind.ROS_IN, (data,), channel="/t", type_name=kind)
            counts = session.gateway.ledger.to_dict()["ros_in"]["/t"]
            assert len(entries) > 1 or counts["dropped"]  # an answer or a reason, never nothing
            check(entries)

    run()


def test_every_ros_type_is_covered() -> None:
    assert set(CLASSES) <= {*strategies.ros_messages(), *strategies.STRUCTS}


def test_a_defect_would_be_seen() -> None:
    """The check above can fail."""
    note = Note(Level.ERROR, "internal_error", "lost").pack()
    with pytest.raises(AssertionError, match="lost"):
        check([Entry(1, 1, Kind.NOTE, payload=(note,))])
