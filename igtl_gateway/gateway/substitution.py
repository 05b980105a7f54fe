"""What peers get in place of a message that they do not read: one walk through the table of substitutes.

A row may make messages that a peer does not read either, such as the children of a BIND: these are replaced again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.convert.substitutes import Shown, Substitute
from igtl_gateway.gateway.naming import ShownNames
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.wire import Raw


@dataclass(frozen=True, slots=True)
class Step:
    """A message in place of another one, or why there is none.

    Attributes:
        source: the stream that it replaces, TYPE/device: that of the message, or of an earlier step.
        row: the row of the table.
        shown: the message; None if the row could not make it.
        device, full_name: its name, which no other stream has.
        is_own: whether it has the name of the message.
        readers: the peers that read it.
        left: the peers that do not, and get nothing in its place.
        error: why the row could not make it.
    """

    source: str
    row: Substitute
    shown: Shown | None = None
    device: str = ""
    full_name: str = ""
    is_own: bool = False
    readers: tuple[Peer, ...] = ()
    left: tuple[Peer, ...] = ()
    error: Exception | None = None


def in_place_of(
    message: Shown, source: str, peers: Sequence[Peer], names: ShownNames, *, is_own: bool = True
) -> Iterator[Step]:
    """Yield what peers get in place of a message that none of them reads.

    Args:
        message: type, full name and content.
        source: its stream, TYPE/device.
        peers: those that have a table.
        names: the names that are in use.
        is_own: whether the message itself has the name of the first one.
    """
    groups: dict[int, tuple[Substitute, list[Peer]]] = {}
    for peer in peers:
        if row := peer.instead_of(message.igtl_type):
            groups.setdefault(id(row), (row, []))[1].append(peer)
    for row, members in groups.values():
        try:
            made = row.instead(message.name, message.content)
        except (ConversionError, WireError) as error:
            yield Step(source, row, error=error)
            continue
        for one in made:
            device, full_name = names.of(one.igtl_type, one.name, source)
            readers = tuple(peer for peer in members if peer.may_send(one.igtl_type))
            others = [peer for peer in members if not peer.may_send(one.igtl_type)]
            again = [peer for peer in others if _has_more(peer, one)]
            left = tuple(peer for peer in others if peer not in again)
            own = is_own and one.name == message.name
            yield Step(source, row, one, device, full_name, own, readers, left)
            if again:
                moved = Shown(one.igtl_type, full_name, one.content)
                yield from in_place_of(moved, f"{one.igtl_type}/{device}", again, names, is_own=own)


def _has_more(peer: Peer, message: Shown) -> bool:
    """Return whether a peer gets something in place of a message that it does not read."""
    row = peer.instead_of(message.igtl_type)
    return row is not None and row.show is not None and not isinstance(message.content, Raw)
