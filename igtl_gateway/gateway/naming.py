"""Names that two things share: frames on /tf, devices of two peers, topics and devices of two streams.

A mapping of names either keeps different names apart, or a note names which ones it does not.  Frames are kept apart by
the rule of topics: of the names that differ only in characters that a frame does not have, the first keeps the frame,
and each other one gets its hash behind it.  What shares a name because its senders chose so cannot be kept apart here:
two peers with one device, two parents of one frame.  All of this depends on the inputs and their order alone, and
``Config.naming`` switches it off for recordings that are older than it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from igtl_gateway.config.configuration import NAMING
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.convert.names import MAX_DEVICE_NAME, frames_of_name, name_hash, short_device_name
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.wire.fields import visible

#: Codes of the notes.
FRAME_RENAMED, FRAME_SHARED, NAME_SHARED, NAME_CUT = "frame_renamed", "frame_shared", "name_shared", "name_cut"
#: Maximum number of names, and of frames, that are compared; a peer may invent any.
MAX_NAMES = 10_000


class FrameNames:
    """The frames of devices and tools, one for each name.

    Args:
        naming: version of the rules of names, see ``Config.naming``.

    Attributes:
        news: findings about names that are not reported yet.
    """

    def __init__(self, naming: int = NAMING) -> None:
        self.news: list[Finding] = []
        self._naming = naming
        self._owners: dict[tuple[str, str], str] = {}  # parent and child → the name that they belong to

    def of(self, name: str, base_frame: str, *, keep: bool = True) -> tuple[str, str]:
        """Return (parent, child) frame of a device or tool, as ``frames_of_name``, or a child frame of its own.

        ``keep``: it has the frame from now on.
        """
        parent, child = wanted = frames_of_name(name, base_frame, self._naming)
        while (owner := self._owners.get((parent, child), name)) != name:
            child = f"{child}_{name_hash(name)}"
        if not keep or (parent, child) in self._owners or len(self._owners) >= MAX_NAMES:
            return parent, child
        self._owners[parent, child] = name
        if child != wanted[1]:
            owner = self._owners[wanted]
            text = f"{name!r} gets the frame {child!r}: {wanted[1]!r} in {parent!r} belongs to {owner!r}"
            self.news.append(Finding(Level.WARN, FRAME_RENAMED, text, data={"name": name, "frame": child}))
        return parent, child


class SharedNames:
    """Finds the names that several senders use at the same time.

    Args:
        peers: those that are connected.
    """

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        self._streams = _Senders()
        self._frames = _Senders()

    def knows(self, stream: str, link: int) -> bool:
        """Return whether a stream came from a link before."""
        return self._streams.knows(stream, link, "")

    def stream(self, stream: str, link: int, topics: tuple[str, ...] = ()) -> list[Finding]:
        """Return the finding for the first message of a stream from a link while another link sends it, too."""
        others = self._streams.before(stream, link, "")
        if not others:
            return []
        links = [*(one for one, _ in others), link]
        senders = " and ".join(map(self._sender, links))
        text = f"{stream} comes from {senders}: their messages share one topic and one frame"
        data = {"links": links, "topics": list(topics)}
        return [Finding(Level.WARN, NAME_SHARED, text, stream, tuple(links), data=data)]

    def frames(self, message: TFMessage, stream: str, link: int) -> Iterator[Finding]:
        """Yield a finding for each frame that has another parent, or another sender, than before."""
        for one in message.transforms:
            parent, child = frame_id(one.header.frame_id), frame_id(one.child_frame_id)
            others = self._frames.before(child, link, f"{parent}\0{stream}")
            if not others:
                continue
            places = [(known, *text.split("\0", 1)) for known, text in others]
            # a tool that one peer sends in two ways is one tool; two peers with one stream have their own finding
            if why := [(its, at) for known, its, at in places if its != parent or (known != link and at != stream)]:
                text = " and ".join(f"in {its!r} by {at}" for its, at in (*why, (parent, stream)))
                text = f"frame {child!r} is sent {text}: on /tf a frame has one parent, and the last message wins"
                yield Finding(Level.WARN, FRAME_SHARED, text, stream, (link,), data={"frame": child})

    def on_link_down(self, link: int) -> None:
        """Forget the sender of a closed link: who connects again is no second sender."""
        self._streams.forget(link)
        self._frames.forget(link)

    def _sender(self, link: int) -> str:
        peer = self._peers.get(link)
        return f"link {link}" + (f" ({peer.address})" if peer and peer.address else "")


class _Senders:
    """Who sends what: links, each with a string, by name.

    A sender is looked up at its first message only, because later ones take the fast path: so none is forgotten while
    its link is open, and above the limit no further one is ever added.
    """

    def __init__(self) -> None:
        self._known: dict[str, list[tuple[int, str]]] = {}
        self._of_link: dict[int, set[str]] = {}
        self._count = 0

    def knows(self, name: str, link: int, text: str) -> bool:
        """Return whether a name has this sender."""
        return (link, text) in self._known.get(name, ())

    def before(self, name: str, link: int, text: str) -> list[tuple[int, str]]:
        """Return the other senders of a name, and add this one; nothing if it is known, or there are too many."""
        if self.knows(name, link, text) or self._count >= MAX_NAMES:
            return []
        known = self._known.get(name, ())
        self._count += 1
        self._known[name] = [*known, (link, text)]
        self._of_link.setdefault(link, set()).add(name)
        return list(known)

    def forget(self, link: int) -> None:
        """Remove what a link has sent."""
        for name in self._of_link.pop(link, ()):
            self._known[name] = [sender for sender in self._known[name] if sender[0] != link]
            if not self._known[name]:
                del self._known[name]


class ShownNames:
    """The device names of what peers get in place of messages that they do not read.

    Each has its own: one that a stream to peers has is not used a second time.

    Args:
        is_taken: returns whether a stream to peers, TYPE/device, is another one.
    """

    def __init__(self, is_taken: Callable[[str], bool]) -> None:
        self._is_taken = is_taken
        self._owners: dict[str, str] = {}  # stream → the one that it is shown in place of

    def of(self, igtl_type: str, name: str, source: str) -> tuple[str, str]:
        """Return device and full name for ``name`` of what is sent in place of a message of the stream ``source``."""
        full_name = name
        while True:
            device = short_device_name(full_name)
            stream = f"{igtl_type}/{device}"
            if self._owners.get(stream, source) == source and not self._is_taken(stream):
                break
            full_name = f"{full_name}_{name_hash(source + full_name)}"
        if len(self._owners) < MAX_NAMES:
            self._owners[stream] = source
        return device, full_name


def cut_name(stream: str, device: str, *, known: bool) -> list[Finding]:
    """Return the finding for a device name that its sender may have cut; ``known``: the full name is known."""
    if known or len(device.encode("utf-8", "surrogateescape")) < MAX_DEVICE_NAME:
        return []
    text = (
        f"the device name {visible(device)!r} fills its {MAX_DEVICE_NAME} bytes: "
        "if its sender has cut it, topics and frames have the cut name, and a second one that begins so is the same"
    )
    return [Finding(Level.WARN, NAME_CUT, text, stream, subject=device)]
