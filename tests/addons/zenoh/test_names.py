"""Keys, tokens, gids and attachments, against vectors whose gids the C++ of rmw_zenoh gave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.zenoh import names
from igtl_gateway.addons.zenoh.names import Entity, Kind, Node, read_attachment, read_token
from igtl_gateway.addons.zenoh.own_node import TypeHashes
from igtl_gateway.base.qos import Qos
from tests.tables import table

VECTORS = json.loads(Path(__file__).with_name("vectors.json").read_text("utf-8"))
_NAME = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,8}){1,4}", fullmatch=True)
_QOS = st.builds(Qos, st.integers(1, 10_000), st.booleans(), st.booleans())


@table("vector", VECTORS["tokens"], ids=lambda vector: f"{vector['kind']} {vector.get('topic', '')}")
def test_tokens_keys_hashes_and_gids_are_those_of_the_vectors(vector: dict[str, Any]) -> None:
    token = vector["token"]
    entity = read_token(token)
    node = entity.node
    assert names.gid(token).hex() == vector["gid"]
    if entity.kind is Kind.NODE:
        assert (node.token(), node.name, node.namespace) == (token, vector["node"], vector["ns"])
        return
    made = node.entity_token(entity.number, entity.kind, entity.topic, entity.type, entity.type_hash, entity.qos)
    assert made == token
    assert entity.key == vector["data_key"]
    assert TypeHashes().of(vector["type"]) == entity.type_hash == vector["hash"]


def test_attachments_are_those_of_the_vectors() -> None:
    found = VECTORS["attachment"]
    values = found["sequence"], found["source_timestamp_ns"], bytes.fromhex(found["gid"])
    assert names.attachment(*values).hex() == found["hex"]
    assert read_attachment(bytes.fromhex(found["hex"])) == values


@given(st.binary(max_size=64))
def test_an_attachment_is_read_or_refused(found: bytes) -> None:
    try:
        sequence, stamp_ns, gid = read_attachment(found)
    except ValueError:
        assert len(found) != names.ATTACHMENT_BYTES or found[16] != 16
    else:
        assert names.attachment(sequence, stamp_ns, gid) == found


@given(
    _NAME, _NAME | st.just("/"), _QOS, st.sampled_from([Kind.PUBLISHER, Kind.SUBSCRIPTION, Kind.SERVER, Kind.CLIENT])
)
def test_tokens_round_trip(topic: str, namespace: str, qos: Qos, kind: Kind) -> None:
    node = Node(7, "ab12", 0, "node", namespace)
    token = node.entity_token(3, kind, topic, "std_msgs/msg/String", "RIHS01_" + 64 * "0", qos)
    expected = Entity(node, 3, kind, topic, "std_msgs/msg/String", "RIHS01_" + 64 * "0", qos)
    assert read_token(token) == expected
    assert read_token(f"{token}/backends:cuda:1;") == expected  # of later releases


@given(st.text("@ros2_lv/7aNMPS%:,_x0 é\n*", max_size=80) | st.text(max_size=80))
def test_a_hostile_token_is_refused_with_a_reason(token: str) -> None:
    for text in (token, f"{names.SPACE}/{token}", f"{names.SPACE}/7/ab/0/1/MP/%/%/n/{token}"):
        with pytest.raises(ValueError, match=r"."):
            read_token(text)


def test_an_endless_token_is_refused() -> None:
    with pytest.raises(ValueError, match="2048 at most"):
        read_token(f"{names.SPACE}/7/ab/0/0/NN/%/%/{'n' * 10_000}")


@table("topic", ["", "/", "chatter", "/a/*", "/a//b", "/a/$x", "/@adv", "/é", "/a b", "/a\n", "/a/"])
def test_names_that_mean_something_in_a_key_are_refused(topic: str) -> None:
    with pytest.raises(ValueError, match="found the topic"):
        names.data_key(0, topic, "std_msgs/msg/String", "RIHS01_" + 64 * "0")
