"""An imitation of PlusServer's side of a connection: what it skips, what it does not, and how it answers.

After ``vtkPlusOpenIGTLinkServer::DataReceiverThread`` of PlusLib 112a7f3: a type that its message factory does not know
is logged, and its body is then read as the next header.  The frames are those of ``vtkPlusIgtlMessageFactory``.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.base.buffers import join
from igtl_gateway.wire import Header, Item, Message, encode
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.header import HEADER_SIZE
from igtl_gateway.wire.transform import Transform

#: The factory of OpenIGTLink 3.1 (94244fe) without video, and the types that PLUS adds.
FACTORY = frozenset(
    "CAPABILITY COMMAND GET_IMAGE GET_IMGMETA GET_LBMETA GET_POINT GET_POLYDATA GET_STATUS GET_TRAJ GET_TRANS IMAGE "
    "IMGMETA LBMETA POINT POLYDATA POSITION QTDATA RTS_COMMAND RTS_POLYDATA RTS_QTDATA RTS_TDATA STATUS STP_POLYDATA "
    "STP_QTDATA STP_TDATA STRING STT_POLYDATA STT_QTDATA STT_TDATA TDATA TRAJ TRANSFORM CLIENTINFO TRACKEDFRAME "
    "USMESSAGE".split()
)
#: Bytes of a device name, to which it cuts one; version 2 has the whole name in its metadata.
NAME_SIZE = 20
PLACE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0)


class PlusReceiver:
    """Reads what a client sends, as PlusServer does.

    Attributes:
        read: the types that arrived.
        lost: the first type at which the stream was lost; "" while it is whole.
        version: header version of the answers.
    """

    def __init__(self) -> None:
        self.read: list[str] = []
        self.lost = ""
        self.version = 1

    def receive(self, sent: Iterable[bytes]) -> None:
        for message in sent:
            if self.lost:
                return
            header = Header.unpack(message)
            assert len(message) == HEADER_SIZE + header.body_size
            self.version = max(self.version, header.version)
            if header.type not in FACTORY and header.body_size:
                self.lost = header.type
            else:
                self.read.append(header.type)


def frame(
    number: int, *names: str, version: int = 1, status: str = "OK", ticks_per_frame: int = 1 << 28
) -> list[bytes]:
    """A tracked frame: one TRANSFORM for each name, all with one stamp."""
    ticks = (1_700_000_000 << 32) + number * ticks_per_frame
    metadata = (Item.of("TransformStatus", status), Item.of("TransformValid", str(int(status == "OK"))))
    messages = []
    for name in names:
        whole = (Item.of("IGTL_DEVICE_NAME", name),) if len(name) > NAME_SIZE else ()
        items = (*whole, *metadata) if version > 1 else ()
        messages.append(Message("TRANSFORM", name[:NAME_SIZE], Transform(PLACE), ticks, version, 0, items))
    return [join(encode(message)) for message in messages]


def client_info(*attributes: str) -> str:
    """The text of CLIENTINFO from a device of PLUS that reads from a server."""
    start = " ".join(("<ClientInfo", *attributes))
    return f'{start}>\n  <MessageTypes>\n    <Message Type="TRANSFORM" />\n  </MessageTypes>\n</ClientInfo>\n'


def failed_reply(command_id: int, reason: str) -> bytes:
    """The reply to a command in header version 1, which has no metadata."""
    text = f'<CommandReply Name="StopRecording" Status="FAIL" Error="{reason}" Message=""></CommandReply>'
    return join(encode(Message("RTS_COMMAND", "Plus", Command(command_id, "StopRecording", text.encode()))))
