"""The layout: text, topics, quality of service, metadata, and CDR that an independent library reads alike."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.names import topic_token
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import LayoutError, WireTopics


@pytest.fixture(scope="module")
def store() -> Typestore:
    """rosbags, knowing our types from their text."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in layout.OWN_TYPES.items():
        store.register(get_types_from_msg(text, name))
    return store


# --- text ------------------------------------------------------------------------------------------------------


@given(st.text() | st.binary().map(lambda data: data.decode("utf-8", "surrogateescape")))
def test_escaped_text_is_a_ros_string_and_comes_back(text: str) -> None:
    escaped = layout.escape(text)
    assert "\0" not in escaped
    escaped.encode()  # no lone surrogates left
    assert layout.unescape(escaped) == text


@pytest.mark.parametrize(
    ("text", "escaped"),
    [("Probe", "Probe"), ("Größe", "Größe"), ("a\0b", r"a\u0000b"), ("\udcff", r"\udcff"), ("a\\b", r"a\\b")],
)
def test_only_what_must_be_escaped_is(text: str, escaped: str) -> None:
    assert layout.escape(text) == escaped


# --- topics ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ProbeToTracker", "Probe--Tip", "__probe__", "2nd", "", "Größe", "///"])
def test_a_device_has_one_token_in_the_file_and_in_ros(name: str) -> None:
    topic = WireTopics().topic(Kind.IGTL_IN, "TRANSFORM", name)
    assert topic == f"/igtl_gateway/wire/in/transform/{topic_token(name)}"


@given(st.lists(st.tuples(st.sampled_from([Kind.IGTL_IN, Kind.IGTL_OUT]), st.text(max_size=5), st.text(max_size=5))))
def test_topics_are_valid_distinct_and_stable(streams: list[tuple[Kind, str, str]]) -> None:
    topics, again = WireTopics(), WireTopics()
    given_topics = [topics.topic(*stream) for stream in streams]
    assert [again.topic(*stream) for stream in streams] == given_topics
    assert len({topic.lower() for topic in given_topics}) == len({(k, f"{t}/{d}") for k, t, d in streams})
    for topic, (kind, _, _) in zip(given_topics, streams, strict=True):
        assert topic.startswith(layout.WIRE_TOPICS[kind] + "/")
        assert all(topic_token_is_valid(token) for token in topic[1:].split("/"))


def topic_token_is_valid(token: str) -> bool:
    """ROS 2's rule for a token of a topic name."""
    return re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", token) is not None


def test_names_that_meet_after_sanitising_get_numbers() -> None:
    topics = WireTopics()
    names = [topics.topic(Kind.IGTL_IN, "STRING", name).rpartition("/")[2] for name in ("a-b", "a b", "A_b", "a_b_2")]
    assert names == ["a_b", "a_b_2", "A_b_3", "a_b_2_2"]


def test_a_peer_that_invents_names_gets_one_shared_channel() -> None:
    topics = WireTopics()
    streams = layout.MAX_WIRE_STREAMS
    for number in range(streams):
        assert topics.topic(Kind.IGTL_IN, "STRING", f"n{number}") not in layout.SHARED_TOPICS
    assert topics.topic(Kind.IGTL_IN, "STRING", "one more") == "/igtl_gateway/wire/in/other"
    assert topics.topic(Kind.IGTL_IN, "STRING", "n0") == "/igtl_gateway/wire/in/string/n0"
    assert topics.topic(Kind.IGTL_OUT, "STRING", "one more") == "/igtl_gateway/wire/out/string/one_more"


# --- quality of service ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize("reliable", [False, True])
def test_qos_round_trip_and_as_rosbags_reads_it(reliable: bool, latched: bool) -> None:
    qos = Qos(depth=7, reliable=reliable, latched=latched)
    text = layout.qos_yaml(qos)
    assert layout.parse_qos_yaml(text) == qos
    (parsed,) = parse_qos(text)
    assert parsed.depth == 7
    assert parsed.history.name == "KEEP_LAST"
    assert parsed.reliability.name == ("RELIABLE" if reliable else "BEST_EFFORT")
    assert parsed.durability.name == ("TRANSIENT_LOCAL" if latched else "VOLATILE")


def test_qos_of_older_rosbag2_in_numbers() -> None:
    text = "- history: 3\n  depth: 0\n  reliability: 2\n  durability: 1\n  deadline:\n    sec: 2147483647"
    assert layout.parse_qos_yaml(text) == Qos(depth=Qos().depth, reliable=False, latched=True)


@pytest.mark.parametrize("text", ["", "[]", "- depth: 5", "nonsense"])
def test_no_qos(text: str) -> None:
    assert layout.parse_qos_yaml(text) is None


# --- metadata --------------------------------------------------------------------------------------------------


def test_sealed_metadata_opens_and_shows_damage() -> None:
    sealed = layout.seal({"b": "2", "a": "ü"})
    assert layout.unseal(sealed) == {"a": "ü", "b": "2"}
    for key in sealed:
        with pytest.raises(LayoutError, match="checksum"):
            layout.unseal({**sealed, key: sealed[key] + "x"})
        with pytest.raises(LayoutError, match="checksum"):
            layout.unseal({name: value for name, value in sealed.items() if name != key})


def test_a_command_line_with_undecodable_bytes_can_be_sealed() -> None:
    sealed = layout.seal({"command": "bridge \udcff"})
    assert layout.unseal(sealed)["command"].encode() == rb"bridge \udcff"
