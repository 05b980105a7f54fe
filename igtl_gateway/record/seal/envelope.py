"""DSSE envelopes (Dead Simple Signing Envelope) with one signature.

An envelope has one spelling here: :func:`pack`.  A reader that compares with it finds every changed byte, also those
that no signature covers, such as spaces or the name of the key.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.shape import fields, list_of, text
from igtl_gateway.base.untrusted.text import parse_json

#: Media type of an in-toto statement.
PAYLOAD_TYPE = "application/vnd.in-toto+json"

_SHAPE = fields(
    {
        "payload": text,
        "payloadType": text,
        "signatures": list_of(fields({"keyid": text, "sig": text}, needed=("keyid", "sig"))),
    },
    needed=("payload", "payloadType", "signatures"),
)


@dataclass(frozen=True, slots=True)
class Envelope:
    """A payload, the identifier of the key (hexadecimal), and the signature of :func:`signed_bytes`."""

    payload: bytes
    key_id: str
    signature: bytes


def signed_bytes(payload: bytes) -> bytes:
    """Return the bytes that the signature covers: the pre-authentication encoding of DSSE."""
    return b"DSSEv1 %d %s %d %s" % (len(PAYLOAD_TYPE), PAYLOAD_TYPE.encode(), len(payload), payload)


def pack(envelope: Envelope) -> str:
    """Return the envelope as JSON."""
    signature = {"keyid": envelope.key_id, "sig": base64.b64encode(envelope.signature).decode()}
    return json.dumps(
        {
            "payload": base64.b64encode(envelope.payload).decode(),
            "payloadType": PAYLOAD_TYPE,
            "signatures": [signature],
        }
    )


def parse(written: str, place: str) -> Envelope:
    """Parse an envelope; its signature is not checked.  Raises DamagedRecording for another spelling."""
    found = parse_json(written, place)
    _SHAPE(found, place)
    if found["payloadType"] != PAYLOAD_TYPE or len(found["signatures"]) != 1:
        raise DamagedRecording(f"{place}: found another envelope, expected one in-toto statement with one signature")
    try:
        signature = base64.b64decode(found["signatures"][0]["sig"], validate=True)
        envelope = Envelope(
            base64.b64decode(found["payload"], validate=True), found["signatures"][0]["keyid"], signature
        )
    except (binascii.Error, ValueError):
        raise DamagedRecording(f"{place}: found an envelope that is not base64") from None
    if pack(envelope) != written:
        raise DamagedRecording(f"{place}: found an envelope in another spelling than that of igtl-gateway")
    return envelope
