"""DSSE envelopes: one spelling, and each other one is refused; the bytes that a signature covers."""

from __future__ import annotations

import base64
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.seal.envelope import PAYLOAD_TYPE, Envelope, pack, parse, signed_bytes
from tests.tables import table

ONE = Envelope(b'{"a":1}', "0123456789abcdef", b"\xff" * 64)
TEXT = pack(ONE)


@given(st.builds(Envelope, st.binary(max_size=40), st.text(max_size=20), st.binary(max_size=70)))
def test_what_was_packed_is_read(envelope: Envelope) -> None:
    text = pack(envelope)
    assert text.isascii()
    assert parse(text, "here") == envelope
    found = json.loads(text)
    assert base64.b64decode(found["payload"]) == envelope.payload
    assert found["payloadType"] == PAYLOAD_TYPE == "application/vnd.in-toto+json"
    assert [base64.b64decode(each["sig"]) for each in found["signatures"]] == [envelope.signature]


def test_what_a_signature_covers_is_the_encoding_of_the_standard() -> None:
    """DSSE: "DSSEv1", then length and text of type and payload, with a space between them."""
    assert signed_bytes(b"hello world") == b"DSSEv1 28 application/vnd.in-toto+json 11 hello world"
    assert signed_bytes(b"") == b"DSSEv1 28 application/vnd.in-toto+json 0 "


@given(st.integers(0, len(TEXT) - 1), st.integers(1, 127))
def test_every_changed_byte_is_refused_or_another_envelope(at: int, change: int) -> None:
    changed = TEXT[:at] + chr(ord(TEXT[at]) ^ change) + TEXT[at + 1 :]
    try:
        found = parse(changed, "here")
    except DamagedRecording as error:
        assert str(error).startswith("here")
    else:
        assert found != ONE and pack(found) == changed


def spelled(**changes: object) -> str:
    return json.dumps(json.loads(TEXT) | changes)


@table(
    ("text", "reason"),
    [
        ("", "here: found invalid JSON"),
        ("[]", "here: found [], expected an object"),
        ("{}", "here: found no field 'payload', expected one"),
        (spelled(payload=5), "here.payload: found 5, expected a string"),
        (spelled(signatures=[{"keyid": "a"}]), "here.signatures[0]: found no field 'sig', expected one"),
        (spelled(payloadType="text/plain"), "here: found another envelope, expected one in-toto statement with one"),
        (spelled(signatures=[]), "here: found another envelope"),
        (spelled(signatures=json.loads(TEXT)["signatures"] * 2), "here: found another envelope"),
        (spelled(payload="a"), "here: found an envelope that is not base64"),
        (spelled(payload="YQ==*"), "here: found an envelope that is not base64"),
        (spelled(payload="ä==="), "here: found an envelope that is not base64"),
        (spelled(signatures=[{"keyid": "a", "sig": "*"}]), "here: found an envelope that is not base64"),
        (spelled(more=1), "here: found an envelope in another spelling than that of igtl-gateway"),
        (TEXT + " ", "in another spelling"),
        (TEXT.replace(": ", ":"), "in another spelling"),
        (TEXT.replace("payloadType", "payload\\u0054ype"), "in another spelling"),
        (spelled(payload="YR=="), "in another spelling"),  # bits behind the last byte
        (spelled(signatures=[{"sig": "", "keyid": ""}]), "in another spelling"),  # another order
    ],
)
def test_another_spelling_is_refused(text: str, reason: str) -> None:
    with pytest.raises(DamagedRecording) as error:
        parse(text, "here")
    assert reason in str(error.value)
