"""Messages of services and actions: their definitions and hashes, from the files of their service or action."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.base.untrusted.definitions import parse_definition
from igtl_gateway.base.untrusted.derived_types import DerivedType, as_message, messages_of
from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.record.sessionfile.schemas import RosTypes
from tests import exchanges
from tests.tables import table

SUFFIXES = {"srv": ["Event"], "action": ["FeedbackMessage", "SendGoal_Event", "GetResult_Event"]}
OTHERS = [
    "p/msg/A_Event",
    "p/srv/A",
    "p/srv/A_Request",
    "p/srv/A_FeedbackMessage",
    "p/action/A_Event",
    "p/action/A_Goal",
]


@table("ros_type", OTHERS)
def test_other_types_are_not_derived(ros_type: str) -> None:
    assert DerivedType.of(ros_type) is None


def test_a_definition_of_a_file_is_for_the_messages_of_its_topics() -> None:
    assert messages_of("p/srv/S") == ["p/srv/S_Event"]
    assert messages_of("p/action/A") == [f"p/action/A_{each}" for each in SUFFIXES["action"]]
    for other in ("p/msg/M", "p/srv/S_Event", "p/action/A_FeedbackMessage", ""):
        assert messages_of(other) == [other]


#: What stands in a file where the definition of ``p/srv/S_Event`` is expected.
TEXTS = {
    "bare": "bool a\n---\nint64 b\n",
    "rosbag2": f"{RULE}\nSRV: p/srv/S\nbool a\n---\nint64 b\n",
    "with types": f"{RULE}\nSRV: p/srv/S\nbool a\n---\nint64 b\n\n{RULE}\nMSG: builtin_interfaces/msg/Time\n"
    "int32 sec\nuint32 nanosec\n",
    "of Windows": f"{RULE}\r\nSRV: p/srv/S\r\nbool a\r\n---\r\nint64 b\r\n",
    "of the message": as_message("bool a\n---\nint64 b\n", "p/srv/S_Event"),
}


@table("text", TEXTS.values(), ids=TEXTS)
def test_the_text_of_a_service_becomes_that_of_its_events(text: str) -> None:
    made = as_message(text, "p/srv/S_Event")
    _, *others = sorted(get_types_from_msg(made, "p/srv/S_Event"), key="p/srv/S_Event".__ne__)
    needed = {"service_msgs/msg/ServiceEventInfo", "builtin_interfaces/msg/Time"}
    assert {*others} == {"p/msg/S_Request", "p/msg/S_Response", *needed}
    decoded = MessageDecoder({"p/srv/S_Event": made}.get).decode(  # type: ignore[arg-type]
        "p/srv/S_Event", exchanges.event(0, 0, 5, request=b"\1")
    )
    assert (decoded.info.sequence_number, decoded.request[0].a, decoded.response) == (5, True, [])


@table("text", ["", "bool a\n", "a\n---\nb\n---\nc\n", f"{RULE}\nSRV: p/srv/S\nbool a\n"])
def test_text_with_other_parts_stays(text: str) -> None:
    assert as_message(text, "p/srv/S_Event") == text
    assert as_message(text, "p/msg/S") == text


@pytest.mark.skipif(not find_spec("test_msgs"), reason="needs the definitions of ROS 2")
def test_the_hashes_are_those_of_rosidl(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every service and action that is installed, computed from its text alone."""
    share = Path(sys.prefix, "share")
    stated: dict[str, str] = {}
    for place in (*share.glob("*/srv/*.srv"), *share.glob("*/action/*.action")):
        rows = json.loads(place.with_suffix(".json").read_bytes())["type_hashes"]
        hashes = {row["type_name"]: row["hash_string"] for row in rows}
        kind = place.parent.name
        names = [f"{place.parts[-3]}/{kind}/{place.stem}_{suffix}" for suffix in SUFFIXES[kind]]
        stated |= {name: hashes[name] for name in names}
    types = RosTypes()
    assert {name: found.type_hash for name in stated if (found := types.find(name))} == stated
    monkeypatch.setattr(RosTypes, "_stated_hash", lambda *_: "")
    computed = RosTypes()
    assert {name: found.type_hash for name in stated if (found := computed.find(name))} == stated
    assert len(stated) >= 30


_PIECES = st.sampled_from(
    ["---", RULE, "SRV: p/srv/S", "ACTION: p/action/A", "MSG: p/T", "bool a", "p/T t", "---\r", "", "\0"]
)


@given(
    st.lists(_PIECES | st.text(max_size=20), max_size=12),
    st.sampled_from(["p/srv/S_Event", "p/action/A_GetResult_Event"]),
)
def test_any_text_is_a_definition_or_refused(lines: list[str], ros_type: str) -> None:
    text = as_message("\n".join(lines), ros_type)
    with suppress(DamagedRecording):
        parse_definition(text, ros_type)
