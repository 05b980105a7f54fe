"""The jobs of the programs of a measurement."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from igtl_gateway.base.versions import Self
from igtl_gateway_lab.bench.cases import BenchStream, Direction


@dataclass(frozen=True, slots=True)
class JobStream:
    """A stream that a program sends or receives.

    Attributes:
        stream: which.
        direction: which way it goes through the gateway; without a gateway, whose bytes it is.
        topic: where, in ROS.
        count: messages to send; 0: for ``seconds``.
        client: the client that receives it, if a program has several.
        window: of a flood, how many messages may be on their way; 0: any number.
        progress: file with the last received number, see ``window``.
    """

    stream: BenchStream
    direction: Direction
    topic: str
    count: int = 0
    client: int = 0
    window: int = 0
    progress: str = ""

    @property
    def device(self) -> str:
        return self.stream.device(self.direction)

    @property
    def key(self) -> str:
        """The name of the columns of received messages."""
        return f"{self.device}#{self.client}" if self.client else self.device


@dataclass(frozen=True, slots=True)
class Job:
    """The job of a program.

    Attributes:
        side: ``"ros"`` or ``"igtl"``, or a peer on the side of OpenIGTLink, see ``peers``.
        name: of the node.
        sends: streams to send.
        ``hears``: streams to receive.
        seconds: how long to send what has no count.
        times: file to write times into.
        address: of the gateway, for OpenIGTLink.
        listen: be a server there instead.
        zenoh: endpoint of the router, for ROS over Zenoh; "": over DDS.
        native: library with the native loops, see ``probe``; "": those in Python.
    """

    side: str
    name: str
    sends: tuple[JobStream, ...]
    hears: tuple[JobStream, ...]
    seconds: float
    times: str
    address: tuple[str, int] = ("127.0.0.1", 0)
    listen: bool = False
    native: str = ""
    zenoh: str = ""

    def to_json(self) -> str:
        return json.dumps(asdict(self), default=lambda value: value.value)

    @classmethod
    def from_json(cls, text: str) -> Self:
        values = json.loads(text)
        for name in ("sends", "hears"):
            values[name] = tuple(
                JobStream(BenchStream(**part.pop("stream")), Direction(part.pop("direction")), **part)
                for part in values[name]
            )
        values["address"] = tuple(values["address"])
        return cls(**values)
