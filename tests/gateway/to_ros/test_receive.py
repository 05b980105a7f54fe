"""3D Slicer as a peer: its greeting, its names and its queries, recognised or named by a profile."""

from __future__ import annotations

import pytest

from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.substitutes import SLICER_READS
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.query import EmptyQuery, QueryReply, StartTracking
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script
from tests.tables import table

POSE = Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 5.0, 6.0, 7.0))
#: A code of an uninitialised number.
NONSENSE = Status(26_624)
#: What the connector can ask for.
QUERIES = ("GET_IMAGE", "GET_IMGMETA", "GET_LBMETA", "GET_POINT", "STT_TDATA", "STP_TDATA")


def script(version: int = 2, profile: str = "auto") -> Script:
    made = Script(Config(profile=profile, to_igtl=(ToIgtlRow(topic="/ct", device="CT"),)).watched())
    made.up(1, peer="127.0.0.1:1", role="server")
    items = (Item.of("dummy", "dummy"),) if version == 2 else ()
    made.greeted = made.igtl(Message("STATUS", "", NONSENSE, 0, version, 0, items))  # type: ignore[attr-defined]
    return made


@pytest.mark.parametrize("version, profile", [(2, "auto"), (2, "slicer"), (1, "slicer")])
def test_the_greeting_is_no_state_and_no_topic(version: int, profile: str) -> None:
    made = script(version, profile)
    assert made.gateway.profile_of(1) == "slicer"
    assert not [line for line in made.greeted if line.startswith("ros /igtl/in")]  # type: ignore[attr-defined]
    # a later one without a name is a state of what sends it
    lines = made.igtl(Message("STATUS", "", Status(1)))
    assert any(line.startswith("ros /igtl/in/unnamed/") for line in lines)


@table("full", ["A name of 20 bytes..", "A name of 20 bytes, and of more"])
def test_names_that_fill_the_header_are_whole_by_the_metadata(full: str) -> None:
    made = script()
    items = (Item.of("MRMLNodeName", full), Item.of("TransformStatus", "OK"))
    lines = made.igtl(Message("TRANSFORM", full[:20], POSE, 0, 2, 0, items))
    token = "A_name_of_20_bytes" + ("__and_of_more" if len(full) > 20 else "__")
    assert any(line.startswith(f"ros /igtl/in/{token}") for line in lines), lines
    assert "note name_cut" not in lines


@table("name", QUERIES)
@table("with_data", [True, False])
def test_each_query_of_slicer_gets_only_what_it_reads(name: str, with_data: bool) -> None:
    made = script()
    if with_data:
        picture = rosmsg.Image(Header(T0_NS, "camera"), 2, 2, "mono8", 0, 2, bytes(4))
        made.ros("/ct", picture)
        made.ros("/igtl/out/Tool", rosmsg.TransformStamped(Header(T0_NS, "base"), "tool", (0, 0, 0), (0, 0, 0, 1)))
    lines = made.igtl(Message(name, "", StartTracking(0, "") if name == "STT_TDATA" else EmptyQuery()))
    types = [line.split()[1].partition("/")[0] for line in lines if line.startswith("igtl ")]
    assert set(types) <= {*SLICER_READS, "RTS_TDATA"} and types, lines
    assert not [line for line in lines if line.startswith("note ") and "stream" not in line and "query" not in line]


def test_a_text_without_a_name_has_a_topic() -> None:
    assert "ros /igtl/in/unnamed/string" in script().igtl(Message("STRING", "", String.of("x")))


def test_the_reply_to_a_query_for_tracking_data_needs_no_name() -> None:
    lines = script().igtl(Message("RTS_TDATA", "", QueryReply(0)))
    assert not [line for line in lines if line.startswith("note ") and "stream" not in line]
