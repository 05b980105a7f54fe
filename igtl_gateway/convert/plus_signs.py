"""The signs of PLUS in messages of header version 1, which has no metadata.

Sources: ``vtkPlusOpenIGTLinkServer``, ``vtkPlusIgtlMessageFactory``, ``vtkPlusOpenIGTLinkDevice`` and
``PlusIgtlClientInfo`` of PlusLib 112a7f3.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.convert.names import AS_PLUS, MAX_DEVICE_NAME, frame_token
from igtl_gateway.wire import Message
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import cut_text
from igtl_gateway.wire.text import String, text_of
from igtl_gateway.wire.tracking import TrackingData

#: Maximum number of messages in which tracked frames are searched; until then, streams of poses are not compiled.
MAX_SEARCHED = 64
#: Number of equal frames that show PLUS: of several messages each, and of a single one.
_FRAMES, _SINGLE_FRAMES = 2, 8
#: After this number of equal frames of a single pose, a client is not searched any more.
_CLIENT_FRAMES = 3

_POSE = re.compile(r"[A-Z][A-Za-z0-9]*To[A-Z][A-Za-z0-9]*")
_PICTURE = re.compile(r"[A-Za-z0-9]+_[A-Za-z0-9]+")
#: Type → form of the device names that PLUS gives it.
_NAMES = {"TRANSFORM": _POSE, "POSITION": _POSE, "IMAGE": _PICTURE}
#: A frame in the name of a picture; digits are a number.  Before ``AS_PLUS``: letters and digits.
_FRAME, _FRAME_BEFORE = re.compile(r"[0-9]*[A-Z].*|[A-Za-z].*", re.DOTALL), re.compile(r"[A-Za-z][A-Za-z0-9]*")
#: A transform of a tracked frame in the metadata of a picture: each has the frames of its name.
_FIELD = re.compile(r"([^\n]+?)To([A-Z0-9][^\n]*?)Transform(?:Status)?")
_REPLY_DEVICE = re.compile(r"ACK_[0-9]{1,10}")


def frame_of_picture(device: str, keys: Iterable[str] = (), naming: int = AS_PLUS) -> str:
    """Return the frame in the name of a picture: ``Tracker`` of ``Image_Tracker``; "" without one.

    PLUS joins the two frames of the transform that it embeds, ``EmbeddedTransformToFrame`` is the second one.  Where
    that has a ``_`` itself, the metadata show it if they name it.

    Args:
        device: of the picture.
        keys: of its metadata, which have the transforms of its tracked frame.
        naming: version of the rules of names, see ``Config.naming``.
    """
    name, _, frame = device.rpartition("_")
    if naming < AS_PLUS:
        return frame if name and _FRAME_BEFORE.fullmatch(frame) else ""
    parts = device.split("_")
    if len(parts) > 2:
        named = {one for key in keys if (found := _FIELD.fullmatch(key)) for one in found.groups()}
        ends = ("_".join(parts[at:]) for at in range(1, len(parts)) if any(parts[:at]))
        if end := next((end for end in ends if end in named), ""):
            return frame_token(end)
    return frame_token(frame) if name and _FRAME.fullmatch(frame) else ""


def whole_tool_names(names: Sequence[str], items: Iterable[tuple[str, str]]) -> list[str]:
    """Return the names of the tools of tracking data as they were before PLUS cut them to 20 bytes.

    Args:
        names: of the tools.
        items: metadata as (key, value); PLUS has the place of each tool under its name and ``Index``.
    """
    whole = list(names)
    for key, value in items:
        name = key.removesuffix("Index")
        place = whole_number(value, len(whole) - 1) if name != key else None
        if (
            place is not None
            and len(name.encode()) > MAX_DEVICE_NAME
            and cut_text(name, MAX_DEVICE_NAME) == names[place]
        ):
            whole[place] = name
    return whole


def is_recent_plus(message: Message) -> bool:
    """Return whether only a PLUS that reads header version 2 can send such a message."""
    content = message.content
    if isinstance(content, ClientInfo):
        return "TDATAResolution=" in text_of(
            content.data, content.encoding
        )  # the name of this attribute is younger than its version 2
    if isinstance(content, TrackingData):
        return message.device_name == f"TDATA_{len(content.elements)}Elem"
    return (
        isinstance(content, Command)
        and message.type == "RTS_COMMAND"
        and _is_reply(text_of(content.data, content.encoding))
    )


def is_any_plus(message: Message) -> bool:
    """Return whether only PLUS, of any release, can send such a message."""
    content = message.content
    if isinstance(content, ClientInfo):
        return True
    return (
        isinstance(content, String)
        and bool(_REPLY_DEVICE.fullmatch(message.device_name))
        and _is_reply(text_of(content.data, content.encoding))
    )


def may_show_plus(message: Message) -> bool:
    """Return whether a later message of this stream may be a sign of PLUS: none of them may pass unseen."""
    return message.type == "STRING" and bool(_REPLY_DEVICE.fullmatch(message.device_name))


def _is_reply(text: str) -> bool:
    return text.startswith("<CommandReply ") and " Status=" in text


@dataclass(slots=True)
class TrackedFrames:
    """Searches for the tracked frames of PLUS: messages with one stamp, in one order, named as ProbeToTracker is.

    Attributes:
        streams: whether the peer is a server: only there, frames of a single pose are a sign.
    """

    streams: bool
    _searched: int = 0
    _ticks: int = 0
    _names: list[str] = field(default_factory=list)
    _before: list[str] = field(default_factory=list)
    _equal: int = 0

    @property
    def is_over(self) -> bool:
        """Whether the search has ended without a result."""
        return self._searched >= MAX_SEARCHED

    def must_see(self, message: Message) -> bool:
        """Return whether later messages of this stream may be parts of a frame; the others are ``passed_over``."""
        form = _NAMES.get(message.type)
        return not self.is_over and (form is _POSE or (form is _PICTURE and bool(form.fullmatch(message.device_name))))

    def passed_over(self, pictures: int) -> None:
        """Count pictures that ``follow`` would only count."""
        self._searched = min(self._searched + pictures, MAX_SEARCHED)

    def follow(self, message: Message) -> bool:
        """Return whether the messages up to this one are frames of PLUS."""
        form = _NAMES.get(message.type)
        if self.is_over or form is None:
            return False
        self._searched += 1
        named = form.fullmatch(message.device_name)
        if not named and form is _PICTURE:  # PLUS takes the name of a picture from its source, if it has one
            return False
        if not named or not message.ticks or message.header_version > 1:
            self._searched = MAX_SEARCHED  # PLUS stamps and names all poses
            return False
        if message.ticks != self._ticks:
            self._end_frame(message.ticks)
        self._names.append(f"{message.type}/{message.device_name}")
        several = len(self._names) > 1 and self._equal + 1 >= _FRAMES and self._names == self._before
        return several or (self.streams and self._equal >= _SINGLE_FRAMES)

    def _end_frame(self, ticks: int) -> None:
        same = bool(self._names) and self._names == self._before and ticks > self._ticks
        self._equal = self._equal + 1 if same else int(bool(self._names))
        if self._equal >= _CLIENT_FRAMES and len(self._names) == 1 and not self.streams:
            self._searched = MAX_SEARCHED
        self._ticks, self._before, self._names = ticks, self._names, []
