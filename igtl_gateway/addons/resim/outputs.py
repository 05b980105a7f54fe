"""What the programs published in a run: written as a session, and digested for the comparison of runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from igtl_gateway.addon import __version__
from igtl_gateway.addon.reading import Entry, Kind, Qos
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.writing import Definition, SessionWriter
from igtl_gateway.addons.resim.goals import numbering
from igtl_gateway.addons.resim.unread import Digest, ledger_of

#: Topics that every node has: kept in the session, but not part of the verdict.
OF_EVERY_NODE = ("/rosout", "/parameter_events")


@dataclass(slots=True)
class OutputStream:
    """A topic that the programs published in a run.

    Attributes:
        topic, type: of it.
        qos: as its publisher offers it.
        messages: their number.
        first_ns, last_ns: session time of the first and the last one, UTC ns.
        digest: SHA-256 of times and bytes, with numbers for goal ids, as hexadecimal digits; set at the end of the run.
    """

    topic: str
    type: str
    qos: Qos
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    digest: str = ""
    sum: hashlib._Hash = field(default_factory=hashlib.sha256, repr=False, compare=False)
    _numbered: Callable[[bytes], bytes] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._numbered = numbering(self.topic)

    def cover(self, time_ns: int, data: bytes) -> None:
        """Have the digest cover a message."""
        data = self._numbered(data)
        self.sum.update(time_ns.to_bytes(8, "little"))
        self.sum.update(len(data).to_bytes(8, "little"))
        self.sum.update(data)

    @property
    def summary(self) -> Digest:
        """What its digest stands for, and the digest."""
        return Digest(self.messages, self.first_ns, self.digest)

    @property
    def kind(self) -> Kind:
        """A ROS topic begins with a slash, an OpenIGTLink stream with its type."""
        return Kind.ROS_IN if self.topic.startswith("/") else Kind.IGTL_IN


class OutputFile:
    """The outputs of a run as a session file: ROS messages that are inputs of a gateway, at their session time.

    The stamp of an entry is the session time at which it was published; of several at one time, each is a nanosecond
    later than the one before it.  Its source stamp is the session time itself.

    Args:
        path: the file to write.
        recording: name of the recording that drove the programs.
        overwrite: replace an existing file.
    """

    def __init__(self, path: Path, recording: str, *, overwrite: bool = False) -> None:
        self.path = path
        self.streams: dict[str, OutputStream] = {}
        self.definitions: dict[str, str] = {}
        self._seq = self._stamp_ns = 0
        facts = {
            "config": json.dumps(Config().to_dict(), sort_keys=True),
            "igtl_gateway_version": __version__,
            "resim_of": recording,
        }
        self._writer = SessionWriter(
            path,
            facts,
            qos_of=lambda topic, _type: self.streams[topic].qos if topic in self.streams else None,
            definition_of=self._definition_of,
            overwrite=overwrite,
        )

    def _definition_of(self, ros_type: str) -> Definition | None:
        """As the program has it; its own text of the feedback of an action is empty: that type is in no file."""
        text = self.definitions.get(ros_type, "")
        return Definition(text.encode()) if text and "/action/" not in ros_type else None

    def add(self, stream: OutputStream, time_ns: int, data: bytes) -> None:
        """Add a message."""
        self._seq += 1
        self._stamp_ns = max(self._stamp_ns + 1, time_ns)
        if not stream.messages:
            stream.first_ns = time_ns
        stream.messages += 1
        stream.last_ns = time_ns
        stream.cover(time_ns, data)
        links = (1,) if stream.kind is Kind.IGTL_IN else ()
        self._writer.write(
            Entry(self._seq, self._stamp_ns, stream.kind, stream.topic, stream.type, (data,), links, time_ns)
        )

    @property
    def count(self) -> int:
        """Messages so far."""
        return self._seq

    def close(self) -> None:
        """Finish the file; idempotent."""
        for stream in self.streams.values():
            stream.digest = stream.sum.hexdigest()
        self._writer.close(ledger_of({name: each.summary for name, each in self.streams.items()}))
