"""Device names ⇄ tokens of topics ⇄ frames.

An OpenIGTLink stream has one name of at most 20 bytes.  In ROS it has a topic and frame ids, in a session file a
channel.  ``topic_token`` is the rule for topics and channels.  By the convention of PLUS, a transform named ``AToB``
transforms coordinates from A to B; in tf this is parent ``B`` and child ``A``.
"""

from __future__ import annotations

import re
import zlib

from igtl_gateway.wire.fields import cut_text

MAX_DEVICE_NAME = 20

#: Token and frame of a device without a name.
UNNAMED = "unnamed"

#: rmw rejects topics of more than 247 characters; about half of that remains for the rest of the topic.
MAX_TOKEN = 120
_NOT_IN_TOKEN = re.compile(r"[^A-Za-z0-9_]")
#: A name of two frames and what divides it, searched in this order: one expression for both is quadratic.
_WORD = re.compile(r"[A-Za-z0-9_]+\n?")
#: ``To`` between a name and one that starts with a capital letter or, as PLUS divides it, a digit; before, a letter.
_TO, _TO_CAPITAL = re.compile(r"To(?=[A-Z0-9])"), re.compile(r"To(?=[A-Z])")
#: From this version of the rules of names on, see ``Config.naming``, names are divided and completed as PLUS does it.
AS_PLUS = 2


def topic_token(name: str) -> str:
    """Return ``name`` as one token of a topic: each other character becomes ``_``, and a ``_`` precedes a digit.

    If the name is too long (names in metadata have no limit), the token is its beginning and its hash.
    """
    token = _NOT_IN_TOKEN.sub("_", name[:MAX_TOKEN]) or UNNAMED
    if len(name) > MAX_TOKEN:
        token = f"{token[: MAX_TOKEN - 5]}_{name_hash(name)}"
    return f"_{token}" if token[0].isdigit() else token


def frames_of(name: str, base_frame: str, naming: int = AS_PLUS) -> tuple[str, str]:
    """Return (parent, child) frame of a transform: (B, A) for ``AToB``; any other name is a child of the base frame.

    ``naming``: version of the rules, see ``Config.naming``.
    """
    divides = _TO if naming >= AS_PLUS else _TO_CAPITAL
    if _WORD.fullmatch(name) and (found := divides.search(name, 1)):
        return name[found.end() :].removesuffix("\n"), name[: found.start()]
    return base_frame, name or UNNAMED


def frames_of_name(name: str, base_frame: str, naming: int = AS_PLUS) -> tuple[str, str]:
    """Return (parent, child) frame of a device or tool with any name; names that differ in signs can have the same."""
    return frames_of(topic_token(name), base_frame, naming)


def frame_token(name: str) -> str:
    """Return a frame in a part of a name with the characters that ``frames_of_name`` gives it."""
    return _NOT_IN_TOKEN.sub("_", name)


def name_hash(name: str) -> str:
    """Return four hexadecimal digits that depend only on the name."""
    return f"{zlib.crc32(name.encode('utf-8', 'surrogateescape')) & 0xFFFF:04x}"


def short_device_name(name: str) -> str:
    """Return ``name`` if it has at most 20 bytes, else its beginning, ``_`` and four hexadecimal digits of its hash."""
    if len(name.encode("utf-8", "surrogateescape")) <= MAX_DEVICE_NAME:
        return name
    return f"{cut_text(name, MAX_DEVICE_NAME - 5)}_{name_hash(name)}"
