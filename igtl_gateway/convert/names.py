"""Device names ⇄ tokens of topics ⇄ frames.

An OpenIGTLink stream has one name of at most 20 bytes; in ROS it has a topic and frame ids, and in a session file a
channel.  ``topic_token`` is the one rule for both.  By the convention of PLUS, a transform named ``AToB`` takes
coordinates of A to B; in tf this is parent ``B`` and child ``A``.
"""

from __future__ import annotations

import re
import zlib

from igtl_gateway.wire.fields import cut_text

MAX_DEVICE_NAME = 20

#: Token and frame of a device without a name.
UNNAMED = "unnamed"

#: rmw refuses topics above 247 characters; half of that leaves room for what stands around the token.
MAX_TOKEN = 120
_NOT_IN_TOKEN = re.compile(r"[^A-Za-z0-9_]")
#: ``To`` between a name that ends in lower case, digit or capital and one that starts with a capital.
_A_TO_B = re.compile(r"^([A-Za-z0-9_]+?)To([A-Z][A-Za-z0-9_]*)$")


def topic_token(name: str) -> str:
    """Return ``name`` as one token of a topic: each other character becomes ``_``, and a ``_`` precedes a digit.

    Of a name that is too long (metadata has no limit) the token is the beginning and the hash of the name.
    """
    token = _NOT_IN_TOKEN.sub("_", name[:MAX_TOKEN]) or UNNAMED
    if len(name) > MAX_TOKEN:
        token = f"{token[: MAX_TOKEN - 5]}_{name_hash(name)}"
    return f"_{token}" if token[0].isdigit() else token


def frames_of(name: str, base_frame: str) -> tuple[str, str]:
    """(parent, child) frame of a transform: ``AToB`` gives (B, A), any other name is a child of the base frame."""
    if match := _A_TO_B.match(name):
        return match[2], match[1]
    return base_frame, name or UNNAMED


def name_hash(name: str) -> str:
    """Four hex digits that depend on nothing but the name."""
    return f"{zlib.crc32(name.encode('utf-8', 'surrogateescape')) & 0xFFFF:04x}"


def short_device_name(name: str) -> str:
    """``name`` in at most 20 bytes: itself, or its beginning with ``_`` and four hex digits of its hash."""
    if len(name.encode("utf-8", "surrogateescape")) <= MAX_DEVICE_NAME:
        return name
    return f"{cut_text(name, MAX_DEVICE_NAME - 5)}_{name_hash(name)}"
